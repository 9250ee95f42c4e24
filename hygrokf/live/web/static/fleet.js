// The fleet: a summary, and one row per cabinet, sorted by need of attention.

import { areOld, sparkline } from "./spark.js";
import { Fault, ask } from "./server.js";
import {
  CONDENSATION, FRESH_S, age, celsius, chance, clock, fixed, kelvin, make, near, percent, say, span, timeOf, whole,
  withTimes,
} from "./text.js";

const COLUMNS = [
  // name, heading, label for narrow screens without headings
  ["state", "State", ""], ["turbine", "Turbine", ""], ["condensation", "Condensation now", "Condensation"],
  ["forecast", "Forecast up to", "Forecast up to"], ["margin", "Dew-point margin", "Margin"],
  ["course", "Margin, 3 d back, 2 d ahead", "Margin, 3 days back, 2 ahead"],
  ["temperature", "Temperature", "Temperature"], ["humidity", "Rel. humidity", "Rel. humidity"],
  ["cabinet", "Cabinet", "Cabinet"], ["heard", "Last heard", "Last heard"],
];
const LIKELY = 0.5, POSSIBLE = 0.1;
const RETRY_MS = 10000;
const SEVERITIES = ["notice", "warning", "alarm"];
// text of each state in the summary, sorted by need of attention
const STATES = {
  "at risk": "at risk", alarm: "with an alarm", stale: "stale", "no estimate": "without estimate", "in doubt": "in doubt", off: "off", ok: "ok",
};

/** The state of a row as shown: a row with old data or a rejected model is never "ok". */
export function shownState(row) {
  const calm = row.state === "ok" || row.state === "off";
  if (calm && silent(row)) return "stale";
  return row.state === "ok" && row.model === "reject" ? "in doubt" : row.state;
}

/** The class of a state's badge; an alarm has the colour of its severity. */
export const stateClass = (state, severity) =>
  `badge ${state.replace(" ", "-")} ${state === "alarm" && severity >= 0 ? `of-${SEVERITIES[severity]}` : ""}`;

const silent = (row) => row.heard === null || clock() - row.heard > FRESH_S;

export class Fleet {
  constructor() {
    this.rows = new Map();
    this.only = null;
    this.grid = null;
    this.asked = 0;
    this.body = make("tbody");
    this.found = make("p", { class: "found", role: "status" });
    this.search = make("input", {
      type: "search", id: "search", placeholder: "Find a turbine", "aria-label": "Find a turbine", autocomplete: "off",
      spellcheck: "false", "aria-keyshortcuts": "/", oninput: () => this.filter(),
      onkeydown: (event) => { if (event.key === "Enter") this.body.querySelector("tr:not([hidden]) a")?.click(); },
    });
    this.chips = new Map(Object.keys(STATES).map((state) => [state, make("button", {
      type: "button", class: `chip ${state.replace(" ", "-")}`, "aria-pressed": "false", hidden: true, dataset: { state },
      onclick: () => this.choose(state),
    })]));
    const head = make("tr", { role: "row" },
      COLUMNS.map(([name, text]) => make("th", { scope: "col", role: "columnheader", class: name }, text)));
    this.root = make("section", { class: "fleet", "aria-label": "Cabinets by need" },
      make("div", { class: "tools" }, make("h1", { tabindex: "-1" }, "Cabinets"), this.search, this.found),
      make("p", { class: "summary", role: "group", "aria-label": "Turbines by state" }, ...this.chips.values()),
      make("table", { role: "table" }, make("thead", { role: "rowgroup" }, head), this.body));
    this.body.setAttribute("role", "rowgroup");
  }

  get title() { return "Cabinets"; }
  concerns() { return true; }
  path() { return "fleet"; }

  update(data) {
    const seen = new Set();
    let place = this.body.firstElementChild;
    for (const row of data.turbines) {
      seen.add(row.turbine);
      let shown = this.rows.get(row.turbine);
      if (!shown) this.rows.set(row.turbine, shown = new Row(row.turbine));
      shown.update(row);
      if (shown.root === place) place = place.nextElementSibling;
      else this.body.insertBefore(shown.root, place);
    }
    for (const [name, row] of this.rows) {
      if (seen.has(name)) continue;
      row.root.remove();
      this.rows.delete(name);
    }
    this.tick();
    this.filter();
    this.drawMargins();
  }

  /** Request the courses of the margin if they are old; the rows do not need them. */
  async drawMargins() {
    if (!areOld(this.grid) || Date.now() - this.asked < RETRY_MS) return;
    this.asked = Date.now();
    try {
      this.grid = await ask("margins");
    } catch (fault) {
      if (!(fault instanceof Fault)) throw fault;
      return;
    }
    for (const [name, row] of this.rows) row.drawMargin(this.grid.turbines[name], this.grid);
  }

