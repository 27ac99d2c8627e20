// Abscissas of histories: step number, time, load, a channel, the number in the label.
import * as api from "../../lib/api.js";
import { spread } from "../../lib/even.js";
import { channelsOfSteps, readGauges } from "../../lib/steps.js";
import { h, select, replace, count } from "../../lib/dom.js";

/** @import { Body, GaugeReadings } from "#routes" */
/** @import { Viewer } from "../results.js" */
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

const COARSE = 25; // steps that a history begins with
const MOST = 300; // steps of a history: a plot has few more pixels for their points

/**
 * Readings of gauges over the steps. Of a long test the plot comes first with a few steps, then with more in between;
 * a new question, and leaving the screen, end the work on the one before.
 * @param {Viewer} screen
 */
export function gaugeHistory(screen) {
  const { result } = screen;
  const note = h("p.quiet", { role: "status", hidden: true, "data-role": "thinned" });
  /** @type {AbortController | null} */
  let going = null;
  let asked = "";
  let again = false;
  screen.ends.push(() => going?.abort());

  /**
   * @param {Body<"post", "/tests/{test_id}/analyses/{analysis_id}/gauges">} body
   * @param {(steps: GaugeReadings[]) => unknown} draw called with more and more readings, in the order of the steps
   */
  async function read(body, draw) {
    const { steps, path, frame } = result;
    const question = JSON.stringify([body, frame]);
    again = going !== null && question === asked; // more steps are finished: they are read once this has ended
    if (again) return;
    going?.abort();
    const mine = new AbortController();
    const { signal } = mine;
    going = mine;
    asked = question;
    const long = steps.length > COARSE;
    const coarse = spread(steps, COARSE);
    const shown = spread(steps, MOST);
    const rest = shown.filter((n) => !coarse.includes(n));
    /** @type {Map<number, GaugeReadings>} */
    const found = new Map();
    const put = async (/** @type {GaugeReadings[]} */ part) => {
      if (signal.aborted) return;
      for (const one of part) found.set(one.n, one);
      note.hidden = !long || found.size >= steps.length;
      note.textContent = `${count(found.size)} of ${count(steps.length)} steps, evenly spread${found.size < shown.length ? "; more are being read" : ""}. The table that Export saves has all.`;
      await draw([...found.values()].sort((a, b) => a.n - b.n));
    };
    try {
      await put(await readGauges(path, long ? { ...body, steps: coarse } : body, { frame }, signal));
      // the first step defines the frame, so each part has it
      if (rest.length) await put(await readGauges(path, { ...body, steps: [steps[0], ...rest] }, { frame }, signal, put));
    } catch (error) {
      if (!api.aborted(error)) throw error;
    } finally {
      if (going === mine) going = null;
    }
    if (again && !signal.aborted) await read(body, draw);
  }
  return { read, note };
}
