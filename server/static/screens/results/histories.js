// Abscissas of histories: step number, time, load, a channel, the number in the label.
import { channelsOfSteps } from "../../lib/steps.js";
import { h, select, replace } from "../../lib/dom.js";

/** @import { Result } from "./analysis.js" */

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

/** Unit of the ending of a channel's name. @type {Record<string, string>} */
const UNITS = { um: "µm", c: "°C", degc: "°C", nm: "N m", deg: "°", percent: "%" };
for (const unit of ["kPa", "MPa", "Pa", "bar", "N", "kN", "mm", "V", "mV", "s", "K", "Hz"]) UNITS[unit.toLowerCase()] = unit;

/** "pressure_kpa" -> "pressure (kPa)": the unit that a channel's name ends in. @param {string} name */
export function channelText(name) {
  const found = /^(.+)_([a-z]+)$/.exec(name);
  const unit = found ? UNITS[found[2]] : undefined;
  return found && unit ? `${found[1].replaceAll("_", " ")} (${unit})` : name.replaceAll("_", " ");
}

/** The choice of an abscissa. @param {Result} result */
export function abscissas(result) {
  const choice = select([["n", "step number"]], "n");
  /** @type {Map<number, { [name: string]: number }>} */
  let channels_ = new Map();
  let chosen = false; // by the user
  choice.addEventListener("change", () => {
    chosen = true;
  });
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
    replace(
      choice,
      found.map(([value, text]) => h("option", { value, selected: value === before }, text)),
    );
    if (!chosen && channels.length) choice.value = `channel:${channels[0]}`; // load or channel that drives the test
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
  return {
    choice,
    fill,
    at,
    get text() {
      return choice.selectedOptions[0]?.text ?? "";
    },
  };
}
