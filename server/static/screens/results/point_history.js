// History of the probed point: the shown field's value with its uncertainty over the steps, or against a channel.
import * as api from "../../lib/api.js";
import { banded, chartIn } from "../../widgets/plots.js";
import { shown, uncertain } from "../../lib/units.js";
import { h, replace, field, numeric, table, tick, notify } from "../../lib/dom.js";
import { isRelative, shownUnit } from "./analysis.js";
import { abscissas } from "./histories.js";

/** @import { Column, Part } from "#dom" */
/** @import { Viewer } from "../results.js" */
/** @import { Result } from "./analysis.js" */
/** @typedef {{ n: number, value: number | null, u: number | null, why: string }} Reading in the unit of the file */

const PAGE = 500;

/** @param {Viewer} screen */
export function pointHistory(screen) {
  const { result, map, interval } = screen;
  const plot = chartIn(h("div", { "data-role": "point-chart" }));
  const list = h("div");
  const text = h("p.quiet", { role: "status" }, "Click a point of the picture: the shown field there, step by step, is drawn here.");
  const against = abscissas(result);
  const root = h(
    "details.panel",
    { "data-role": "point" },
    h("summary", "History"),
    h("div.row", field("History against", against.choice)),
    text,
    plot.box,
    list,
  );
  /** @type {Map<string, Promise<Reading[]>>} by number of steps, variable, point and axes */
  const known = new Map();
  let asked = 0;

  /**
   * A variable of a point in all steps, in columns.
   * @param {string} name
   * @param {number} i
   */
  function read(name, i) {
    const key = `${result.steps.length} ${result.frame} ${name} ${i}`;
    const held = known.get(key);
    if (held) return held;
    const { grid } = /** @type {NonNullable<typeof map.now>} */ (map.now);
    const made = pages(result, name, { x_px: Math.max(grid.x[i], 0), y_px: Math.max(grid.y[i], 0), frame: result.frame, limit: PAGE });
    known.set(key, made);
    made.catch(() => known.delete(key));
    return made;
  }

  async function draw() {
    asked += 1;
    const mine = asked;
    const { info, pinned: i } = screen.state;
    if (!root.open || i === undefined || !map.now) return;
    if (!info || info.component !== null || info.flags) {
      text.textContent = "A history needs a field of numbers: choose another field.";
      return;
    }
    if (!plot.box.firstChild) text.textContent = "Reading …";
    const steps = result.steps;
    const found = await read(info.name, i);
    if (mine !== asked) return;
    await against.fill();
    if (mine !== asked) return;
    const placed = placedOf(found, steps, isRelative(info.name) ? result.reference : null, against.at);
    const { unit: base, factor } = shownUnit(info.name, info.unit);
    const most = factor * Math.max(0, ...placed.map((one) => Math.abs(one.value ?? 0)));
    const to = shown(base, factor * Math.max(0, ...found.map((one) => Math.abs(one.value ?? 0))));
    const scaled = (/** @type {number | null} */ v, by = 1) => (v === null ? null : v * by * factor * to.factor);
    const curve = { label: info.text, value: placed.map((one) => scaled(one.value)), u: placed.map((one) => scaled(one.u, interval.factor)) };
    const x = placed.map((one) => one.x);
    plot.box.dataset.answer = JSON.stringify({ x, value: placed.map((one) => one.value), sigma: placed.map((one) => one.u) });
    const label = `${info.text} at row ${Math.floor(i / map.now.grid.cols)}, column ${i % map.now.grid.cols}`;
    text.textContent = `${label}; the band is ± ${interval.symbol}: ${interval.text}`;
    const abscissa = against.text;
    await plot.draw({
      x: abscissa,
      y: `${info.text}${to.unit ? ` (${to.unit})` : ""}`,
      height: 320,
      label,
      ...banded(x, [curve], ""),
      series: [
        { label: info.text, dots: true },
        { label: "+", edge: true },
        { label: "−", edge: true },
      ],
    });
    /** @type {(one: typeof placed[number]) => Part} */
    const cell = ({ value, u, zero, why }) => {
      if (value === null) return why;
      return zero ? "0" : uncertain(value * factor, u === null ? null : u * interval.factor * factor, base, most);
    };
    const place = against.choice.value === "n" ? [] : [numeric(abscissa, (/** @type {typeof placed[number]} */ one) => tick(one.x))];
    const columns = [["Step", (/** @type {Reading} */ one) => one.n], ...place, numeric(`${info.text} ± ${interval.symbol}`, cell)];
    replace(list, table(/** @type {Column<typeof placed[number]>[]} */ (columns), placed, { caption: label }));
  }

  const redraw = () => draw().catch(notify);
  against.choice.addEventListener("change", redraw);
  root.addEventListener("toggle", redraw);
  let last = "";
  screen.drawn.add(() => {
    // another step leaves a history as it is
    const now = `${screen.info?.key} ${result.frame} ${screen.state.pinned}`;
    if (now === last) return;
    last = now;
    redraw();
  });
  screen.landed.add(redraw);
  interval.changed.add(redraw);
  screen.ends.push(plot.close);
  return { root, draw: redraw };
}

/**
 * A variable of a point in all steps.
 * @param {Result} result
 * @param {string} name
 * @param {{ x_px: number, y_px: number, frame: string, limit: number }} where
 */
async function pages(result, name, where) {
  /** @type {Reading[]} */
  const found = [];
  /** @type {string | null | undefined} */
  let cursor;
  do {
    const page = await api.get(`${result.path}/history/${name}`, { ...where, cursor });
    page.n.forEach((n, k) =>
      found.push({ n, value: page.value[k], u: page.sigma[k], why: page.status[k] === "ok" ? "not in this step" : page.status[k].replace(/_/g, " ") }),
    );
    cursor = page.next_cursor;
  } while (cursor);
  return found;
}

/**
 * Readings in the order of the abscissa.
 * @param {Reading[]} found
 * @param {number[]} steps
 * @param {number | null} reference step at which the variable is zero by definition
 * @param {(n: number) => number | null} at
 */
function placedOf(found, steps, reference, at) {
  const origin = (/** @type {number} */ n) => ({ n, value: 0, u: 0, why: "" });
  const added = reference !== null && !steps.includes(reference) ? [origin(reference)] : [];
  return [...added, ...found]
    .map((one) => ({ ...(one.n === reference ? origin(one.n) : one), zero: one.n === reference, x: at(one.n) ?? NaN }))
    .filter((one) => Number.isFinite(one.x))
    .sort((p, q) => p.x - q.x);
}