  /** Show only the turbines in one state, or all again. */
  choose(state) {
    this.only = this.only === state ? null : state;
    for (const [name, chip] of this.chips) chip.setAttribute("aria-pressed", String(name === this.only));
    this.filter();
  }

  filter() {
    const sought = this.search.value.trim().toLowerCase();
    let count = 0;
    for (const [name, row] of this.rows) {
      row.root.hidden = !name.toLowerCase().includes(sought) || (this.only !== null && row.state !== this.only);
      count += !row.root.hidden;
    }
    say(this.found, sought || this.only ? `${whole(count)} of ${whole(this.rows.size)}` : whole(this.rows.size));
  }

  /** Update ages and the states that depend on them, which change without an event. */
  tick() {
    const counts = {};
    let worst = 0;
    for (const row of this.rows.values()) {
      row.tick();
      counts[row.state] = (counts[row.state] ?? 0) + 1;
      if (row.state === "alarm") worst = Math.max(worst, row.row.severity);
    }
    this.chips.get("alarm").classList.toggle("of-warning", SEVERITIES[worst] !== "alarm");
    for (const [state, chip] of this.chips) {
      chip.hidden = !counts[state] && state !== this.only;
      say(chip, `${whole(counts[state] ?? 0)} ${STATES[state]}`);
    }
  }

  end() {}
}

class Row {
  constructor(name) {
    this.cells = {};
    this.root = make("tr", { role: "row", dataset: { turbine: name } }, COLUMNS.map(([key, , text]) =>
      this.cells[key] = make("td", { role: "cell", class: key, dataset: { label: text } })));
    this.reason = make("span", { class: "reason" });
    this.cells.turbine.append(make("a", { href: `#/turbine/${encodeURIComponent(name)}` }, name), this.reason);
    this.badge = make("span", { class: "badge" });
    this.cells.state.append(this.badge);
  }

  update(row) {
    const text = JSON.stringify(row);
    if (text === this.text) return;
    this.text = text;
    this.row = row;
    this.shown = null;
    const c = this.cells;
    c.condensation.replaceChildren(chance(row.condensation));
    c.condensation.className = `condensation ${rank(row.condensation)}`;
    c.forecast.replaceChildren(...(row.forecast
      ? [chance(row.forecast.condensation), make("span", { class: "more" }, timeOf(row.forecast.time, near(row.forecast.time)))] : ["–"]));
    c.forecast.className = `forecast ${rank(row.forecast?.condensation)}`;
    c.margin.replaceChildren(kelvin(row.margin), bound(row.margin_lower === null ? "" : `≥ ${fixed(row.margin_lower, 1, true)}`));
    c.temperature.replaceChildren(celsius(row.temperature), half(row.temperature_half, 1));
    c.humidity.replaceChildren(percent(row.relative_humidity), half(row.relative_humidity_half, 0));
    const rejected = row.model === "reject";
    c.cabinet.replaceChildren(rejected && row.cabinet !== "changed" ? "model rejected" : row.cabinet ?? "–",
      rejected && row.cabinet === "changed" ? bound("model rejected") : "");
    c.cabinet.className = `cabinet ${rejected || row.cabinet === "changed" ? "changed" : ""}`;
    this.root.classList.toggle("rejected", rejected);
    c.heard.replaceChildren(age(row.heard));
    this.tick();
  }

  drawMargin(margins, grid) {
    this.cells.course.replaceChildren(margins ? sparkline(margins, grid) : "");
  }

  /** The reason of the state shown, and the other kinds of open alarms. */
  words(state) {
    const { row } = this;
    // the server's reason of another state would contradict the one that is shown
    const reason = state === "ok" ? "" : state === row.state ? withTimes(row.pieces, near) : state === "in doubt" ? "a number of its model is rejected"
      : row.heard === null ? "never heard" : `not heard for ${span(clock() - row.heard)}`;
    const stated = state === "at risk" ? [CONDENSATION] : state === "alarm" ? row.content[0].values.kinds : [];
    const kinds = [...new Set(row.alarms.map((alarm) => alarm.kind))].filter((kind) => !stated.includes(kind));
    return [reason, ...kinds].filter(Boolean).join("; ");
  }

  tick() {
    const { row, badge, root } = this;
    const state = this.state = shownState(row);
    say(this.reason, this.words(state));
    const shown = `${state} ${row.severity} ${silent(row)}`;
    if (this.shown === shown) return;
    this.shown = shown;
    root.classList.toggle("stale", state === "stale" || silent(row));
    root.dataset.state = state;
    say(badge, state);
    badge.className = stateClass(state, row.severity);
  }
}

const rank = (value) => value >= LIKELY ? "likely" : value >= POSSIBLE ? "possible" : "";
const bound = (text) => make("span", { class: "more" }, text);
const half = (value, digits) => bound(value === null ? "" : `± ${fixed(value, digits)}`);
