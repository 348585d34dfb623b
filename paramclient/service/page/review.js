/** Review of staged changes, their results, and undo. */

import { at, request } from "./api.js";
import { announce, button, changesTable, el, setText } from "./dom.js";
import { closeDialog, openDialog } from "./dialogs.js";
import { valueText } from "./details.js";
import { keyOf, store } from "./store.js";
import { defaultOf, many, meaningOf, sameText, warningOf } from "./values.js";

/** Values in one request, fewer than the service accepts. */
const VALUES_PER_REQUEST = 1000;
/** Timeout of a request in milliseconds; the service has its own for a lossy link. */
const WRITE_TIMEOUT = 120_000;
/** Milliseconds added for each value: four times its duration at 9600 baud. */
const WRITE_TIMEOUT_PER_VALUE = 400;

export const OUTCOMES = {
  accepted: { text: "accepted", kind: "good" },
  unchanged: { text: "had it already", kind: "good" },
  adjusted: { text: "adjusted", kind: "warn" },
  unproven: { text: "sent, not proven", kind: "warn" },
  skipped: { text: "left out", kind: "quiet" },
  unknown: { text: "sent, not acknowledged", kind: "warn" },
  "not tried": { text: "not tried", kind: "quiet" },
  refused: { text: "refused", kind: "bad" },
};

/** A confirmation of what may be dangerous, shown while it is needed. `change` is called when its box changes. */
class Confirmation {
  constructor(title, text, label, change) {
    this.box = el("input", { type: "checkbox", on: { change } });
    this.element = el(
      "div",
      { class: "armed", role: "alert", hidden: true },
      el("p", {}, el("b", { text: `${title} ` }), text),
      el("label", {}, this.box, el("span", { text: label })),
    );
  }

  /** Shows or hides it; it must be given again after each change. */
  show(isNeeded) {
    if (this.element.hidden === !isNeeded) return;
    this.element.hidden = !isNeeded;
    this.box.checked = false;
  }

  get isNeeded() {
    return !this.element.hidden;
  }

  get forbids() {
    return this.isNeeded && !this.box.checked;
  }
}

/** The confirmation for writes to a vehicle while it is armed. */
export class Caution extends Confirmation {
  constructor(component, change) {
    const text = "Its motors may turn, and new values take effect immediately.";
    super("The vehicle is armed.", text, "Send anyway", change);
    const key = keyOf(component);
    const look = () => this.show(Boolean(store.components.get(key)?.is_armed));
    look();
    store.whileShown(this.element, "armed", () => {
      look();
      change();
    });
  }
}

/** The confirmation for values outside the range in the metadata. */
class RangeCaution extends Confirmation {
  constructor(change) {
    super("Values are out of range.", "The firmware may misbehave with them.", "Send them anyway", change);
  }
}

