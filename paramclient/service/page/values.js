/** Values: formatting, parsing, comparison. */

const BOUNDS = {
  INT8: [-(2n ** 7n), 2n ** 7n - 1n],
  UINT8: [0n, 2n ** 8n - 1n],
  INT16: [-(2n ** 15n), 2n ** 15n - 1n],
  UINT16: [0n, 2n ** 16n - 1n],
  INT32: [-(2n ** 31n), 2n ** 31n - 1n],
  UINT32: [0n, 2n ** 32n - 1n],
  INT64: [-(2n ** 63n), 2n ** 63n - 1n],
  UINT64: [0n, 2n ** 64n - 1n],
};
const WORDS = {
  nan: "NaN",
  "+nan": "NaN",
  inf: "Infinity",
  "+inf": "Infinity",
  infinity: "Infinity",
  "-inf": "-Infinity",
  "-infinity": "-Infinity",
};

export const isFloat = (type) => type === "REAL32" || type === "REAL64";
export const isWhole = (type) => type in BOUNDS;

/**
 * Formats a value: a float always with a point or an exponent, an integer with all digits, from its bits if a
 * JavaScript number cannot represent it.
 */
export function textOf(param) {
  if (param === null || param === undefined) return "";
  const { value, type } = param;
  if ((type === "INT64" || type === "UINT64") && param.bits) {
    const bits = BigInt(`0x${param.bits}`);
    return String(type === "INT64" ? BigInt.asIntN(64, bits) : bits);
  }
  return numberText(value, type);
}

/** Formats a number without bits, such as a default or a limit. */
export function numberText(value, type) {
  if (typeof value !== "number") return String(value ?? "");
  const text = Object.is(value, -0) ? "-0" : String(value);
  return isFloat(type) && /^-?\d+$/.test(text) ? `${text}.0` : text;
}

/** Returns the meaning of a value from its metadata: `Loiter`, `GPS | Baro`; "" for a plain number. */
export function meaningOf(text, info, type) {
  if (!info) return "";
  const named = info.values?.[text.replace(/\.0$/, "")];
  if (named !== undefined) return named;
  const mask = info.bits ? maskOf(text, type) : null;
  if (mask === null || mask === 0n) return "";
  const names = Object.entries(info.bits)
    .filter(([bit]) => (mask >> BigInt(bit)) & 1n)
    .map(([, name]) => name);
  const rest = Object.keys(info.bits).reduce((left, bit) => left & ~(1n << BigInt(bit)), mask);
  return [...names, ...(rest ? [`0x${rest.toString(16)}`] : [])].join(" | ");
}

/** Returns the bits of a number as an integer, or null. */
export function maskOf(text, type) {
  const whole = text.replace(/\.0$/, "");
  if (!/^-?\d+$/.test(whole)) return null;
  const number = BigInt(whole);
  if (number >= 0n) return number;
  const bounds = BOUNDS[type];
  return bounds ? number & (bounds[1] - bounds[0]) : null;
}

/** Formats the number of this type with these bits. */
export function textOfMask(mask, type) {
  const bounds = BOUNDS[type];
  return String(bounds && bounds[0] < 0n && mask > bounds[1] ? mask - (bounds[1] - bounds[0] + 1n) : mask);
}

/**
 * Parses an input as a value of this type: `{text}`, which the service takes, or `{error}`. Integers may be
 * hexadecimal; a comma is a decimal point. A value of another type is text, or bytes after `hex:`.
 */
