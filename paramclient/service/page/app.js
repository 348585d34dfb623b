/** The page: connects data, views and user actions. */

import { Stream } from "./api.js";
import { chooseOther, drawBanner } from "./compare.js";
import { Details } from "./details.js";
import { showKeys } from "./dialogs.js";
import { announce, button, byId, el, isNarrow, onceAFrame, setText } from "./dom.js";
import { CellEditor } from "./editor.js";
import { Grid } from "./grid.js";
import { nameOf, outcomesText, review, undo, undoButton } from "./review.js";
import { showStations } from "./stations.js";
import { HIGHLIGHT_TIME, OTHERS, store } from "./store.js";
import { defaultOf, many, parse, recentText } from "./values.js";
import { drawActions, drawVehicles, offerDescriptions, showError } from "./vehicles.js";

const FILTERS = {
  all: { text: "All", has: () => true },
  changed: { text: "Changed from default", has: (row) => row.isChanged === true },
  differs: { text: "Differs", has: (row) => ["differs", "here"].includes(store.table.comparison(row)) },
  pending: { text: "Staged", has: (row) => store.table.pending.has(row.name) },
  recent: { text: "Changed by others", has: (row) => row.recent !== null },
};

const shown = { words: [], group: "", filter: "all" };

const grid = new Grid({
  table: () => store.table,
  open: (row) => edit(row),
  show: (row) => details.open(row, true),
  moved: (row) => details.follow(row),
});
const editor = new CellEditor({ grid, stage: (name, text) => store.stage(name, text) });
const details = new Details({ leave: () => grid.root.focus({ preventScroll: true }) });

function edit(row) {
  if (!store.mayWrite) details.open(row, true);
  else if (isNarrow()) details.open(row, true);
  else editor.open(row, store.table.pending.get(row.name));
}

// filters and views

function matches(row) {
  if (shown.group && row.group !== shown.group) return false;
  if (!FILTERS[shown.filter].has(row)) return false;
  return shown.words.every(
    (word) =>
      row.words.includes(word) || row.text.toLowerCase() === word || (word.length > 1 && row.text.startsWith(word)),
  );
}

/** Sorts names that start with the search text before names that contain it. */
function ranked(rows) {
  const [word] = shown.words;
  if (!word) return rows;
  const rank = ({ name }) => {
    const place = name.toLowerCase().indexOf(word);
    return place === 0 ? 0 : place > 0 ? 1 : 2;
  };
  return rows
    .map((row) => [rank(row), row])
    .sort(([a], [b]) => a - b)
    .map(([, row]) => row);
}

function drawTable() {
  const { table } = store;
  const rows = table.sorted;
  const chosen = ranked(rows.filter(matches));
  grid.set(chosen);
  setText(
    byId("count"),
    chosen.length === rows.length ? many(rows.length, "parameter") : `${chosen.length} of ${rows.length}`,
  );
  drawGroups();
  drawChips();
  drawEmpty(chosen.length, rows.length);
  drawBar();
  offerDescriptions();
  const active = grid.active;
  details.refresh(table.rows.get(details.name));
  if (editor.row) editor.refresh(table.rows.get(editor.row.name));
  if (active && grid.name === null) grid.name = active.name;
}

const draw = onceAFrame(() => {
  drawTable();
  if (store.table.other) drawBanner();
});
const drawState = onceAFrame(() => {
  drawVehicles();
  drawEmpty(grid.rows.length, store.table.rows.size);
});

function drawGroups() {
  const { groups, rows } = store.table;
  const key = JSON.stringify([store.selected, shown.group, [...groups]]);
  const list = byId("groups");
  if (list.dataset.shown === key) return;
  list.dataset.shown = key;
  const hadFocus = list.contains(document.activeElement);
  const names = [...groups.keys()].sort((a, b) => Number(a === OTHERS) - Number(b === OTHERS) || a.localeCompare(b));
  const total = rows.size;
  const item = (group, text, count) =>
    el(
      "li",
      {},
      el(
        "button",
        {
          type: "button",
          class: `group${group === shown.group ? " chosen" : ""}`,
          "aria-current": group === shown.group ? "true" : null,
          on: { click: () => choose({ group }) },
        },
        el("span", { text }),
        el("small", { text: String(count) }),
      ),
    );
  list.replaceChildren(item("", "All groups", total), ...names.map((name) => item(name, name, groups.get(name))));
  if (hadFocus) list.querySelector(".chosen")?.focus();
  const choice = byId("group-choice");
  choice.replaceChildren(
    el("option", { value: "", text: `All groups (${total})` }),
    ...names.map((name) => el("option", { value: name, text: `${name} (${groups.get(name)})` })),
  );
  choice.value = shown.group;
}

