// Charts drawn with uPlot: courses with bands, readings and forecast; hourly probabilities; properties.

import { DAY_S, HOUR_S, clock, day, fixed, hour, make, say, utc } from "./text.js";

const CURSORS = "courses";
const GAP = 5, LEAST_GAP_S = 1.5 * HOUR_S;

function colours() {
  const style = getComputedStyle(document.documentElement);
  return new Proxy({}, { get: (_, name) => style.getPropertyValue(`--${name}`).trim() });
}

/** Times and columns with a null inserted in every gap, so that no line crosses the gap. */
function withGaps(time, ...columns) {
  const steps = time.slice(1).map((at, i) => at - time[i]).sort((a, b) => a - b);
  const longest = Math.max(LEAST_GAP_S, GAP * (steps[steps.length >> 1] || 0));
  const extended = [[], ...columns.map(() => [])];
  time.forEach((at, i) => {
    if (i && at - time[i - 1] > longest) {
      extended[0].push((at + time[i - 1]) / 2);
      columns.forEach((_, c) => extended[c + 1].push(null));
    }
    extended[0].push(at);
    columns.forEach((column, c) => extended[c + 1].push(column[i]));
  });
  return extended;
}

function axes(c) {
  const font = "12px system-ui, sans-serif";
  const line = { stroke: c.grid, width: 1 };
  return [
    {
      stroke: c.muted, font, grid: line, ticks: { ...line, size: 4 }, space: 64, size: 24, gap: 4,
      incrs: [300, 900, 1800, 3600, 10800, 21600, 43200, 86400, 172800, 604800],
      values: (_, splits) => splits.map((at) => hour(at) === "00:00" ? day(at) : hour(at)),
    },
    {
      stroke: c.muted, font, grid: line, ticks: { show: false }, size: 46, gap: 6, space: 30,
      values: (_, splits, axis, space, step) => splits.map((at) => fixed(at, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)))),
    },
  ];
}

/** A chart in a figure: title, readout, drawing; `figure.chart` is the uPlot object. */
export class Chart {
  constructor(id, title, unit, options) {
    Object.assign(this, { title, unit, ...options });
    this.readout = make("output", { class: "readout" });
    this.note = make("p", { class: "chart-note", hidden: true });
    this.place = make("div", { class: "drawing", role: "img" });
    this.heading = make("span", {}, title);
    this.figure = make("figure", { id: `chart-${id}`, class: "chart" },
      make("figcaption", {}, make("h3", {}, this.heading, " ", make("span", { class: "unit" }, unit)), this.readout),
      this.note, this.place);
    this.wide = new ResizeObserver(() => this.fit());
    this.wide.observe(this.place);
  }

  /** Show data; `note` says what is missing. */
  show(data, range, note = "") {
    this.data = data;
    this.range = range;
    this.note.hidden = !note;
    say(this.note, note);
    this.place.setAttribute("aria-label", `${this.title}: ${this.spoken(data)}`);
    if (this.chart) this.chart.setData(data);
    else this.draw();
    this.tell(null);
  }

  draw() {
    this.chart?.destroy();
    const width = this.place.clientWidth;
    this.chart = null;
    if (!width || !this.data) return;
    const c = colours();
    this.chart = new uPlot({
      width,
      height: this.height,
      legend: { show: false },
      padding: [8, 26, 0, 0],
      cursor: {
        y: false,
        drag: { x: false, y: false },
        points: { show: false },
        sync: this.alone ? undefined : { key: CURSORS },
      },
      scales: { x: { range: () => this.range }, y: { range: this.limits } },
      axes: axes(c),
      series: [{}, ...this.series(c)],
      bands: this.bands(c),
      hooks: {
        draw: [(plot) => { this.mark(plot, c); this.separate(plot, c); }],
        setCursor: [(plot) => this.tell(plot.cursor.idx)],
      },
    }, this.data, this.place);
    this.figure.chart = this.chart;
  }

  /** Redraw in other colours. */
  recolour() { this.draw(); }

  fit() {
    const width = this.place.clientWidth;
    if (!this.chart) this.draw();
    else if (width && width !== this.chart.width) this.chart.setSize({ width, height: this.height });
  }

  end() {
    this.wide.disconnect();
    this.chart?.destroy();
  }

  tell(index) {
    say(this.readout, this.read(this.data, index));
  }

  bands() { return []; }
  mark() {}

  /** A line at the present time, after which the forecast begins. */
  separate(plot, c) {
    const now = clock();
    if (this.range && now < this.range[1] - 60) verticalLine(plot, now, c.muted, "now");
  }

