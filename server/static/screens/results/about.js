// Settings and step summaries of an analysis.
import { h, replace, table, badge, definitions, num, tick, count, quantity, when, STATE_KIND } from "../../lib/dom.js";

import { REMEDY, camerasBadge } from "./cameras.js";
import { NOT_INCLUDED } from "./uncertainty.js";
import { amount, inUnits } from "../../lib/units.js";

/** @import { Viewer } from "../results.js" */
/** @import { StepSummary } from "#routes" */

/**
 * Settings, software, inputs; each step's figures, checks and warnings.
 * @param {Viewer} screen
 */
export function about(screen) {
  const { result } = screen;
  const root = h("details.panel", { "data-role": "about" }, h("summary", "Settings and checks"));
  const body = h("div");
  root.append(body);

  /**
   * @param {unknown} value
   * @returns {string}
   */
  const text = (value) => {
    if (value === null || value === undefined) return "none";
    if (Array.isArray(value)) return value.length > 12 ? `${value.length} entries` : value.map(text).join(", ") || "none";
    if (typeof value === "object")
      return (
        Object.entries(value)
          .filter(([, v]) => v !== null && !(Array.isArray(v) && !v.length))
          .map(([k, v]) => `${k} ${text(v)}`)
          .join("; ") || "none"
      );
    return typeof value === "number" ? tick(value) : String(value);
  };

  /** @param {StepSummary} one */
  const denseText = ({ dense }) =>
    h("span", { title: dense?.reason ?? "" }, dense?.file ? `${count(dense.valid)} of ${count(dense.vectors)}` : dense ? "none" : "–");

  function draw() {
    const { analysis } = result;
    const steps = analysis.summary?.steps ?? [];
    const failed = Object.entries(analysis.steps_failed ?? {});
    const verdict = (/** @type {StepSummary["epipolar_check"]} */ check) =>
      check ? h("span", { title: check.reason }, badge(check.level, STATE_KIND[check.level] ?? "warn")) : "–";
    const largest = (/** @type {string} */ name) => Math.max(0, ...steps.map((one) => one.sigma_median_mm?.[name] ?? 0)); // a column has one unit
    const warned = steps.flatMap((one) => [
      ...(one.epipolar_check && one.epipolar_check.level !== "ok" ? [`Step ${one.n}: ${one.epipolar_check.reason}`] : []),
      ...(one.dense?.reason ? [`Step ${one.n}: no dense field: ${one.dense.reason}`] : []),
      ...(one.camera_motion?.camera_moved ? [`Step ${one.n}: ${one.camera_motion.text}. ${REMEDY}`] : []),
    ]);
    replace(
      body,
      analysis.stale ? h("p", badge("out of date", "warn"), " ", (analysis.stale_reasons ?? []).join("; ")) : null,
      warned.length
        ? h(
            "div",
            h("h3", "Warnings"),
            h(
              "ul",
              warned.map((one) => h("li", inUnits(one))),
            ),
          )
        : null,
      failed.length
        ? h(
            "div",
            h("h3", "Steps that failed"),
            h(
              "ul",
              failed.map(([n, one]) => h("li", `Step ${n}: ${one.code}: ${one.detail} ${one.remedy}`)),
            ),
          )
        : null,
      h("h3", "Settings"),
      definitions([
        ["kind", analysis.kind],
        ...Object.entries(analysis.settings ?? {}).map(([name, value]) => /** @type {const} */ ([name.replace(/_/g, " "), text(value)])),
        ["software", analysis.software ?? "–"],
        ["begun", when(analysis.created_utc)],
        [
          "calibration",
          analysis.inputs?.calibration_sha256
            ? [
                analysis.calibration_id ? h("a", { href: `#/calibrate/${analysis.calibration_id}` }, analysis.calibration_id) : null,
                " ",
                h("code", analysis.inputs.calibration_sha256.slice(0, 16)),
              ]
            : "–",
        ],
      ]),
      h("h3", "Steps"),
      table(
        [
          ["Step", (one) => one.n, { numeric: true }],
          ["Valid", (one) => `${count(one.valid)} of ${count(one.points)}`, { numeric: true }],
          ["Epipolar check", (one) => verdict(one.epipolar_check)],
          ["Cameras", (one) => camerasBadge(one.camera_motion)],
          ["Epipolar offset", (one) => quantity(one.epipolar_offset_rms_px, "px", 3), { numeric: true }],
          ["Correlation", (one) => num(Math.min(...Object.values(one.zncc_median ?? { none: NaN })), 4), { numeric: true }],
          ["σ Z", (one) => amount(one.sigma_median_mm?.z_mm, "mm", 2, largest("z_mm")), { numeric: true }],
          ["σ W", (one) => amount(one.sigma_median_mm?.w_mm, "mm", 2, largest("w_mm")), { numeric: true }],
          ["Strain noise floor", (one) => amount(one.strain?.noise_floor_microstrain?.exx, "µm/m", 3), { numeric: true }],
          ...(analysis.settings.dense_step_px ? [/** @type {const} */ (["Vectors of the dense field", denseText, { numeric: true }])] : []),
          ["Patch", (one) => h("span", { title: one.patch?.reason ?? "" }, one.patch?.patch ?? "–")],
          ["Time", (one) => quantity(one.wall_s, "s", 3), { numeric: true }],
        ],
        steps,
        {
          caption: `Summary of ${(analysis.n_finished ?? 0) > steps.length ? `the first ${steps.length} steps of ${count(analysis.n_finished)}` : "each step"}; σ are medians of the reported standard uncertainties (k = 1)${steps.some((one) => !one.sigma_calibration_median_mm) ? `, ${NOT_INCLUDED}` : ""}`,
          empty: "No step is finished yet.",
        },
      ),
      definitions(
        steps.length
          ? [
              ["epipolar check of the last step", inUnits(steps.at(-1)?.epipolar_check?.reason ?? "–")],
              ["cameras at the last step", inUnits(steps.at(-1)?.camera_motion?.text ?? "–")],
              ["patch of the last step", inUnits(steps.at(-1)?.patch?.reason ?? "–")],
            ]
          : [],
      ),
    );
  }
  draw();
  return { root, draw };
}
