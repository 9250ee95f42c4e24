// Sparklines of the dew-point margin: three days back and two ahead, with band and zero line, drawn as SVG.

import { clock, fixed, kelvin, near } from "./text.js";

const WIDTH = 150, HEIGHT = 34;
const LOW = -4, HIGH = 12; // [K], the same for all rows so that they can be compared; values beyond are drawn at the edge
const NAMESPACE = "http://www.w3.org/2000/svg";

function shape(tag, attributes, ...children) {
  const element = document.createElementNS(NAMESPACE, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

const level = (margin) => HEIGHT * (HIGH - Math.min(HIGH, Math.max(LOW, margin))) / (HIGH - LOW);

/** Uninterrupted runs of steps with a value between `from` and `to`, each as [first, last + 1]. */
function runs(value, from, to) {
  const intervals = [];
  for (let i = from; i < to; i++) {
    if (value[i] === null) continue;
    const first = i;
    while (i < to && value[i] !== null) i++;
    intervals.push([first, i]);
  }
  return intervals;
}

/** The sparkline of a turbine; `grid`: start, step and number of past steps of all turbines. */
export function sparkline(margins, grid) {
  const { value, half } = margins, count = value.length;
  const x = (i) => WIDTH * (i + 0.5) / count;
  const point = (i, margin) => `${x(i).toFixed(1)} ${level(margin).toFixed(1)}`;
  const parts = [];
  for (const [kind, from, to] of [["past", 0, grid.past], ["ahead", grid.past, count]]) {
    for (const [first, end] of runs(value, from, to)) {
      const steps = Array.from({ length: end - first }, (_, k) => first + k);
      const upper = steps.map((i) => point(i, value[i] + half[i])), lower = steps.map((i) => point(i, value[i] - half[i]));
      parts.push(shape("path", { class: `band ${kind}`, d: `M${upper.join("L")}L${lower.reverse().join("L")}Z` }));
      parts.push(shape("path", { class: `line ${kind}`, d: `M${steps.map((i) => point(i, value[i])).join("L")}` }));
    }
  }
  const now = WIDTH * grid.past / count;
  return shape("svg", { class: "spark", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img", "aria-label": spoken(margins, grid) },
    shape("rect", { class: "wet", x: 0, y: level(0), width: WIDTH, height: HEIGHT - level(0) }), ...parts,
    shape("path", { class: "zero", d: `M0 ${level(0)}H${WIDTH}` }), shape("path", { class: "now", d: `M${now} 0V${HEIGHT}` }));
}

/** The lowest margins in words. */
function spoken({ value }, grid) {
  const lowest = (from, to) => {
    let lowestAt = -1;
    for (let i = from; i < to; i++) if (value[i] !== null && (lowestAt < 0 || value[i] < value[lowestAt])) lowestAt = i;
    return lowestAt < 0 ? "none" : `${kelvin(value[lowestAt])}, ${near(grid.start + grid.step * (lowestAt + 0.5))}`;
  };
  return `Dew-point margin. Lowest of the last ${fixed(grid.past * grid.step / 86400, 0)} days: ${lowest(0, grid.past)}; `
    + `lowest forecast: ${lowest(grid.past, value.length)}`;
}

/** Whether the sparklines are too old: more than a quarter of a step has passed in the tracker's time. */
export const areOld = (grid) => !grid || Math.abs(clock() - (grid.start + grid.past * grid.step)) > grid.step / 4;
