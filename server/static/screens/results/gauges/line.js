// A line: the shown field along it.
import * as api from "../../../lib/api.js";
import { distanceMm } from "../../../lib/along.js";
import { h, replace, count, select, field, notify, problemText } from "../../../lib/dom.js";
import { shown } from "../../../lib/units.js";
import { banded, chartIn } from "../../../widgets/plots.js";
import { pretty, shownUnit } from "../analysis.js";
import { budgetTable } from "../uncertainty.js";
import { clear, four, times } from "./shared.js";

/** @import { GaugeReadings } from "#routes" */
/** @import { Known } from "../../../widgets/plots.js" */
/** @import { Gauges, Panel, Spot } from "./shared.js" */
/** @typedef {NonNullable<GaugeReadings["lines"]>[number]} Reading */

const ALONG = [
  ["mm", "mm along the surface"],
  ["px", "pixels of the image"],
];

/** Root mean squares of a budget along a line. @type {(budget: { [cause: string]: Known } | null | undefined) => { [cause: string]: number | null }} */
const rms = (budget) =>
  Object.fromEntries(
    Object.entries(budget ?? {}).map(([cause, parts]) => {
      const known = parts.filter((part) => part !== null);
      return [cause, known.length ? Math.sqrt(known.reduce((sum, part) => sum + part * part, 0) / known.length) : null];
    }),
  );

/**
 * @param {Gauges} my
 * @param {{ root: HTMLElement, draw: () => Promise<void> }} more several lines, below this one
 * @returns {Panel}
 */
export function linePanel(my, more) {
  const { screen, state } = my;
  const { result, interval } = screen;
  const plot = chartIn(h("div", { "data-role": "line-chart" }));
  const text = h("div");
  const along = select(ALONG, "mm");
  along.addEventListener("change", () => draw().catch(notify));
  const inputs = four(["Line from x", "Line from y", "Line to x", "Line to y"], (v) => {
    state.line = [/** @type {Spot} */ (v.slice(0, 2)), /** @type {Spot} */ (v.slice(2))];
    return my.changed("line");
  });
  /** @type {{ line: Reading, from: [Spot, Spot], name: string } | null} */
  let answer = null;

  async function read() {
    if (!state.line || !screen.info || screen.step === null) return;
    const from = state.line;
    if (screen.info.component !== null) return void replace(text, h("p.quiet", "A line needs a scalar field; choose another field."));
    const name = screen.info.name;
    replace(text, h("p.quiet", "Reading …"));
    const asked = my.body({ lines: [{ vertices_px: from }], variables: [...new Set([name, "x_mm", "y_mm", "z_mm"])], steps: [screen.step] });
    const [step] = (await api.post(`${result.path}/gauges`, asked, { frame: result.frame })).steps;
    if (step.problem) return void replace(text, problemText(api.problemOf(step.problem)));
    const [line] = step.lines ?? [];
    answer = { line, from, name };
    await draw();
    await more.draw();
  }

  async function draw() {
    if (!answer) return;
    const { line, from, name } = answer;
    const { value, sigma, units, budget, not_included: lacking } = line.values[name];
    const { unit: base, factor: toBase } = shownUnit(name, units);
    const to = shown(base, toBase * value.reduce((/** @type {number} */ most, v) => Math.max(most, Math.abs(v ?? 0)), 0));
    const [unit, factor] = [to.unit, to.factor * toBase];
    const values = times(value, factor);
    const errors = times(times(sigma, factor), interval.factor);
    const mm = distanceMm(["x_mm", "y_mm", "z_mm"].map((axis) => line.values[axis].value));
    const inMm = along.value === "mm" && mm !== null;
    const x = inMm ? mm : line.distance_px;
    const missing = value.filter((v) => v === null).length;
    replace(
      text,
      h(
        "p.quiet",
        `${count(value.length)} positions from (${from[0].join(", ")}) to (${from[1].join(", ")}) px`,
        missing ? `; ${missing} without a value: ${[...new Set(line.missing.filter(Boolean))].join(", ").replace(/_/g, " ")}` : "",
        along.value === "mm" && !mm ? "; the distance in mm is unknown where points are missing, so it is given in px" : "",
        errors.some((v) => v !== null) ? `; the band is ± ${interval.symbol}: ${interval.text}` : "; no standard uncertainty is known",
      ),
      budgetTable(rms(budget), unit, factor, lacking ?? ""),
    );
    plot.box.dataset.answer = JSON.stringify({ x, value, sigma });
    await plot.draw({
      x: inMm ? "distance (mm)" : "distance (px)",
      y: `${screen.info?.text ?? name}${unit ? ` (${unit})` : ""}`,
      height: 320,
      said: interval.text,
      ...banded(x, [{ label: pretty(name), value: values, u: errors }], interval.symbol),
      label: `${pretty(name)} along the line`,
    });
  }

  function close() {
    answer = null;
    plot.close();
  }
  const root = h(
    "details.panel",
    h("summary", "Line"),
    h("p.quiet", "Choose the tool Line above the picture and drag, or give its ends."),
    inputs.row,
    h("div.row", field("Along", along), clear(my, "line", close, [plot.box, text])),
    plot.box,
    text,
    more.root,
  );
  return { root, fill: () => state.line && inputs.fill(state.line.flat()), read, draw, close };
}