/** Shows the staged changes, writes them after confirmation, and shows the results. */
export async function review() {
  const { component, table } = store;
  const changes = [...table.pending.values()].sort((a, b) => (a.name < b.name ? -1 : 1));
  if (!component || !changes.length) return;
  const lines = new Map(
    changes.map((change) => [change.name, lineOf(change, () => table.rows.get(change.name), () => drop(change.name))]),
  );
  const elements = [...lines.values()].map((line) => line.element);
  const dropping = el("th", {}, el("span", { class: "unseen", text: "Drop" }));
  const table_ = changesTable(["Name", "Now", "New", "Remark", dropping], el("tbody", {}, elements));
  const armed = new Caution(component, () => refresh());
  const range = new RangeCaution(() => refresh());
  const summary = el("p", { class: "summary", role: "status" });
  const send = button("", () => go(), { kind: "strong" });
  const cancel = button("Not yet", closeDialog, { kind: "quiet" });
  const buttons = el("div", { class: "buttons" }, cancel, send);
  let isSending = false;
  let sent = null;

  function refresh() {
    const count = lines.size;
    if (isSending || sent) return;
    range.show([...lines.values()].some((line) => line.isOutOfRange));
    send.disabled = !count || armed.forbids || range.forbids;
    send.classList.toggle("strong", !armed.isNeeded && !range.isNeeded);
    send.replaceChildren(el("span", { text: `Send ${many(count, "change")}` }));
  }

  store.whileShown(table_, "table", () => {
    if (isSending || sent) return;
    for (const line of lines.values()) line.follow();
    refresh();
  });

  function drop(name) {
    lines.get(name).element.remove();
    lines.delete(name);
    table.pending.delete(name);
    store.emit("pending");
    refresh();
    if (!lines.size) closeDialog();
    else send.focus();
  }

  async function go() {
    if (isSending || armed.forbids || range.forbids) return;
    isSending = true;
    send.disabled = cancel.disabled = true;
    send.replaceChildren(el("span", { text: "Sending …" }));
    sent = { names: new Set(lines.keys()), outcomes: [], at: Date.now() };
    table.sent = sent;
    const queue = [...lines.values()];
    while (queue.length) sent.outcomes.push(...(await sendBatch(component, queue.splice(0, VALUES_PER_REQUEST), range.isNeeded)));
    for (const each of sent.outcomes) if (each.isTaken) table.pending.delete(each.name);
    isSending = false;
    armed.element.hidden = range.element.hidden = true;
    store.emit("pending");
    store.emit("table");
    const said = outcomesText(sent.outcomes);
    summary.textContent = said;
    announce(said);
    const late = sent.outcomes.filter((each) => each.isTaken && each.isLate).map((each) => each.name);
    if (late.length) summary.append(el("br"), `Takes effect after a reboot of the vehicle: ${late.join(", ")}.`);
    const done = button("Done", closeDialog, { kind: "strong" });
    buttons.replaceChildren(undoButton(sent), done);
    done.focus();
  }

  refresh();
  const focus = [armed, range].find((each) => each.isNeeded)?.box ?? send;
  await openDialog(`Review: ${nameOf(component)}`, el("div", {}, armed.element, range.element, table_, summary), buttons, {
    isHeld: () => isSending,
    kind: "wide",
    focus,
  });
}

/** Returns a button that undoes what was sent; "" if the vehicle took nothing. */
export const undoButton = (sent) =>
  sent.outcomes.some((each) => each.isTaken) ? button("Undo …", undo, { kind: "quiet", drawing: "undo" }) : "";

/** Stages the values from before the last write and shows the review. */
export function undo() {
  closeDialog();
  const { sent } = store.table;
  if (!sent) return;
  for (const each of sent.outcomes) if (each.isTaken) store.stage(each.name, each.before);
  if (store.table.pending.size) review();
  else announce("Nothing to undo: the vehicle has the previous values.");
}

/** Counts the results in words. */
export function outcomesText(outcomes) {
  const counts = new Map();
  for (const { status } of outcomes) {
    const { text } = OUTCOMES[status] ?? { text: status };
    counts.set(text, (counts.get(text) ?? 0) + 1);
  }
  const order = Object.values(OUTCOMES).map(({ text }) => text);
  const sorted = [...counts].sort(([a], [b]) => order.indexOf(a) - order.indexOf(b));
  return `${sorted.map(([text, count]) => `${count} ${text}`).join(", ")}.`;
}

/** Returns the display name of a vehicle; with its link, where another one has the same ids. */
export function nameOf(component) {
  const name = AUTOPILOTS[component.autopilot] ?? (component.kind || component.autopilot);
  const words = `${name} ${component.system}/${component.component}${component.extended ? ", extended" : ""}`;
  const same = ["system", "component", "extended"];
  const others = [...store.components.values()].filter((each) => each.link !== component.link);
  return others.some((each) => same.every((key) => each[key] === component[key])) ? `${words}, ${component.link}` : words;
}

const AUTOPILOTS = { px4: "PX4", ardupilot: "ArduPilot" };

