// What histories are drawn against: step number, time, load, a channel, the number in the label; and an area's history.
import { channelsOfSteps } from "../../lib/steps.js";
import { chart } from "../../widgets/plots.js";
import { h, select, replace } from "../../lib/dom.js";

/** @import { GaugeReadings } from "#routes" */
/** @import { Result } from "./analysis.js" */
/** @import { Interval } from "./uncertainty.js" */

/** @type {WeakMap<Result, { steps: number, found: Map<number, { [name: string]: number }> }>} step -> its channels */
const kept = new WeakMap();

/** @param {Result} result */
async function channelsOf(result) {
  const known = kept.get(result);
  if (known && known.steps === result.steps.length) return known.found;
  const found = await channelsOfSteps(result.testId);
  kept.set(result, { steps: result.steps.length, found });
  return found;
}

/** "pressure_kpa" -> "pressure (kPa)": the unit that a channel's name ends in. @param {string} name */
export function channelText(name) {
  const units = /** @type {Record<string, string>} */ ({ kpa: "kPa", mpa: "MPa", pa: "Pa", bar: "bar", n: "N", kn: "kN", mm: "mm", um: "µm", v: "V", mv: "mV", s: "s", c: "°C", degc: "°C", k: "K", nm: "N m", hz: "Hz", deg: "°", percent: "%" });
  const found = /^(.+)_([a-z]+)$/.exec(name);
  const unit = found ? units[found[2]] : undefined;
  return found && unit ? `${found[1].replaceAll("_", " ")} (${unit})` : name.replaceAll("_", " ");
}

/** The choice of an abscissa. @param {Result} result */
export function abscissas(result) {
  const choice = select([["n", "step number"]], "n");
  /** @type {Map<number, { [name: string]: number }>} */
  let channels_ = new Map();
  let chosen = false; // by the user
  choice.addEventListener("change", () => { chosen = true; });
  async function fill() {
    const listed = result.test.steps ?? [];
    const found = [["n", "step number"]];
    if (listed.some((one) => one.captured_utc)) found.push(["time", "time (s)"]);
    if (listed.some((one) => one.load_n !== null && one.load_n !== undefined)) found.push(["load", "load (N)"]);
    channels_ = await channelsOf(result);
    const channels = [...new Set([...channels_.values()].flatMap(Object.keys))];
    for (const name of channels) found.push([`channel:${name}`, channelText(name)]);
    if (listed.some((one) => Number.isFinite(parseFloat(one.label ?? "")))) found.push(["label", "number in the label"]);
    const before = choice.value;
    replace(choice, found.map(([value, text]) => h("option", { value, selected: value === before }, text)));
    if (!chosen && channels.length) choice.value = `channel:${channels[0]}`; // what drives the test
  }
  /**
   * @param {number} n
   * @returns {number | null}
   */
  function at(n) {
    const listed = (/** @type {number} */ k) => result.entry(k);
    const step = listed(n);
    const time = (/** @type {typeof step} */ one) => Date.parse(one?.timestamp_utc ?? one?.captured_utc ?? "");
    if (choice.value === "n") return n;
    if (choice.value === "time") return (time(step) - time(listed(result.reference))) / 1000;
    if (choice.value === "load") return step?.load_n ?? null;
    if (choice.value === "label") return Number.isFinite(parseFloat(step?.label ?? "")) ? parseFloat(step?.label ?? "") : null;
    return channels_.get(n)?.[choice.value.slice(8)] ?? null;
  }
  return { choice, fill, at, get text() { return choice.selectedOptions[0]?.text ?? ""; } };
}

const RELATIVE = /^([uvw]_mm|exx|eyy|exy|e1|e2|max_shear|von_mises|strain|elongation_mm|true_strain)$/;
/**
 * Whether a quantity is relative to the reference, where it is zero by definition.
 * @param {string} name
 */
export const isRelative = (name) => RELATIVE.test(name);

/**
 * An area's mean over the steps.
 * @param {HTMLElement} box
 * @param {{ result: Result, against: ReturnType<typeof abscissas>, name: string, text: string, unit: string, factor: number, interval: Interval, steps: GaugeReadings[] }} of
 */
export function areaChart(box, { result, against, name, text, unit, factor, interval, steps }) {
  const found = steps.map((one) => {
    const read = one.areas?.[0]?.values[name];
    return { n: one.n, mean: read?.mean ?? null, u: read?.mean_sigma ?? null };
  });
  const zero = isRelative(name) ? { n: result.reference, mean: 0, u: 0 } : null;
  const rows = [...(zero ? [zero] : []), ...found.filter((one) => one.n !== zero?.n)]
    .map((one) => ({ x: against.at(one.n) ?? NaN, value: one.mean === null ? null : factor * one.mean, u: one.u === null ? null : factor * interval.factor * one.u }))
    .filter((one) => Number.isFinite(one.x)).sort((p, q) => p.x - q.x);
  const edge = (/** @type {1 | -1} */ sign) => rows.map((one) => (one.value === null || one.u === null ? null : one.value + sign * one.u));
  return chart(box, { x: against.text, y: `mean ${text}${unit ? ` (${unit})` : ""}`, height: 320, said: interval.text, label: `Mean of ${text} over the area`,
    series: [{ label: `mean ${text}`, dots: true, u: rows.map((one) => one.u) }, { label: `+ ${interval.symbol}`, edge: true, colour: 0 }, { label: `− ${interval.symbol}`, edge: true, colour: 0 }], bands: [[2, 3]],
    data: [rows.map((one) => one.x), rows.map((one) => one.value), edge(1), edge(-1)] });
}
