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
  // quantity, title, unit, digits, with text, sensor, level that is always in view
  ["temperature", "Temperature", "°C", 1, celsius, TEMPERATURE],
  ["relative_humidity", "Relative humidity", "%", 0, percent, HUMIDITY],
  ["margin", "Dew-point margin of the coldest surface", "K", 1, kelvin, HUMIDITY, 0],
  ["absolute_humidity", "Absolute humidity", "g/m³", 1, grams, HUMIDITY],
];
const LEVELS = { margin: "condensation" }; // what a level that is always in view is called
const RESTS_ON = { temperature: ["thermal"], absolute_humidity: ["hygric"] }; // all others rest on both numbers of the model
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
    const [found, shelved, stated] = await Promise.all([
      ask(this.path()), ask("shelves"), ask(`events?turbine=${encodeURIComponent(this.name)}`)]);
    return { ...found, shelves: shelved.shelves.filter((one) => one.turbine === this.name), events: stated.events };
  }

  choose(days) {
    this.days = days;
    localStorage.setItem(DAYS_KEPT, days);
    this.refresh();
  }

  update(found) {
    this.found = found;
    this.tick();
    this.showModel(found);
    this.showTiles(found);
    this.showAdvice(found);
    replaceItems(this.alarms, found.alarms, false, found.shelves);
    this.shelves.replaceChildren(...found.shelves.map((one) => shelfItem(one, false, this.refresh)));
    this.showChanges(found);
    const range = rangeOf(found, this.days);
    for (const [quantity, chart] of this.charts) {
      if (quantity === "relative_humidity") chart.setThreshold(100 * found.humid.limit, "limit");
      chart.update(found, quantity, range, this.contradiction(found, quantity) || this.missing(found, quantity));
    }
    this.hours.update(found.hours, range);
    this.humid.rename(`Probability of relative humidity above ${fixed(100 * found.humid.limit, 0)} %, by hour`);
    this.humid.update(found.humid, range);
    this.showProperties(found);
    this.showData(found);
  }

  tick() {
    if (!this.found) return;
    this.showState(this.found);
    const at = this.found.time.at(-1);
    this.root.classList.toggle("stale", at === undefined || clock() - at > FRESH_S);
    if (at === this.shown) return;
    this.shown = at;
    this.state.replaceChildren(...(at === undefined
      ? [`no estimate in the last ${this.days} d`] : ["as of ", timeOf(at), ", ", age(at), " old"]));
  }

  /** Why a quantity has no readings; empty if it has some. */
  missing(found, quantity) {
    const [, , , , , sensor] = QUANTITIES.find((one) => one[0] === quantity);
    const kind = sensor === HUMIDITY ? "humidity" : "temperature";
    if (!found.courses[quantity] && !found.forecast?.courses[quantity]) {
      return found.time.length ? `this turbine's model has no ${kind}` : "no estimate in these days";
    }
    const signal = found.signals.find((one) => one.signal === sensor);
    if (!signal || signal.last === null) return `no ${kind} sensor: estimate from the model alone`;
    const days = clock() - this.days * DAY_S;
    if (signal.last < days) return `no ${kind} reading since ${local(signal.last)}: estimate from the model alone`;
    return "";
  }

  /** That the readings of a quantity's sensor contradict its estimate; empty if they do not. */
  contradiction(found, quantity) {
    const [, , , , , sensor] = QUANTITIES.find((one) => one[0] === quantity);
    const signal = found.signals.find((one) => one.signal === sensor);
    if (!signal?.contradicts || (quantity !== "temperature" && quantity !== "relative_humidity")) return "";
    return `the reading, ${reading(signal)}\u00a0${unitText(signal.unit)}, contradicts the estimate`;
  }

  /** Show the turbine's state and its reason, as the overview does. */
  showState(found) {
    const heard = found.signals.reduce((last, one) => Math.max(last, one.received ?? -Infinity), -Infinity);
    const severity = found.alarms.filter((one) => one.ended === null)
      .reduce((worst, one) => Math.max(worst, SEVERITIES.indexOf(one.severity)), -1);
    const state = shownState({ ...found, model: found.model.verdict, heard: Number.isFinite(heard) ? heard : null });
    say(this.badge, state);
    this.badge.className = stateClass(state, severity);
    say(this.reason, state === found.state && state !== "alarm" ? `${withTimes(found.pieces)}${found.since ? `, since ${local(found.since)}` : ""}` : "");
  }

  showChanges(found) {
    const rows = found.events.map((one) => make("li", {}, timeOf(one.time), ": ", make("strong", {}, one.kind),
      make("span", { class: "more" }, `, stated by ${one.made_by}${one.note ? ` – ${one.note}` : ""}`)));
    this.changes.replaceChildren(...(rows.length ? rows : [make("li", { class: "quiet-note" }, "None was stated.")]));
  }

  /** Show the numbers of the model that are in doubt. */
  showModel(found) {
    const doubtful = found.model.numbers.filter((one) => one.verdict !== "believe");
    this.root.classList.toggle("rejected", found.model.verdict === "reject");
    this.model.hidden = !doubtful.length;
    this.model.replaceChildren(...doubtful.map((one) => make("li", { class: one.verdict },
      make("strong", {}, `${one.mark} ${one.part} time constant ${one.words}`), one.why ? `: ${one.why}` : "")));
  }

  /** A note if a quantity rests on a rejected number of the model, else empty. */
  rests(found, quantity) {
    const parts = RESTS_ON[quantity] ?? ["thermal", "hygric"];
    return found.model.numbers.some((one) => one.verdict === "reject" && parts.includes(one.part))
      ? "by a rejected model" : "";
  }

  showTiles(found) {
    const tiles = QUANTITIES.filter(([quantity]) => found.courses[quantity]).map(([quantity, title, , , text]) => {
      const { value, lower, upper } = found.courses[quantity];
      const missing = this.missing(found, quantity);
      const rests = this.rests(found, quantity);
      return tile(quantity, title.replace(" of the coldest surface", ""), text(value.at(-1)),
        `95\u00a0%: ${bare(text(lower.at(-1)))} … ${bare(text(upper.at(-1)))}`,
        [missing ? "from the model alone" : "", this.contradiction(found, quantity), rests].filter(Boolean).join("; "),
        rests ? "rejected" : "");
    });
    const now = found.condensation.at(-1);
    if (now !== undefined && now !== null) {
      tiles.splice(3, 0, tile("condensation", "Condensation now", chance(now), highestAhead(found.forecast),
        this.rests(found, "condensation"),
        `${now >= 0.5 ? "likely" : now >= 0.1 ? "possible" : ""} ${this.rests(found, "condensation") ? "rejected" : ""}`));
    }
    this.tiles.replaceChildren(...tiles);
  }

  showAdvice(found) {
    const text = found.forecast?.advice;
    this.advice.hidden = !text;
    if (!text) return;
    const made = found.forecast.made;
    const doubt = this.rests(found, "advice");
    this.advice.replaceChildren(make("strong", {}, "Restart: "), text, doubt ? `, ${doubt}` : "",
      Number.isFinite(made) ? make("span", { class: "more" }, " (forecast made ", age(made), " ago)") : "");
  }

  showProperties(found) {
    const rangeOfAll = [clock() - this.days * DAY_S, clock()];
    const order = Object.keys(PROPERTIES);
    for (const property of [...found.properties].sort((a, b) => order.indexOf(a.name) - order.indexOf(b.name))) {
      let one = this.properties.get(property.name);
      if (!one) {
        this.properties.set(property.name, one = new PropertyRow(property));
        this.propertyRows.append(one.root);
      }
      one.update(property, rangeOfAll, found.model.numbers.find((number) => number.property === property.name));
    }
    for (const [name, one] of this.properties) one.root.hidden = !found.properties.some((property) => property.name === name);
    if (!this.properties.size) this.propertyRows.replaceChildren(make("p", { class: "quiet-note" }, "Nothing is known yet of these days."));
    else this.propertyRows.querySelector(":scope > .quiet-note")?.remove();
  }

  showData(found) {
    this.signals.replaceChildren(...found.signals.map(signalRow));
    const rows = Object.entries(found.counts).map(([kind, count]) => make("li", {}, counted(kind, count, "reading")));
    if (found.held) rows.push(make("li", {}, counted("held", found.held, "reading")));
    this.aside.replaceChildren(...(rows.length ? rows : [make("li", { class: "quiet-note" }, "Nothing.")]));
  }

  recolour() {
    for (const [, chart] of this.charts) chart.recolour();
    this.hours.recolour();
    this.humid.recolour();
    for (const one of this.properties.values()) one.chart.recolour();
  }

  end() {
    for (const [, chart] of this.charts) chart.end();
    this.hours.end();
    this.humid.end();
    for (const one of this.properties.values()) one.chart.end();
  }
}

