/** Comparison with a file, an earlier state or another vehicle, and applying values from it. */

import { Problem, at, get, request } from "./api.js";
import { announce, button, byId, changesTable, choice, el, faultText, nothing, setText } from "./dom.js";
import { closeDialog, openDialog } from "./dialogs.js";
import { valueText } from "./details.js";
import { Caution, OUTCOMES, nameOf, outcomesText } from "./review.js";
import { keyOf, store } from "./store.js";
import { many, moment, numberText, textOf } from "./values.js";

/** Maximum size of a parameter file in bytes, as in the service. */
const FILE_BYTES_MAX = 2 * 2 ** 20;
/** Timeout of a plan in milliseconds. */
const PLAN_TIMEOUT = 120_000;
/** Timeout of an apply in milliseconds, and for each of its values: it may reboot the vehicle. */
const APPLY_TIMEOUT = 300_000;
const APPLY_TIMEOUT_PER_VALUE = 400;

/** Asks what to compare with; `file` is a file dropped onto the page. */
export async function chooseOther(file = null) {
  const { component } = store;
  if (!component) return;
  const fault = faultText();
  const attempt = async (work) => {
    fault.textContent = "";
    try {
      setOther(await work());
      closeDialog();
    } catch (error) {
      fault.textContent = error.message;
    }
  };
  const take = () => input.files[0] && attempt(() => fromFile(input.files[0]));
  const input = el("input", { type: "file", on: { change: take } });
  const text = "A parameter file of any ground station. You can also drop it onto the page.";
  const snapshots = el("ul", { class: "choices" }, nothing("Looking …"));
  const vehicles = el("ul", { class: "choices" });
  const content = el(
    "div",
    {},
    fault,
    el("h3", { text: "A file" }),
    el("label", { class: "drop" }, el("span", { text }), input),
    el("h3", { text: "An earlier state" }),
    snapshots,
    el("h3", { text: "Another vehicle" }),
    vehicles,
  );
  if (file) attempt(() => fromFile(file));
  fillSnapshots(component, snapshots, attempt);
  fillVehicles(component, vehicles, attempt);
  await openDialog(`Compare ${nameOf(component)} with …`, content, [button("Cancel", closeDialog, { kind: "quiet" })], {
    focus: input,
  });
}

/** Sets the compared set, or null for no comparison. */
export function setOther(other) {
  store.table.other = other;
  store.emit("other");
  if (other) announce(`Compared with ${other.label}.`);
}

async function fromFile(file) {
  if (file.size > FILE_BYTES_MAX)
    throw new Problem(0, { detail: `${file.name} has ${file.size} bytes; that is no parameter file.` });
  const content = { name: file.name, base64: await base64(file) };
  const read = await request("POST", "/api/files", content);
  const own = read.components.find((each) => each.component === store.component.component);
  const { params } = own ?? read.components[0] ?? { params: {} };
  return otherOf(file.name, params, { file: content }, true, read.notes);
}

async function fillSnapshots(component, list, attempt) {
  try {
    const { snapshots } = await get(at(component, "/snapshots"));
    fill(list, [...snapshots].reverse(), "The cache has no earlier state.", (each) => [
      moment(each.time),
      `${each.reason}, ${many(each.size, "parameter")}`,
      () =>
        attempt(async () => {
          const state = await get(at(component, "/params", { at: each.id }));
          return otherOf(`state of ${moment(each.time)}`, state.params, { at: each.id }, false);
        }),
    ]);
  } catch (error) {
    list.replaceChildren(nothing(error.message));
  }
}

function fillVehicles(component, list, attempt) {
  const others = [...store.components.values()].filter((each) => keyOf(each) !== keyOf(component));
  fill(list, others, "No other vehicle is known.", (each) => [
    nameOf(each),
    `on ${each.link}`,
    () =>
      attempt(async () => {
        const { params } = await get(at(each, "/params"));
        const values = Object.entries(params).map(([name, param]) => [name, textOf(param)]);
        return otherOf(nameOf(each), params, { values: Object.fromEntries(values) }, false);
      }),
  ]);
}

function fill(list, items, remark, parts) {
  const made = items.map((item) => choice(...parts(item)));
  list.replaceChildren(...(made.length ? made : [nothing(remark)]));
}

function otherOf(label, params, source, isPartial, notes = []) {
  const values = new Map();
  for (const [name, param] of Object.entries(params)) {
    values.set(name, { text: valueText(param, param.type ?? typeOf(name)) });
  }
  return { label, values, source, isPartial, notes };
}