  level(plot, at, colour, dash, text = "") {
    const { ctx, bbox } = plot;
    const y = Math.round(plot.valToPos(at, "y", true)) + 0.5;
    if (y < bbox.top || y > bbox.top + bbox.height) return;
    ctx.save();
    ctx.strokeStyle = colour;
    ctx.setLineDash(dash.map((length) => length * devicePixelRatio));
    ctx.lineWidth = devicePixelRatio;
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    if (text) {
      ctx.fillStyle = colour;
      ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
      ctx.textAlign = "left";
      ctx.textBaseline = y > bbox.top + 16 * devicePixelRatio ? "bottom" : "top";
      ctx.fillText(text, bbox.left + 4 * devicePixelRatio, y);
    }
    ctx.restore();
  }
}

function verticalLine(plot, at, colour, text) {
  const { ctx, bbox } = plot;
  const x = Math.round(plot.valToPos(at, "x", true)) + 0.5;
  if (x < bbox.left || x > bbox.left + bbox.width) return;
  ctx.save();
  ctx.strokeStyle = ctx.fillStyle = colour;
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([2 * devicePixelRatio, 2 * devicePixelRatio]);
  ctx.beginPath();
  ctx.moveTo(x, bbox.top);
  ctx.lineTo(x, bbox.top + bbox.height);
  ctx.stroke();
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  ctx.fillText(text, x + 4 * devicePixelRatio, bbox.top + 2 * devicePixelRatio);
  ctx.restore();
}

/** A quantity: estimate and forecast with their bands, readings as points. */
export class Course extends Chart {
  constructor(id, title, unit, { format, threshold = null, thresholdName = "" }) {
    super(id, title, unit, { format, threshold, thresholdName, height: 168 });
    this.limits = (_, low, high) => this.limitsOf(low ?? 0, high ?? 1);
  }

  /** A level that is drawn as a line and is always in view. */
  setThreshold(threshold, name) { Object.assign(this, { threshold, thresholdName: name }); }

  limitsOf(low, high) {
    const lowest = Math.min(low, this.threshold ?? low), highest = Math.max(high, this.threshold ?? high);
    const room = 0.06 * (highest - lowest) || 1;
    return [lowest - room, highest + room];
  }

  /** turbine: the server's data of a turbine. */
  update(turbine, quantity, range, note) {
    const past = turbine.courses[quantity];
    const ahead = turbine.forecast?.courses[quantity];
    const readings = turbine.readings[quantity];
    const tables = [
      readings ? [readings.time, readings.value] : [[], []],
      past ? withGaps(turbine.time, past.value, past.lower, past.upper) : [[], [], [], []],
      ahead ? [turbine.forecast.time, ahead.value, ahead.lower, ahead.upper] : [[], [], [], []],
    ];
    this.show(joinByTime(tables), range, note);
  }

  series(c) {
    const edge = { stroke: "transparent", points: { show: false } };
    const plain = { width: 1.75, points: { show: false } };
    return [
      { stroke: c.reading, paths: () => null, points: { show: true, size: 5, width: 0, fill: c.reading } },
      { ...plain, stroke: c.model }, edge, edge,
      { ...plain, stroke: c.forecast, dash: [6, 3] }, edge, edge,
    ];
  }

  bands(c) {
    return [{ series: [4, 3], fill: c["model-band"] }, { series: [7, 6], fill: c["forecast-band"] }];
  }

  mark(plot, c) {
    if (this.threshold !== null) this.level(plot, this.threshold, c.alarm, [5, 3], this.thresholdName);
  }

  read(data, index) {
    let at = index;
    if (at === null || at === undefined) at = lastIndex(data[2]);
    else at = nearest(data, at);
    if (at === null) return "";
    const [value, lower, upper] = isNumber(data[2][at]) ? [2, 3, 4] : [5, 6, 7];
    const text = `${this.format(data[value][at])} (${this.format(data[lower][at])} … ${this.format(data[upper][at])})`;
    const kind = value === 5 ? "forecast " : "";
    const when = index === null || index === undefined ? "last" : stampText(data[0][at]);
    const reading = isNumber(data[1][at]) ? ` · reading ${this.format(data[1][at])}` : "";
    return `${when}: ${kind}${text}${reading}`;
  }

  spoken(data) {
    const at = lastIndex(data[2]);
    return at === null ? "no estimate" : `last ${this.format(data[2][at])} ${this.unit}, `
      + `between ${this.format(data[3][at])} and ${this.format(data[4][at])} with 95 percent`;
  }
}

const isNumber = (value) => value !== null && value !== undefined;
const stampText = (at) => `${day(at)} ${hour(at)} (${utc(at).slice(11)})`;