/** The row of a signal: its last reading, or that it never came. */
function signalRow(one) {
  const never = one.last === null;
  const value = never ? (one.needed === "required" ? "never came: no estimate without it" : "never came")
    : `${reading(one)}\u00a0${unitText(one.unit)}`.trim();
  return make("tr", { class: never ? "never" : clock() - one.received > FRESH_S ? "stale" : null, dataset: { signal: one.signal } },
    make("th", { scope: "row" }, words(one.signal)),
    make("td", {}, value, one.contradicts ? make("span", { class: "contradicts" }, " contradicts the estimate") : ""),
    make("td", {}, never ? "" : timeOf(one.last)), make("td", {}, never ? "" : [age(one.received), " ago"]),
    make("td", {}, whole(one.count)));
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

/** The highest forecast probability, and when it is first reached. */
function highestAhead(forecast) {
  let most = -1, when = null;
  forecast?.time.forEach((at, i) => {
    if (at >= clock() && forecast.condensation[i] > most) [most, when] = [forecast.condensation[i], at];
  });
  return when === null ? "no forecast" : `forecast up to ${chance(most)}, ${near(when)}`;
}

const bare = (text) => text.replace(/\u00a0.*$/, "");

function reading(one) {
  const size = Math.abs(one.value);
  return one.unit === "degC" ? fixed(one.value, 1) : fixed(one.value, size >= 100 ? 0 : size >= 10 || one.unit === "%" ? 1 : 2);
}
