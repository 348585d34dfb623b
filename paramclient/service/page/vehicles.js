/** Vehicles and their states: the list, the status line, and the actions. */

import { at, download, request } from "./api.js";
import { announce, button, byId, choice, el, faultText, nothing, setText } from "./dom.js";
import { chooseOther } from "./compare.js";
import { closeDialog, openDialog } from "./dialogs.js";
import { nameOf } from "./review.js";
import { keyOf, store } from "./store.js";
import { many, span } from "./values.js";

const STATES = {
  new: "no parameters yet",
  cached: "from the cache, not confirmed",
  partial: "not complete",
  synced: "up to date",
  fetching: "fetching",
  lost: "lost",
};
/** Timeout in milliseconds for fetching a table, over a slow radio too. */
const FETCH_TIMEOUT = 900_000;
/** Timeout in milliseconds for metadata: 100 kB at 2 kB per second. */
const DESCRIPTION_TIMEOUT = 300_000;
/** Timeout in milliseconds for saving a table that must be fetched first. */
const SAVE_TIMEOUT = 180_000;
const FORMATS = [
  ["qgc", "QGroundControl", ".params"],
  ["parm", "MAVProxy, ArduPilot", ".parm"],
  ["mission-planner", "Mission Planner", ".param"],
  ["pck", "Packed file of a vehicle", ".pck"],
  ["json", "paramclient, JSON", ".json"],
];
const KINDS = { new: "idle", cached: "warn", partial: "warn", synced: "good", fetching: "busy", lost: "bad" };
const LINK_PROBLEMS = { failed: "link failed", opening: "link opening", ended: "end of the log" };

/** Returns the state of a component in words, and the kind of its dot. */
export function stateOf(component) {
  const link = component.link_state;
  if (link !== "open") return { text: LINK_PROBLEMS[link] ?? link, kind: link === "ended" ? "idle" : "bad" };
  if (component.fetch) return { text: progressText(component.fetch), kind: "busy" };
  return { text: STATES[component.state] ?? component.state, kind: KINDS[component.state] ?? "idle" };
}

function progressText(fetch) {
  const { received, total, seconds_left: left } = fetch;
  return `fetching${total ? ` ${received} of ${total}` : ""}${left === null || left === undefined ? "" : `, ${span(left)} left`}`;
}

export function drawVehicles() {
  const components = [...store.components.values()].sort(
    (a, b) => a.system - b.system || a.component - b.component || (a.link < b.link ? -1 : 1),
  );
  drawList(byId("vehicles"), components);
  if (!components.length) byId("vehicles").append(nothing("None found yet."));
  drawChoice(components);
  drawVehicle(store.component);
}

function drawList(list, components) {
  const had = new Map([...list.children].map((item) => [item.dataset.key, item]));
  const items = components.map((component) => {
    const key = keyOf(component);
    const item =
      had.get(key) ??
      el(
        "li",
        { data: { key } },
        el(
          "button",
          { type: "button", class: "vehicle", on: { click: () => store.select(key).catch(showError) } },
          el("i", { class: "dot" }),
          el("b"),
          el("small"),
        ),
      );
    const [choose] = item.children;
    const [dot, name, remark] = choose.children;
    const state = stateOf(component);
    setText(name, nameOf(component));
    setText(remark, `${component.is_armed ? "armed · " : ""}${state.text} · ${component.link}`);
    dot.className = `dot ${component.is_armed ? "bad" : state.kind}`;
    choose.classList.toggle("chosen", key === store.selected);
    if (key === store.selected) choose.setAttribute("aria-current", "true");
    else choose.removeAttribute("aria-current");
    return item;
  });
  if (items.length !== list.children.length || items.some((item, place) => list.children[place] !== item))
    list.replaceChildren(...items);
}

function drawChoice(components) {
  const choice = byId("vehicle-choice");
  const wanted = components.map((each) => [keyOf(each), nameOf(each)]);
  if (JSON.stringify(wanted) !== choice.dataset.shown) {
    choice.dataset.shown = JSON.stringify(wanted);
    choice.replaceChildren(...wanted.map(([value, text]) => el("option", { value, text })));
  }
  choice.hidden = !wanted.length;
  choice.value = store.selected ?? "";
}

function drawVehicle(component) {
  byId("vehicle").hidden = !component;
  document.title = component ? `${nameOf(component)} – parameters` : "Parameters";
  if (!component) return;
  const state = stateOf(component);
  setText(byId("title"), nameOf(component));
  const badges = [[state.kind, state.text], component.is_armed && ["armed", "ARMED"]].filter(Boolean);
  const shown = JSON.stringify(badges);
  if (byId("badges").dataset.shown !== shown) {
    byId("badges").dataset.shown = shown;
    byId("badges").replaceChildren(...badges.map(([kind, text]) => el("span", { class: `badge ${kind}`, text })));
  }
  const { kind, firmware, link, count } = component;
  const parts = [kind, firmware, link, count && many(count, "parameter")];
  setText(byId("subtitle"), parts.filter(Boolean).join(" · "));
  drawFetch(component);
}

