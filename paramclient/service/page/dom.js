/** DOM elements. Texts are inserted as `textContent`, never as markup. */

/**
 * Creates an element. `props` are attributes, except `class`, `text`, `on` (listeners) and `data`. Attributes and
 * children that are false, null or undefined are omitted.
 */
export function el(tag, props = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "class") made.className = value;
    else if (name === "text") made.textContent = value;
    else if (name === "on") for (const [type, listener] of Object.entries(value)) made.addEventListener(type, listener);
    else if (name === "data") Object.assign(made.dataset, value);
    else if (name in PROPERTIES) made[name] = value;
    else made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return made;
}

/** Returns the element with this id, which always exists. */
export const byId = (id) => document.getElementById(id);

/** Returns a decorative icon of the page. */
export function icon(name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("class", "icon");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(SVG, "path");
  path.setAttribute("d", DRAWINGS[name]);
  svg.append(path);
  return svg;
}

/** Creates a button with a text, an icon, or both; `label` names one with only an icon. */
export function button(text, onclick, { kind = "", drawing = null, label = null, ...more } = {}) {
  return el(
    "button",
    {
      type: "button",
      class: `button ${kind}`.trim(),
      "aria-label": label,
      title: label,
      on: { click: onclick },
      ...more,
    },
    drawing && icon(drawing),
    text && el("span", { text }),
  );
}

/** Sets a text if it differs: no rendering and no announcement otherwise. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Sets or removes an attribute if it differs. */
export function setAttribute(element, name, value) {
  if (value === null || value === undefined || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
}

/** Returns an item of a list of choices. */
export const choice = (name, remark, click) => {
  const texts = [el("b", { text: name }), el("small", { text: remark })];
  return el("li", {}, el("button", { type: "button", class: "choice", on: { click } }, texts));
};

/** Returns the item of an empty list. */
export const nothing = (text) => el("li", { class: "nothing", text });

/** Returns a paragraph for an error. */
export const faultText = () => el("p", { class: "fault", role: "alert" });

/** Returns a table of changes. Its columns are headings, or elements of their own. */
export function changesTable(columns, body, kind = "") {
  const heads = columns.map((each) => (each.nodeType ? each : el("th", { scope: "col", text: each })));
  return el("table", { class: `changes ${kind}` }, el("thead", {}, el("tr", {}, heads)), body);
}

/** Announces a text to screen readers. */
export function announce(text) {
  const region = byId("spoken");
  region.append(el("p", { text }));
  while (region.children.length > ANNOUNCEMENTS_MAX) region.firstChild.remove();
}

/** Returns a function that runs once per frame for all its calls. */
export function onceAFrame(work) {
  let isDue = false;
  return () => {
    if (isDue) return;
    isDue = true;
    // a hidden page gets no frames, but must be current when it is shown again
    const begin = document.hidden ? (run) => setTimeout(run, HIDDEN_FRAME_INTERVAL) : requestAnimationFrame;
    begin(() => {
      isDue = false;
      work();
    });
  };
}

/** Returns whether the screen has space for the list only, as on a phone. */
export const isNarrow = () => matchMedia("(max-width: 760px)").matches;

const SVG = "http://www.w3.org/2000/svg";
/** Announcements that a screen reader still finds, at most. */
const ANNOUNCEMENTS_MAX = 5;
/** Milliseconds between two renderings of a hidden page. */
const HIDDEN_FRAME_INTERVAL = 200;
const PROPERTIES = { value: 1, checked: 1, disabled: 1, hidden: 1, indeterminate: 1, selected: 1, max: 1 };
const DRAWINGS = {
  keep: "M2.5 5h2.7l1-1.5h3.6l1 1.5h2.7v8h-11ZM8 11a2.2 2.2 0 1 0 0-4.4A2.2 2.2 0 0 0 8 11Z",
  close: "M4 4l8 8M12 4l-8 8",
  refresh: "M13 8a5 5 0 1 1-1.5-3.6M13 2v3h-3",
  save: "M8 2.5v7M5 7l3 3 3-3M3 13h10",
  compare: "M5 2.5v11M2.5 5 5 2.5 7.5 5M11 13.5v-11M8.5 11l2.5 2.5 2.5-2.5",
  station: "M8 9v5M5 14h6M8 7.5a1 1 0 1 0 0-2 1 1 0 0 0 0 2ZM4.8 9.7a4.5 4.5 0 0 1 0-6.4M11.2 3.3a4.5 4.5 0 0 1 0 6.4",
  help: "M5.8 6a2.2 2.2 0 1 1 3.2 2c-.7.4-1 .8-1 1.6M8 12.2v.3",
  undo: "M3 6.5h6.5a3.5 3.5 0 0 1 0 7H6M3 6.5 6 3.5M3 6.5l3 3",
};
