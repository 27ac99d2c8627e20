// History of the probed point: the shown field's value with its uncertainty over the steps, or against a channel.
import * as api from "../../lib/api.js";
import { chart } from "../../widgets/plots.js";
import { shown, uncertain } from "../../lib/units.js";
import { h, replace, field, numeric, table, tick, notify } from "../../lib/dom.js";
import { shownUnit } from "./analysis.js";
import { abscissas, isRelative } from "./histories.js";

/** @import { Viewer } from "../results.js" */
/** @typedef {{ n: number, value: number | null, u: number | null, why: string }} Reading in the unit of the file */

const PAGE = 500;

/** @param {Viewer} screen */
export function pointHistory(screen) {
  const { result, map, interval } = screen;
  const box = h("div", { "data-role": "point-chart" });
  const list = h("div");
  const text = h("p.quiet", { role: "status" }, "Click a point of the picture: the shown field there, step by step, is drawn here.");
  const against = abscissas(result);
  const root = h("details.panel", { "data-role": "point" }, h("summary", "Point"), h("div.row", field("History against", against.choice)), text, box, list);
  /** @type {Awaited<ReturnType<typeof chart>> | null} */
  let plot = null;
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
    const made = pages(name, { x_px: Math.max(grid.x[i], 0), y_px: Math.max(grid.y[i], 0), frame: result.frame, limit: PAGE });
    known.set(key, made);
    made.catch(() => known.delete(key));
    return made;
  }
  /**
   * @param {string} name
   * @param {{ x_px: number, y_px: number, frame: string, limit: number }} where
   */
  async function pages(name, where) {
    /** @type {Reading[]} */
    const found = [];
    /** @type {string | null | undefined} */
    let cursor;
    do {
      const page = await api.get(`${result.path}/history/${name}`, { ...where, cursor });
      page.n.forEach((n, k) => found.push({ n, value: page.value[k], u: page.sigma[k], why: page.status[k] === "ok" ? "not in this step" : page.status[k].replace(/_/g, " ") }));
      cursor = page.next_cursor;
    } while (cursor);
    return found;
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
    if (!box.firstChild) text.textContent = "Reading …";
    const steps = result.steps;
    const found = await read(info.name, i);
    if (mine !== asked) return;
    await against.fill();
    if (mine !== asked) return;
    // at the reference a displacement or a strain is zero by definition
    const zero = isRelative(info.name) ? result.reference : null;
    const rows = found.map((one) => (one.n === zero ? { ...one, value: 0, u: 0, why: "" } : one));
    if (zero !== null && !steps.includes(zero)) rows.unshift({ n: zero, value: 0, u: 0, why: "" });
    const { unit: base, factor } = shownUnit(info.name, info.unit);
    const to = shown(base, factor * Math.max(0, ...rows.map((one) => Math.abs(one.value ?? 0))));
    const placed = rows.map((one) => ({ ...one, x: against.at(one.n) ?? NaN })).filter((one) => Number.isFinite(one.x)).sort((p, q) => p.x - q.x);
    const most = factor * Math.max(0, ...placed.map((one) => Math.abs(one.value ?? 0)));
    const value = placed.map((one) => (one.value === null ? null : one.value * factor * to.factor));
    const band = (/** @type {1 | -1} */ sign) => placed.map((one, k) => { const v = value[k]; return v === null || one.u === null ? null : v + sign * one.u * interval.factor * factor * to.factor; });
    plot?.close();
    plot = null;
    box.dataset.answer = JSON.stringify({ x: placed.map((one) => one.x), value: placed.map((one) => one.value), sigma: placed.map((one) => one.u) });
    const label = `${info.text} at row ${Math.floor(i / map.now.grid.cols)}, column ${i % map.now.grid.cols}`;
    text.textContent = `${label}; the band is ± ${interval.symbol}: ${interval.text}`;
    plot = await chart(box, { x: against.choice.selectedOptions[0]?.text ?? "", y: `${info.text}${to.unit ? ` (${to.unit})` : ""}`, height: 320, label, series: [{ label: info.text, dots: true }, { label: "+", edge: true }, { label: "−", edge: true }],
      bands: [[2, 3]], data: [placed.map((one) => one.x), value, band(1), band(-1)] });
    replace(list, table([["Step", (one) => one.n], ...(against.choice.value === "n" ? [] : [numeric(against.choice.selectedOptions[0]?.text ?? "", (/** @type {typeof placed[number]} */ one) => tick(one.x))]),
      numeric(`${info.text} ± ${interval.symbol}`, (one) => (one.value === null ? one.why : one.n === zero ? "0" : uncertain(one.value * factor, one.u === null ? null : one.u * interval.factor * factor, base, most)))], placed, { caption: label }));
  }

  const redraw = () => draw().catch(notify);
  against.choice.addEventListener("change", redraw);
  root.addEventListener("toggle", redraw);
  let last = "";
  screen.drawn.add(() => { // another step leaves a history as it is
    const now = `${screen.info?.key} ${result.frame} ${screen.state.pinned}`;
    if (now === last) return;
    last = now;
    redraw();
  });
  screen.landed.add(redraw);
  interval.changed.add(redraw);
  screen.ends.push(() => plot?.close());
  return { root, draw: redraw };
}
