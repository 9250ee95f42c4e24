// One turbine: the air now, advice, alarms, courses with forecast, time constants, its data.

import { replaceItems, shelfItem } from "./alarms.js";
import { Course, Hours, PropertyCourse, rangeOf } from "./charts.js";
import { askChange } from "./dialogs.js";
import { shownState, stateClass } from "./fleet.js";
import { ask } from "./server.js";
import {
  DAY_S, FRESH_S, age, celsius, chance, clock, fixed, grams, kelvin, local, make, near, percent, say, significant, span, timeOf,
  unitText, whole, withTimes, words,
} from "./text.js";

const DAYS = [1, 3, 7, 14], DAYS_KEPT = "hygrokf.days";
const SEVERITIES = ["notice", "warning", "alarm"];
const HUMIDITY = "cabinet_relative_humidity", TEMPERATURE = "cabinet_temperature";
const QUANTITIES = [
  // quantity, title, unit, digits, function that formats with unit, sensor, level that is always in view
  ["temperature", "Temperature", "°C", 1, celsius, TEMPERATURE],
  ["relative_humidity", "Relative humidity", "%", 0, percent, HUMIDITY],
  ["margin", "Dew-point margin of the coldest surface", "K", 1, kelvin, HUMIDITY, 0],
  ["absolute_humidity", "Absolute humidity", "g/m³", 1, grams, HUMIDITY],
];
const LEVELS = { margin: "condensation" }; // name of the level that is always in view
const PARTS_OF = { temperature: ["thermal"], absolute_humidity: ["hygric"] }; // parts of the model that determine a quantity; all others need both
const PROPERTIES = {
  thermal_time_constant: "Thermal time constant",
  hygric_k: "Hygric constant k",
  heat_release_change: "Change of heat release",
  humidity_offset: "Offset of the humidity reading",
};
const NOT_USED = {
  late: "came too late to be used",
  repeated: "came again with the same value",
  revised: "came with another value for the same time; the last one is used",
  "revised late": "came with another value after the estimate was final; it is used once the store is filtered anew",
  contradicting: "had the same time and different values; none is used",
  "bad quality": "were marked as bad by the source",
  "ambiguous quality": "had a quality whose vocabulary is not stated",
  "uncertain quality": "were marked as uncertain by the source, and are used",
  "no number": "were not numbers",
  "impossible value": "were outside the signal's range",
  "other unit": "stated another unit than the mapping",
  "unknown tag": "had a tag that is not mapped",
  "no known field": "had no field that is mapped",
  "no value": "had no value",
  "of no device": "were of an edge node itself, not of one of its devices",
  "too many edge nodes": "came from more edge nodes than are followed",
  "alias changed": "used aliases that changed in a gap",
  "no records": "had nothing at the path of their records",
  held: "are held back, stamped ahead of the clock",
  malformed: "could not be read",
  "too large": "were too large",
  "too deep": "were nested too deep",
  "unknown turbine": "named a turbine that is not tracked",
  "no time": "had no time",
  "ambiguous time": "had a local time that comes twice",
  "impossible time": "had a time before 1990, after 2100 or too far ahead",
  "too many ahead": "had a time ahead of the clock, when too many of them were held back",
};

