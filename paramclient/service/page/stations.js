/** The dialog of the ground stations behind the gateway, and of what the answers to them have saved. */

import { get } from "./api.js";
import { closeDialog, openDialog } from "./dialogs.js";
import { button, el } from "./dom.js";
import { many, span } from "./values.js";

/** Milliseconds between two requests while the dialog is open. */
const INTERVAL = 2_000;

/** Shows the stations, and keeps the list current until the dialog is closed. */
export async function showStations() {
  const summary = el("p", { class: "summary", role: "status" });
  const list = el("ul", { class: "stations" });
  const load = async () => {
    const stations = await get("/api/stations");
    const saved = stations.reduce((sum, each) => sum + each.saved_bytes, 0);
    summary.textContent = stations.length
      ? `${many(stations.length, "station")}. Answers from the cache kept ${size(saved)} off the links of the vehicles.`
      : "No ground station is connected. Stations connect to the endpoints of serve --mavlink.";
    list.replaceChildren(...stations.map(item));
  };
  await load();
  const timer = setInterval(() => load().catch(() => {}), INTERVAL);
  const close = button("Close", closeDialog, { kind: "strong" });
  await openDialog("Ground stations", el("div", {}, summary, list), [close], { focus: close });
  clearInterval(timer);
}

function item(station) {
  const asked = Object.entries(station.requests).map(([kind, count]) => `${count} × ${kind}`);
  const heard = `as ${station.ids.join(", ")}, MAVLink ${station.mavlink}, last heard ${span(station.silence_s)} ago`;
  return el(
    "li",
    {},
    el("b", { text: station.name }),
    el("small", { text: station.ids.length ? heard : "Not heard yet" }),
    el("small", { text: asked.length ? `Asked for: ${asked.join(", ")}` : "Has asked for no parameters" }),
    el("small", { text: `${many(station.answered, "answer")} from the cache, ${size(station.saved_bytes)} saved` }),
    station.dropped > 0 && el("small", { class: "fault", text: `${many(station.dropped, "frame")} dropped: it reads too slowly` }),
  );
}

/** Formats a number of bytes: `820 bytes`, `4.2 kB`, `1.3 MB`. */
function size(bytes) {
  if (bytes < 1000) return many(bytes, "byte");
  return bytes < 1e6 ? `${(bytes / 1000).toFixed(1)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}
