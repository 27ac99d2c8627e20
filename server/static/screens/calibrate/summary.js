// A calibration in one badge and one row of figures: state, verdict and decision are one fact to its user.
import * as api from "../../lib/api.js";
import { h, badge, definitions, quantity } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {{ state: string, decision?: string | null, level?: string | null }} Fact */

/** @type {Record<string, [text: string, kind: string]>} */
const LEVEL = { good: ["good", "good"], warning: ["warning", "warn"], failed: ["refused", "bad"] };
/** @type {Record<string, string>} */
const STATE = { failed: "bad", interrupted: "warn", cancelled: "warn", unfinished: "busy" };

/**
 * Text and kind of the one badge.
 * @param {Fact} fact
 * @returns {[text: string, kind: string]}
 */
export function statusOf({ state, decision, level }) {
  if (decision === "discarded") return ["discarded", "bad"];
  if (state !== "complete") return [state, STATE[state] ?? ""];
  const [text, kind] = LEVEL[level ?? ""] ?? ["imported", ""];
  if (decision === "accepted") return [kind === "warn" ? "accepted with a warning" : "accepted", kind === "warn" ? "warn" : "good"];
  return [text, kind];
}

/** @param {Fact} fact */
export const statusBadge = (fact) => badge(...statusOf(fact));

/**
 * Geometry of a complete calibration's cameras, and their parameters; null if there are none.
 * @param {Model<"CalibrationReply">} document_
 */
export async function geometryOf(document_) {
  if (document_.state !== "complete") return null;
  try {
    return await api.get(`/calibrations/${/** @type {"{calibration_id}"} */ (document_.id)}/geometry`);
  } catch {
    return null; // a broken file shows its error at its use
  }
}

/**
 * Stereo angle, baseline, focal length and field of view.
 * @param {Model<"GeometryReply"> | null} found
 */
export function figures(found) {
  if (!found) return null;
  const { cam1, cam2 } = found.cameras ?? {};
  const both = (/** @type {string | null} */ one, /** @type {string | null} */ two) => (one === two ? one : `${one ?? "–"}; ${two ?? "–"}`);
  const size = (/** @type {readonly number[] | null | undefined} */ mm) => (mm ? `${quantity(mm[0], "", 3)} × ${quantity(mm[1], "mm", 3)}` : null);
  /** @type {[string, import("#dom").Part][]} */
  const rows = [
    ["stereo angle", quantity(found.stereo_angle_deg, "°", 4)],
    ["baseline", quantity(found.baseline_mm, "mm", 4)],
  ];
  if (cam1 && cam2) {
    rows.push(
      ["field of view", both(size(cam1.field_of_view_mm), size(cam2.field_of_view_mm))],
      ["stand-off", both(quantity(cam1.standoff_mm, "mm", 4), quantity(cam2.standoff_mm, "mm", 4))],
    );
    rows.push([
      "focal length",
      cam1.focal_length_mm === null && cam2.focal_length_mm === null
        ? h("span.quiet", "not known: the rig file does not state pixel_um")
        : both(quantity(cam1.focal_length_mm, "mm", 4), quantity(cam2.focal_length_mm, "mm", 4)),
    ]);
  }
  return definitions(rows);
}
