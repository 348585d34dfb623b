/** Dialogs: one at a time, with the browser's focus handling. */

import { onToken, roleOf, setToken } from "./api.js";
import { button, byId, el, faultText } from "./dom.js";

let asking = null;
let end = () => {};

/** Opens the dialog; the promise resolves when it is closed. Esc closes it unless `isHeld()`. */
export function openDialog(title, content, buttons, { isHeld = () => false, kind = "", focus = null } = {}) {
  const dialog = byId("dialog");
  closeDialog();
  const heading = el("h2", { id: "dialog-title", text: title });
  const close = button("", () => isHeld() || closeDialog(), { kind: "quiet only", drawing: "close", label: "Close" });
  dialog.className = kind;
  dialog.replaceChildren(
    el("header", {}, heading, close),
    el("div", { class: "scroll" }, content),
    el("footer", {}, buttons),
  );
  dialog.oncancel = (event) => {
    if (isHeld()) event.preventDefault();
  };
  return new Promise((resolve) => {
    const back = document.activeElement;
    end = () => {
      end = () => {};
      dialog.replaceChildren();
      if (back?.isConnected) back.focus({ preventScroll: true });
      resolve();
    };
    dialog.onclose = () => dialog.open || end();
    dialog.showModal();
    (focus ?? dialog.querySelector("footer .strong") ?? close).focus();
  });
}

/** Closes it at once: the browser's event arrives when another dialog may be open. */
export function closeDialog() {
  byId("dialog").close();
  end();
}

/** Asks for the token. Simultaneous calls share one dialog. */
function askForToken() {
  asking ??= ask().finally(() => {
    asking = null;
  });
  return asking;
}

async function ask() {
  let isDone = false;
  const field = el("input", { type: "password", id: "token", autocomplete: "current-password", required: true });
  const fault = faultText();
  const form = el(
    "form",
    {
      id: "token-form",
      on: {
        submit: async (event) => {
          event.preventDefault();
          const token = field.value.trim();
          try {
            if ((await roleOf(token)) === null) fault.textContent = "The token is not valid for this service.";
            else {
              setToken(token);
              isDone = true;
              closeDialog();
            }
          } catch (error) {
            fault.textContent = error.message;
          }
          field.select();
        },
      },
    },
    el("p", { text: "This service requires a token. The browser keeps it until this tab is closed." }),
    el("label", { for: "token", text: "Token" }),
    field,
    fault,
  );
  const enter = el("button", { type: "submit", form: "token-form", class: "button strong", text: "Sign in" });
  while (!isDone) await openDialog("Sign in", form, [enter], { kind: "small", isHeld: () => !isDone, focus: field });
}

onToken(askForToken);

/** Shows the keyboard shortcuts. */
export function showKeys() {
  const keys = [
    ["/", "search"],
    ["↑ ↓, Page Up, Page Down, Home, End", "move in the table"],
    ["Enter", "edit the value; stage what was edited"],
    ["Esc", "leave: the editor, the details, the search"],
    ["Space or →", "all that is known of the parameter"],
    ["d", "take the default"],
    ["t", "take the value that is compared with"],
    ["u", "drop the change of the parameter"],
    ["Ctrl Enter", "review what is to be sent"],
    ["Ctrl Z", "undo what was sent last, after a review"],
    ["?", "this list"],
  ];
  const list = el(
    "dl",
    { class: "keys" },
    keys.flatMap(([key, text]) => [el("dt", {}, el("kbd", { text: key })), el("dd", { text })]),
  );
  return openDialog("Keys", list, [button("Close", closeDialog, { kind: "strong" })]);
}