export class Turbine {
  constructor(name, refresh) {
    this.name = name;
    const kept = Number(localStorage.getItem(DAYS_KEPT));
    this.days = DAYS.includes(kept) ? kept : 3;
    this.refresh = refresh;
    this.tiles = make("dl", { class: "tiles" });
    this.state = make("p", { class: "as-of" });
    this.badge = make("span", { class: "badge" });
    this.reason = make("p", { class: "state-reason" });
    this.changes = make("ul", { class: "events" });
    this.shelves = make("ul", { class: "alarms shelves" });
    this.model = make("ul", { class: "model", "aria-label": "Numbers of the model" });
    this.advice = make("p", { class: "advice", hidden: true });
    this.alarms = make("ul", { class: "alarms" });
    this.charts = QUANTITIES.map(([quantity, title, unit, digits, , , level]) =>
      [quantity, new Course(quantity, title, unit, { format: (value) => fixed(value, digits), threshold: level ?? null,
        thresholdName: LEVELS[quantity] ?? "" })]);
    this.hours = new Hours("condensation", "Probability of condensation, by hour");
    this.humid = new Hours("humid", "");
    this.properties = new Map();
    this.propertyRows = make("div", { class: "properties" });
    this.signals = make("tbody");
    this.aside = make("ul", { class: "aside" });
    const choice = make("div", { class: "days", role: "radiogroup", "aria-label": "Days shown" }, DAYS.map((days) =>
      make("label", {}, make("input", { type: "radio", name: "days", value: days, checked: days === this.days,
        onchange: () => this.choose(days) }), `${days} d`)));
    const key = make("p", { class: "key" },
      make("span", { class: "key-model" }, "estimate with 95 % band"), make("span", { class: "key-reading" }, "reading"),
      make("span", { class: "key-forecast" }, "forecast with 95 % band"));
    this.root = make("article", { class: "turbine" },
      make("p", { class: "back" }, make("a", { href: "#/" }, "‹ All cabinets")),
      make("div", { class: "tools" }, make("h1", { tabindex: "-1" }, name), this.badge, this.state),
      this.reason, this.model, this.tiles, this.advice, this.alarms, this.shelves,
      make("section", { "aria-label": "Courses" }, make("div", { class: "tools sticky" }, make("h2", {}, "Course"), choice, key),
        this.charts.slice(0, 3).map(([, chart]) => chart.figure), this.hours.figure, this.humid.figure, this.charts[3][1].figure),
      make("section", {}, make("h2", {}, "Cabinet properties"), this.propertyRows),
      make("section", {}, make("h2", {}, "Changes"), this.changes,
        make("button", { type: "button", class: "quiet", id: "state-change", onclick: () => askChange(name) }, "State a change …")),
      make("section", {}, make("h2", {}, "Data"),
        make("table", { class: "signals" }, make("thead", {}, make("tr", {},
          ["Signal", "Last reading", "Time", "Received", "In 24 h"].map((text) => make("th", { scope: "col" }, text)))), this.signals),
        make("h3", {}, "Not used"), this.aside));
  }

  get title() { return this.name; }
  concerns(names) { return names === null || names.includes(this.name); }
  path() { return `turbine/${encodeURIComponent(this.name)}?days=${this.days}`; }

  async load() {
    const [turbine, shelves, events] = await Promise.all([
      ask(this.path()), ask("shelves"), ask(`events?turbine=${encodeURIComponent(this.name)}`)]);
    return { ...turbine, shelves: shelves.shelves.filter((shelf) => shelf.turbine === this.name), events: events.events };
  }

  choose(days) {
    this.days = days;
    localStorage.setItem(DAYS_KEPT, days);
    this.refresh();
  }

  update(data) {
    this.data = data;
    this.tick();
    this.showModel(data);
    this.showTiles(data);
    this.showAdvice(data);
    replaceItems(this.alarms, data.alarms, false, data.shelves);
    this.shelves.replaceChildren(...data.shelves.map((shelf) => shelfItem(shelf, false, this.refresh)));
    this.showChanges(data);
    const range = rangeOf(data, this.days);
    for (const [quantity, chart] of this.charts) {
      if (quantity === "relative_humidity") chart.setThreshold(100 * data.humid.limit, "limit");
      chart.update(data, quantity, range, this.contradiction(data, quantity) || this.missing(data, quantity));
    }
    this.hours.update(data.hours, range);
    this.humid.rename(`Probability of relative humidity above ${fixed(100 * data.humid.limit, 0)} %, by hour`);
    this.humid.update(data.humid, range);
    this.showProperties(data);
    this.showData(data);
  }

  tick() {
    if (!this.data) return;
    this.showState(this.data);
    const at = this.data.time.at(-1);
    this.root.classList.toggle("stale", at === undefined || clock() - at > FRESH_S);
    if (at === this.shown) return;
    this.shown = at;
    this.state.replaceChildren(...(at === undefined
      ? [`no estimate in the last ${this.days} d`] : ["as of ", timeOf(at), ", ", age(at), " old"]));
  }

  /** Why a quantity has no readings; empty if it has readings. */
  missing(data, quantity) {
    const [, , , , , sensor] = QUANTITIES.find(([name]) => name === quantity);
    const kind = sensor === HUMIDITY ? "humidity" : "temperature";
    if (!data.courses[quantity] && !data.forecast?.courses[quantity]) {
      return data.time.length ? `this turbine's model has no ${kind}` : "no estimate in these days";
    }
    const signal = data.signals.find((row) => row.signal === sensor);
    if (!signal || signal.last === null) return `no ${kind} sensor: estimate from the model alone`;
    const start = clock() - this.days * DAY_S;
    if (signal.last < start) return `no ${kind} reading since ${local(signal.last)}: estimate from the model alone`;
    return "";
  }

  /** The note that the readings of a quantity's sensor contradict the estimate; empty if they do not. */
  contradiction(data, quantity) {
    const [, , , , , sensor] = QUANTITIES.find(([name]) => name === quantity);
    const signal = data.signals.find((row) => row.signal === sensor);
    if (!signal?.contradicts || (quantity !== "temperature" && quantity !== "relative_humidity")) return "";
    return `the reading, ${reading(signal)}\u00a0${unitText(signal.unit)}, contradicts the estimate`;
  }