function drawChips() {
  const { table } = store;
  const rows = table.sorted;
  const counts = {};
  for (const kind of Object.keys(FILTERS))
    counts[kind] = kind === "all" ? rows.length : rows.reduce((sum, row) => sum + Number(FILTERS[kind].has(row)), 0);
  const kinds = Object.keys(FILTERS).filter(
    (kind) =>
      ["all", "changed", shown.filter].includes(kind) || counts[kind] || (kind === "differs" && table.other),
  );
  const key = JSON.stringify([shown.filter, kinds.map((kind) => [kind, counts[kind]])]);
  const box = byId("chips");
  if (box.dataset.shown === key) return;
  box.dataset.shown = key;
  const focused = box.contains(document.activeElement) ? document.activeElement.dataset.kind : null;
  box.replaceChildren(
    ...kinds.map((kind) =>
      el(
        "button",
        {
          type: "button",
          class: `chip ${kind}`,
          data: { kind },
          "aria-pressed": String(kind === shown.filter),
          on: { click: () => choose({ filter: kind }) },
        },
        el("span", { text: FILTERS[kind].text }),
        kind !== "all" && el("small", { text: String(counts[kind]) }),
      ),
    ),
  );
  if (focused) [...box.children].find((chip) => chip.dataset.kind === focused)?.focus();
}

function drawEmpty(count, total) {
  const { component, table } = store;
  const box = byId("empty");
  const text = emptyText(count, total, component, table);
  box.hidden = !text;
  byId("grid").classList.toggle("bare", Boolean(text));
  setText(box, text);
}

function emptyText(count, total, component, table) {
  if (count) return "";
  if (!component) return store.isConnected ? "No vehicle found yet. Vehicles appear here automatically." : "";
  if (!total)
    return component.fetch
      ? "Loading the parameters."
      : table.isLoaded
        ? "No parameters are known yet. Fetch requests them from the vehicle."
        : "Loading …";
  if (shown.filter === "changed" && !shown.words.length)
    return table.sorted.some((row) => row.isChanged !== null)
      ? "All values are the firmware's defaults."
      : "The defaults of this vehicle are not known.";
  return "No parameter matches the search.";
}

function drawBar() {
  const { pending, sent } = store.table;
  const bar = byId("bar");
  const count = pending.size;
  const key = JSON.stringify([store.selected, count, sent?.at, store.mayWrite]);
  if (bar.dataset.shown === key) return;
  bar.dataset.shown = key;
  bar.hidden = !count && !sent;
  if (count) {
    bar.replaceChildren(
      el("b", { text: `${many(count, "change")} staged` }),
      button("Drop", () => store.unstageAll(), { kind: "quiet", label: "Drop all changes" }),
      button("Review …", review, { kind: "strong" }),
    );
  } else if (sent) {
    const forget = () => {
      store.table.sent = null;
      draw();
    };
    bar.replaceChildren(
      el("span", { text: `Sent: ${outcomesText(sent.outcomes)}` }),
      undoButton(sent),
      button("", forget, { kind: "quiet only", drawing: "close", label: "Close" }),
    );
  }
}

/** Handles a change of the filter. */
function choose(change) {
  Object.assign(shown, change);
  grid.root.scrollTop = 0;
  byId("group-choice").value = shown.group;
  drawTable();
}

// events of the service

store.on("all", () => {
  byId("rail").hidden = byId("main").hidden = false; // hidden until a valid token is there
  editor.close(false);
  details.forget();
  shown.group = "";
  if (shown.filter !== "changed") shown.filter = "all";
  drawActions();
  drawVehicles();
  drawBanner();
  drawTable();
});
store.on("components", drawState);
store.on("table", draw);
store.on("pending", draw);
store.on("other", () => {
  shown.filter = store.table.other ? "differs" : "all";
  if (store.table.other) {
    byId("search").value = ""; // the previous search would hide differences
    shown.words = [];
  }
  drawBanner();
  drawTable();
});
store.on("armed", (component) =>
  announce(`${nameOf(component)} is ${component.is_armed ? "armed" : "not armed any more"}.`),
);

