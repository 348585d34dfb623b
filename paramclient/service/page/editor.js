/** Editors of a value: a number with its range, a list of named values, or check boxes for bits. */

import { button, byId, el, faultText, isNarrow } from "./dom.js";
import { defaultOf, isFloat, isWhole, maskOf, parse, rangeOf, sameText, textOf, textOfMask, warningOf } from "./values.js";

const OTHER = "other";

/**
 * Creates the form for one parameter. Calls `stage(text)` with a valid value, and `leave()` at the end.
 * `first` receives the focus, and `refresh(row)` handles a changed value.
 */
export function editorOf(row, pending, { stage, leave, isCompact = true }) {
  const { info, type } = row;
  const before = row.text;
  const value = pending?.text ?? before;
  const hint = el("p", { class: "hint", id: `hint-${isCompact ? "cell" : "sheet"}`, text: hints(row) });
  const fault = faultText();
  const doubts = el("p", { class: "doubt", role: "status" });
  const recent = el("p", { class: "doubt", role: "status" });
  const report = (read) => {
    fault.textContent = read.error ?? "";
    doubts.textContent = read.error ? "" : warningOf(read.text, info, type);
  };
  const input = inputOf(row, value, hint.id, report);
  const form = el(
    "form",
    {
      class: "edit",
      "aria-label": `Edit ${row.name}`,
      novalidate: true,
      on: {
        submit: (event) => {
          event.preventDefault();
          const read = input.read();
          report(read);
          if (read.error) input.first.focus();
          else {
            stage(read.text);
            leave();
          }
        },
        keydown: (event) => {
          if (event.key === "Escape") leave();
          else if (event.key === "Enter" && !["BUTTON", "TEXTAREA"].includes(event.target.tagName)) form.requestSubmit();
          else return;
          event.preventDefault();
          event.stopPropagation();
        },
      },
    },
    el("div", { class: "fields" }, input.fields),
    hint,
    fault,
    doubts,
    recent,
    el(
      "div",
      { class: "buttons" },
      el("button", { type: "submit", class: "button strong", text: "Stage" }),
      button("Cancel", leave, { kind: "quiet" }),
      defaultOf(row.document) !== null &&
        button("Default", () => input.write(defaultOf(row.document)), { kind: "quiet" }),
    ),
  );
  form.first = input.first;
  form.refresh = (now) => {
    if (!sameText(now.text, before, type))
      recent.textContent = `The vehicle now has ${now.text}${now.recent ? `, by ${now.recent.by}` : ""}.`;
  };
  return form;
}

/** Opens the only form, over the value of a row; returns a function that refreshes it. */
export class CellEditor {
  constructor({ grid, stage }) {
    this.grid = grid;
    this.stage = stage;
    this.box = byId("editor");
    this.row = null;
    grid.root.addEventListener("scroll", () => this.place(), { passive: true });
    addEventListener("resize", () => this.place());
    this.box.addEventListener("focusout", (event) => {
      if (this.row && event.relatedTarget && !this.box.contains(event.relatedTarget)) this.close(false);
    });
  }

  open(row, pending) {
    this.row = row;
    this.form = editorOf(row, pending, {
      stage: (text) => this.stage(row.name, text),
      leave: () => this.close(true),
    });
    this.box.replaceChildren(this.form);
    this.box.hidden = false;
    this.place();
    this.form.first.focus();
    this.form.first.select?.();
  }

  close(isBack) {
    if (!this.row) return;
    this.row = null;
    if (isBack) this.grid.root.focus({ preventScroll: true });
    this.box.hidden = true;
    this.box.replaceChildren();
  }

  refresh(row) {
    if (this.row && row) this.form.refresh(row);
  }

  /** Positions the form at its row, within the screen. */
  place() {
    if (!this.row || isNarrow()) return;
    const cell = this.grid.place(this.row.name);
    const frame = this.grid.root.getBoundingClientRect();
    const { offsetWidth: width, offsetHeight: height } = this.box;
    const top = cell ? Math.max(frame.top, Math.min(cell.top - 5, innerHeight - height - 8)) : frame.top;
    const left = Math.max(8, Math.min((cell ?? frame).left - 8, innerWidth - width - 8));
    this.box.style.transform = `translate(${Math.round(left)}px, ${Math.round(top)}px)`;
  }
}

