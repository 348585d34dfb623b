/** Requests to the service, and its event stream. */

/** Value of X-Author in every request: the page recognizes its own changes by it. */
export const AUTHOR = `page-${crypto.getRandomValues(new Uint16Array(1))[0].toString(16).padStart(4, "0")}`;
const BASE = "/api/v1";
/** Timeout of a request in milliseconds. */
const REQUEST_TIMEOUT = 15_000;
/** Milliseconds between two checks whether the service responds. */
const CHECK_INTERVAL = 10_000;
/** Maximum milliseconds between two attempts to open the event stream. */
const RETRY_INTERVAL_MAX = 10_000;
const KINDS = [
  ...["hello", "component", "change", "params", "resynced", "progress", "job", "link", "gap"],
  ...["extended_change", "extended_params", "extended_progress"],
];

/** An error of the service; `status` is 0 if it cannot be reached. */
export class Problem extends Error {
  constructor(status, document) {
    super(
      document?.detail ||
        document?.title ||
        (status ? `The service responded with status ${status}.` : "The service cannot be reached."),
    );
    this.status = status;
    this.document = document ?? {};
  }
}

let askForToken = () => Promise.reject(new Problem(401, { detail: "A token is required." }));

/** Sets the function that asks for a token; it resolves when the session has started. */
export function onToken(ask) {
  askForToken = ask;
}

/** Returns the path of a component's resource, or of its cached data (`is_kept`). */
export function at(component, what = "", query = {}) {
  if (component.is_kept) {
    const search = new URLSearchParams(query);
    return `/vehicles/${encodeURIComponent(component.key)}/${component.component}${what}?${search}`;
  }
  const search = new URLSearchParams({ link: component.link, ...query });
  return `/components/${component.system}/${component.component}${what}?${search}`;
}

/**
 * Sends a request and returns the JSON of the response, or null. `body` is sent as JSON, a File unchanged. If a token
 * is required, asks the user and repeats the request.
 */
export async function request(method, address, body, { timeout = REQUEST_TIMEOUT } = {}) {
  const answer = await exchange(method, address, body, timeout);
  return isJson(answer) ? answer.json() : null;
}

export const get = (address) => request("GET", address);

/** Requests a file to save: its name and content. */
export async function download(address, timeout) {
  const answer = await exchange("GET", address, undefined, timeout);
  const [, name] = /filename="?([^";]+)/.exec(answer.headers.get("content-disposition") ?? "") ?? [];
  return { name: name ?? "parameters", content: await answer.blob() };
}

const isJson = (answer) => answer.status !== 204 && (answer.headers.get("content-type") ?? "").includes("json");

async function exchange(method, address, body, timeout) {
  for (;;) {
    const answer = await attempt(method, address, body, timeout);
    if (answer.ok) return answer;
    if (answer.status !== 401 || address === "/session")
      throw new Problem(answer.status, isJson(answer) ? readable(await answer.json()) : null);
    await askForToken();
  }
}

async function attempt(method, address, body, timeout) {
  const ends = AbortSignal.timeout(timeout);
  const options = { method, signal: ends, headers: { "X-Author": AUTHOR }, cache: "no-store" };
  if (body instanceof Blob) {
    options.body = body;
    options.headers["Content-Type"] = "application/octet-stream";
  } else if (body !== undefined) {
    options.body = JSON.stringify(body);
    options.headers["Content-Type"] = "application/json";
  }
  try {
    return await fetch(BASE + address, options);
  } catch {
    throw new Problem(0, ends.aborted ? { detail: `The service did not respond within ${timeout / 1000} s.` } : null);
  }
}

/** Returns the errors of a body as one sentence. */
function readable(document) {
  if (!Array.isArray(document?.detail)) return document;
  return { ...document, detail: document.detail.map((each) => each.msg).join("; ") };
}

/**
 * Follows the event stream. Calls `begin()` if everything must be loaded: at the start, after a gap, and after a
 * restart of the service. Calls `take(event)` with every other event, and `changed(isOpen)` when the connection opens
 * or closes.
 */
export class Stream {
  constructor({ begin, take, changed }) {
    this.begin = begin;
    this.take = take;
    this.changed = changed;
    this.last = null;
    this.run = null;
    this.pause = 500;
    this.source = null;
    addEventListener("online", () => this.open());
    setInterval(() => this.checkConnection(), CHECK_INTERVAL);
  }

  open() {
    clearTimeout(this.waiting);
    this.source?.close();
    const source = new EventSource(`${BASE}/events${this.last ? `?after=${encodeURIComponent(this.last)}` : ""}`);
    this.source = source;
    const receive = (message) => {
      if (message.lastEventId) this.last = message.lastEventId;
      this.receive(JSON.parse(message.data));
    };
    source.onmessage = receive;
    for (const kind of KINDS) source.addEventListener(kind, receive);
    source.onerror = () => {
      if (source !== this.source) return;
      this.changed(false);
      if (source.readyState === EventSource.CLOSED) this.retryLater();
    };
  }

  receive(event) {
    if (event.type === "hello") {
      this.pause = 500;
      this.changed(true);
      const isNew = event.run !== this.run || !event.resumed;
      this.run = event.run;
      if (isNew) this.begin();
    } else if (event.type === "gap") this.begin();
    else this.take(event);
  }

  /** The browser gives up: a token is required, or no service is running. */
  retryLater() {
    this.source?.close();
    this.waiting = setTimeout(async () => {
      try {
        await get("/me");
        this.open();
      } catch {
        this.retryLater();
      }
    }, this.pause);
    this.pause = Math.min(RETRY_INTERVAL_MAX, this.pause * 2);
  }

  /** Reconnects after silence: a lost network closes no connection. */
  async checkConnection() {
    if (document.hidden || this.source?.readyState !== EventSource.OPEN) return;
    try {
      await fetch("/health", { signal: AbortSignal.timeout(CHECK_INTERVAL / 2), cache: "no-store" });
      if (this.isNumb) this.open();
      this.isNumb = false;
    } catch {
      this.isNumb = true;
      this.changed(false);
    }
  }
}