export function parse(written, type) {
  if (!isWhole(type) && !isFloat(type)) {
    const isWrong = written.startsWith("hex:") && !/^hex:([\da-f]{2}){0,128}$/i.test(written);
    return isWrong ? { error: "hex: takes pairs of hexadecimal digits." } : { text: written };
  }
  const text = written.trim();
  if (text === "") return { error: "A value is missing." };
  if (isWhole(type)) {
    if (!/^[+-]?(\d{1,20}|0x[\da-f]{1,16})$/i.test(text))
      return { error: `${type} takes a whole number, such as 12 or 0x1F.` };
    const size = BigInt(text.replace(/^[+-]/, ""));
    const number = text.startsWith("-") ? -size : size;
    const [low, high] = BOUNDS[type];
    if (number < low || number > high) return { error: `${type} holds ${low} to ${high}.` };
    return { text: String(number) };
  }
  const word = WORDS[text.toLowerCase()];
  if (word !== undefined) return { text: word };
  const plain = text.replace(",", ".");
  if (!/^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d{1,3})?$/i.test(plain))
    return { error: "Not a number. Examples: 12, -1.5, 1e-3, nan, inf." };
  const number = type === "REAL64" ? Number(plain) : Math.fround(Number(plain));
  if (!Number.isFinite(number)) return { error: `${text} is more than a ${type} holds.` };
  return { text: numberText(Number(plain), type) };
}

/** Returns a warning about a value from its metadata. */
export function warningOf(text, info, type) {
  if (!info) return "";
  const units = info.units ? ` ${info.units}` : "";
  const number = Number(text);
  const as = (bound) => (type === "REAL32" ? Math.fround(bound) : bound);
  if (Number.isNaN(number))
    return typeof info.minimum === "number" || typeof info.maximum === "number" ? "NaN is outside every range." : "";
  if (typeof info.minimum === "number" && as(number) < as(info.minimum))
    return `Below the minimum of ${info.minimum}${units}.`;
  if (typeof info.maximum === "number" && as(number) > as(info.maximum))
    return `Above the maximum of ${info.maximum}${units}.`;
  return "";
}

/** Returns whether two texts are the same value of this type, REAL32 as float32. */
export function sameText(a, b, type) {
  if (a === b) return true;
  if (isWhole(type) && /^-?\d+$/.test(a) && /^-?\d+$/.test(b)) return BigInt(a) === BigInt(b);
  const [x, y] = [Number(a), Number(b)];
  if (Number.isNaN(x) || Number.isNaN(y)) return false;
  return type === "REAL32" ? Math.fround(x) === Math.fround(y) : x === y;
}

/** Formats the firmware's default; null if it is unknown. */
export const defaultOf = (param) => (param.default === undefined ? null : numberText(param.default, param.type));

/** Describes the origin of the default; null if it is unknown. */
export const defaultSourceOf = (param) => param.default_source && `Default of the ${param.default_source}`;

/** Formats a range: `0 to 12 1/s`. */
export function rangeOf(info) {
  const units = info?.units ? ` ${info.units}` : "";
  const [low, high] = [info?.minimum, info?.maximum];
  if (low !== undefined && high !== undefined) return `${low} to ${high}${units}`;
  if (low !== undefined) return `from ${low} up${units}`;
  return high !== undefined ? `up to ${high}${units}` : "";
}

/** Formats a duration: `4 s`, `3 min`, `2 h`. */
export function span(seconds) {
  if (seconds < 90) return `${Math.max(0, Math.round(seconds))} s`;
  return seconds < 5400
    ? `${Math.round(seconds / 60)} min`
    : seconds < 172800
      ? `${Math.round(seconds / 3600)} h`
      : `${Math.round(seconds / 86400)} days`;
}

/** Formats a local time: the time today, otherwise with the date. */
export function moment(at) {
  const when = new Date(typeof at === "number" ? at * 1000 : at);
  const clock = when.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
  return when.toDateString() === new Date().toDateString() ? clock : `${when.toLocaleDateString()} ${clock}`;
}

/** Describes what happened to a parameter; `when` is such as "5 s ago". */
export function recentText(recent, when = "") {
  const ago = when && ` ${when}`;
  return recent.kind === "changed" ? `was ${recent.before}, changed${ago} by ${recent.by}` : `${recent.kind}${ago}`;
}

export const many = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
