/** The dialog of extended parameters, which are sent one by one. */

import { at, get, request } from "./api.js";
import { closeDialog, openDialog } from "./dialogs.js";
import { announce, button, byId, changesTable, el, faultText, setText } from "./dom.js";
import { Caution, OUTCOMES, nameOf, statusOf } from "./review.js";
import { authorOf, keyOf, store } from "./store.js";
import { isFloat, isWhole, many, numberText, parse } from "./values.js";

/** Prefix of a value that is given as bytes in hexadecimal digits. */
const HEX = "hex:";
const EXTENDED = { ext: "true" };
/** Timeout in milliseconds for a list, and for a change in progress. */
const EXTENDED_TIMEOUT = 180_000;

/** Shows the button of the dialog for a component that has, or usually has, extended parameters. */
export function offerExtended() {
  const offer = byId("extended");
  if (offer) offer.hidden = !hasExtended(store.component);
}

export const hasExtended = (component) => Boolean(component?.extended?.is_expected || component?.extended?.params);

/** Formats a value, 64-bit integers with all digits. Bytes are `hex:…` already. */
function textOf({ value, type, bits }) {
  if (type !== "INT64" && type !== "UINT64") return numberText(value, type);
  const number = BigInt(`0x${bits}`);
  return String(type === "INT64" ? BigInt.asIntN(64, number) : number);
}

/** Parses an input as a value of this type: `{send}`, or `{error}` with a sentence. */
function read(text, type) {
  if (isWhole(type) || isFloat(type)) {
    const { error, send, text: digits } = parse(text, type);
    if (error) return { error };
    return { send: typeof send === "object" ? digits : send };
  }
  if (!text.startsWith(HEX)) return { send: text };
  const hex = text.slice(HEX.length).replace(/\s/g, "");
  return /^([\da-f]{2}){0,128}$/i.test(hex) ? { send: { hex } } : { error: "hex: takes pairs of hexadecimal digits." };
}

/** One parameter: its value, and the form to change it. */
class Line {
  constructor(param, set) {
    this.field = null;
    this.remark = el("td", { class: "remark", role: "status" });
    this.cell = el("td", { class: "new" });
    this.kind = el("td", { class: "now" });
    this.set = store.mayWrite && button("Set", () => set(this), { label: `Set ${param.name}` });
    this.element = el(
      "tr",
      {},
      el("th", { scope: "row", text: param.name }),
      this.kind,
      this.cell,
      this.remark,
      this.set && el("td", { class: "drop-it" }, this.set),
    );
    this.enter = (event) => {
      if (event.key !== "Enter" || event.target.tagName === "TEXTAREA") return;
      event.preventDefault();
      set(this);
    };
    this.take(param);
  }

  take(param) {
    const before = this.text;
    this.param = param;
    this.text = textOf(param);
    setText(this.kind, param.type);
    if (!this.set) setText(this.cell, this.text);
    else if (before === undefined || [before, this.text].includes(this.field.value)) this.draw();
  }

  /** Renders the field; text with line ends needs several lines. */
  draw() {
    const tag = /[\r\n]/.test(this.text) ? "textarea" : "input";
    if (this.field?.tagName.toLowerCase() !== tag) {
      const label = `Value of ${this.param.name}`;
      this.field = el(tag, { "aria-label": label, spellcheck: "false", autocomplete: "off", on: { keydown: this.enter } });
      this.cell.replaceChildren(this.field);
    }
    this.field.value = this.text;
    this.text = this.field.value; // the browser normalizes line ends
  }

  report(text, kind = "quiet") {
    this.remark.className = `remark outcome ${kind}`;
    this.remark.textContent = text;
  }
}

