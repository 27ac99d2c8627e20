// The way back to the calibrated place, wherever the page finds the cameras off it.
import * as api from "../lib/api.js";
import { h, action, notify, quantity, replace } from "../lib/dom.js";

/** @typedef {import("#routes").Model<"StageReply">} Stage */

export const OFF_ZERO_MM = 0.01; // as the service judges a capture

/**
 * Axes that move cameras and are off dZ = 0; empty while one moves.
 * @param {Stage} stage
 */
export function offZero(stage) {
  const axes = stage.axes ?? [];
  if (axes.some((axis) => axis.moving)) return [];
  return axes.filter((axis) => axis.position_mm !== null && Math.abs(axis.position_mm - axis.zero_mm) > OFF_ZERO_MM);
}

/**
 * Button that takes both cameras to dZ = 0.
 * @param {() => unknown} [done]
 */
export function backToZero(done = () => {}) {
  return action(
    "Back to the calibrated position",
    async () => {
      const { job } = await api.post("/stage/moves", { dz_mm: { cam1: 0, cam2: 0 } });
      const ended = await api.finished(job.id);
      if (ended.state !== "succeeded") throw api.jobProblem(ended);
      notify("The cameras are back at their calibrated position.", "good");
      await done();
    },
    { kind: "primary" },
  );
}

/** A line with that button where the cameras are off their place, empty otherwise; `update` looks again. */
export function wayBackNote() {
  const box = h("div", { "data-role": "way-back" });
  async function update() {
    try {
      const off = offZero(await api.get("/stage"));
      replace(
        box,
        off.length
          ? h(
              "div.caution",
              { role: "status" },
              h(
                "p",
                `The cameras are off their calibrated position: ${off.map((axis) => `${axis.cameras.join(", ") || `axis ${axis.axis}`} by ${quantity(axis.position_mm - axis.zero_mm, "mm", 4)}`).join("; ")}. What is captured here is not measured rightly.`,
              ),
              backToZero(update),
            )
          : null,
      );
    } catch {
      replace(box); // the bar shows that the stage is silent
    }
  }
  return { root: box, update };
}
