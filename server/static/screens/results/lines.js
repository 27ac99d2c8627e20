// Several lines, and lines over the steps, in one plot of the shown field.
import { readGauges } from "../../lib/steps.js";
import { chartIn } from "../../widgets/plots.js";
import { distanceMm, resampled } from "../../lib/along.js";
import { shown } from "../../lib/units.js";
import { h, replace, field, select, notify } from "../../lib/dom.js";
import { shownUnit } from "./analysis.js";

/** @import { GaugeReadings } from "#routes" */
/** @import { Viewer } from "../results.js" */
/** @typedef {[[number, number], [number, number]]} Ends */
/** @typedef {{ name: string, ends: Ends }} Kept */
/** @typedef {{ label: string, colour: number, x: number[], mm: number[] | null, value: (number | null)[] }} Curve */

const POSITIONS = 200;
const MOST = 24; // curves in one plot

/**
 * @param {Viewer} screen
 * @param {object} of
 * @param {Kept[]} of.kept lines that were kept before; filled on
 * @param {() => Ends | null} of.current line that is drawn now
 * @param {(more: any) => any} of.body of a request for gauges
 * @param {() => void} of.redraw draws the gauges over the picture again
 */
export function lines(screen, { kept, current, body, redraw }) {
  const { result } = screen;
  let serial = Math.max(0, ...kept.map((one) => Number(/\d+$/.exec(one.name)?.[0] ?? 0)));
  const plot = chartIn(h("div", { "data-role": "lines-chart" }));
  const { box } = plot;
  const list = h("div.row");
  const note = h("p.quiet", { role: "status" });
  const over = select(
    [
      ["one", "this step"],
      ["all", "all steps"],
    ],
    "one",
  );
  const keep = h("button", { type: "button", title: "Compare this line with the next ones" }, "Keep this line");
  keep.addEventListener("click", () => {
    const ends = current();
    if (!ends) {
      note.textContent = "Draw a line first.";
      return;
    }
    serial += 1;
    kept.push({ name: `L${serial}`, ends: structuredClone(ends) });
    listed();
    draw().catch(notify);
  });
  const root = h(
    "div",
    { "data-role": "lines" },
    h("h3", "Several lines, and lines over the steps"),
    h("div.row", keep, field("Steps of the lines", over), list),
    note,
    box,
  );
  let asked = 0;

  const buttons = () =>
    kept.map((one) => {
      const onclick = () => {
        kept.splice(kept.indexOf(one), 1);
        listed();
        draw().catch(notify);
      };
      return h("button", { type: "button", onclick }, `Remove ${one.name}`);
    });

  function listed() {
    replace(list, buttons());
    redraw();
  }

  async function draw() {
    asked += 1;
    const mine = asked;
    const ends = current();
    /** @type {Kept[]} */
    const each = kept.length ? kept : ends ? [{ name: "line", ends }] : [];
    const all = over.value === "all";
    if (!each.length || (!kept.length && !all) || !screen.info || screen.step === null || screen.info.component !== null) {
      plot.close();
      box.replaceChildren();
      delete box.dataset.answer;
      note.textContent = kept.length && screen.info?.component !== null ? "Lines need a scalar field; choose another field." : "";
      return;
    }
    const { name, unit: units, text } = screen.info;
    const variables = [...new Set([name, "x_mm", "y_mm", "z_mm"])];
    const steps = await readGauges(
      result.path,
      body({ lines: each.map((one) => ({ name: one.name, vertices_px: one.ends })), variables, steps: all ? result.steps.slice(-MOST) : [screen.step] }),
      { frame: result.frame },
    );
    if (mine !== asked) return;
    const curves = curvesOf(
      steps,
      name,
      kept.map((one) => one.name),
      all,
    );
    const drawn = curves.filter((one) => one.value.some((v) => v !== null)).slice(-MOST);
    const total = all ? result.steps.length * each.length : curves.length;
    const { unit: base, factor } = shownUnit(name, units);
    const to = shown(base, factor * drawn.reduce((most, one) => one.value.reduce((/** @type {number} */ m, v) => Math.max(m, Math.abs(v ?? 0)), most), 0));
    const inMm = drawn.every((one) => one.mm);
    const xOf = (/** @type {Curve} */ one) => (inMm ? /** @type {number[]} */ (one.mm) : one.x);
    const longest = Math.max(0, ...drawn.map((one) => xOf(one).at(-1) ?? 0));
    const at = Array.from({ length: POSITIONS + 1 }, (_, k) => (k * longest) / POSITIONS);
    box.dataset.answer = JSON.stringify(drawn.map((one) => ({ label: one.label, value: one.value })));
    note.textContent = `${drawn.length} ${drawn.length === 1 ? "curve" : "curves"}${total > drawn.length ? ` of ${total}: steps without ${text} are left out, and no more than ${MOST} are drawn` : ""}`;
    await plot.draw({
      x: inMm ? "distance (mm)" : "distance (px)",
      y: `${text}${to.unit ? ` (${to.unit})` : ""}`,
      height: 320,
      label: `${text} along ${each.length === 1 ? "the line" : "the lines"}`,
      series: drawn.map((one) => ({ label: one.label, colour: one.colour })),
      data: [at, ...drawn.map((one) => resampled(xOf(one), one.value, at).map((v) => (v === null ? null : v * factor * to.factor)))],
    });
  }
  over.addEventListener("change", () => draw().catch(notify));
  screen.landed.add(() => draw().catch(notify));
  screen.ends.push(plot.close);
  replace(list, buttons());
  return { root, kept, draw };
}

/**
 * @param {GaugeReadings[]} steps
 * @param {string} name of the variable
 * @param {string[]} kept names of the lines; none: of a single line
 * @param {boolean} all true: of several steps
 * @returns {Curve[]}
 */
const curvesOf = (steps, name, kept, all) =>
  steps
    .filter((step) => !step.problem)
    .flatMap((step) =>
      (step.lines ?? []).map((line, k) => ({
        label: [kept[k] ?? "", all ? `step ${step.n}` : ""].filter(Boolean).join(", "),
        colour: kept.length > 1 || !all ? k : step.n,
        x: line.distance_px,
        mm: distanceMm(["x_mm", "y_mm", "z_mm"].map((axis) => line.values[axis].value)),
        value: line.values[name]?.value ?? line.distance_px.map(() => null),
      })),
    );
