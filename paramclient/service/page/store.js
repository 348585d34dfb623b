/** The state of the page: vehicles, tables, staged and written changes. */

import { AUTHOR, at, get, roleOf } from "./api.js";
import { meaningOf, sameText, textOf } from "./values.js";

/** Milliseconds for which changes by other clients are highlighted. */
export const HIGHLIGHT_TIME = 600_000;
/** Milliseconds until a table is loaded again after an error. */
const RELOAD_DELAY = 2_000;
/** Parameters with one prefix from which on they are a group. */
const GROUP_SIZE_MIN = 2;
export const OTHERS = "Others";

export const keyOf = ({ link, system, component, extended }) =>
  `${link} ${system}/${component}${extended ? " extended" : ""}`;

/** One parameter: the document of the service, and derived values. */
class Row {
  constructor(document) {
    this.recent = null;
    this.take(document);
  }

  take(document) {
    const info = document.metadata ?? this.info;
    this.document = document;
    this.info = info;
    this.name = document.name;
    this.type = document.type;
    this.text = textOf(document);
    this.meaning = meaningOf(this.text, info, this.type);
    this.isChanged = document.is_default === undefined ? null : !document.is_default;
    this.description = info?.short_description ?? "";
    this.words = `${this.name} ${this.description} ${this.meaning} ${info?.long_description ?? ""}`.toLowerCase();
  }
}

/** The table of one component, and the changes staged for it. */
class Table {
  constructor() {
    this.rows = new Map();
    this.pending = new Map();
    this.sent = null;
    this.other = null;
    this.seq = -1;
    this.wanted = -1;
    this.loads = 0;
    this.isLoaded = false;
    this.early = null;
    this.forget();
  }

  /** Rows sorted by name, each with its group. */
  get sorted() {
    if (!this.order) {
      this.order = [...this.rows.values()].sort((a, b) => (a.name < b.name ? -1 : a.name > b.name ? 1 : 0));
      this.groups = new Map();
      const prefix = (row) => row.name.split("_", 1)[0];
      const counts = new Map();
      for (const row of this.order) counts.set(prefix(row), (counts.get(prefix(row)) ?? 0) + 1);
      for (const row of this.order) {
        row.group = row.info?.group || (counts.get(prefix(row)) < GROUP_SIZE_MIN ? OTHERS : prefix(row));
        this.groups.set(row.group, (this.groups.get(row.group) ?? 0) + 1);
      }
    }
    return this.order;
  }

  forget() {
    this.order = null;
    this.groups = new Map();
  }

  load(documents, seq) {
    const before = this.rows;
    this.rows = new Map();
    for (const [name, document] of Object.entries(documents)) {
      const row = before.get(name) ?? new Row({ name, ...document });
      row.take({ name, ...document });
      this.rows.set(name, row);
    }
    this.seq = seq;
    this.isLoaded = true;
    this.forget();
  }

  /** Continues with the previously loaded table, if any. */
  keep() {
    this.isLoaded = this.rows.size > 0;
  }

  /** Applies a change; returns the row that was changed, added or removed, or null. */
  change(event) {
    if (!this.isLoaded) {
      this.early?.push(event); // without a load in progress, the next one includes the event
      return null;
    }
    const isIncluded = event.seq <= this.seq; // in the loaded table: only announced
    const isTrust = event.old && event.new && sameText(textOf(event.old), textOf(event.new), event.new.type);
    const row = this.rows.get(event.name);
    const recent = { at: Date.now(), by: authorOf(event.by), kind: event.kind };
    if (event.new === null) {
      if (!isIncluded && this.rows.delete(event.name)) this.forget();
      return row || isIncluded ? { ...row, name: event.name, recent } : null;
    }
    if (isIncluded) {
      if (!row || isTrust || (event.kind !== "added" && !event.old)) return null;
      row.recent = { ...recent, before: event.old && textOf(event.old) };
      return row;
    }
    const document = { name: event.name, ...event.new };
    if (!row) {
      const added = new Row(document);
      this.rows.set(event.name, added);
      this.forget();
      if (event.kind !== "added") return null;
      added.recent = recent;
      return added;
    }
    const before = row.text;
    row.take(document);
    if (isTrust || sameText(before, row.text, row.type)) return null;
    row.recent = { ...recent, kind: "changed", before };
    return row;
  }