  /** Show the turbine's state and its reason, as the overview does. */
  showState(data) {
    const heard = data.signals.reduce((last, signal) => Math.max(last, signal.received ?? -Infinity), -Infinity);
    const severity = data.alarms.filter((alarm) => alarm.ended === null)
      .reduce((worst, alarm) => Math.max(worst, SEVERITIES.indexOf(alarm.severity)), -1);
    const state = shownState({ ...data, model: data.model.verdict, heard: Number.isFinite(heard) ? heard : null });
    say(this.badge, state);
    this.badge.className = stateClass(state, severity);
    say(this.reason, state === data.state && state !== "alarm" ? `${withTimes(data.pieces)}${data.since ? `, since ${local(data.since)}` : ""}` : "");
  }

  showChanges(data) {
    const rows = data.events.map((event) => make("li", {}, timeOf(event.time), ": ", make("strong", {}, event.kind),
      make("span", { class: "more" }, `, stated by ${event.made_by}${event.note ? ` – ${event.note}` : ""}`)));
    this.changes.replaceChildren(...(rows.length ? rows : [make("li", { class: "quiet-note" }, "None was stated.")]));
  }

  /** Show the numbers of the model that are in doubt. */
  showModel(data) {
    const doubtful = data.model.numbers.filter((number) => number.verdict !== "believe");
    this.root.classList.toggle("rejected", data.model.verdict === "reject");
    this.model.hidden = !doubtful.length;
    this.model.replaceChildren(...doubtful.map((number) => make("li", { class: number.verdict },
      make("strong", {}, `${number.mark} ${number.part} time constant ${number.words}`), number.why ? `: ${number.why}` : "")));
  }

  /** The note that a quantity depends on a rejected number of the model; empty if it does not. */
  rejection(data, quantity) {
    const parts = PARTS_OF[quantity] ?? ["thermal", "hygric"];
    return data.model.numbers.some((number) => number.verdict === "reject" && parts.includes(number.part))
      ? "by a rejected model" : "";
  }

  showTiles(data) {
    const tiles = QUANTITIES.filter(([quantity]) => data.courses[quantity]).map(([quantity, title, , , text]) => {
      const { value, lower, upper } = data.courses[quantity];
      const missing = this.missing(data, quantity);
      const rejection = this.rejection(data, quantity);
      return tile(quantity, title.replace(" of the coldest surface", ""), text(value.at(-1)),
        `95\u00a0%: ${withoutUnit(text(lower.at(-1)))} … ${withoutUnit(text(upper.at(-1)))}`,
        [missing ? "from the model alone" : "", this.contradiction(data, quantity), rejection].filter(Boolean).join("; "),
        rejection ? "rejected" : "");
    });
    const now = data.condensation.at(-1), rejection = this.rejection(data, "condensation");
    if (now !== undefined && now !== null) {
      tiles.splice(3, 0, tile("condensation", "Condensation now", chance(now), highestAhead(data.forecast),
        rejection, `${now >= 0.5 ? "likely" : now >= 0.1 ? "possible" : ""} ${rejection ? "rejected" : ""}`));
    }
    this.tiles.replaceChildren(...tiles);
  }

  showAdvice(data) {
    const text = data.forecast?.advice;
    this.advice.hidden = !text;
    if (!text) return;
    const { made } = data.forecast;
    const rejection = this.rejection(data, "advice");
    this.advice.replaceChildren(make("strong", {}, "Restart: "), text, rejection ? `, ${rejection}` : "",
      Number.isFinite(made) ? make("span", { class: "more" }, " (forecast made ", age(made), " ago)") : "");
  }

  showProperties(data) {
    const rangeOfAll = [clock() - this.days * DAY_S, clock()];
    const order = Object.keys(PROPERTIES);
    for (const property of [...data.properties].sort((a, b) => order.indexOf(a.name) - order.indexOf(b.name))) {
      let row = this.properties.get(property.name);
      if (!row) {
        this.properties.set(property.name, row = new PropertyRow(property));
        this.propertyRows.append(row.root);
      }
      row.update(property, rangeOfAll, data.model.numbers.find((number) => number.property === property.name));
    }
    for (const [name, row] of this.properties) row.root.hidden = !data.properties.some((property) => property.name === name);
    if (!this.properties.size) this.propertyRows.replaceChildren(make("p", { class: "quiet-note" }, "Nothing is known yet of these days."));
    else this.propertyRows.querySelector(":scope > .quiet-note")?.remove();
  }

