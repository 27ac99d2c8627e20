// An analysis that still runs: whether the newest step is followed, how far it is, Finish and Cancel.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { analysisJob, ENDED } from "../../widgets/analysis_job.js";
import { h, notify } from "../../lib/dom.js";

/** @import { Viewer } from "../results.js" */

/**
 * Step to show once more steps are finished; null: stay.
 * @param {readonly number[]} steps that are finished, in their order
 * @param {number | null} shown
 * @param {boolean} following
 */
export function nextShown(steps, shown, following) {
  const newest = steps.at(-1) ?? null;
  if (newest === null || newest === shown) return null;
  return following || shown === null ? newest : null;
}

/**
 * Field to show if none was chosen: the displacement W if the step has it, else the shape Z.
 * @param {readonly string[]} keys of the step's fields
 */
export function usualField(keys) {
  return ["w_mm", "z_mm"].find((key) => keys.includes(key)) ?? keys[0] ?? null;
}

/**
 * @param {Viewer} screen
 * @param {(n: number) => Promise<void>} go shows a step
 */
export function live(screen, go) {
  const { result } = screen;
  const running = () => !ENDED.includes(result.analysis.state);
  const follow = h("input", { type: "checkbox", checked: true, "data-role": "follow" });
  const root = h("div", { hidden: true });
  const { analysis } = result;
  const atNewest = () => screen.step === null || screen.step === result.steps.at(-1);
  follow.checked = atNewest();
  if (running() && analysis.job_id) {
    const row = analysisJob({
      testId: result.testId,
      analysisId: result.analysisId,
      jobId: analysis.job_id,
      follow: analysis.follow ?? false,
      before: [h("label.check", { title: "Show each step as soon as it is measured" }, follow, "follow the newest step")],
    });
    root.hidden = false;
    root.append(row.root);
    screen.ends.push(events.on("job", row.draw));
    api.get(`/jobs/${analysis.job_id}`).then(row.draw, notify);
  }
  follow.addEventListener("change", () => {
    if (follow.checked) landed().catch(notify);
  });

  /** More steps are finished: the newest is shown if it is followed. */
  async function landed() {
    const next = screen.state.playing ? null : nextShown(result.steps, screen.step, follow.checked);
    if (next !== null) await go(next);
  }
  /** A step was chosen by hand: the newest one is followed from there, another one stays. */
  function moved() {
    follow.checked = atNewest();
  }
  return { root, landed, moved, running };
}
