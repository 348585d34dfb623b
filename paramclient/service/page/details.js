/** Details of one parameter: description, trust, history, and the form to edit it. */

import { at, get } from "./api.js";
import { button, byId, el, isNarrow, nothing } from "./dom.js";
import { editorOf } from "./editor.js";
import { authorOf, store } from "./store.js";
import { defaultOf, defaultSourceOf, meaningOf, moment, recentText, numberText, parse, rangeOf, span, textOf } from "./values.js";

/** History entries shown, at most. */
const HISTORY_ENTRIES_MAX = 20;
const TRUST = {
  live: "received from the vehicle",
  verified: "from the cache, confirmed by the vehicle",
  cached: "from the cache, not confirmed",
};

export class Details {
  constructor({ leave }) {
    this.root = byId("details");
    this.leave = leave;
    this.name = null;
    this.root.addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return;
      event.preventDefault();
      this.close();
    });
  }

  get isOpen() {
    return !this.root.hidden;
  }

  /** Shows a parameter; `isWanted` opens the panel and moves the focus to it. */
  open(row, isWanted) {
    if (!row) return;
    this.root.hidden = false;
    document.body.classList.toggle("with-sheet", isNarrow());
    if (this.name !== row.name || this.key !== store.selected) this.draw(row);
    if (isWanted)
      (this.form && isNarrow()
        ? this.root.querySelector("h2")
        : (this.form?.first ?? this.root.querySelector("h2"))
      ).focus();
  }

  /** Shows the selected row if the panel is open. */
  follow(row) {
    if (this.isOpen && row && !this.root.contains(document.activeElement)) this.open(row, false);
  }

  close() {
    this.forget();
    this.leave();
  }

  forget() {
    this.root.hidden = true;
    document.body.classList.remove("with-sheet");
    this.name = null;
  }

  draw(row) {
    this.name = row.name;
    this.key = store.selected;
    this.form = store.mayWrite
      ? editorOf(row, store.table.pending.get(row.name), {
          stage: (text) => store.stage(row.name, text),
          leave: () => this.close(),
          isCompact: false,
        })
      : null;
    this.value = el("p", { class: "now" });
    this.facts = el("dl");
    this.past = el("ol", { class: "past" });
    const { info } = row;
    this.root.replaceChildren(
      el(
        "header",
        {},
        el("h2", { tabindex: "-1", text: row.name }),
        button("", () => this.close(), { kind: "quiet only", drawing: "close", label: "Close" }),
      ),
      el(
        "div",
        { class: "scroll" },
        info?.short_description && el("p", { class: "short", text: info.short_description }),
        this.value,
        this.form,
        info?.long_description && el("p", { class: "long", text: info.long_description }),
        this.facts,
        el("h3", { text: "History" }),
        this.past,
      ),
    );
    this.refresh(row);
    this.loadPast(row);
  }

  /** Updates the value and its staged change. */
  refresh(row) {
    if (!this.isOpen || !row || row.name !== this.name) return;
    const { document: known, info } = row;
    this.form?.refresh(row);
    this.value.replaceChildren(
      el("b", { text: row.text }),
      el("span", { text: row.meaning || info?.units || "" }),
      row.recent ? el("em", { text: recentText(row.recent, `${span((Date.now() - row.recent.at) / 1000)} ago`) }) : "",
    );
    const standard = defaultOf(known);
    const facts = [
      ["Default", standard !== null && `${standard}${meaning(standard, row)}`, defaultSourceOf(known)],
      ["Range", rangeOf(info)],
      ["Type", row.type],
      ["Index", known.index],
      ["Group", row.group],
      ["Value", TRUST[known.trust] ?? known.trust],
      ["Restart", info?.reboot_required && "a new value counts from the next start on"],
      ["Read-only", info?.is_read_only && "the vehicle sets it by itself"],
      ["Changes", info?.is_volatile && "by itself, now and then"],
    ];
    const shown = facts.filter(([, text]) => text !== null && text !== undefined && text !== false && text !== "");
    this.facts.replaceChildren(
      ...shown.flatMap(([word, text, title]) => [el("dt", { text: word }), el("dd", { text: String(text), title })]),
    );
    if (row.recent && row.recent.at !== this.recentAt) {
      this.recentAt = row.recent.at;
      this.loadPast(row);
    }
  }

  async loadPast(row) {
    const component = store.component;
    if (!component) return;
    try {
      const found = await get(at(component, "/history", { name: row.name, limit: HISTORY_ENTRIES_MAX }));
      if (this.name !== row.name) return;
      const entries = [...found.history].sort((a, b) => timeOf(b) - timeOf(a));
      this.past.replaceChildren(...entries.map((entry) => this.entry(entry, row)));
      if (!entries.length) this.past.append(nothing("No changes recorded."));
    } catch (error) {
      this.past.replaceChildren(nothing(error.message));
    }
  }

  entry(entry, row) {
    const old = valueText(entry.old, row.type);
    const now = entry.new === null ? "gone" : valueText(entry.new, row.type);
    const take = () => {
      const { error, text } = parse(old, row.type);
      if (!error) store.stage(row.name, text);
    };
    return el(
      "li",
      {},
      el("span", { class: "step", text: `${old} → ${now}` }),
      el("small", { text: `${moment(timeOf(entry))} · ${authorOf(entry.by)}` }),
      store.mayWrite && button("Take", take, { kind: "quiet", label: `Take ${old} again` }),
    );
  }
}

/** Returns the time of a history entry in unix seconds. */
const timeOf = (entry) => Date.parse(entry.time) / 1000;

/** Returns the value of a document, which is a parameter or a number. */
export function valueText(value, type) {
  return value !== null && typeof value === "object" ? textOf({ type, ...value }) : numberText(value, type);
}

function meaning(text, row) {
  const words = meaningOf(text, row.info, row.type) || row.info?.units;
  return words ? ` ${words}` : "";
}