function lastIndex(column) {
  for (let i = column.length - 1; i >= 0; i--) if (isNumber(column[i])) return i;
  return null;
}

/** The index of the estimate or forecast that is closest in time to a given index. */
function nearest(data, index) {
  let best = null;
  for (let step = 0; step < 40; step++) {
    for (const i of [index - step, index + step]) {
      if ((isNumber(data[2][i]) || isNumber(data[5][i])) && (best === null
        || Math.abs(data[0][i] - data[0][index]) < Math.abs(data[0][best] - data[0][index]))) best = i;
    }
    if (best !== null && step > 3) break;
  }
  return best;
}

/** Join several tables, each with its own times, by time. */
function joinByTime(tables) {
  const filled = tables.map((table) => table[0].length ? table : [[0], ...table.slice(1).map(() => [undefined])]);
  const data = uPlot.join(filled, filled.map((table) => table.map(() => 1)));
  if (data[0][0] === 0) return data.map((column) => column.slice(1));
  return data;
}

/** The highest probability in every past and forecast hour. */
export class Hours extends Chart {
  constructor(id, title) {
    super(id, title, "%", { format: (value) => String(Math.round(value)), limits: () => [0, 100], height: 120 });
  }

  /** hours: rows (beginning of the hour, probability) in `past` and `forecast`. */
  update(hours, range) {
    const table = (rows) => [rows.map((row) => row[0]), rows.map((row) => 100 * row[1])];
    this.show(joinByTime([table(hours.past), table(hours.forecast)]), range,
      hours.past.length || hours.forecast.length ? "" : "this turbine's model has no humidity");
  }

  rename(title) {
    this.title = title;
    say(this.heading, title);
  }

  series(c) {
    const paths = uPlot.paths.bars({ size: [0.9], align: 1 });
    const bar = { paths, points: { show: false }, width: 0 };
    return [{ ...bar, fill: c["model-bar"] }, { ...bar, fill: c["forecast-bar"] }];
  }

  read(data, index) {
    const column = (at) => isNumber(data[1][at]) ? 1 : 2;
    const at = index === null || index === undefined ? lastIndex(data[1]) : index;
    if (at === null || !isNumber(data[column(at)][at])) return "";
    const value = data[column(at)][at];
    const text = value < 0.1 ? "< 0.1" : value > 99.9 ? "> 99.9" : value.toFixed(value < 10 ? 1 : 0);
    const when = index === null || index === undefined ? "last hour" : stampText(data[0][at]);
    return `${when}: ${column(at) === 2 ? "forecast " : ""}${text} %`;
  }

  spoken(data) {
    const highest = (column) => Math.max(0, ...column.filter(isNumber));
    return `highest ${Math.round(highest(data[1]))} percent, forecast ${Math.round(highest(data[2]))} percent`;
  }
}

/** The course of a property with its bounds, and the fit's value as a dashed line. */
export class PropertyCourse extends Chart {
  constructor(id, title, unit, format) {
    super(id, title, unit, { format, height: 108, alone: true, limits: undefined });
    this.limits = (_, low, high) => {
      const lowest = Math.min(low ?? this.reference, this.reference), highest = Math.max(high ?? this.reference, this.reference);
      const room = 0.08 * (highest - lowest || Math.abs(highest) || 1);
      return [lowest - room, highest + room];
    };
  }

  update(property, range) {
    this.reference = property.reference;
    this.show(withGaps(property.time, property.value, property.lower, property.upper), range);
  }

  series(c) {
    const edge = { stroke: "transparent", points: { show: false } };
    // a few values hardly show as a line
    const points = { show: this.data[0].length < 30, size: 4, width: 0, fill: c.model };
    return [{ stroke: c.model, width: 1.75, points }, edge, edge];
  }

  bands(c) { return [{ series: [3, 2], fill: c["model-band"] }]; }

  mark(plot, c) { this.level(plot, this.reference, c.muted, [5, 3]); }

  read(data, index) {
    if (index === null || index === undefined || !isNumber(data[1][index])) return "";
    return `${stampText(data[0][index])}: ${this.format(data[1][index])} `
      + `(${this.format(data[2][index])} … ${this.format(data[3][index])})`;
  }

  spoken(data) {
    const at = lastIndex(data[1]);
    return at === null ? "not observable" : `last ${this.format(data[1][at])} ${this.unit}, fit ${this.format(this.reference)}`;
  }
}

/** Time range of a turbine's charts: the chosen days back, and the forecast ahead for at most as many days. */
export function rangeOf(turbine, days) {
  const now = clock();
  const end = turbine.forecast?.time.at(-1) ?? now;
  return [now - days * DAY_S, Math.min(Math.max(now, end), now + days * DAY_S)];
}
