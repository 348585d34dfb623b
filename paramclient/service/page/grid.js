/**
 * The table: a scrolling list with only its visible rows in the DOM. The grid has the focus and names the selected row.
 */

import { byId, el, isNarrow, setAttribute, setText } from "./dom.js";
import { defaultOf, defaultSourceOf, recentText, textOf } from "./values.js";

/** Rows rendered above and below the visible ones. */
const OVERSCAN_ROWS = 10;
/** Milliseconds without scrolling after which it has ended. */
const SCROLL_END_DELAY = 120;

export class Grid {
  /** `open(row)` edits, `show(row)` opens the details, `moved(row)` reports the selection. */
  constructor({ table, open, show, moved }) {
    this.table = table;
    this.open = open;
    this.show = show;
    this.moved = moved;
    this.root = byId("grid");
    this.body = byId("rows");
    this.head = this.root.querySelector(".head");
    this.rows = [];
    this.index = 0;
    this.name = null;
    this.made = new Map();
    this.spare = [];
    this.root.addEventListener("scroll", () => this.draw(false), { passive: true });
    this.root.addEventListener("keydown", (event) => this.key(event));
    this.body.addEventListener("click", (event) => this.click(event));
    this.body.addEventListener("dblclick", (event) => this.click(event, true));
    new ResizeObserver(() => this.measure()).observe(this.root);
    this.measure();
  }

  /** The selected row, or null. */
  get active() {
    return this.rows[this.index] ?? null;
  }

  measure() {
    this.height = isNarrow() ? 58 : 32;
    this.view = this.root.clientHeight;
    this.top = this.head.offsetHeight;
    for (const made of this.made.values()) made.at = -1;
    this.resize();
    this.draw();
  }

  /** Shows these rows; the selection stays on or near its parameter. */
  set(rows) {
    this.rows = rows;
    const place = this.name === null ? -1 : rows.findIndex((row) => row.name === this.name);
    this.index = place >= 0 ? place : Math.max(0, Math.min(this.index, rows.length - 1));
    this.resize();
    this.draw();
  }

  resize() {
    const height = `${this.rows.length * this.height}px`;
    if (this.body.style.height !== height) this.body.style.height = height;
    setAttribute(this.root, "aria-rowcount", this.rows.length + 1);
  }

  /** Renders rows that have become visible, in the elements of hidden ones. */
  draw(isAnew = true) {
    const top = Math.max(0, this.root.scrollTop - this.top);
    const from = Math.max(0, Math.floor(top / this.height) - OVERSCAN_ROWS);
    const to = Math.min(this.rows.length, Math.ceil((top + this.view) / this.height) + OVERSCAN_ROWS);
    for (const [index, made] of this.made) {
      if (index < from || index >= to) {
        this.made.delete(index);
        this.spare.push(made);
      }
    }
    for (let index = from; index < to; index++) {
      let made = this.made.get(index);
      if (made && !isAnew) continue;
      if (!made) {
        made = this.spare.pop() ?? this.make();
        this.made.set(index, made);
      }
      this.fill(made, index);
    }
    for (const made of this.spare) made.row.hidden = true;
    clearTimeout(this.settling);
    this.settling = setTimeout(() => this.settle(), SCROLL_END_DELAY);
    const shown = this.made.get(this.index);
    setAttribute(this.root, "aria-activedescendant", shown ? shown.row.id : null);
  }

  /** After scrolling, sorts the elements for screen readers. */
  settle() {
    if (this.body.matches(":active")) return this.draw(false); // a pressed row that moves in the DOM is not clicked
    const wanted = [...this.made].sort(([a], [b]) => a - b).map(([, made]) => made.row);
    if (wanted.some((row, place) => this.body.children[place] !== row)) this.body.prepend(...wanted);
  }

  make() {
    const cell = (kind) => el("span", { role: "gridcell", class: kind });
    const made = { at: -1, name: cell("name"), value: cell("value"), third: cell("third"), text: cell("text") };
    made.number = el("b");
    made.units = el("small");
    made.value.append(made.number, made.units);
    made.mark = el("i", { class: "mark" });
    made.label = el("span", { class: "label" });
    made.name.append(made.mark, made.label);
    made.row = el(
      "div",
      { role: "row", class: "row", id: `row-${++this.count}` },
      made.name,
      made.value,
      made.third,
      made.text,
    );
    this.body.append(made.row);
    return made;
  }

