// The fleet: one row per cabinet, highest risk first.

import { FRESH_S, age, celsius, chance, clock, fixed, kelvin, make, near, percent, say, timeOf, whole } from "./text.js";

const COLUMNS = [
  // name, heading, label for narrow screens without headings
  ["state", "State", ""], ["turbine", "Turbine", ""], ["condensation", "Condensation now", "Condensation"],
  ["forecast", "Forecast up to", "Forecast up to"], ["margin", "Dew-point margin", "Margin"],
  ["temperature", "Temperature", "Temperature"], ["humidity", "Rel. humidity", "Rel. humidity"],
  ["cabinet", "Cabinet", "Cabinet"], ["heard", "Last heard", "Last heard"],
];
const LIKELY = 0.5, POSSIBLE = 0.1;
const SEVERITIES = ["notice", "warning", "alarm"];

export class Fleet {
  constructor() {
    this.rows = new Map();
    this.body = make("tbody");
    this.found = make("p", { class: "found", role: "status" });
    this.search = make("input", {
      type: "search", id: "search", placeholder: "Find a turbine", "aria-label": "Find a turbine", autocomplete: "off",
      spellcheck: "false", "aria-keyshortcuts": "/", oninput: () => this.filter(),
      onkeydown: (event) => { if (event.key === "Enter") this.body.querySelector("tr:not([hidden]) a")?.click(); },
    });
    const head = make("tr", { role: "row" },
      COLUMNS.map(([name, text]) => make("th", { scope: "col", role: "columnheader", class: name }, text)));
    this.root = make("section", { class: "fleet", "aria-label": "Cabinets by risk" },
      make("div", { class: "tools" }, make("h1", { tabindex: "-1" }, "Cabinets"), this.search, this.found),
      make("table", { role: "table" }, make("thead", { role: "rowgroup" }, head), this.body));
    this.body.setAttribute("role", "rowgroup");
  }

  get title() { return "Cabinets"; }
  concerns() { return true; }
  path() { return "fleet"; }

  update(found) {
    const seen = new Set();
    let place = this.body.firstElementChild;
    for (const row of found.turbines) {
      seen.add(row.turbine);
      let one = this.rows.get(row.turbine);
      if (!one) this.rows.set(row.turbine, one = new Row(row.turbine));
      one.update(row);
      if (one.root === place) place = place.nextElementSibling;
      else this.body.insertBefore(one.root, place);
    }
    for (const [name, one] of this.rows) {
      if (seen.has(name)) continue;
      one.root.remove();
      this.rows.delete(name);
    }
    this.filter();
    this.tick();
  }

  filter() {
    const sought = this.search.value.trim().toLowerCase();
    let count = 0;
    for (const [name, one] of this.rows) {
      one.root.hidden = !name.toLowerCase().includes(sought);
      count += !one.root.hidden;
    }
    say(this.found, sought ? `${whole(count)} of ${whole(this.rows.size)}` : whole(this.rows.size));
  }

  /** Update ages, which grow without an event. */
  tick() {
    for (const one of this.rows.values()) one.tick();
  }

  end() {}
}

class Row {
  constructor(name) {
    this.cells = {};
    this.root = make("tr", { role: "row", dataset: { turbine: name } }, COLUMNS.map(([key, , text]) =>
      this.cells[key] = make("td", { role: "cell", class: key, dataset: { label: text } })));
    this.alarm = make("span", { class: "kinds" });
    this.cells.turbine.append(make("a", { href: `#/turbine/${encodeURIComponent(name)}` }, name), this.alarm);
    this.badge = make("span", { class: "badge" });
    this.cells.state.append(this.badge);
  }

  update(row) {
    const text = JSON.stringify(row);
    if (text === this.text) return;
    this.text = text;
    this.row = row;
    const c = this.cells;
    say(this.alarm, [...new Set(row.alarms.map((alarm) => alarm.kind))].filter((kind) => kind !== "cabinet changed").join(", "));
    const words = row.margin === null ? "not modelled" : chance(row.condensation);
    c.condensation.replaceChildren(words);
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

  tick() {
    const { row, badge, root } = this;
    const stale = row.heard === null || clock() - row.heard > FRESH_S;
    const state = row.severity >= 0 ? SEVERITIES[row.severity]
      : stale ? "no data" : row.condensation >= LIKELY ? "at risk" : row.model === "reject" ? "in doubt" : "ok";
    if (this.shown === `${state} ${stale}`) return;
    this.shown = `${state} ${stale}`;
    root.classList.toggle("stale", stale);
    root.dataset.state = state;
    say(badge, state);
    badge.className = `badge ${state.replace(" ", "-")}`;
  }
}

const rank = (value) => value >= LIKELY ? "likely" : value >= POSSIBLE ? "possible" : "";
const bound = (text) => make("span", { class: "more" }, text);
const half = (value, digits) => bound(value === null ? "" : `± ${fixed(value, digits)}`);
