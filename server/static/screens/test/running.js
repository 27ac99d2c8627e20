// Running analyses of this test: a link at the head of its screen, one row an analysis at the place where it was begun.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { analysisJob, doing, ENDED } from "../../widgets/analysis_job.js";
import { continueButton } from "../../widgets/analyses_table.js";
import { stateBadge, warningsBox } from "../results/warnings.js";
import { h, replace, notify, problemText } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Job } from "../../widgets/analysis_job.js" */
/** @typedef {ReturnType<typeof running>} Running */

/**
 * @param {string} testId
 * @param {Ends} ends
 * @param {() => Promise<unknown>} done called when an analysis has ended
 */
export function running(testId, ends, done) {
  const head = h("span.row", { "data-role": "measuring" });
  const root = h("div", { role: "status", "data-role": "progress" });
  /** @type {Map<string, { job: Job, row: HTMLElement, draw: (job: Job) => void, link: HTMLElement }>} */
  const known = new Map();

  function drawHead() {
    replace(
      head,
      [...known.values()]
        .filter(({ job }) => !ENDED.includes(job.state))
        .map(({ job, link }) => h("a.badge.busy", { href: link.getAttribute("href") ?? "" }, `measuring: ${doing(job)}`)),
    );
  }

  /**
   * Show an analysis' job, from now to its end.
   * @param {Job} job
   * @param {string} analysisId
   * @param {boolean} follow
   */
  function show(job, analysisId, follow) {
    if (known.has(job.id)) return;
    for (const [id, one] of known)
      if (ENDED.includes(one.job.state)) {
        one.row.remove();
        known.delete(id);
      }
    const link = h("a.button", { href: `#/results/${testId}/${analysisId}` }, "Show results");
    const { root: bar, draw } = analysisJob({ testId, analysisId, jobId: job.id, follow });
    bar.append(link);
    const row = h("div", bar);
    root.append(row);
    known.set(job.id, { job, row, draw, link });
    draw(job);
    drawHead();
    api.get(`/jobs/${job.id}`).then(take, notify); // it may have ended before it was shown
  }

  /** @param {Job} job */
  async function take(job) {
    const one = known.get(job.id);
    if (!one) {
      if (job.kind !== "analysis" || job.subject.test_id !== testId || ENDED.includes(job.state)) return;
      const analysisId = String(job.subject.analysis_id);
      const { follow } = await api.get(`/tests/${testId}/analyses/${analysisId}`);
      show(job, analysisId, follow ?? false);
      return;
    }
    const before = one.job.state;
    one.job = job;
    one.draw(job);
    drawHead();
    if (!ENDED.includes(job.state) || ENDED.includes(before)) return;
    const warnings = /** @type {import("../results/warnings.js").Warning[] | undefined} */ (job.result?.warnings);
    const problem = ["succeeded", "cancelled"].includes(job.state) ? null : problemText(api.jobProblem(job));
    const failed = Object.keys(job.result?.steps_failed ?? {}).length;
    const goOn = continueButton({ testId, analysisId: String(job.subject.analysis_id), state: job.state, failed }, () => one.row.remove());
    replace(one.row, h("div.row", stateBadge(job.state, warnings), one.link, goOn), problem, warningsBox(warnings));
    await done();
  }

  const ask = async () => {
    for (const job of (await api.get("/jobs", { limit: 100 })).jobs) await take(job);
  };
  ask().catch(notify);
  ends.push(
    events.on("job", (job) => take(job).catch(notify)),
    events.on("open", () => {
      ask().catch(notify);
    }),
  );
  return { head, root, show };
}
