// A test's analyses in a table, and the button that goes on with one that stopped.
import * as api from "../lib/api.js";
import { stateBadge, warningsCell } from "../screens/results/warnings.js";
import { h, action, confirmed, table, when } from "../lib/dom.js";

/** @import { Model } from "#routes" */

const OPEN = ["interrupted", "cancelled", "failed"];

/**
 * The button that measures the steps which an analysis has not measured; null where nothing is left to measure.
 * @param {{ testId: string, analysisId: string, state?: string | null, failed?: number, label?: string }} of
 *   `failed`: number of its steps that could not be measured
 * @param {() => unknown} [begun]
 */
export function continueButton({ testId, analysisId, state, failed = 0, label = analysisId }, begun) {
  if (!OPEN.includes(state ?? "") && !(state === "succeeded" && failed)) return null;
  const send = (/** @type {boolean} */ other) => api.post(`/tests/${testId}/analyses/${analysisId}:continue`, { other_version: other });
  async function run() {
    try {
      await send(false);
    } catch (error) {
      if (!(error instanceof api.Problem && error.code === "software_changed")) throw error;
      if (!(await confirmed("Continue with another version?", h("p", error.message), "Continue"))) return;
      await send(true);
    }
    await begun?.();
  }
  return action("Continue", run, { title: "What is measured is kept; the other steps are measured now", "aria-label": `Continue ${label}` });
}

/**
 * @param {Pick<Model<"TestReply">, "id" | "analyses">} test
 * @param {() => unknown} begun called when one is gone on with
 */
export const analysesTable = (test, begun) =>
  table(
    [
      ["Analysis", (one) => h("a", { href: `#/results/${test.id}/${one.id}` }, one.label || one.id)],
      ["Kind", (one) => one.kind],
      [
        "State",
        (one) => {
          const of = { testId: test.id, analysisId: one.id, state: one.state, failed: one.steps_failed?.length, label: one.label || one.id };
          return h("span.row", one.state ? stateBadge(one.state, one.warnings) : null, continueButton(of, begun));
        },
      ],
      ["Checks", warningsCell],
      ["Calibration", (one) => (one.calibration_id ? h("a", { href: `#/calibrate/${one.calibration_id}` }, "look at it") : "–")],
      ["Begun", (one) => when(one.created_utc)],
    ],
    (test.analyses ?? []).toReversed(),
    {
      caption: "Analyses of this test, newest first",
      empty: "This test has not been measured yet.",
      onrow: (one) => {
        location.hash = `#/results/${test.id}/${one.id}`;
      },
    },
  );
