// The accepted calibration against the live pair: how far the cameras have moved since.
import * as api from "../../lib/api.js";
import { h, replace, badge, quantity } from "../../lib/dom.js";
import { backToZero } from "../../widgets/way_back.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"LiveCheckReply">} Check */

const PAUSE_MS = 4000;
const NONE_MS = 10000;
/** @type {Record<Check["level"], [text: string, kind: string]>} */
const LEVELS = {
  ok: ["as calibrated", "good"],
  warning: ["cameras may have moved", "warn"],
  failed: ["cameras have moved", "bad"],
  no_texture: ["not checked", ""],
  off_zero: ["cameras off their calibrated position", "bad"],
  busy: ["waiting", "busy"],
};

/** @param {Ends} ends */
export function liveCheck(ends) {
  const shown = h("div.row", { role: "status", "data-role": "live-check" }, h("span.quiet", "The accepted calibration is checked …"));
  let closed = false;
  /** @type {number | undefined} */
  let timer;
  let level = "";

  /** @param {Check} found */
  function draw(found) {
    const [text, kind] = LEVELS[found.level];
    const own = found.own_px === null ? "" : `, the calibration's own at most ${quantity(found.own_px, "px", 2)}`;
    const words = found.offset_px === null ? `${found.text}.` : `Points are ${quantity(found.offset_px, "px", 2)} off their epipolar lines${own}.`;
    replace(
      shown,
      badge(text, kind),
      h("span", words),
      found.level === "off_zero" ? backToZero() : null,
      found.level === "failed" || found.level === "warning" ? h("a.button", { href: "#/calibrate" }, "Calibrate again") : null,
      h("a", { href: `#/calibrate/${found.calibration_id}` }, "The calibration"),
    );
  }

  async function ask() {
    let pause = PAUSE_MS;
    try {
      if (!document.hidden) {
        const { calibrations } = await api.get("/calibrations", { accepted: true });
        if (closed) return;
        if (calibrations.length) {
          const found = await api.get("/rig/calibration-check");
          if (closed) return;
          if (found.level !== "busy" || level !== "busy") draw(found);
          level = found.level;
        } else {
          if (level !== "none")
            replace(shown, badge("no calibration", "warn"), h("span", "None has been accepted yet."), h("a.button", { href: "#/calibrate" }, "Calibrate"));
          level = "none";
          pause = NONE_MS;
        }
      }
    } catch (error) {
      if (closed) return;
      level = "";
      replace(shown, badge("not checked"), h("span.quiet", error instanceof Error ? error.message : String(error)));
    }
    timer = setTimeout(ask, pause);
  }
  ask();
  ends.push(() => {
    closed = true;
    clearTimeout(timer);
  });
  return h("section.panel.strip", { "aria-label": "Calibration check" }, h("h2", "Calibration"), shown);
}
