// The bar of controls: field, axes, image, opacity and step.
import { h, replace, field, select, notify } from "../../lib/dom.js";
import { shown as shownIn } from "../../lib/units.js";
import { usualField } from "./live.js";

/** @import { Over } from "../../widgets/field_map.js" */
/** @import { Viewer } from "../results.js" */

/** @type {[Over, string][]} */
export const IMAGES = [
  ["reference", "reference, camera 1"],
  ["cam1", "this step, camera 1"],
  ["cam2", "this step, camera 2"],
];

/**
 * @param {Viewer} screen
 * @param {object} to
 * @param {() => Promise<void>} to.refresh shows step, field and image as they are chosen now
 * @param {() => void} to.chosen another field is chosen
 * @param {() => void} to.moved a step is chosen by hand
 */
export function controlsBar(screen, { refresh, chosen, moved }) {
  const { result, state, map } = screen;
  const fieldChoice = h("select", { id: "resultfield", "aria-label": "Field" });
  const imageChoice = select(IMAGES, "reference");
  const opacity = h("input", { id: "opacity", type: "range", min: 0, max: 100, value: 75 });
  const opacityText = h("span", { "data-role": "opacity", "aria-hidden": "true" }); // the slider shows its own value
  const slider = h("input", { id: "resultstep", type: "range", min: 0, max: Math.max(result.steps.length - 1, 0), step: 1, "aria-label": "Step" });
  const stepText = h("output", { "data-role": "step" });
  const axesField = h("div.field");
  const play = h("button", { type: "button", "aria-pressed": "false", title: "Play through the steps", onclick: () => playing(!state.playing) }, "▶ Play");

  async function fields() {
    if (state.step === null) return;
    const { shown } = await result.fields(state.step);
    // a field that was chosen and that this step lacks (a shape has no displacement) stays chosen for the others
    if (!state.chosen) state.field = usualField(shown.map((one) => one.key));
    state.info = shown.find((one) => one.key === state.field) ?? null;
    const options = (/** @type {string} */ group) =>
      shown
        .filter((one) => one.group === group)
        .map((one) => {
          const text = one.unit ? `${one.text} (${shownIn(one.unit).unit})` : one.text;
          return h("option", { value: one.key, selected: one.key === state.field, title: one.about }, text);
        });
    replace(
      fieldChoice,
      state.info ? null : h("option", { value: state.field, selected: true }, `${state.field} (not in this step)`),
      [...new Set(shown.map((one) => one.group))].map((group) => h("optgroup", { label: group }, options(group))),
    );
  }

  /** Which step is shown, of how many. */
  function counter() {
    if (state.step === null) return;
    const at = result.steps.indexOf(state.step);
    const text = result.stepText(state.step);
    slider.max = String(Math.max(result.steps.length - 1, 0));
    slider.value = String(at);
    slider.setAttribute("aria-valuetext", text);
    replace(stepText, h("span.of", `${at + 1} of ${result.steps.length}`), h("span.name", { title: text }, text));
  }

  /** A step chosen by hand. @param {number} n */
  async function choose(n) {
    state.step = n;
    moved();
    await refresh();
  }
  const move = (/** @type {number} */ by) =>
    choose(result.steps[Math.min(Math.max(result.steps.indexOf(state.step ?? NaN) + by, 0), result.steps.length - 1)]).catch(notify);

  /** @param {boolean} on */
  async function playing(on) {
    play.setAttribute("aria-pressed", String(on));
    play.textContent = on ? "❚❚ Pause" : "▶ Play";
    const mine = on ? {} : null;
    state.playing = mine;
    while (state.playing === mine && mine && document.contains(play)) {
      const at = (result.steps.indexOf(state.step ?? NaN) + 1) % result.steps.length;
      const began = performance.now();
      try {
        state.step = result.steps[at];
        await refresh();
      } catch (error) {
        notify(error);
        playing(false);
        return;
      }
      await new Promise((resolve) => setTimeout(resolve, Math.max(400 - (performance.now() - began), 30)));
    }
  }

  fieldChoice.addEventListener("change", () => {
    state.field = fieldChoice.value;
    state.chosen = true;
    chosen();
    refresh().catch(notify);
  });
  imageChoice.addEventListener("change", () => {
    state.image = /** @type {Over} */ (imageChoice.value);
    refresh().catch(notify);
  });
  slider.addEventListener("input", () => choose(result.steps[Number(slider.value)]).catch(notify));
  const fade = () => {
    map.view.canvas.style.opacity = String(Number(opacity.value) / 100);
    opacityText.textContent = `${opacity.value}\u00a0%`;
  };
  opacity.addEventListener("input", fade);
  fade();
  const before = h("button", { type: "button", "aria-label": "Step before", onclick: () => move(-1) }, "◂");
  const next = h("button", { type: "button", "aria-label": "Next step", onclick: () => move(1) }, "▸");
  const root = h(
    "div.row.controls",
    h("div.field", h("label", { for: "resultfield" }, "Field"), fieldChoice),
    axesField,
    field("Image", imageChoice),
    h("div.field", h("label", { for: "opacity" }, "Opacity"), h("span.control", opacity, opacityText)),
    h("div.field.grow", h("label", { for: "resultstep" }, "Step "), h("span.control", before, slider, next, play, stepText)),
  );
  return { root, axesField, fields, counter };
}