/** Opens the dialog for the selected component. */
export async function showExtended() {
  const { component } = store;
  const key = keyOf(component);
  const lines = new Map();
  const body = el("tbody", {});
  const state = el("p", { class: "summary", role: "status" });
  const fault = faultText();
  const armed = new Caution(component, () => refresh());
  const columns = ["Name", "Type", "Value", "Result"];
  if (store.mayWrite) columns.push(el("td"));
  const table = changesTable(columns, body, "extended");
  const fetch_ = button("Fetch", fetchAll, { label: "Fetch all extended parameters from the component" });
  let seq = -1;
  let early = null;

  function refresh() {
    for (const line of lines.values()) if (line.set) line.set.disabled = armed.forbids || line.isSending;
    table.hidden = !lines.size;
  }

  function take(param) {
    const line = lines.get(param.name);
    if (line) line.take(param);
    else {
      const added = new Line(param, send);
      lines.set(param.name, added);
      body.append(added.element);
    }
  }

  function drop(name) {
    lines.get(name)?.element.remove();
    lines.delete(name);
  }

  async function load() {
    early = [];
    const found = await get(at(component, "/params", EXTENDED));
    for (const name of [...lines.keys()]) if (!(name in found.params)) drop(name);
    const params = Object.values(found.params).sort((a, b) => (a.name < b.name ? -1 : 1));
    for (const param of params) take(param);
    seq = found.seq;
    const missed = early;
    early = null;
    missed.forEach(change);
    showCount();
    refresh();
  }

  function showCount() {
    setText(state, lines.size ? many(lines.size, "extended parameter") : "None are known yet. Fetch requests them.");
  }

  function change(event) {
    if (event.seq <= seq) return;
    if (event.new === null) drop(event.name);
    else {
      take(event.new);
      const by = authorOf(event.by);
      const isValue = event.old && (event.old.bits !== event.new.bits || event.old.type !== event.new.type);
      if (isValue && by !== "you") lines.get(event.name).report(`now ${textOf(event.new)}, by ${by}`, "warn");
    }
    refresh();
  }

  store.whileShown(table, "extended", (event) => {
    if (event && keyOf(event) !== key) return;
    if (event) early ? early.push(event) : change(event);
    else attempt(load);
  });

  async function attempt(work) {
    setText(fault, "");
    try {
      await work();
    } catch (error) {
      early = null;
      setText(fault, error.message);
    }
  }

  async function fetchAll() {
    fetch_.disabled = true;
    setText(state, "Fetching …");
    await attempt(async () => {
      const done = await request("POST", at(component, "/fetch", EXTENDED), {}, { timeout: EXTENDED_TIMEOUT });
      await load();
      const missing = done.missing.length ? `, ${done.missing.length} are missing` : "";
      announce(`${many(done.received, "extended parameter")} received${missing}.`);
    });
    if (fault.textContent) setText(state, "");
    fetch_.disabled = false;
  }

  async function send(line) {
    const { param, field } = line;
    const { send: value, error } = read(field.value, param.type);
    if (error) return line.report(error, "bad");
    if (armed.forbids || line.isSending) return undefined;
    line.isSending = true;
    refresh();
    line.report("Sending …");
    try {
      const body = { values: { [param.name]: value } };
      const answer = await request("PATCH", at(component, "/params", EXTENDED), body, { timeout: EXTENDED_TIMEOUT });
      const { status, reason, actual, bits } = answer.results[0];
      const now = { ...param, value: actual, bits };
      if (bits) {
        line.text = field.value; // what was typed is sent
        line.take(now);
      }
      end(line, status, status === "adjusted" ? textOf(now) : reason);
    } catch (problem) {
      end(line, statusOf(problem), problem.message);
    }
    line.isSending = false;
    refresh();
    return undefined;
  }

  function end(line, status, reason) {
    const word = OUTCOMES[status] ?? { text: status, kind: "warn" };
    const said = word.text + (reason ? `: ${reason}` : "");
    line.report(said, word.kind);
    announce(`${line.param.name}: ${said}`);
  }

  refresh();
  attempt(load);
  const content = el("div", {}, armed.element, state, fault, table);
  const buttons = el("div", { class: "buttons" }, button("Close", closeDialog, { kind: "quiet" }), fetch_);
  await openDialog(`Extended parameters of ${nameOf(component)}`, content, buttons, { kind: "wide", focus: fetch_ });
}
