/** The service: requests, and its stream of events. */

/** What this page calls itself with every write, so that it knows its own changes among those of others. */
export const ASKER = `page-${crypto.getRandomValues(new Uint16Array(1))[0].toString(16).padStart(4, "0")}`;
const BASE = "/api/v1";
const PATIENCE = 15_000;
const PULSE = 10_000;
const LONGEST_PAUSE = 10_000;
const KINDS = ["hello", "component", "change", "params", "resynced", "progress", "job", "link", "gap"];

/** What the service said went wrong, in a sentence; `status` 0 is a service that could not be reached. */
export class Problem extends Error {
  constructor(status, document) {
    super(
      document?.detail ||
        document?.title ||
        (status ? `The service answered ${status}.` : "The service cannot be reached."),
    );
    this.status = status;
    this.document = document ?? {};
  }
}

let askForToken = () => Promise.reject(new Problem(401, { detail: "A token is needed." }));

/** Says who is asked for a token when the service wants one; what it gives ends when the page has it. */
export function onToken(ask) {
  askForToken = ask;
}

/** The address of a component's resource; of one that is in the cache alone (`is_kept`), of what is kept there. */
export function at(component, what = "", query = {}) {
  if (component.is_kept) {
    const search = new URLSearchParams(query);
    return `/vehicles/${encodeURIComponent(component.key)}/${component.component}${what}?${search}`;
  }
  const search = new URLSearchParams({ link: component.link, ...query });
  return `/components/${component.system}/${component.component}${what}?${search}`;
}

/**
 * A request. Gives the JSON of the answer, or null where there is none. `body` is sent as JSON, a File as it is.
 * Where a token is wanted, the person is asked and the request made again.
 */
export async function request(method, address, body, { patience = PATIENCE } = {}) {
  const answer = await exchange(method, address, body, patience);
  return isJson(answer) ? answer.json() : null;
}

export const get = (address) => request("GET", address);

/** A file that is to be saved: its name and its content. */
export async function download(address, patience) {
  const answer = await exchange("GET", address, undefined, patience);
  const [, name] = /filename="?([^";]+)/.exec(answer.headers.get("content-disposition") ?? "") ?? [];
  return { name: name ?? "parameters", content: await answer.blob() };
}

const isJson = (answer) => answer.status !== 204 && (answer.headers.get("content-type") ?? "").includes("json");

async function exchange(method, address, body, patience) {
  for (;;) {
    const answer = await attempt(method, address, body, patience);
    if (answer.ok) return answer;
    if (answer.status !== 401 || address === "/session")
      throw new Problem(answer.status, isJson(answer) ? readable(await answer.json()) : null);
    await askForToken();
  }
}

async function attempt(method, address, body, patience) {
  const ends = AbortSignal.timeout(patience);
  const options = { method, signal: ends, headers: { "X-Asker": ASKER }, cache: "no-store" };
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
    throw new Problem(0, ends.aborted ? { detail: `The service did not answer in ${patience / 1000} s.` } : null);
  }
}

/** A list of what was wrong with a body, as a sentence. */
function readable(document) {
  if (!Array.isArray(document?.detail)) return document;
  return { ...document, detail: document.detail.map((each) => each.msg).join("; ") };
}

/**
 * The stream of events. `begin()` is called whenever everything has to be loaded anew: at the start, after a gap,
 * and when the service is another run or has forgotten what was missed. `take(event)` gets every other event,
 * `standing(isOpen)` whether the service can be heard.
 */
export class Stream {
  constructor({ begin, take, standing }) {
    this.begin = begin;
    this.take = take;
    this.standing = standing;
    this.last = null;
    this.run = null;
    this.pause = 500;
    this.source = null;
    addEventListener("online", () => this.open());
    setInterval(() => this.feel(), PULSE);
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
      this.standing(false);
      if (source.readyState === EventSource.CLOSED) this.again();
    };
  }

  receive(event) {
    if (event.type === "hello") {
      this.pause = 500;
      this.standing(true);
      const isNew = event.run !== this.run || !event.resumed;
      this.run = event.run;
      if (isNew) this.begin();
    } else if (event.type === "gap") this.begin();
    else this.take(event);
  }

  /** The browser has given up: a token may be wanted, or nobody is there. */
  again() {
    this.source?.close();
    this.waiting = setTimeout(async () => {
      try {
        await get("/me");
        this.open();
      } catch {
        this.again();
      }
    }, this.pause);
    this.pause = Math.min(LONGEST_PAUSE, this.pause * 2);
  }

  /** A network that goes away without a word closes nothing: the service is felt for now and then. */
  async feel() {
    if (document.hidden || this.source?.readyState !== EventSource.OPEN) return;
    try {
      await fetch("/health", { signal: AbortSignal.timeout(PULSE / 2), cache: "no-store" });
      if (this.isNumb) this.open();
      this.isNumb = false;
    } catch {
      this.isNumb = true;
      this.standing(false);
    }
  }
}