/** A row of the review. `follow()` updates it with the vehicle's current value. */
function lineOf(change, rowNow, drop) {
  const { name } = change;
  const now = el("td", { class: "now" });
  const wanted = el("td", { class: "new" });
  const remark = el("td", { class: "remark" });
  const away = el(
    "td",
    { class: "drop-it" },
    button("", drop, { kind: "quiet only", drawing: "close", label: `Drop ${name}` }),
  );
  const element = el("tr", {}, el("th", { scope: "row", text: name }), now, wanted, remark, away);
  const line = { change, rowNow, element, remark, away };
  line.follow = () => {
    const row = rowNow();
    const [doubts, remarks] = remarksOf(change, row);
    line.isOutOfRange = Boolean(row && warningOf(change.text, row.info, row.type));
    setText(now, inWords(row?.text ?? "", row));
    setText(wanted, inWords(change.text, row));
    remark.replaceChildren(doubts && el("b", { class: "outcome warn", text: `${doubts} ` }), remarks);
  };
  line.follow();
  return line;
}

/** Returns warnings and notes for a change. */
function remarksOf({ text, before }, row) {
  if (!row) return ["The vehicle no longer has this parameter.", ""];
  const { info, type } = row;
  const remarks = [];
  if (sameText(row.text, text, type)) remarks.push("The vehicle already has this value.");
  if (!sameText(row.text, before, type)) remarks.push(`It was ${before} when you edited it.`);
  if (info?.reboot_required) remarks.push("Takes effect after a reboot.");
  if (info?.is_read_only) remarks.push("The vehicle sets it itself.");
  const standard = defaultOf(row.document);
  if (standard !== null && sameText(text, standard, type)) remarks.push("The default.");
  return [warningOf(text, info, type), remarks.join(" ")];
}

function inWords(value, row) {
  const meaning = meaningOf(value, row?.info, row?.type);
  return `${value} ${meaning || (row?.info?.units ?? "")}`.trim();
}

/** Writes changes in one request, shows each result in its row, and returns the outcomes. */
async function sendBatch(component, lines, force) {
  const parts = lines.map((line) => ({ line, outcome: outcomeBefore(line) }));
  const open = parts.filter(({ outcome }) => outcome.status !== "refused");
  for (const { line } of open) {
    line.away.replaceChildren();
    line.element.classList.add("busy");
    line.remark.textContent = "sending …";
  }
  if (open.length) await writeValues(component, open, force);
  for (const { line, outcome } of open) {
    const { text, kind } = OUTCOMES[outcome.status] ?? { text: outcome.status, kind: "warn" };
    line.element.classList.remove("busy");
    line.remark.replaceChildren(
      el("b", { class: `outcome ${kind}`, text }),
      outcome.reason ? ` ${outcome.reason}` : "",
    );
  }
  return parts.map(({ outcome }) => outcome);
}

/** The outcome of a change before it is sent; `refused` if the vehicle no longer has the parameter. */
function outcomeBefore({ change: { name }, rowNow }) {
  const row = rowNow();
  if (!row) return { name, isTaken: false, status: "refused" };
  return {
    name,
    before: row.text,
    type: row.type,
    isTaken: false,
    isLate: Boolean(row.info?.reboot_required),
  };
}

/** Sends the changes, and completes their outcomes. `force` sends values that are out of range. */
async function writeValues(component, parts, force) {
  try {
    const values = Object.fromEntries(parts.map(({ line: { change } }) => [change.name, change.text]));
    const timeout = WRITE_TIMEOUT + parts.length * WRITE_TIMEOUT_PER_VALUE;
    const { results } = await request("PATCH", at(component, "/params"), { values, force }, { timeout });
    const byName = new Map(results.map((each) => [each.name, each]));
    for (const { line, outcome } of parts) complete(outcome, byName.get(outcome.name), line.change.text);
  } catch (error) {
    for (const { outcome } of parts) {
      outcome.status = statusOf(error);
      outcome.reason = error.message;
    }
  }
}

/** Returns what is known of a write after an error: only with a documented problem, nothing was written. */
export const statusOf = (error) => (error.document?.type && error.status !== 500 ? "not tried" : "unknown");

function complete(outcome, result, text) {
  outcome.status = result.status;
  outcome.isTaken = ["accepted", "adjusted"].includes(result.status);
  if (result.reason) outcome.reason = result.reason;
  else if (result.status === "adjusted")
    outcome.reason = `The vehicle changed ${text} to ${valueText(result.actual, outcome.type)}.`;
  else outcome.reason = result.note ?? "";
}
