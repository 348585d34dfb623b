/** The vehicles and how they are: the list at the side, the line on top, what can be done with one. */

import { at, download, get, request } from "./api.js";
import { announce, button, byId, el, setText } from "./dom.js";
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
/** A table that has to be fetched first. */
const SAVE_PATIENCE = 180_000;
/** A file of descriptions may have 100 kB, and the radio 2 kB a second. */
const DESCRIPTION_PATIENCE = 300_000;
const KINDS = { new: "idle", cached: "warn", partial: "warn", synced: "good", fetching: "busy", lost: "bad" };
/** The kinds of vehicle of MAV_TYPE that have parameters worth a name. */
const TYPES = {
  1: "plane",
  2: "quadrotor",
  3: "coaxial",
  4: "helicopter",
  10: "rover",
  11: "boat",
  12: "submarine",
  13: "hexarotor",
  14: "octorotor",
  15: "tricopter",
  19: "tailsitter",
  20: "tailsitter",
  21: "tiltrotor",
  22: "VTOL",
  26: "gimbal",
  30: "camera",
};
const AWAY = { away: "link away", failed: "link failed", opening: "link opening" };

/** How a component is, in words and as a kind of dot. */
export function stateOf(component) {
  const link = store.links.get(component.link)?.state ?? component.link_state ?? "open";
  if (link !== "open") return { text: AWAY[link] ?? link, kind: "bad" };
  if (component.is_lost)
    return { text: `lost${component.silence_s ? ` for ${span(component.silence_s)}` : ""}`, kind: "bad" };
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
  drawList(components);
  drawChoice(components);
  drawVehicle(store.component);
}

function drawList(components) {
  const list = byId("vehicles");
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
          { type: "button", class: "vehicle", on: { click: () => store.select(key).catch(complain) } },
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
  if (!items.length) list.append(el("li", { class: "nothing", text: "None heard yet." }));
}

function drawChoice(components) {
  const choice = byId("vehicle-choice");
  const wanted = components.map((each) => [keyOf(each), nameOf(each)]);
  if (JSON.stringify(wanted) !== choice.dataset.shown) {
    choice.dataset.shown = JSON.stringify(wanted);
    choice.replaceChildren(...wanted.map(([value, text]) => el("option", { value, text })));
  }
  choice.hidden = !components.length;
  if (store.selected) choice.value = store.selected;
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
  const { link, count, vehicle_type: type, identity } = component;
  const parts = [TYPES[type], versionOf(identity?.firmware), link, count && many(count, "parameter")];
  setText(byId("subtitle"), parts.filter(Boolean).join(" · "));
  drawFetch(component);
}

/** A version as AUTOPILOT_VERSION packs it: three bytes, then its kind. */
const versionOf = (packed) => (packed ? `${packed >>> 24}.${(packed >> 16) & 255}.${(packed >> 8) & 255}` : null);

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

/** What can be done with a vehicle; made once for each role. */
export function drawActions() {
  const actions = [
    button("Compare", () => chooseOther(), { drawing: "compare" }),
    button("Save", save, { drawing: "save" }),
    button("Describe", describe, {
      drawing: "help",
      label: "Ask the vehicle what its parameters mean",
      id: "describe",
      hidden: true,
    }),
    store.mayWrite &&
      button("Snapshot", keepState, { drawing: "keep", label: "Snapshot: keep the present state, to go back to" }),
    button("Fetch", fetchAll, { drawing: "refresh", label: "Fetch all parameters from the vehicle" }),
  ];
  byId("actions").replaceChildren(...actions.filter(Boolean));
  byId("meter-cancel").replaceChildren(button("Stop", stopFetch, { kind: "quiet" }));
  setText(byId("role"), store.mayWrite ? "" : "read-only");
}

async function fetchAll() {
  try {
    await request("POST", at(store.component, "/fetch"), { refresh: true, wait: false });
    announce("Fetching all parameters.");
  } catch (error) {
    complain(error);
  }
}