  /** Compares a row with the compared set: "same", "differs", "here", "there", or null. */
  comparison(row) {
    if (!this.other) return null;
    const other = this.other.values.get(row.name);
    if (other === undefined) return this.other.isPartial ? null : "here";
    return sameText(row.text, other.text, row.type) ? "same" : "differs";
  }
}

/** The whole state. `on(kind, listener)` returns a function that unsubscribes. */
class Store {
  constructor() {
    this.role = null;
    this.components = new Map();
    this.tables = new Map();
    this.selected = null;
    this.isConnected = null;
    this.seq = -1;
    this.early = null;
    this.listeners = new Map();
    this.loads = 0;
  }

  on(kind, listener) {
    if (!this.listeners.has(kind)) this.listeners.set(kind, []);
    this.listeners.get(kind).push(listener);
    return () =>
      this.listeners.set(
        kind,
        this.listeners.get(kind).filter((each) => each !== listener),
      );
  }

  /** Subscribes while an element is in the page. */
  whileShown(element, kind, listener) {
    const end = this.on(kind, (what) => (element.isConnected ? listener(what) : end()));
  }

  emit(kind, what) {
    for (const listener of this.listeners.get(kind) ?? []) listener(what);
  }

  /** The selected component, or null. */
  get component() {
    return this.components.get(this.selected) ?? null;
  }

  get table() {
    return this.tables.get(this.selected) ?? NO_TABLE;
  }

  get mayWrite() {
    return this.role === "write";
  }

  /** Loads the state of the service; events during the load are applied afterwards. */
  async begin() {
    const load = ++this.loads;
    this.early = [];
    for (const table of this.tables.values()) {
      table.isLoaded = table.isLoading = false;
      table.early = null;
      table.seq = table.wanted = -1; // another run counts anew
      table.loads++;
    }
    const found = await get("/api/vehicles");
    const role = await roleOf();
    if (load !== this.loads) return;
    this.role = role;
    const documents = new Map(found.vehicles.map((each) => [keyOf(each), each]));
    const before = this.components.get(this.selected);
    if (before && !documents.has(this.selected)) documents.set(this.selected, asLost(before));
    this.components = documents;
    this.seq = found.seq;
    const early = this.early;
    this.early = null;
    for (const event of early) this.take(event);
    if (!this.component) this.selected = first(this.components);
    this.emit("all");
    if (this.selected) await this.loadTable(this.selected);
  }

  async select(key) {
    this.selected = key;
    this.emit("all");
    if (!this.table.isLoaded) await this.loadTable(key);
  }

  async loadTable(key) {
    const component = this.components.get(key);
    if (!component) return;
    const table = this.tableOf(key);
    table.isLoaded = false;
    table.early ??= [];
    const load = ++table.loads;
    table.isLoading = true;
    let found;
    try {
      found = await get(at(component, "/params", { metadata: "true" }));
    } catch (error) {
      if (load !== table.loads) return;
      this.keepTable(key, !(error.status < 500));
      throw error;
    } finally {
      if (load === table.loads) table.isLoading = false;
    }
    if (load !== table.loads) return;
    table.load(found.params, found.seq ?? -1);
    this.catchUp(key);
    this.reload(key, -1);
  }

  /** After a failed load, the table stays, with later events applied, and is loaded again. */
  keepTable(key, mayWork) {
    const table = this.tableOf(key);
    table.keep();
    this.catchUp(key);
    if (key !== this.selected) return;
    const load = table.loads;
    const again = () => load === table.loads && key === this.selected && this.loadTable(key).catch(() => {});
    if (mayWork) setTimeout(again, RELOAD_DELAY);
  }

