// Extensometers: elongation, length and strain between two points over the steps.
import { h, numeric, replace, table, tick, select, field, notify } from "../../../lib/dom.js";
import { amount, shown, uncertain } from "../../../lib/units.js";
import { banded, chartIn } from "../../../widgets/plots.js";
import { abscissas, gaugeHistory } from "../histories.js";
import { budgetTable, withBudget } from "../uncertainty.js";
import { four, nextName, times } from "./shared.js";

/** @import { GaugeReadings } from "#routes" */
/** @import { Viewer } from "../../results.js" */
/** @import { Interval } from "../uncertainty.js" */
/** @import { Known } from "../../../widgets/plots.js" */
/** @import { Gauges, Panel } from "./shared.js" */
/** @typedef {ReturnType<typeof historyOf>} History */
/** @typedef {History["rows"][number]} Row */

/** @type {[name: string, text: string, unit: string][]} */
const QUANTITIES = [
  ["strain", "strain", "µm/m"],
  ["elongation_mm", "elongation (mm)", "mm"],
  ["length_mm", "length (mm)", "mm"],
  ["true_strain", "true strain", "µm/m"],
];

/**
 * @param {Gauges} my
 * @returns {Panel}
 */
export function extensometersPanel(my) {
  const { screen, state } = my;
  const { result, interval } = screen;
  const plot = chartIn(h("div", { "data-role": "extensometer-chart" }));
  const box = h("div");
  const quantity = select(QUANTITIES, "strain");
  const against = abscissas(result);
  for (const choice of [quantity, against.choice]) choice.addEventListener("change", () => draw().catch(notify));
  const inputs = four(["Extensometer a x", "Extensometer a y", "Extensometer b x", "Extensometer b y"], ([x0, y0, x1, y1]) => {
    state.extensometers.push({ name: nextName(state), a: [x0, y0], b: [x1, y1] });
    return my.changed("extensometer");
  });
  const history = gaugeHistory(screen);
  /** @type {GaugeReadings[] | null} */
  let answer = null;

  async function read() {
    if (!state.extensometers.length) {
      close();
      plot.box.replaceChildren();
      box.replaceChildren();
      return;
    }
    if (!answer) replace(box, h("p.quiet", "Reading …"));
    const asked = my.body({ extensometers: state.extensometers.map((one) => ({ name: one.name, a_px: one.a, b_px: one.b })) });
    await history.read(asked, async (steps) => {
      answer = steps;
      await against.fill();
      await draw();
    });
  }

  async function draw() {
    if (!answer) return;
    const found = historyOf(screen, answer, quantity.value, against);
    const names = state.extensometers.map((one) => one.name);
    const each = (/** @type {"value" | "sigma"} */ part) => found.rows.map((one) => names.map((_, k) => found.of(one, k, part)));
    const drawn = curves(found, names, interval);
    plot.box.dataset.answer = JSON.stringify({ x: drawn.data[0], value: each("value"), sigma: each("sigma") });
    await plot.draw({
      x: against.text,
      y: `${quantity.selectedOptions[0].text.replace(" (mm)", "")} (${found.to.unit})`,
      height: 320,
      said: interval.text,
      ...drawn,
      label: `${quantity.value} of the extensometers`,
    });
    const abscissa = against.choice.value === "n" ? [] : [numeric(against.text, (/** @type {Row} */ one) => tick(one.x))];
    const columns = names.map((name, k) => numeric(name, (/** @type {Row} */ one) => valueText(found, one, k, interval)));
    const caption = `± ${interval.text}`;
    replace(
      box,
      table([["Step", (one) => one.n], ["Label", (one) => one.label], ...abscissa, ...columns], found.rows, { caption }),
      h("div.row", state.extensometers.map(remove)),
    );
  }

  const remove = (/** @type {{ name: string }} */ gauge) => {
    const onclick = () => {
      state.extensometers = state.extensometers.filter((one) => one !== gauge);
      my.changed("extensometer");
    };
    return h("button", { type: "button", onclick }, `Remove ${gauge.name}`);
  };
  function close() {
    answer = null;
    plot.close();
  }
  const root = h(
    "details.panel",
    h("summary", "Extensometers"),
    h("p.quiet", "Choose the tool Extensometer and click its two ends, or give them."),
    inputs.row,
    h("div.row", field("Show", quantity), field("Against", against.choice)),
    history.note,
    plot.box,
    box,
  );
  return { root, fill: () => {}, read, draw, close };
}

/**
 * One quantity over the steps, in the order of the abscissa.
 * @param {Viewer} screen
 * @param {GaugeReadings[]} answer
 * @param {string} name of the quantity
 * @param {ReturnType<typeof abscissas>} against
 */
function historyOf({ result }, answer, name, against) {
  const steps = answer.filter((one) => !one.problem);
  const start = name === "length_mm" ? null : result.reference; // it is zero there, though nothing was measured
  const label = (start === null ? undefined : result.entry(start))?.label ?? "";
  const rows = [...(start === null || steps.some((one) => one.n === start) ? [] : [{ n: start, label, extensometers: [] }]), ...steps]
    .map((one) => ({ n: one.n, label: one.label, x: against.at(one.n) ?? NaN, each: one.extensometers ?? [] }))
    .filter((one) => Number.isFinite(one.x))
    .sort((p, q) => p.x - q.x);
  const base = QUANTITIES.find((one) => one[0] === name)?.[2] ?? "mm";
  const toBase = base === "mm" ? 1 : 1e6;
  const most = Math.max(0, ...rows.flatMap((one) => one.each.map((gauge) => Math.abs(gauge?.values[name]?.value ?? 0) * toBase)));
  /** @type {(one: typeof rows[number], k: number, part: "value" | "sigma") => number | null} */
  const of = (one, k, part) => one.each[k]?.values[name]?.[part] ?? (one.n === start ? 0 : null);
  return { name, start, rows, base, toBase, most, to: shown(base, most), of };
}

/**
 * Curves of the extensometers.
 * @param {History} history
 * @param {string[]} names
 * @param {Interval} interval
 */
function curves({ rows, of, toBase, to }, names, interval) {
  const factor = toBase * to.factor;
  /** @type {(k: number, part: "value" | "sigma") => Known} */
  const column = (k, part) =>
    times(
      rows.map((one) => of(one, k, part)),
      factor,
    );
  const each = names.map((label, k) => ({ label, edge: `${label} `, dots: true, value: column(k, "value"), u: times(column(k, "sigma"), interval.factor) }));
  return banded(
    rows.map((one) => one.x),
    each,
    interval.symbol,
  );
}

/**
 * @param {History} history
 * @param {Row} one
 * @param {number} k
 * @param {Interval} interval
 */
function valueText({ name, start, of, base, toBase, most }, one, k, interval) {
  const [v, s] = [of(one, k, "value"), of(one, k, "sigma")];
  if (v === null) return one.each[k]?.missing?.replace(/_/g, " ") || "–";
  if (one.n === start && !s) return "0";
  if (s === null) return amount(v * toBase, base, 4, most);
  const { budget, not_included: lacking } = one.each[k]?.values[name] ?? {};
  return withBudget(uncertain(v * toBase, s * toBase * interval.factor, base, most), budgetTable(budget, base, toBase, lacking ?? ""));
}