/** Gets descriptions of the parameters, from the vehicle, which may take a while over a radio, or from a file. */
async function describe() {
  const { component } = store;
  const fault = el("p", { class: "fault", role: "alert" });
  const state = el("p", { role: "status" });
  const attempt = async (method, body) => {
    fault.textContent = "";
    state.textContent = "Reading …";
    try {
      const { count } = await request(method, at(component, "/metadata"), body, { patience: DESCRIPTION_PATIENCE });
      await store.loadTable(keyOf(component));
      closeDialog();
      announce(`${many(count, "parameter")} described.`);
    } catch (error) {
      fault.textContent = error.message;
    }
    state.textContent = "";
  };
  const input = el("input", {
    type: "file",
    id: "file",
    on: { change: () => input.files[0] && attempt("PUT", input.files[0]) },
  });
  const ask = button("Ask the vehicle", () => attempt("POST", {}), { kind: "strong" });
  const content = el(
    "div",
    {},
    el("p", {
      text: "Units, ranges and the names of values are not known here yet. A vehicle with PX4 can tell them; for others there is a file of their firmware.",
    }),
    el("h3", { text: "From a file" }),
    el(
      "label",
      { class: "drop", for: "file" },
      el("span", { text: "apm.pdef.xml, parameters.json or the like" }),
      input,
    ),
    state,
    fault,
  );
  await openDialog(
    `Describe the parameters of ${nameOf(component)}`,
    content,
    [button("Cancel", closeDialog, { kind: "quiet" }), ask],
    { focus: ask },
  );
}

/** Offers that where nothing is described. */
export function offerDescriptions() {
  const { table } = store;
  byId("describe").hidden = !table.isLoaded || !table.rows.size || table.sorted.some((row) => row.info);
}

async function stopFetch() {
  const { component } = store;
  try {
    const { jobs } = await get("/jobs");
    const running = jobs.filter(
      (job) => job.kind === "fetch" && job.state === "running" && keyOf(job) === keyOf(component),
    );
    for (const job of running) await request("DELETE", `/jobs/${encodeURIComponent(job.id)}`);
    if (!running.length) announce("The service fetches by itself; that cannot be stopped here.");
  } catch (error) {
    complain(error);
  }
}

async function keepState() {
  try {
    await request("POST", at(store.component, "/snapshots"), { reason: "kept by hand" });
    announce("The present state is kept.");
    tellShortly("The present state is kept; Compare shows it.");
  } catch (error) {
    complain(error);
  }
}

/** Lets the person choose a form of file, and saves the table as one; what keeps it from that is told. */
async function save() {
  const { component } = store;
  let forms;
  try {
    ({ forms } = await get("/forms"));
  } catch (error) {
    complain(error);
    return;
  }
  const list = el(
    "ul",
    { class: "choices" },
    forms
      .filter((form) => form.writes !== false && form.is_written !== false)
      .map((form) => {
        const name = form.name ?? form.form ?? form;
        const choose = el(
          "button",
          { type: "button", class: "choice", on: { click: () => take(name) } },
          el("b", { text: form.title ?? name }),
          el("small", { text: form.endings?.join(", ") ?? name }),
        );
        return el("li", {}, choose);
      }),
  );
  const state = el("p", { role: "status" });
  const fault = el("p", { class: "fault", role: "alert" });

  async function take(form) {
    fault.textContent = "";
    state.textContent = "The vehicle is asked for all of it …";
    try {
      const { name, content } = await download(at(component, "/file", { form }), SAVE_PATIENCE);
      const address = URL.createObjectURL(content);
      el("a", { href: address, download: name }).click();
      setTimeout(() => URL.revokeObjectURL(address), SAVE_PATIENCE);
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

/** Says what went wrong, where everybody sees it, until something else is said. */
export function complain(error) {
  tellShortly(error.message, true);
  announce(error.message);
}

let hiding = null;

function tellShortly(text, isBad = false) {
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