function inputOf(row, value, hintId, report) {
  const { info, type } = row;
  if (info?.bits && maskOf(value, type) !== null) return boxes(row, value, report);
  if (info?.values) return list(row, value, hintId, report);
  return number(row, value, hintId, report);
}

function number(row, value, hintId, report) {
  const { info, type, name } = row;
  const first = el(/[\r\n]/.test(value) ? "textarea" : "input", {
    class: "number",
    value,
    inputmode: isFloat(type) ? "decimal" : isWhole(type) ? "numeric" : "text",
    autocomplete: "off",
    spellcheck: "false",
    enterkeyhint: "done",
    "aria-label": `Value of ${name}`,
    "aria-describedby": hintId,
    on: {
      input: () => report(parse(first.value, type)),
    },
  });
  const write = (text) => {
    first.value = text;
    report(parse(text, type));
    first.focus();
  };
  return {
    first,
    fields: [first, info?.units && el("span", { class: "units", text: info.units })],
    read: () => parse(first.value, type),
    write,
  };
}

function list(row, value, hintId, report) {
  const { info, type, name } = row;
  const plain = (text) => text.replace(/\.0$/, "");
  const field = number(row, value, hintId, report);
  const options = Object.entries(info.values).sort(([a], [b]) => Number(a) - Number(b));
  const isNamed = options.some(([each]) => each === plain(value));
  const first = el(
    "select",
    {
      "aria-label": `Value of ${name}`,
      "aria-describedby": hintId,
      on: {
        change: () => {
          field.first.hidden = first.value !== OTHER;
          if (first.value === OTHER) field.first.focus();
          else report(parse(first.value, type));
        },
      },
    },
    options.map(([each, text]) => el("option", { value: each, text: `${text} (${each})` })),
    el("option", { value: OTHER, text: "Another number …" }),
  );
  const write = (text) => {
    const isKnown = options.some(([each]) => each === plain(text));
    first.value = isKnown ? plain(text) : OTHER;
    field.first.value = text;
    field.first.hidden = isKnown;
    first.focus();
  };
  first.value = isNamed ? plain(value) : OTHER;
  field.first.hidden = isNamed;
  return {
    first,
    fields: [first, ...field.fields.slice(0, 1)],
    read: () => (first.value === OTHER ? field.read() : parse(first.value, type)),
    write,
  };
}

function boxes(row, value, report) {
  const { info, type, name } = row;
  let mask = maskOf(value, type);
  const total = el("output", { class: "mask" });
  const text = () => textOfMask(mask, type);
  const show = () => {
    total.textContent = `= ${text()} (0x${mask.toString(16)})`;
    for (const [bit, box] of made) box.checked = Boolean((mask >> bit) & 1n);
  };
  const made = Object.keys(info.bits).map((bit) => {
    const box = el("input", {
      type: "checkbox",
      on: {
        change: () => {
          mask ^= 1n << BigInt(bit);
          show();
          report(parse(text(), type));
        },
      },
    });
    return [BigInt(bit), box];
  });
  const labels = made.map(([bit, box]) =>
    el("label", { class: "bit" }, box, el("span", { text: info.bits[bit] }), el("small", { text: `bit ${bit}` })),
  );
  const group = el("fieldset", { class: "bits", "aria-label": `Bits of ${name}` }, labels);
  show();
  return {
    first: made[0]?.[1] ?? total,
    fields: [group, total],
    read: () => parse(text(), type),
    write: (standard) => {
      mask = maskOf(standard, type) ?? mask;
      show();
    },
  };
}

function hints(row) {
  const { info, type } = row;
  const range = rangeOf(info);
  const standard = defaultOf(row.document);
  return [
    `now ${textOf(row.document)}`,
    standard !== null && `default ${standard}`,
    range && `range ${range}`,
    info?.increment && `step ${info.increment}`,
    info?.is_read_only && "read-only: the vehicle sets it",
    info?.reboot_required && "counts from the next start on",
    !info && type,
  ]
    .filter(Boolean)
    .join(" · ");
}
