// Two analyses beside each other: the same field with linked zoom, and their difference.
import * as api from "../../lib/api.js";
import { FieldMap } from "../../widgets/field_map.js";
import { Result, allTests } from "./analysis.js";
import { drawTriad } from "../../widgets/triad.js";
import { Scale } from "../../widgets/scale.js";
import { chart } from "../../widgets/plots.js";
import { h, replace, select, field, definitions, count, quantity, notify } from "../../lib/dom.js";

/** @import { Grid } from "../../lib/point_grid.js" */
/** @import { Model } from "#routes" */
/** @import { Viewer } from "../results.js" */
/** @import { Shown } from "./analysis.js" */
/** @import { Statistics } from "../../lib/point_grid.js" */
/** @typedef {{ grid: Grid, values: ArrayLike<number>, sigma: ArrayLike<number> | null }} Field */
/** @typedef {Model<"TestReply">["analyses"]} Analyses */

const BINS = 41;

/**
 * Values of B at the points of A: the same where the grids are, else between B's points by the rule of the map.
 * @param {Grid} gridA
 * @param {Grid} gridB
 * @param {ArrayLike<number>} values
 */
export function onto(gridA, gridB, values) {
  if (gridA.same(gridB)) return { values: Float64Array.from(values, (v, i) => (gridB.valid[i] ? v : NaN)), interpolated: false };
  const out = new Float64Array(gridA.x.length);
  for (let i = 0; i < out.length; i += 1) out[i] = gridB.at(values, gridA.x[i], gridA.y[i]);
  return { values: out, interpolated: true };
}

/**
 * Differences A - B at A's points, and the standard uncertainty of each where both have one.
 * @param {Field} a
 * @param {Field} b
 */
export function difference(a, b) {
  const other = onto(a.grid, b.grid, b.values);
  const sigmaB = b.sigma ? onto(a.grid, b.grid, b.sigma).values : null;
  const values = new Float64Array(a.values.length);
  const sigma = a.sigma && sigmaB ? Float64Array.from(a.sigma, (own, i) => Math.hypot(own, sigmaB[i])) : null;
  for (let i = 0; i < values.length; i += 1) values[i] = a.grid.valid[i] ? a.values[i] - other.values[i] : NaN;
  return { values, sigma, interpolated: other.interpolated };
}