function drawFetch(component) {
  const { fetch } = component;
  byId("fetching").hidden = !fetch;
  if (!fetch) return;
  const meter = byId("meter");
  if (fetch.total) meter.value = Math.min(1, fetch.received / fetch.total);
  else meter.removeAttribute("value");
  const pace = fetch.rate ? `, ${Math.round(fetch.rate)} a second` : "";
  setText(byId("meter-text"), `${progressText(fetch)}${pace}`);
}

/** Returns the actions of a vehicle, created once for each role and kind. */
export function drawActions() {
  const actions = [
    button("Compare", () => chooseOther(), { drawing: "compare" }),
    button("Save", shown(save), { drawing: "save" }),
    button("Load descriptions", shown(describe), { drawing: "help", id: "describe", hidden: true }),
    store.mayWrite &&
      button("Snapshot", shown(keepState), { drawing: "keep", label: "Snapshot: record the current values for a later restore" }),
    button("Fetch", shown(fetchAll), { drawing: "refresh", label: "Fetch all parameters from the vehicle" }),
  ];
  byId("actions").replaceChildren(...actions.filter(Boolean));
  byId("meter-cancel").replaceChildren(button("Stop", stopFetch, { kind: "quiet" }));
  setText(byId("role"), store.mayWrite ? "" : "read-only");
  offerDescriptions();
}

/** Offers to load metadata from the vehicle if there is none. */
export function offerDescriptions() {
  const { component, table } = store;
  const offer = byId("describe");
  if (offer) offer.hidden = !table.rows.size || component?.has_metadata || component?.autopilot !== "px4";
}

async function describe() {
  announce("Loading the descriptions.");
  byId("describe").disabled = true;
  try {
    await request("POST", at(store.component, "/fetch"), { metadata: true }, { timeout: DESCRIPTION_TIMEOUT });
    announce("The descriptions are loaded.");
  } finally {
    byId("describe").disabled = false;
  }
}

/** Returns an action whose error is shown. */
const shown = (action) => () => action().catch(showError);

/** The running fetch of this page, or null. */
let fetching = null;

async function fetchAll() {
  announce("Fetching all parameters.");
  const own = new AbortController();
  fetching = own;
  try {
    const options = { timeout: FETCH_TIMEOUT, signal: own.signal };
    await request("POST", at(store.component, "/fetch"), { refresh: true }, options);
  } catch (error) {
    if (!own.signal.aborted) throw error;
  } finally {
    if (fetching === own) fetching = null;
  }
}

function stopFetch() {
  if (fetching) fetching.abort();
  else announce("This page did not start the fetch, and cannot stop it.");
}

async function keepState() {
  await request("POST", at(store.component, "/snapshots"), { reason: "kept by hand" });
  announce("Snapshot created.");
  showBriefly("Snapshot created. Compare shows it.");
}

/** Asks for a file format and saves the table. */
async function save() {
  const { component } = store;
  const choices = FORMATS.map(([format, title, ending]) => choice(title, ending, () => take(format)));
  const list = el("ul", { class: "choices" }, choices);
  const state = el("p", { role: "status" });
  const fault = faultText();

  async function take(format) {
    fault.textContent = "";
    state.textContent = "Fetching all parameters from the vehicle …";
    try {
      const { name, content } = await download(at(component, "/file", { format }), SAVE_TIMEOUT);
      const address = URL.createObjectURL(content);
      el("a", { href: address, download: name }).click();
      setTimeout(() => URL.revokeObjectURL(address), SAVE_TIMEOUT);
      state.textContent = `Saved as ${name}.`;
    } catch (error) {
      state.textContent = "";
      fault.textContent = error.message;
    }
  }

  const content = el("div", {}, list, state, fault);
  await openDialog(
    `Save the parameters of ${nameOf(component)}`,
    content,
    [button("Close", closeDialog, { kind: "quiet" })],
    { focus: list.querySelector("button") },
  );
}

/** Shows an error until the next message. */
export function showError(error) {
  showBriefly(error.message, true);
  announce(error.message);
}

let hiding = null;

function showBriefly(text, isBad = false) {
  let note = byId("note");
  if (!note) {
    note = el("p", { id: "note" });
    document.body.append(note);
  }
  note.className = isBad ? "bad" : "";
  note.textContent = text;
  note.hidden = false;
  clearTimeout(hiding);
  hiding = setTimeout(() => (note.hidden = true), isBad ? 12_000 : 5_000);
}