  count = 0;

  fill(made, index) {
    const row = this.rows[index];
    const table = this.table();
    const { row: element } = made;
    element.hidden = false;
    if (made.at !== index) {
      made.at = index;
      element.style.transform = `translateY(${index * this.height}px)`;
      element.setAttribute("aria-rowindex", index + 2);
    }
    const pending = table.pending.get(row.name);
    const comparison = table.comparison(row);
    const other = table.other;
    setText(made.label, row.name);
    if (pending) setText(made.number, `${row.text} → ${pending.text}`);
    else setText(made.number, row.text);
    setText(made.units, pending ? "" : row.meaning || row.info?.units || "");
    setText(
      made.third,
      other ? (other.values.get(row.name)?.text ?? (other.isPartial ? "" : "–")) : (defaultOf(row.document) ?? ""),
    );
    setAttribute(made.third, "title", other ? null : defaultSourceOf(row.document));
    setText(made.text, row.description);
    setText(made.mark, "");
    const states = [
      "row",
      pending && "pending",
      row.recent && "recent",
      row.isChanged && "changed",
      comparison === "differs" && "differs",
      comparison === "here" && "differs",
      row.document.trust === "cached" && "cached",
      index === this.index && "active",
    ];
    const kind = states.filter(Boolean).join(" ");
    if (element.className !== kind) element.className = kind;
    setAttribute(element, "aria-selected", index === this.index);
    setAttribute(made.value, "aria-description", rowDescription(row, pending));
    setAttribute(
      element,
      "title",
      row.recent?.kind === "changed"
        ? `${row.recent.before} → ${textOf(row.document)}, changed by ${row.recent.by}`
        : (row.recent?.kind ?? null),
    );
  }

  /** Selects a row and scrolls it into view. */
  go(index) {
    if (!this.rows.length) return;
    this.index = Math.max(0, Math.min(this.rows.length - 1, index));
    this.name = this.rows[this.index].name;
    const top = this.index * this.height;
    const bottom = top + this.height + this.top - this.view;
    if (top < this.root.scrollTop) this.root.scrollTop = top;
    else if (bottom > this.root.scrollTop) this.root.scrollTop = bottom;
    this.draw();
    this.moved(this.active);
  }

  /** Selects a parameter by name if it is shown. */
  find(name) {
    const index = this.rows.findIndex((row) => row.name === name);
    if (index >= 0) this.go(index);
    return index >= 0;
  }

  /** Returns the screen position of a row's value; null if it is not visible. */
  place(name) {
    for (const [index, made] of this.made) {
      if (this.rows[index]?.name === name) return made.value.getBoundingClientRect();
    }
    return null;
  }

  key(event) {
    if (event.target !== this.root || event.ctrlKey || event.metaKey || event.altKey) return;
    const page = Math.max(1, Math.floor(this.view / this.height) - 2);
    const steps = {
      ArrowDown: 1,
      ArrowUp: -1,
      PageDown: page,
      PageUp: -page,
      Home: -Infinity,
      End: Infinity,
    };
    if (event.key in steps) this.go(this.index + steps[event.key]);
    else if (!this.active) return;
    else if (event.key === "Enter" || event.key === "F2") this.open(this.active);
    else if (event.key === " " || event.key === "ArrowRight") this.show(this.active);
    else return;
    event.preventDefault();
  }

  click(event, isTwice = false) {
    const element = event.target.closest(".row");
    const entry = [...this.made].find(([, made]) => made.row === element);
    if (!entry) return;
    this.root.focus({ preventScroll: true });
    this.go(entry[0]);
    if (isNarrow()) this.show(this.active);
    else if (isTwice || event.target.closest(".value")) this.open(this.active);
  }
}

/** Describes the marks of a row in words. */
function rowDescription(row, pending) {
  const words = [
    pending && `staged: ${pending.text}`,
    row.isChanged && "changed from default",
    row.recent && recentText(row.recent),
    row.document.trust === "cached" && "from the cache, not confirmed",
  ];
  return words.filter(Boolean).join("; ") || null;
}