const typeOf = (name) => store.table.rows.get(name)?.type ?? "REAL64";

async function base64(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let text = "";
  for (let at = 0; at < bytes.length; at += 4096) text += String.fromCharCode(...bytes.subarray(at, at + 4096));
  return btoa(text);
}

/** Shows the compared set and its actions. */
export function drawBanner() {
  const banner = byId("banner");
  const { table } = store;
  const { other } = table;
  banner.hidden = !other;
  byId("third").textContent = other ? other.label : "Default";
  if (!other) return banner.replaceChildren();
  const names = [...other.values.keys()];
  const there = names.filter((name) => !table.rows.has(name)).length;
  const numberOf = (kind) => table.sorted.filter((row) => table.comparison(row) === kind).length;
  const differ = numberOf("differs");
  const here = numberOf("here");
  const counts = [`${differ} differ`, here && `${here} only here`, there && `${there} only there`];
  banner.replaceChildren(
    el(
      "span",
      {},
      "Compared with ",
      el("b", { text: other.label }),
      `: ${counts.filter(Boolean).join(", ")}.`,
      other.notes.map((note) => el("small", { text: ` ${typeof note === "string" ? note : (note.text ?? "")}` })),
    ),
    store.mayWrite && button("Take over …", takeOver, { kind: "strong", disabled: !differ && !there }),
    button("", () => setOther(null), { kind: "quiet only", drawing: "close", label: "End the comparison" }),
  );
}

/** Plans the changes to the compared set, and applies the values that the user selects. */
export async function takeOver() {
  const { component, table } = store;
  const { other } = table;
  const fault = faultText();
  const summary = el("p", { class: "summary", role: "status", text: "Planning the changes …" });
  const body = el("tbody");
  const apply = button("Apply", () => go(), { kind: "strong", disabled: true });
  const cancel = button("Not now", () => (hasBegun ? stopping.abort() : closeDialog()), { kind: "quiet" });
  const buttons = el("div", { class: "buttons" }, cancel, apply);
  const armed = new Caution(component, () => refresh());
  const all = el("input", {
    type: "checkbox",
    "aria-label": "All planned changes",
    on: {
      change: () => {
        for (const line of lines)
          if (!line.box.disabled && (line.status === "set" || !all.checked)) line.box.checked = all.checked;
        refresh();
      },
    },
  });
  const table_ = changesTable([el("th", {}, all), "Name", "Now", "New", "Remark"], body);
  let lines = [];
  const stopping = new AbortController();
  let hasBegun = false;
  let isOver = false;

  function refresh() {
    const count = lines.filter((line) => line.box.checked).length;
    const whole = lines.filter((line) => line.status === "set").length;
    all.checked = count > 0 && count >= whole;
    all.indeterminate = count > 0 && count < whole;
    if (hasBegun) return;
    apply.disabled = !count || armed.forbids;
    apply.classList.toggle("strong", !lines.some((line) => line.box.checked && line.isOutOfRange));
    apply.replaceChildren(el("span", { text: `Apply ${many(count, "value")}` }));
  }

  async function go() {
    const chosen = lines.filter((line) => line.box.checked);
    if (hasBegun || armed.forbids) return;
    hasBegun = true;
    for (const line of lines) line.box.disabled = true;
    all.disabled = apply.disabled = true;
    cancel.replaceChildren(el("span", { text: "Stop" }));
    summary.textContent = "Applying …";
    const include = chosen.filter((line) => line.status !== "set").map((line) => exactly(line.name));
    const body = {
      ...other.source,
      only: chosen.map((line) => exactly(line.name)),
      include,
      allow_armed: armed.isNeeded,
      partial: true,
    };
    const timeout = APPLY_TIMEOUT + chosen.length * APPLY_TIMEOUT_PER_VALUE;
    try {
      show(await request("POST", at(component, "/apply"), body, { timeout, signal: stopping.signal }), chosen);
    } catch (error) {
      fault.textContent = error.message;
      summary.textContent = stopping.signal.aborted ? "Values that were written stay on the vehicle." : "";
    }
    isOver = true;
    buttons.replaceChildren(button("Done", closeDialog, { kind: "strong" }));
    buttons.querySelector(".strong").focus();
  }

  function show(result, chosen) {
    const outcomes = [];
    for (const line of chosen) {
      const row = result.params[line.name] ?? { status: "unchanged" };
      const word = OUTCOMES[row.status] ?? { text: row.status, kind: "warn" };
      const made = row.status === "adjusted" ? `The vehicle changed it to ${numberText(row.actual, row.type)}. ` : "";
      line.remark.replaceChildren(
        el("b", { class: `outcome ${word.kind}`, text: word.text }),
        ` ${made}${row.reason ?? ""}`,
      );
      const isTaken = ["accepted", "adjusted", "unproven"].includes(row.status);
      outcomes.push({
        name: line.name,
        status: row.status,
        isTaken,
        before: line.before,
      });
    }
    table.sent = { names: new Set(chosen.map((line) => line.name)), outcomes, at: Date.now() };
    const late = result.reboot_required;
    summary.textContent = `${outcomesText(outcomes)}${late.length ? ` Takes effect after a reboot of the vehicle: ${late.join(", ")}.` : ""}`;
    fault.textContent = result.error ?? "";
    announce(summary.textContent);
    store.emit("pending");
    store.emit("table");
  }

  async function makePlan() {
    try {
      const plan = await request("POST", at(component, "/plan"), other.source, { timeout: PLAN_TIMEOUT });
      lines = linesOf(plan, table, other, refresh);
      body.replaceChildren(...lines.map((line) => line.element));
      const count = lines.filter((line) => line.status === "set").length;
      const left = lines.length - count;
      summary.textContent = count
        ? `${many(count, "value")} would be set${left ? `; ${left} would be left out unless you choose them` : ""}.`
        : "No value would be written.";
      refresh();
    } catch (error) {
      summary.textContent = "";
      fault.textContent = error.message;
    }
  }

  store.whileShown(table_, "table", () => {
    if (!hasBegun) for (const line of lines) line.follow();
  });
  store.whileShown(table_, "apply", (event) => {
    if (hasBegun && !isOver && keyOf(event) === keyOf(component) && event.total)
      summary.textContent = `${PHASES[event.phase] ?? "Applying"}: ${event.done} of ${event.total}`;
  });
  const opened = openDialog(
    `Take over from ${other.label}`,
    el("div", {}, armed.element, fault, summary, table_),
    buttons,
    { isHeld: () => hasBegun && !isOver, kind: "wide", focus: cancel },
  );
  await makePlan();
  await opened;
}