  /** Takes the changes that arrived during a load. */
  catchUp(key) {
    const table = this.tableOf(key);
    const early = table.early ?? [];
    table.early = null;
    for (const event of early) this.takeChange(key, event);
    if (key === this.selected) this.emit("table");
  }

  tableOf(key) {
    if (!this.tables.has(key)) this.tables.set(key, new Table());
    return this.tables.get(key);
  }

  take(event) {
    if (this.early !== null) {
      this.early.push(event);
      return;
    }
    if (event.type === "link") {
      for (const each of this.components.values()) if (each.link === event.link) each.link_state = event.state;
      this.emit("components");
      return;
    }
    const key = keyOf(event);
    if (event.type === "vehicle") this.takeComponent(key, event);
    else if (event.type === "change") this.takeChange(key, event);
    else if (event.type === "apply") this.emit("apply", event);
  }

  takeComponent(key, event) {
    if (event.seq <= this.seq) return;
    const document = event.vehicle;
    const isForgotten = document === null;
    if (isForgotten) {
      const before = this.components.get(key);
      if (key === this.selected && before) this.components.set(key, asLost(before));
      else this.components.delete(key);
      const table = this.tables.get(key);
      if (table) table.isLoaded = false; // staged changes wait for the vehicle's return
    } else {
      const before = this.components.get(key);
      this.components.set(key, document);
      const isReady = (each) => each && `${each.fetches} ${each.has_metadata} ${each.state === "synced"}`;
      if (before && isReady(before) !== isReady(document)) this.reload(key, event.seq);
      if (before && Boolean(before.is_armed) !== Boolean(document.is_armed)) this.emit("armed", document);
    }
    const isBack = key === this.selected && !isForgotten && !this.table.isLoaded && !this.table.isLoading;
    if (isBack) this.loadTable(key).catch(() => {});
    if (!this.component) {
      const key = first(this.components);
      if (key) this.select(key);
      else this.emit("all");
    } else this.emit("components");
  }

  takeChange(key, event) {
    const table = this.tables.get(key);
    if (!table) return;
    const row = table.change(event);
    if (row?.info?.is_volatile) row.recent = null;
    else if (row) {
      if (event.by?.includes(AUTHOR)) row.recent = null;
      else this.emit("recent", { key, row });
    }
    if (key === this.selected) this.emit("table");
  }

  /** Loads a table again, after a load in progress, if it lacks what an event reports. */
  reload(key, seq) {
    const table = this.tables.get(key);
    if (!table) return;
    table.wanted = Math.max(table.wanted, seq);
    clearTimeout(table.reloading);
    const isDue = () => table.isLoaded && table.wanted > table.seq;
    table.reloading = setTimeout(() => isDue() && this.loadTable(key).catch(() => {}), 150);
  }

  /** Stages a value; one equal to the vehicle's is removed. */
  stage(name, text) {
    const row = this.table.rows.get(name);
    if (!row) return;
    if (sameText(text, row.text, row.type)) this.table.pending.delete(name);
    else this.table.pending.set(name, { name, text, before: row.text });
    this.emit("pending");
  }

  unstage(name) {
    if (this.table.pending.delete(name)) this.emit("pending");
  }

  unstageAll() {
    this.table.pending.clear();
    this.emit("pending");
  }
}

const NO_TABLE = new Table();

/** A selected component that the service has removed: only the user changes the selection. */
const asLost = (component) => ({ ...component, is_armed: null, state: "lost", silence_s: 0, fetch: null });

/** Names the source of a change. */
export function authorOf(by) {
  if (!by || by === "vehicle") return "the vehicle";
  if (by.includes(AUTHOR)) return "you";
  if (by === "us") return "the service";
  return by.startsWith("us for ") ? by.slice(7) : by;
}

/** Returns the key of the lowest autopilot, else of the lowest component: they are sorted. */
function first(components) {
  const all = [...components.values()].sort((a, b) => a.system - b.system || a.component - b.component);
  const chosen = all.find((each) => each.component === 1) ?? all.find((each) => each.params) ?? all[0];
  return chosen ? keyOf(chosen) : null;
}

export const store = new Store();