  showData(data) {
    this.signals.replaceChildren(...data.signals.map(signalRow));
    const rows = Object.entries(data.counts).map(([kind, count]) => make("li", {}, counted(kind, count, "reading")));
    if (data.held) rows.push(make("li", {}, counted("held", data.held, "reading")));
    this.aside.replaceChildren(...(rows.length ? rows : [make("li", { class: "quiet-note" }, "Nothing.")]));
  }

  recolour() {
    for (const [, chart] of this.charts) chart.recolour();
    this.hours.recolour();
    this.humid.recolour();
    for (const row of this.properties.values()) row.chart.recolour();
  }

  end() {
    for (const [, chart] of this.charts) chart.end();
    this.hours.end();
    this.humid.end();
    for (const row of this.properties.values()) row.chart.end();
  }
}

/** The row of a signal: its last reading, or a note that the signal never came. */
function signalRow(signal) {
  const never = signal.last === null;
  const value = never ? (signal.needed === "required" ? "never came: no estimate without it" : "never came")
    : `${reading(signal)}\u00a0${unitText(signal.unit)}`.trim();
  return make("tr", { class: never ? "never" : clock() - signal.received > FRESH_S ? "stale" : null, dataset: { signal: signal.signal } },
    make("th", { scope: "row" }, words(signal.signal)),
    make("td", {}, value, signal.contradicts ? make("span", { class: "contradicts" }, " contradicts the estimate") : ""),
    make("td", {}, never ? "" : timeOf(signal.last)), make("td", {}, never ? "" : [age(signal.received), " ago"]),
    make("td", {}, whole(signal.count)));
}

/** Text of the counts of rejected readings. */
export function counted(kind, count, what) {
  const text = NOT_USED[kind] ?? kind;
  return `${whole(count)} ${what}${count === 1 ? "" : "s"} ${count === 1 ? text.replace(/^(were|are) /, (verb) => verb === "are " ? "is " : "was ") : text}`;
}

class PropertyRow {
  constructor(property) {
    this.unit = property.unit;
    this.relative = property.unit === "h"; // a time constant is compared with the fit's value, an offset with none
    this.format = (value) => this.relative ? significant(value) : fixed(value, 1, true);
    const title = PROPERTIES[property.name] ?? words(property.name);
    this.now = make("p", { class: "now" });
    this.reference = make("p", { class: "more" });
    this.chart = new PropertyCourse(`property-${property.name}`, title, property.unit, this.format);
    this.chart.figure.querySelector("figcaption").after(this.now, this.reference);
    this.root = make("div", { class: "property", dataset: { property: property.name } }, this.chart.figure);
  }

  update(property, range, number) {
    const { reference, observable } = property;
    const [value, lower, upper] = ["value", "lower", "upper"].map((name) => property[name].at(-1));
    if (observable) {
      this.now.replaceChildren(make("strong", {}, `${this.format(value)}\u00a0${this.unit}`),
        make("span", { class: "more" }, ` ${this.format(lower)} … ${this.format(upper)}`));
    } else this.now.replaceChildren(make("strong", { class: "none" }, "not observable"));
    const change = observable && this.relative ? `; now ${fixed(100 * (value / reference - 1), 0, true)}\u00a0%` : "";
    const verdict = number ? `, ${number.words}` : "";
    say(this.reference, this.relative ? `from the fit: ${this.format(reference)}\u00a0${this.unit}${verdict}${change}` : "relative to the fit");
    this.root.classList.toggle("rejected", number?.verdict === "reject");
    this.chart.update(property, range);
  }
}

function tile(id, title, value, bounds, note, rank = "") {
  return make("div", { class: `tile ${rank}`, id: `now-${id}` }, make("dt", {}, title), make("dd", { class: "value" }, value),
    make("dd", { class: "bounds" }, bounds), note ? make("dd", { class: "note" }, note) : null);
}

/** The highest forecast probability, and the first time at which it is reached. */
function highestAhead(forecast) {
  let highest = -1, when = null;
  forecast?.time.forEach((at, i) => {
    if (at >= clock() && forecast.condensation[i] > highest) [highest, when] = [forecast.condensation[i], at];
  });
  return when === null ? "no forecast" : `forecast up to ${chance(highest)}, ${near(when)}`;
}

const withoutUnit = (text) => text.replace(/\u00a0.*$/, "");

/** The text of a signal's last reading without its unit. */
function reading({ value, unit }) {
  const size = Math.abs(value);
  return unit === "degC" ? fixed(value, 1) : fixed(value, size >= 100 ? 0 : size >= 10 || unit === "%" ? 1 : 2);
}
