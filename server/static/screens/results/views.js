// The views of a field, of which one is shown: over the image, on the surface in space, beside another analysis.
import { h, replace, notify } from "../../lib/dom.js";
import { seenPicture } from "../../widgets/seen_picture.js";
import { IMAGES } from "./controls.js";

/** @import { Seen } from "../../widgets/seen_picture.js" */
/** @import { Viewer } from "../results.js" */
/** @typedef {"image" | "surface" | "compare"} Mode */
/** @typedef {{ root: HTMLElement, update: () => Promise<void>, close: () => void, attach?: () => void, seen?: () => Seen[], about?: string, ownScales?: () => boolean }} OtherView shown instead of the map */

/** @type {[Mode, string][]} */
const MODES = [
  ["image", "Image"],
  ["surface", "3-D surface"],
  ["compare", "Side by side"],
];

/**
 * @param {Viewer} screen
 * @param {() => void} switched another view is shown
 */
export function views(screen, switched) {
  const { result, state, map } = screen;
  const buttons = MODES.map(([name, text]) => {
    const onclick = () => show(name).catch(notify);
    return h("button", { type: "button", "data-mode": name, "aria-pressed": String(name === "image"), onclick }, text);
  });
  const stage = h("div", map.view.root);
  /** @type {OtherView | null} */
  let other = null; // shown instead of the map: the surface, or two maps
  /** @param {Mode} name */
  async function show(name) {
    state.mode = name;
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.mode === name));
    if (other) {
      screen.drawn.delete(other.update);
      other.close();
      other = null;
    }
    replace(stage, map.view.root);
    switched();
    if (name === "image") {
      map.view.fit();
      return;
    }
    /** @type {OtherView} */
    const made = name === "surface" ? await (await import("./surface.js")).surface(screen) : await (await import("./compare.js")).compare(screen);
    if (state.mode !== name || other || !document.contains(stage)) {
      made.close();
      return;
    }
    other = made;
    replace(stage, made.root);
    made.attach?.();
    screen.drawn.add(made.update);
    await made.update();
  }
  screen.ends.push(() => other?.close());

  /** The view that is shown, as SVG. @param {number} width */
  function picture(width) {
    const { testId, analysisId, analysis, test } = result;
    const seen = other?.about ?? `over the image: ${IMAGES.find(([name]) => name === state.image)?.[1]}`;
    return seenPicture(other?.seen?.() ?? [{ frame: map.view.frame, within: map.view.content }], {
      title: `${test.name || testId}: ${state.info?.text ?? state.field}, ${state.step === null ? "" : result.stepText(state.step)}`,
      scale: other?.ownScales?.() ? null : screen.scale,
      width,
      notes: [
        `axes of the ${result.frame === "system" ? "calibration" : "specimen"}; ${seen}; ${screen.message.textContent}`,
        `test ${testId}, analysis ${analysisId}, calibration ${analysis.calibration_id ?? test.calibration_id ?? "not stated"}`,
      ],
    });
  }
  return { modes: h("div.row", { role: "group", "aria-label": "View" }, buttons), stage, picture };
}