const recent = [];
store.on("recent", ({ key, row }) => {
  if (key !== store.selected) return;
  if (!recent.length) {
    setTimeout(() => {
      const [first] = recent;
      announce(recent.length > 1 ? `${recent.length} parameters were changed by others.` : `${first.name}: ${recentText(first)}.`);
      recent.length = 0;
    }, 1000);
  }
  recent.push({ name: row.name, ...row.recent });
});
setInterval(() => {
  for (const table of store.tables.values())
    for (const row of table.rows.values()) if (row.recent && Date.now() - row.recent.at > HIGHLIGHT_TIME) row.recent = null;
  draw();
}, 60_000);

const stream = new Stream({
  begin: () =>
    store.begin().catch((error) => {
      showError(error);
      stream.last = null; // begin anew
      setTimeout(() => stream.open(), 2000);
    }),
  take: (event) => store.take(event),
  changed: (isOpen) => {
    if (store.isConnected === isOpen) return;
    const before = store.isConnected;
    store.isConnected = isOpen;
    byId("unreachable").hidden = isOpen;
    setText(
      byId("unreachable"),
      isOpen
        ? ""
        : "The service does not respond. Shown values may be outdated. The page reconnects automatically.",
    );
    setText(byId("connection"), isOpen ? "" : "not connected");
    if (isOpen && before === false) announce("The service responds again.");
    drawState();
  },
});

// user actions

byId("search").addEventListener("input", () => {
  choose({ words: byId("search").value.toLowerCase().split(/\s+/).filter(Boolean) });
});
byId("search").addEventListener("keydown", (event) => {
  if (event.key === "Enter" || event.key === "ArrowDown") {
    event.preventDefault();
    grid.root.focus();
    grid.go(0);
  } else if (event.key === "Escape") {
    event.preventDefault();
    if (byId("search").value) {
      byId("search").value = "";
      choose({ words: [] });
    } else grid.root.focus();
  }
});
byId("group-choice").addEventListener("change", () => choose({ group: byId("group-choice").value }));
byId("vehicle-choice").addEventListener("change", () => store.select(byId("vehicle-choice").value).catch(showError));
byId("tools").append(
  button("", () => showStations().catch(showError), { kind: "quiet only", drawing: "station", label: "Ground stations" }),
  button("", showKeys, { kind: "quiet only", drawing: "help", label: "Keys" }),
);

const KEYS = {
  "/": () => {
    byId("search").focus();
    byId("search").select();
  },
  "?": showKeys,
  d: () => take((row) => defaultOf(row.document)),
  t: () => take((row) => store.table.other?.values.get(row.name)?.text ?? null),
  u: () => grid.active && store.unstage(grid.active.name),
};

/** Stages another value of the selected row. */
function take(valueOf) {
  const row = grid.active;
  const text = row && store.mayWrite ? valueOf(row) : null;
  if (text === null) return;
  const read = parse(text, row.type);
  if (!read.error) store.stage(row.name, read.text);
}

document.addEventListener("keydown", (event) => {
  const isTyping = event.target.closest("input, select, textarea, dialog, #editor");
  if ((event.ctrlKey || event.metaKey) && !event.altKey && !byId("dialog").open) {
    if (event.key === "Enter") {
      editor.form?.isConnected && editor.row ? editor.form.requestSubmit() : null;
      review();
    } else if (event.key.toLowerCase() === "z" && !isTyping) undo();
    else return;
    event.preventDefault();
  } else if (!isTyping && !event.altKey && event.key in KEYS) {
    event.preventDefault();
    KEYS[event.key]();
  } else if (event.key === "Escape" && !isTyping && !event.defaultPrevented) grid.root.focus({ preventScroll: true });
});

addEventListener("dragover", (event) => {
  if (event.dataTransfer?.types.includes("Files")) event.preventDefault();
});
addEventListener("drop", (event) => {
  const [file] = event.dataTransfer?.files ?? [];
  if (!file) return;
  event.preventDefault();
  if (store.component) chooseOther(file);
});
addEventListener("beforeunload", (event) => {
  if ([...store.tables.values()].some((table) => table.pending.size)) event.preventDefault();
});

stream.open();
