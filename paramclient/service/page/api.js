/** Requests to the service, and its event stream. The token stays in this tab, and is sent in a header only. */

/** Value of X-Author in every request: the page recognizes its own changes by it. */
export const AUTHOR = `page-${crypto.getRandomValues(new Uint16Array(1))[0].toString(16).padStart(4, "0")}`;
/** Timeout of a request in milliseconds. */
const REQUEST_TIMEOUT = 15_000;
/** Milliseconds without an event or comment after which the event stream is opened again. */
const SILENCE_MAX = 40_000;
/** Maximum milliseconds between two attempts to open the event stream. */
const RETRY_INTERVAL_MAX = 10_000;
const TOKEN = "token";

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

/** Sets the function that asks for a token; it resolves when `setToken` has been called with a valid one. */
export function onToken(ask) {
  askForToken = ask;
}

export const setToken = (token) => sessionStorage.setItem(TOKEN, token);

const headers = (token) => ({ "X-Author": AUTHOR, ...(token && { Authorization: `Bearer ${token}` }) });

/** Returns the role of a token, by default that of this tab: "read", "write", or null without a valid one. */
export async function roleOf(token = sessionStorage.getItem(TOKEN)) {
  const answer = await attempt("/health", { headers: headers(token), signal: AbortSignal.timeout(REQUEST_TIMEOUT) });
  if (answer.status === 401) return null;
  if (!answer.ok) throw new Problem(answer.status, null);
  return (await answer.json()).role;
}

/** Returns the path of a component's resource. */
export function at(component, what = "", query = {}) {
  const place = { link: component.link, ext: component.extended, ...query };
  return `/api/vehicles/${component.system}/${component.component}${what}?${new URLSearchParams(place)}`;
}

/** Sends a request with a JSON body and returns the JSON of the response. `signal` ends it. */
export async function request(method, address, body, { timeout = REQUEST_TIMEOUT, signal = null } = {}) {
  const answer = await exchange(method, address, body, timeout, signal);
  return answer.json();
}

export const get = (address, options) => request("GET", address, undefined, options);

/** Requests a file to save: its name and content. */
export async function download(address, timeout) {
  const answer = await exchange("GET", address, undefined, timeout, null);
  const [, name] = /filename="?([^";]+)/.exec(answer.headers.get("content-disposition") ?? "") ?? [];
  return { name: name ?? "parameters", content: await answer.blob() };
}

async function exchange(method, address, body, timeout, signal) {
  for (;;) {
    const ends = AbortSignal.any([AbortSignal.timeout(timeout), ...(signal ? [signal] : [])]);
    const options = { method, signal: ends, cache: "no-store", headers: headers(sessionStorage.getItem(TOKEN)) };
    if (body !== undefined) {
      options.body = JSON.stringify(body);
      options.headers["Content-Type"] = "application/json";
    }
    const answer = await attempt(address, options);
    if (answer.ok) return answer;
    if (answer.status !== 401) throw new Problem(answer.status, await problemOf(answer));
    await askForToken();
  }
}

async function attempt(address, options) {
  try {
    return await fetch(address, options);
  } catch (error) {
    if (error.name === "AbortError") throw new Problem(0, { detail: "Stopped." });
    throw new Problem(0, error.name === "TimeoutError" ? { detail: "The service did not respond in time." } : null);
  }
}

async function problemOf(answer) {
  try {
    return await answer.json();
  } catch {
    return null;
  }
}

/**
 * Follows the event stream. Calls `begin()` if everything must be loaded: at the start, and when events were missed.
 * Calls `take(event)` with every other event, and `changed(isOpen)` when the connection opens or closes.
 */
export class Stream {
  constructor({ begin, take, changed }) {
    this.begin = begin;
    this.take = take;
    this.changed = changed;
    this.last = null;
    this.pause = 500;
    this.reading = null;
    addEventListener("online", () => this.open());
  }

  /** Opens the stream, again after each end. */
  async open() {
    this.reading?.abort();
    const reading = new AbortController();
    this.reading = reading;
    while (!reading.signal.aborted) {
      try {
        if ((await roleOf()) === null) throw new Problem(401, null);
        await this.read(reading);
      } catch (error) {
        if (error.status === 401) {
          await askForToken();
          continue;
        }
      }
      if (reading.signal.aborted) return;
      this.changed(false);
      await new Promise((resolve) => setTimeout(resolve, this.pause));
      this.pause = Math.min(RETRY_INTERVAL_MAX, this.pause * 2);
    }
  }

  async read(reading) {
    const silence = new AbortController();
    let timer = null;
    const alive = () => {
      clearTimeout(timer);
      timer = setTimeout(() => silence.abort(), SILENCE_MAX);
    };
    alive();
    try {
      const answer = await fetch("/api/events", {
        signal: AbortSignal.any([reading.signal, silence.signal]),
        cache: "no-store",
        headers: { ...headers(sessionStorage.getItem(TOKEN)), ...(this.last && { "Last-Event-ID": this.last }) },
      });
      if (!answer.ok) throw new Problem(answer.status, null);
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      for (;;) {
        const { done, value } = await reader.read();
        if (done) return;
        alive();
        const parts = (text + value).split("\n\n");
        text = parts.pop();
        for (const part of parts) this.receive(part);
      }
    } finally {
      clearTimeout(timer);
    }
  }

  receive(part) {
    const [, id] = /^id: (.*)$/m.exec(part) ?? [];
    const [, data] = /^data: (.*)$/m.exec(part) ?? [];
    if (!data) return;
    const event = JSON.parse(data);
    const isFirst = this.last === null;
    this.last = id;
    if (event.type !== "hello") return this.take(event);
    this.pause = 500;
    this.changed(true);
    if (isFirst || !event.resumed) this.begin();
    return undefined;
  }
}
