// Two analyses side by side: the same field with linked zoom, and their difference.
import * as api from "../../lib/api.js";
import { FieldMap } from "../../widgets/field_map.js";
import { Result, allTests } from "./analysis.js";
import { drawTriad } from "../../widgets/triad.js";
import { Scale } from "../../widgets/scale.js";
import { chartIn } from "../../widgets/plots.js";
import { h, replace, select, field, describe, count, quantity, notify } from "../../lib/dom.js";

/** @import { Grid } from "../../lib/point_grid.js" */
/** @import { Model } from "#routes" */
/** @import { ChartPlace } from "../../widgets/plots.js" */
/** @import { Viewer } from "../results.js" */
/** @import { Shown } from "./analysis.js" */
/** @import { Statistics } from "../../lib/point_grid.js" */
/** @typedef {{ grid: Grid, values: ArrayLike<number>, sigma: ArrayLike<number> | null }} Field */
/** @typedef {Model<"TestReply">["analyses"]} Analyses */

const BINS = 41;
const SHOWN = [
  ["side", "the field of each"],
  ["difference", "the difference"],
];

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

/**
 * The choice of the other analysis and of its step.
 * @param {Result} result
 * @param {() => Promise<void>} update
 */
async function otherOf(result, update) {
  const choice = h("select", { "data-role": "other" });
  const stepChoice = h("select", {});
  const tests = await allTests();
  tests.sort((a, b) => Number(b.id === result.testId) - Number(a.id === result.testId)); // its own first
  const testChoice = select(
    tests.map((one) => [one.id, one.name || one.id]),
    result.testId,
  );
  // analyses of other tests are requested when their test is chosen
  /** @type {Map<string, Analyses>} */
  const analyses = new Map([[result.testId, result.test.analyses]]);
  /** @type {Result | null} */
  let other = null;
  async function fillAnalyses() {
    const id = testChoice.value;
    if (!analyses.has(id)) analyses.set(id, (await api.get(`/tests/${id}`)).analyses);
    const others = (analyses.get(id) ?? []).filter((one) => one.id !== result.analysisId);
    replace(
      choice,
      others.length ? null : h("option", { value: "" }, "no other analysis"),
      others.map((one) => h("option", { value: one.id }, one.label || one.id)),
    );
    await choose();
  }
  async function choose() {
    other = choice.value ? await Result.open(testChoice.value, choice.value) : null;
    const of = other;
    await sameAxes();
    replace(stepChoice, h("option", { value: "same" }, "the same step"), of ? of.steps.map((n) => h("option", { value: n }, of.stepText(n))) : null);
    await update();
  }
  /** Both in this analysis' axes, written out, since the other analysis has a best plane of its own. */
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
  return {
    controls: [field("Test", testChoice), field("Compared with", choice), field("At", stepChoice)],
    fill: fillAnalyses,
    /** The other analysis, if there is one. */
    async now() {
      if (other && other.follows !== result.frame) await sameAxes();
      return other;
    },
    /** Its step for one of this analysis. @param {number} n */
    step: (n) => (stepChoice.value === "same" ? n : Number(stepChoice.value)),
  };
}

/**
 * Both views show the same part.
 * @param {FieldMap} left
 * @param {FieldMap} right
 */
function linked(left, right) {
  let following = false;
  const follow = (/** @type {FieldMap} */ from, /** @type {FieldMap} */ to) => () => {
    if (following || !from.view.width || !to.view.width) return;
    following = true;
    const box = from.view.frame.getBoundingClientRect();
    to.view.centreOn((box.width / 2 - from.view.left) / from.view.scale - 0.5, (box.height / 2 - from.view.top) / from.view.scale - 0.5, from.view.scale);
    following = false;
  };
  const [there, back] = [follow(left, right), follow(right, left)];
  left.view.root.addEventListener("viewchange", there);
  right.view.root.addEventListener("viewchange", back);
  const close = () => {
    left.view.root.removeEventListener("viewchange", there);
    right.view.root.removeEventListener("viewchange", back);
  };
  return { there, close };
}

