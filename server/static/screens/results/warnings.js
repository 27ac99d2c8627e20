// Warnings to know before a result is used: the analysis' `warnings`, failed checks in red, the rest in amber.
import { h, badge, STATE_KIND } from "../../lib/dom.js";
import { inUnits } from "../../lib/units.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"AnalysisWarning">} Warning */

/** @type {Record<string, string>} */
const WORDS = {
  epipolar_check_failed: "epipolar check failed",
  epipolar_check_warning: "epipolar check warns",
  cameras_off_zero: "cameras off their place",
  low_coverage: "few points have values",
  calibration_discarded: "calibration discarded",
  calibration_failed: "calibration failed its checks",
  calibration_warning: "calibration warns",
  camera_moved: "a camera moved",
  steps_failed: "some steps failed",
  image_quality: "poor images",
  out_of_date: "out of date",
  not_checked_yet: "being checked",
};
const word = (/** @type {Warning} */ one) => WORDS[one.code] ?? one.code.replace(/_/g, " ");

/**
 * State of an analysis in a word: never plain green where a check failed.
 * @param {string} state
 * @param {Warning[] | undefined} warnings
 */
export function stateBadge(state, warnings) {
  const found = warnings ?? [];
  if (state !== "succeeded" || !found.length) return badge(state, STATE_KIND[state]);
  const failed = found.filter((one) => one.level === "failed").length;
  return failed
    ? badge(`finished, ${failed === 1 ? "a check" : `${failed} checks`} failed`, "bad")
    : badge(`finished, ${found.length === 1 ? "a warning" : `${found.length} warnings`}`, "warn");
}

/**
 * A cell of a list: each warning in a few words; its text and remedy are the title.
 * @param {{ warnings?: Warning[] }} analysis
 */
export function warningsCell(analysis) {
  return h(
    "span.row",
    (analysis.warnings ?? []).map((one) =>
      h("span", { title: inUnits(`${one.text} ${one.remedy}`) }, badge(word(one), one.level === "failed" ? "bad" : "warn")),
    ),
  );
}

/**
 * The head of a screen: each warning with its figures and its remedy; null without any.
 * @param {Warning[] | undefined} warnings
 */
export function warningsBox(warnings) {
  if (!warnings?.length) return null;
  return h(
    "div",
    { role: "alert", "data-role": "warnings" },
    warnings.map((one) =>
      h(
        `div.caution${one.level === "failed" ? ".bad" : ""}`,
        { "data-warning": one.code },
        h("p", badge(word(one), one.level === "failed" ? "bad" : "warn"), ` ${inUnits(one.text)}`),
        h("p", one.remedy),
      ),
    ),
  );
}
