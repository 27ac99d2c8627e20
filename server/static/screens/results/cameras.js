// Whether a camera moved since the calibration, the reference or the step before, as each step's matches say.
import { h, badge } from "../../lib/dom.js";
import { inUnits } from "../../lib/units.js";

/** @import { StepSummary } from "#routes" */
/** @typedef {NonNullable<StepSummary["camera_motion"]>} CameraMotion */

export const REMEDY = "Repair the calibration from steps taken since (stereorig calibration repair), or calibrate again.";

/** @param {CameraMotion | null | undefined} motion */
export function camerasBadge(motion) {
  if (!motion) return "–";
  const [word, kind] = motion.camera_moved ? ["moved", "warn"] : motion.camera_moved === false ? ["at rest", "good"] : ["not known", ""];
  return h("span", { title: inUnits(motion.text) }, badge(word, kind));
}

/**
 * The finding of a step with its consequence, where a camera moved.
 * @param {StepSummary | undefined} step
 */
export function camerasNote(step) {
  const motion = step?.camera_motion;
  if (!motion?.camera_moved) return null;
  return h(
    "div.caution",
    { role: "status", "data-role": "camera-motion" },
    h("p", badge("a camera moved", "warn"), ` Step ${step?.n}: ${inUnits(motion.text)}.`),
    h("p", REMEDY),
  );
}
