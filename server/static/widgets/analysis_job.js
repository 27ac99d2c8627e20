// A running analysis in one row: its progress, Finish if it follows its test, Cancel.
import * as api from "../lib/api.js";
import { h, replace, action, num } from "../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"JobReply">} Job */

export const ENDED = ["succeeded", "failed", "cancelled", "interrupted"];

/**
 * Present work of a running job, in a few words.
 * @param {Pick<Job, "state"> & { progress?: Partial<Job["progress"]> }} job
 */
export function doing({ state, progress }) {
  if (state === "queued") return "waiting for its turn";
  if (state === "cancelling") return "being cancelled";
  if (ENDED.includes(state)) return state;
  return `${progress?.phase ?? ""}${progress?.eta_s ? `, ${num(progress.eta_s, 2)} s left` : ""}`;
}

/**
 * @param {object} of
 * @param {string} of.testId
 * @param {string} of.analysisId
 * @param {string} of.jobId
 * @param {boolean} of.follow true: it measures each new step of its test, until it is finished
 * @param {import("#dom").Part[]} [of.before] parts at the row's beginning
 */
export function analysisJob({ testId, analysisId, jobId, follow, before = [] }) {
  const bar = h("progress", { max: 1, value: 0, "aria-label": "Progress of the analysis" });
  const text = h("span.doing", { "data-role": "doing" });
  const finish = action(
    "Finish",
    async () => {
      await api.post(`/tests/${testId}/analyses/${analysisId}:finish`);
      finishing = true;
      draw(last);
    },
    { title: "Measure the steps that are there, then end; Cancel ends it at once" },
  );
  const cancel = action("Cancel", () => api.post(`/jobs/${jobId}:cancel`), { kind: "danger" });
  const root = h("div.row.analysis-job", { "data-role": "analysis-job" });
  /** @type {Job | null} */
  let last = null;
  let finishing = false;

  /** @param {Job | null} job */
  function draw(job) {
    if (!job || job.id !== jobId) return;
    last = job;
    const ended = ENDED.includes(job.state);
    const { done, total } = job.progress ?? {};
    if (total) bar.value = (done ?? 0) / total;
    text.textContent = finishing && !ended ? "finishing: measures the steps that are there" : doing(job);
    text.title = text.textContent;
    finish.hidden = !follow;
    // a button that cannot be pressed any more keeps its place, so that nothing moves
    for (const button of [finish, cancel]) button.disabled = ended || (finishing && button === finish);
  }
  replace(root, before, h("span.bar", bar), text, finish, cancel);
  return { root, draw };
}
