// Tests and analyses with all of their steps: a document holds the first hundred, its lists the others page by page.
import * as api from "./api.js";
import * as events from "./events.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"StepEntry">} StepEntry */
/** @typedef {{ cursor: string | null | undefined, steps: StepEntry[] }} Page */

const PAGE = 1000;
/** Pages of the test that was read last: of a test that grows, only the last one is read again. @type {{ id: string, pages: Page[] }} */
let kept = { id: "", pages: [] };

events.on("step", (/** @type {StepEntry & { test_id: string }} */ event) => {
  if (event.test_id !== kept.id) return;
  for (const page of kept.pages) {
    const at = page.steps.findIndex((one) => one.n === event.n);
    if (at >= 0) page.steps[at] = { ...page.steps[at], label: event.label, load_n: event.load_n, quality: event.quality };
  }
});

/**
 * A test with all of its steps.
 * @param {string} id
 */
export async function readTest(id) {
  const test = await api.get(`/tests/${id}`);
  if (!test.steps_next_cursor) return test;
  const grown = kept.id === id ? await pagesOf(id, kept.pages.slice(0, -1), kept.pages.at(-1)?.cursor) : [];
  const right = grown.reduce((sum, page) => sum + page.steps.length, 0) === test.n_steps;
  kept = { id, pages: right ? grown : await pagesOf(id, [], null) };
  return { ...test, steps: kept.pages.flatMap((page) => page.steps) };
}

/**
 * Pages that are known, and those from a cursor on.
 * @param {string} id
 * @param {Page[]} before
 * @param {string | null | undefined} from
 */
async function pagesOf(id, before, from) {
  const pages = [...before];
  let cursor = from;
  do {
    const answer = await api.get(`/tests/${id}/steps`, { limit: PAGE, cursor });
    pages.push({ cursor, steps: answer.steps });
    cursor = answer.next_cursor;
  } while (cursor);
  return pages;
}

/**
 * An analysis with the numbers of all of its steps; the figures of the first hundred are in its summary.
 * @param {string} testId
 * @param {string} analysisId
 */
export async function readAnalysis(testId, analysisId) {
  const analysis = await api.get(`/tests/${testId}/analyses/${analysisId}`);
  if ((analysis.n_steps ?? 0) <= (analysis.steps ?? []).length) return analysis;
  const finished = [];
  /** @type {NonNullable<typeof analysis.steps_failed>} */
  const failed = {};
  /** @type {string | null | undefined} */
  let cursor;
  do {
    const page = await api.get(`/tests/${testId}/analyses/${analysisId}/steps`, { limit: PAGE, figures: false, cursor });
    for (const one of page.steps) {
      if (one.state === "finished") finished.push(one.n);
      if (one.problem) failed[String(one.n)] = one.problem;
    }
    cursor = page.next_cursor;
  } while (cursor);
  return { ...analysis, steps_finished: finished, steps_failed: failed };
}

/**
 * Figures of one step of an analysis.
 * @param {string} testId
 * @param {string} analysisId
 * @param {number} n
 */
export async function figuresOf(testId, analysisId, n) {
  const { steps } = await api.get(`/tests/${testId}/analyses/${analysisId}/steps`, { first: n, limit: 1 });
  return steps[0]?.n === n ? (steps[0].figures ?? null) : null;
}

/**
 * The channels of a test's steps by the steps' numbers, page by page.
 * @param {string} testId
 */
export async function channelsOfSteps(testId) {
  /** @type {Map<number, { [name: string]: number }>} */
  const found = new Map();
  /** @type {string | null | undefined} */
  let cursor;
  do {
    const page = await api.get(`/tests/${testId}/steps`, { limit: PAGE, channels: true, cursor });
    for (const one of page.steps) found.set(one.n, one.channels ?? {});
    cursor = page.next_cursor;
  } while (cursor);
  return found;
}

/** @import { Body, GaugeReadings } from "#routes" */

/** Most gauge readings of one request: each takes the service some 80 ms, and one that is left is worked to its end. */
const READINGS = 25;

/**
 * Gauge readings of all steps that are asked for, page by page.
 * @param {string} path of the analysis
 * @param {Body<"post", "/tests/{test_id}/analyses/{analysis_id}/gauges">} body
 * @param {{ [name: string]: unknown }} query
 * @param {AbortSignal} [signal]
 * @param {(steps: GaugeReadings[]) => unknown} [onpage] called with the readings so far, after each page but the last
 */
export async function readGauges(path, body, query, signal, onpage) {
  /** @type {GaugeReadings[]} */
  const steps = [];
  /** @type {string | null | undefined} */
  let cursor;
  do {
    const asked = { ...query, limit: READINGS, cursor };
    const page = await api.post(/** @type {`/tests/${string}/analyses/${string}/gauges`} */ (`${path}/gauges`), body, asked, signal);
    steps.push(...page.steps);
    cursor = page.next_cursor;
    if (cursor) await onpage?.(steps);
  } while (cursor);
  return steps;
}
