// Formats numbers and times, and makes elements.  Data become text nodes and attributes, never markup.

const MINUS = "\u2212", DASH = "\u2013";
export const HOUR_S = 3600, DAY_S = 86400;
export const FRESH_S = HOUR_S;

// -- elements ------------------------------------------------------------------------------------------------------
/** An element with properties (`class`, `dataset`, ARIA and other attributes) and children: elements or text. */
export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "class") element.className = value;
    else if (name === "dataset") Object.assign(element.dataset, value);
    else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

const shownText = new WeakMap();

/** Set an element's text only if it changed, to avoid a new layout; nothing else may write to the element. */
export function say(element, text) {
  if (shownText.get(element) === text) return;
  shownText.set(element, text);
  element.textContent = text;
}

// -- numbers -------------------------------------------------------------------------------------------------------
const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

/** A number with fixed decimals and a true minus sign; a dash if there is no number. */
export function fixed(value, digits, sign = false) {
  if (!known(value)) return DASH;
  let text = Math.abs(value).toFixed(digits);
  const zero = Number(text) === 0;
  if (value < 0 && !zero) text = MINUS + text;
  else if (sign && !zero) text = "+" + text;
  return text;
}

export const celsius = (value) => known(value) ? `${fixed(value, 1)}\u00a0°C` : DASH;
export const percent = (value) => known(value) ? `${fixed(value, 0)}\u00a0%` : DASH;
export const kelvin = (value) => known(value) ? `${fixed(value, 1, true)}\u00a0K` : DASH;
export const grams = (value) => known(value) ? `${fixed(value, Math.abs(value) < 1 ? 2 : 1)}\u00a0g/m³` : DASH;

/** A probability in percent, never 0 or 100, because nothing is certain. */
export function chance(value) {
  if (!known(value)) return DASH;
  const inPercent = 100 * value;
  if (inPercent < 0.1) return "<\u20090.1\u00a0%";
  if (inPercent > 99.9) return ">\u200999.9\u00a0%";
  return `${fixed(inPercent, inPercent < 10 || inPercent > 99 ? 1 : 0)}\u00a0%`;
}

/** A number with three significant digits. */
export function significant(value) {
  if (!known(value)) return DASH;
  const size = Math.abs(value);
  return fixed(value, size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : 3);
}

export const whole = (value) => known(value) ? Math.round(value).toLocaleString("en-US").replaceAll(",", "\u2009") : DASH;

/** Kind of the alarm of condensation, which is the reason of the state "at risk" too. */
export const CONDENSATION = "condensation";
const UNITS = { degC: "°C", "W/m2": "W/m²", "g/m3": "g/m³", 1: "", deg: "°" };
export const unitText = (unit) => unit in UNITS ? UNITS[unit] : unit;

/** `cabinet_relative_humidity` as words. */
export function words(name) {
  const text = name.replaceAll("_", " ");
  return text.charAt(0).toUpperCase() + text.slice(1);
}

// -- times ---------------------------------------------------------------------------------------------------------
let serverAhead_s = 0;
/** Use the server's clock [s], because the device's clock may be wrong. */
export function setClock(now) { serverAhead_s = now - Date.now() / 1000; }
export const clock = () => Date.now() / 1000 + serverAhead_s;

const LONG = new Intl.DateTimeFormat("en-GB",
  { weekday: "short", day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
const SHORT = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
const SECONDS = new Intl.DateTimeFormat("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const DATE = new Intl.DateTimeFormat("en-GB", { weekday: "short", day: "numeric", month: "short" });
const DATE_YEAR = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", year: "numeric" });
const WEEKDAY = new Intl.DateTimeFormat("en-GB", { weekday: "short" });
const YEAR = new Intl.DateTimeFormat("en-GB", { day: "numeric", month: "short", year: "numeric", hour: "2-digit", minute: "2-digit", hourCycle: "h23" });

/** Whether a time needs its year: it is half a year away, or a playback shows another year than the device's. */
function needsYear(at) {
  return Math.abs(clock() - at) > 180 * DAY_S || Math.abs(Date.now() / 1000 - at) > 180 * DAY_S;
}

export const day = (at) => (needsYear(at) ? DATE_YEAR : DATE).format(at * 1000);
export const hour = (at) => SHORT.format(at * 1000);
export const second = (at) => SECONDS.format(at * 1000);
export const utc = (at) => new Date(at * 1000).toISOString().slice(0, 16).replace("T", " ") + " UTC";

/** Local time, with the year if `needsYear`. */
export const local = (at) => (needsYear(at) ? YEAR : LONG).format(at * 1000);

/** The time of day, with the day of the week if it is more than half a day away. */
export function near(at) {
  const off = Math.abs(clock() - at);
  if (off > 6 * DAY_S) return local(at);
  return off < DAY_S / 2 ? hour(at) : `${WEEKDAY.format(at * 1000)} ${hour(at)}`;
}

/** A sentence from its pieces; numbers are times [s], which `format` turns into text, by default with their day. */
export const withTimes = (pieces, format = local) => pieces.map((piece) => typeof piece === "number" ? format(piece) : piece).join("");

/** A time element in local time, with UTC as tooltip. */
export function timeOf(at, text = local(at)) {
  if (!known(at)) return make("span", {}, DASH);
  return make("time", { datetime: new Date(at * 1000).toISOString(), title: utc(at) }, text);
}

/** An age [s] in at most two units. */
export function span(seconds) {
  const s = Math.max(0, Math.round(seconds));
  if (s < 90) return `${s}\u00a0s`;
  const min = Math.floor(s / 60);
  if (min < 90) return `${min}\u00a0min`;
  const h = Math.floor(min / 60);
  if (h < 48) return `${h}\u00a0h` + (h < 10 && min % 60 ? ` ${min % 60}\u00a0min` : "");
  const d = Math.floor(h / 24);
  return `${d}\u00a0d` + (d < 10 && h % 24 ? ` ${h % 24}\u00a0h` : "");
}

/** An element with an age that `countUp` keeps up to date. */
export function age(at, properties = {}) {
  if (!known(at)) return make("span", properties, "never");
  return make("time", { ...properties, datetime: new Date(at * 1000).toISOString(), title: `${local(at)} \u00b7 ${utc(at)}`,
    dataset: { since: at } }, span(clock() - at));
}

/** Update all ages below an element. */
export function countUp(root = document) {
  const now = clock();
  for (const element of root.querySelectorAll("[data-since]")) say(element, span(now - Number(element.dataset.since)));
}

/** The time zone of the displayed times. */
export function zone() {
  const name = Intl.DateTimeFormat().resolvedOptions().timeZone;
  const minutes = -new Date().getTimezoneOffset();
  const sign = minutes < 0 ? MINUS : "+", size = Math.abs(minutes);
  const rest = size % 60 ? `:${String(size % 60).padStart(2, "0")}` : "";
  if (name === "UTC") return name;
  return `${name} (UTC${size ? sign + Math.floor(size / 60) + rest : ""})`;
}