/** Returns a pattern that matches only this name. */
const exactly = (name) => name.replace(/[*?[]/g, "[$&]");

const PHASES = { reading: "Reading", writing: "Writing", rebooting: "Rebooting" };

/** Returns the rows of a plan in the order of writing, then the skipped ones. */
function linesOf(plan, table, other, refresh) {
  const staged = plan.stages.flatMap(({ purpose, steps }) =>
    steps.map((name) => [name, purpose === "all other parameters" ? "" : purpose]),
  );
  const purposes = new Map(staged);
  const names = [...purposes.keys(), ...Object.keys(plan.params).filter((name) => !purposes.has(name))];
  return names
    .map((name) => ({ name, planned: plan.params[name] }))
    .filter(
      ({ name, planned }) =>
        planned &&
        planned.status !== "unchanged" &&
        (planned.status === "set" || planned.before !== planned.wanted) &&
        (table.rows.has(name) || planned.category === "missing"),
    )
    .map(({ name, planned }) => {
      const row = table.rows.get(name);
      const { status } = planned;
      const isOutOfRange = planned.category === "out-of-range";
      const isOut = !row || planned.category === "missing" || (status === "refused" && !isOutOfRange);
      const box = el("input", {
        type: "checkbox",
        checked: status === "set",
        disabled: isOut,
        "aria-label": `Set ${name}`,
        on: { change: refresh },
      });
      const word = status === "set" ? "" : isOut ? "cannot be set" : isOutOfRange ? "doubtful" : "left out";
      const remark = el(
        "td",
        { class: "remark" },
        word && el("b", { class: `outcome ${isOutOfRange ? "warn" : "quiet"}`, text: word }),
        ` ${(planned.reason || purposes.get(name) || "").replace(/^left out: /, "")}`,
      );
      const now = el("td", { class: "now" });
      const element = el(
        "tr",
        { class: isOut ? "out" : "" },
        el("td", { class: "pick" }, box),
        el("th", { scope: "row", text: name }),
        now,
        el("td", { class: "new", text: numberText(planned.wanted, row?.type ?? planned.type) }),
        remark,
      );
      const line = { name, status, box, remark, element, isOutOfRange };
      line.follow = () => {
        line.before = table.rows.get(name)?.text ?? "";
        setText(now, line.before);
      };
      line.follow();
      return line;
    });
}
