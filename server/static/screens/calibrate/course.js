// The course of a calibration's job: its progress, its end, its verdict.
import * as api from "../../lib/api.js";
import { h, replace, action, badge, problemText } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @import { Calibration } from "./tables.js" */

/** @type {Record<string, string>} */
const PHASES = { target: "looking for the target", views: "taking views", grid: "finding the target", calibration: "adjusting" };

/** @param {Model<"JobReply">} job of a calibration */
function verdictOf(job) {
  const verdict = /** @type {Calibration["verdict"]} */ (job.result?.verdict);
  return verdict ? `Verdict: ${verdict.level}.` : "";
}

/**
 * Follow a calibration to its end, with its progress and its verdict.
 * @param {Model<"JobReply">} job
 * @param {HTMLElement} progress
 * @param {AbortSignal} signal
 */
export async function course(job, progress, signal) {
  const bar = h("progress", { max: 1, "aria-label": "Progress of the calibration" });
  const text = h("span");
  replace(
    progress,
    h(
      "div.row",
      h("span", { style: { flex: 1, minWidth: "10rem" } }, bar),
      text,
      action("Cancel", () => api.post(`/jobs/${job.id}:cancel`), { kind: "danger" }),
    ),
  );
  const ended = await api.finished(job.id, {
    signal,
    onprogress: (now) => {
      const { phase: stage, done: ready, total } = now.progress ?? {};
      if (total) bar.value = ready / total;
      text.textContent = now.state === "queued" ? "waiting" : `${PHASES[stage ?? ""] ?? stage ?? ""} ${total ? `${ready} of ${total}` : ""}`;
    },
  });
  replace(
    progress,
    ended.state === "succeeded"
      ? h("p", verdictOf(ended), " It is shown below.")
      : ended.state === "cancelled"
        ? h("p", badge("cancelled", "warn"), " The axes were stopped; no calibration was computed from the views.")
        : problemText(api.jobProblem(ended)),
  );
  return ended;
}