/** @param {Viewer} screen */
export async function compare(screen) {
  const { map, result } = screen;
  const right = new FieldMap("Field of the other analysis over the image of camera 1");
  right.view.canvas.dataset.role = "map-other";
  const scale = new Scale(() => update().catch(notify), false);
  const show = select(SHOWN, "side");
  show.addEventListener("change", () => update().catch(notify));
  const note = h("p.quiet", { role: "status" });
  const figures = h("dl.definitions", { "data-role": "difference" });
  const plot = chartIn(h("div", { "data-role": "difference-histogram" }));
  const other = await otherOf(result, update);
  let asked = 0;
  const link = linked(map, right);
  const left = h("div", h("h2", "This analysis"));
  const rightName = h("h2", "The other");
  const panel = h("div.grid.two", { hidden: true, "data-role": "difference-panel" }, h("div.panel", h("div", scale.root), figures), h("div.panel", plot.box));
  const root = h(
    "div",
    { "data-role": "compare" },
    h("div.row", other.controls, field("Right view", show)),
    h("div.grid.two.views", left, h("div", rightName, right.view.root)),
    note,
    panel,
  );

  async function update() {
    asked += 1;
    const mine = asked;
    if (!map.now) return;
    right.view.canvas.style.opacity = map.view.canvas.style.opacity;
    Object.assign(right, { factor: map.factor, lacking: map.lacking });
    const of = await other.now();
    if (!of) {
      right.view.blank("There is no other analysis to compare with.");
      panel.hidden = true;
      return;
    }
    const n = other.step(map.now.n);
    const key = screen.state.field;
    const found = of.steps.includes(n) ? (await of.fields(n)).shown.find((one) => one.key === key) : null;
    if (mine !== asked) return;
    if (!found || !screen.info) {
      right.view.blank(`The other analysis has no ${key} at step ${n}.`);
      panel.hidden = true;
      note.textContent = "";
      return;
    }
    if (!(await right.load(of, n, found, map.now.image)) || mine !== asked) return;
    right.view.empty.hidden = true;
    result.axes().then(
      (axes) => drawTriad(right.view.frame, axes, "as on the left"),
      () => {},
    );
    const differ = show.value === "difference";
    const named = `${of.analysis.label || of.analysisId}, step ${n}`;
    rightName.textContent = differ ? `This less ${named}` : named;
    panel.hidden = !differ;
    if (!differ) {
      right.redraw(screen.scale); // one scale for both
      note.textContent = "Both use the colour scale of the left view.";
      link.there();
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
    const reported = rmsReported(d);
    drawFigures(figures, b.statistics, found.unit, reported, screen.interval, a.values.length);
    note.textContent = `This analysis less the other${d.interpolated ? "; the points differ, so the other's values are taken between its points" : ", point by point"}${found.unit ? `, in ${found.unit}` : ""}. The reported ${screen.interval.symbol} assumes that both are independent; analyses of the same images, or by one calibration, are not. ${screen.interval.text}.`;
    await histogram(plot, right.measured, b.statistics, found, reported);
    link.there();
  }

  const again = () => update().catch(notify);
  screen.interval.changed.add(again);
  await other.fill().catch(notify);
  return {
    root,
    update,
    /** Both pictures, each with its name; the difference with a colour bar of its own. */
    seen: () => {
      const one = { frame: map.view.frame, within: map.view.content, title: left.firstElementChild?.textContent ?? "" };
      if (panel.hidden && !(right.now && right.view.empty.hidden)) return [one];
      const two = { frame: right.view.frame, within: right.view.content, title: rightName.textContent ?? "" };
      return panel.hidden
        ? [one, two]
        : [
            { ...one, scale: screen.scale },
            { ...two, scale },
          ];
    },
    about: "side by side",
    ownScales: () => !panel.hidden,
    /** The left view moves in, and back out when this is closed. */
    attach: () => {
      left.append(map.view.root);
      map.view.fit();
    },
    close: () => {
      asked += 1;
      screen.interval.changed.delete(again);
      link.close();
      plot.close();
      right.close();
    },
  };
}

/**
 * Root mean square of the reported uncertainties; null if none is known.
 * @param {ReturnType<typeof difference>} of
 */
function rmsReported({ values, sigma }) {
  const known = (sigma ?? new Float64Array()).filter((one, i) => Number.isFinite(values[i]) && Number.isFinite(one));
  return known.length ? Math.sqrt(known.reduce((sum, one) => sum + one ** 2, 0) / known.length) : null;
}

/**
 * @param {HTMLElement} figures
 * @param {Statistics} s
 * @param {string} unit
 * @param {number | null} reported
 * @param {Viewer["interval"]} interval
 * @param {number} points
 */
function drawFigures(figures, s, unit, reported, interval, points) {
  describe(figures, [
    ["mean difference", quantity(s.mean, unit)],
    ["rms", quantity(s.rms, unit)],
    ["sd", quantity(s.sd, unit)],
    [`reported ${interval.symbol} of a difference, rms`, quantity(reported === null ? null : interval.factor * reported, unit)],
    ["min", quantity(s.min, unit)],
    ["max", quantity(s.max, unit)],
    ["points compared", `${count(s.count)} of ${count(points)}`],
  ]);
  Object.assign(figures.dataset, { rms: String(s.rms), mean: String(s.mean), count: String(s.count), reported: String(reported) });
}

/**
 * @param {ChartPlace} plot
 * @param {Float64Array} values
 * @param {Statistics} s
 * @param {Shown} info
 * @param {number | null} sigma
 */
async function histogram(plot, values, s, info, sigma) {
  plot.close();
  const { min, max, mean } = s;
  if (min === null || max === null || mean === null || !(max > min)) {
    replace(plot.box, h("p.quiet", s.count ? `Every difference is ${quantity(min, info.unit)}.` : "No point has a value in both."));
    return;
  }
  const width = (max - min) / BINS;
  const bins = new Array(BINS).fill(0);
  for (const v of values) bins[Math.min(Math.floor((v - min) / width), BINS - 1)] += 1;
  const x = bins.map((_, k) => min + (k + 0.5) * width);
  const normal = sigma ? x.map((v) => (s.count * width * Math.exp(-0.5 * ((v - mean) / sigma) ** 2)) / (sigma * Math.sqrt(2 * Math.PI))) : null;
  await plot.draw({
    x: `difference${info.unit ? ` (${info.unit})` : ""}`,
    y: "points",
    height: 300,
    bars: [true, false],
    series: [{ label: "points" }, ...(normal ? [{ label: "normal distribution of the reported σ" }] : [])],
    data: [x, bins, ...(normal ? [normal] : [])],
    label: "Histogram of the difference",
  });
}
