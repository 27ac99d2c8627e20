// An area: statistics of the shown field in a rectangle, over the steps.
import { h, replace, table, field, notify } from "../../../lib/dom.js";
import { amount, shown, uncertain } from "../../../lib/units.js";
import { banded, chartIn } from "../../../widgets/plots.js";
import { isRelative, pretty, shownUnit } from "../analysis.js";
import { abscissas, gaugeHistory } from "../histories.js";
import { budgetTable, withBudget } from "../uncertainty.js";
import { clear, four } from "./shared.js";

/** @import { GaugeReadings } from "#routes" */
/** @import { Viewer } from "../../results.js" */
/** @import { Gauges, Panel } from "./shared.js" */
/** @typedef {{ name: string, steps: GaugeReadings[] }} Answer */

/**
 * @param {Gauges} my
 * @returns {Panel}
 */
export function areaPanel(my) {
  const { screen, state } = my;
  const { result, interval } = screen;
  const box = h("div", { "data-role": "area" });
  const plot = chartIn(h("div", { "data-role": "area-chart" }));
  const against = abscissas(result);
  against.choice.addEventListener("change", () => draw());
  const inputs = four(["Area left", "Area top", "Area right", "Area bottom"], (v) => {
    state.area = v;
    return my.changed("area");
  });
  const history = gaugeHistory(screen);
  /** @type {Answer | null} */
  let answer = null;

  async function read() {
    if (!state.area || !screen.info) return;
    if (screen.info.component !== null) return void replace(box, h("p.quiet", "An area needs a scalar field; choose another field."));
    const { name } = screen.info;
    if (!box.firstChild) replace(box, h("p.quiet", "Reading …"));
    await history.read(my.body({ areas: [{ rectangle_px: state.area }], variables: [name] }), async (steps) => {
      await against.fill();
      answer = { name, steps };
      draw();
    });
  }

  function draw() {
    if (!answer) return;
    const { name, steps } = answer;
    const { unit, factor } = shownUnit(name, steps.at(-1)?.areas?.[0]?.values[name]?.units ?? "");
    const zero = isRelative(name) ? result.reference : null; // it is zero there by definition
    const most = factor * Math.max(0, ...steps.map((one) => Math.abs(one.areas?.[0]?.values[name]?.mean ?? 0)));
    /** @type {(one: GaugeReadings, part: "mean" | "mean_sigma" | "sd" | "rms" | "min" | "max", digits?: number) => string} */
    const cell = (one, part, digits = 4) => (one.n === zero ? "0" : amount((one.areas?.[0]?.values[name]?.[part] ?? NaN) * factor, unit, digits, most));
    const mean = (/** @type {GaugeReadings} */ one) => {
      const v = one.areas?.[0]?.values[name];
      if (!v || v.mean_sigma === null) return cell(one, "mean");
      return withBudget(
        uncertain((v.mean ?? NaN) * factor, v.mean_sigma * factor * interval.factor, unit, most),
        budgetTable(v.mean_budget, unit, factor, v.not_included ?? ""),
      );
    };
    const to = shown(unit, most);
    plot.draw(means(screen, answer, against, to.unit, factor * to.factor)).catch(notify);
    box.dataset.answer = JSON.stringify(steps.map((one) => one.areas?.[0]?.values[name] ?? null));
    replace(
      box,
      table(
        [
          ["Step", (one) => one.n],
          ["Label", (one) => one.label],
          [`Mean ± ${interval.symbol}`, mean, { numeric: true }],
          ["sd", (one) => cell(one, "sd", 3), { numeric: true }],
          ["rms", (one) => cell(one, "rms"), { numeric: true }],
          ["Min", (one) => cell(one, "min"), { numeric: true }],
          ["Max", (one) => cell(one, "max"), { numeric: true }],
          ["Points", (one) => (one.problem ? one.problem.detail : `${one.areas?.[0].valid} of ${one.areas?.[0].points}`), { numeric: true }],
        ],
        steps,
        { caption: `${pretty(name)} over the rectangle; ${interval.text}` },
      ),
    );
  }

  function close() {
    answer = null;
    plot.close();
  }
  const root = h(
    "details.panel",
    h("summary", "Areas"),
    h("p.quiet", "Choose the tool Area and drag a rectangle, or give its corners."),
    h("div.row", inputs.row, field("Area against", against.choice), clear(my, "area", close, [plot.box, box])),
    history.note,
    plot.box,
    box,
  );
  return { root, fill: () => state.area && inputs.fill(state.area), read, draw, close };
}

/**
 * The area's mean over the steps.
 * @param {Viewer} screen
 * @param {Answer} answer
 * @param {ReturnType<typeof abscissas>} against
 * @param {string} unit
 * @param {number} factor
 */
function means({ result, interval }, { name, steps }, against, unit, factor) {
  const found = steps.map((one) => {
    const read = one.areas?.[0]?.values[name];
    return { n: one.n, mean: read?.mean ?? null, u: read?.mean_sigma ?? null };
  });
  const zero = isRelative(name) ? { n: result.reference, mean: 0, u: 0 } : null;
  const rows = [...(zero ? [zero] : []), ...found.filter((one) => one.n !== zero?.n)]
    .map((one) => ({ ...one, x: against.at(one.n) ?? NaN }))
    .filter((one) => Number.isFinite(one.x))
    .sort((p, q) => p.x - q.x);
  const column = (/** @type {"mean" | "u"} */ part, /** @type {number} */ by) => rows.map(({ [part]: v }) => (v === null ? null : by * v));
  const curve = { label: `mean ${pretty(name)}`, dots: true, value: column("mean", factor), u: column("u", factor * interval.factor) };
  return {
    x: against.text,
    y: `mean ${pretty(name)}${unit ? ` (${unit})` : ""}`,
    height: 320,
    said: interval.text,
    label: `Mean of ${pretty(name)} over the area`,
    ...banded(
      rows.map((one) => one.x),
      [curve],
      interval.symbol,
    ),
  };
}