/** @param {Viewer} screen */
export async function compare(screen) {
  const { map, result } = screen;
  const right = new FieldMap("Field of the other analysis over the image of camera 1");
  right.view.canvas.dataset.role = "map-other";
  const scale = new Scale(() => update().catch(notify), false);
  const choice = h("select", { "data-role": "other" });
  const stepChoice = h("select", {});
  const show = select([["side", "the field of each"], ["difference", "the difference"]], "side");
  const note = h("p.quiet", { role: "status" });
  const figures = h("dl.definitions", { "data-role": "difference" });
  const histogramBox = h("div", { "data-role": "difference-histogram" });
  const bar = h("div", scale.root);
  /** @type {Result | null} */
  let other = null;
  /** @type {Awaited<ReturnType<typeof chart>> | null} */
  let plot = null;
  let asked = 0;

  const tests = await allTests();
  tests.sort((a, b) => Number(b.id === result.testId) - Number(a.id === result.testId)); // its own first
  // analyses of other tests are requested when their test is chosen
  /** @type {Map<string, Analyses>} */
  const analyses = new Map([[result.testId, result.test.analyses]]);
  const testChoice = select(tests.map((one) => [one.id, one.name || one.id]), result.testId);
  async function fillAnalyses() {
    const id = testChoice.value;
    if (!analyses.has(id)) analyses.set(id, (await api.get(`/tests/${id}`)).analyses);
    const others = (analyses.get(id) ?? []).filter((one) => one.id !== result.analysisId);
    replace(choice, others.length ? null : h("option", { value: "" }, "no other analysis"), others.map((one) => h("option", { value: one.id }, one.label || one.id)));
    await choose();
  }
  async function choose() {
    other = choice.value ? await Result.open(testChoice.value, choice.value) : null;
    const of = other;
    await sameAxes();
    replace(stepChoice, h("option", { value: "same" }, "the same step"), of ? of.steps.map((n) => h("option", { value: n }, of.stepText(n))) : null);
    await update();
  }
  /** Both in the same axes: those of this analysis, written out, since the best plane of the other one is its own. */
  async function sameAxes() {
    if (other?.follows === result.frame) return;
    let frame = "system";
    if (result.frame === "specimen") {
      const { alignment } = await api.post(`${result.path}/gauges`, { areas: [{}], variables: ["z_mm"], steps: [result.steps[0]] }, { frame: "specimen" });
      if (alignment) frame = JSON.stringify({ kind: "given", rotation: alignment.rotation, origin_mm: alignment.origin_mm });
    }
    if (other) {
      other.use(frame);
      other.follows = result.frame;
    }
  }
  testChoice.addEventListener("change", () => fillAnalyses().catch(notify));
  choice.addEventListener("change", () => choose().catch(notify));
  stepChoice.addEventListener("change", () => update().catch(notify));
  show.addEventListener("change", () => update().catch(notify));

  // both views show the same part
  let following = false;
  const follow = (/** @type {FieldMap} */ from, /** @type {FieldMap} */ to) => () => {
    if (following || !from.view.width || !to.view.width) return;
    following = true;
    const box = from.view.frame.getBoundingClientRect();
    to.view.centreOn((box.width / 2 - from.view.left) / from.view.scale - 0.5, (box.height / 2 - from.view.top) / from.view.scale - 0.5, from.view.scale);
    following = false;
  };
  const [there, back] = [follow(map, right), follow(right, map)];
  map.view.root.addEventListener("viewchange", there);
  right.view.root.addEventListener("viewchange", back);
  const fade = () => { right.view.canvas.style.opacity = map.view.canvas.style.opacity; };

  const left = h("div", h("h2", "This analysis"));
  const rightName = h("h2", "The other");
  const panel = h("div.grid.two", { hidden: true, "data-role": "difference-panel" }, h("div.panel", bar, figures), h("div.panel", histogramBox));
  const root = h("div", { "data-role": "compare" },
    h("div.row", field("Test", testChoice), field("Compared with", choice), field("At", stepChoice), field("Right view", show)),
    h("div.grid.two.views", left, h("div", rightName, right.view.root)), note,
    panel);

  async function update() {
    asked += 1;
    const mine = asked;
    if (!map.now) return;
    fade();
    Object.assign(right, { factor: map.factor, lacking: map.lacking });
    if (!other) {
      right.view.blank("There is no other analysis to compare with.");
      panel.hidden = true;
      return;
    }
    if (other.follows !== result.frame) await sameAxes();
    const n = stepChoice.value === "same" ? map.now.n : Number(stepChoice.value);
    const key = screen.state.field;
    const found = other.steps.includes(n) ? (await other.fields(n)).shown.find((one) => one.key === key) : null;
    if (mine !== asked) return;
    if (!found || !screen.info) {
      right.view.blank(`The other analysis has no ${key} at step ${n}.`);
      panel.hidden = true;
      note.textContent = "";
      return;
    }
    if (!(await right.load(other, n, found, map.now.image)) || mine !== asked) return;
    right.view.empty.hidden = true;
    result.axes().then((axes) => drawTriad(right.view.frame, axes, "as on the left"), () => {});
    const differ = show.value === "difference";
    const named = `${other.analysis.label || other.analysisId}, step ${n}`;
    rightName.textContent = differ ? `This less ${named}` : named;
    panel.hidden = !differ;
    if (!differ) {
      right.redraw(screen.scale); // one scale for both
      note.textContent = "Both use the colour scale of the left view.";
      there();
      return;
    }
    const a = map.now;
    const b = right.now;
    if (!b) return;
    await Promise.all([a.withSigma, b.withSigma]);
    if (mine !== asked) return;
    const d = difference(a, b);
    const info = { ...found, key: `${key} difference`, text: `difference of ${found.text}`, flags: null, signed: true };
    Object.assign(b, { grid: a.grid, positions: a.positions });
    right.put(d.values, info, d.sigma);
    scale.lay([right.measured], found.unit, null, true);
    right.redraw(scale);
    const s = b.statistics;
    let squares = 0;
    let reported = 0;
    d.sigma?.forEach((sigma, i) => { if (Number.isFinite(d.values[i]) && Number.isFinite(sigma)) { squares += sigma ** 2; reported += 1; } });
    const rmsReported = reported ? Math.sqrt(squares / reported) : null;
    replace(figures, [...definitions([
      ["mean difference", quantity(s.mean, found.unit)], ["rms", quantity(s.rms, found.unit)], ["sd", quantity(s.sd, found.unit)], [`reported ${screen.interval.symbol} of a difference, rms`, quantity(rmsReported === null ? null : screen.interval.factor * rmsReported, found.unit)],
      ["min", quantity(s.min, found.unit)], ["max", quantity(s.max, found.unit)], ["points compared", `${count(s.count)} of ${count(a.values.length)}`],
    ]).children]);
    Object.assign(figures.dataset, { rms: String(s.rms), mean: String(s.mean), count: String(s.count), reported: String(rmsReported) });
    note.textContent = `This analysis less the other${d.interpolated ? "; the points differ, so the other's values are taken between its points" : ", point by point"}${found.unit ? `, in ${found.unit}` : ""}. The reported ${screen.interval.symbol} assumes that both are independent; analyses of the same images, or by one calibration, are not. ${screen.interval.text}.`;
    await histogram(right.measured, s, found, rmsReported);
    there();
  }

  /**
   * @param {Float64Array} values
   * @param {Statistics} s
   * @param {Shown} info
   * @param {number | null} sigma
   */
  async function histogram(values, s, info, sigma) {
    plot?.close();
    plot = null;
    const { min, max, mean } = s;
    if (min === null || max === null || mean === null || !(max > min)) {
      replace(histogramBox, h("p.quiet", s.count ? `Every difference is ${quantity(min, info.unit)}.` : "No point has a value in both."));
      return;
    }
    const width = (max - min) / BINS;
    const bins = new Array(BINS).fill(0);
    for (const v of values) bins[Math.min(Math.floor((v - min) / width), BINS - 1)] += 1;
    const x = bins.map((_, k) => min + (k + 0.5) * width);
    const normal = sigma ? x.map((v) => (s.count * width * Math.exp(-0.5 * ((v - mean) / sigma) ** 2)) / (sigma * Math.sqrt(2 * Math.PI))) : null;
    plot = await chart(histogramBox, { x: `difference${info.unit ? ` (${info.unit})` : ""}`, y: "points", height: 300, bars: [true, false], series: [{ label: "points" }, ...(normal ? [{ label: "normal distribution of the reported σ" }] : [])],
      data: [x, bins, ...(normal ? [normal] : [])], label: "Histogram of the difference" });
  }

  const again = () => update().catch(notify);
  screen.interval.changed.add(again);
  await fillAnalyses().catch(notify);
  return {
    root, update,
    /** Both pictures, each with its name; the difference with a colour bar of its own. */
    seen: () => {
      const one = { frame: map.view.frame, within: map.view.content, title: left.firstElementChild?.textContent ?? "" };
      if (panel.hidden && !(other && right.now && right.view.empty.hidden)) return [one];
      const two = { frame: right.view.frame, within: right.view.content, title: rightName.textContent ?? "" };
      return panel.hidden ? [one, two] : [{ ...one, scale: screen.scale }, { ...two, scale }];
    },
    about: "side by side",
    ownScales: () => !panel.hidden,
    /** The left view moves in, and back out when this is closed. */
    attach: () => { left.append(map.view.root); map.view.fit(); },
    close: () => {
      asked += 1;
      screen.interval.changed.delete(again);
      map.view.root.removeEventListener("viewchange", there);
      right.view.root.removeEventListener("viewchange", back);
      plot?.close();
      right.close();
    },
  };
}
