// Errors of fields, each next to its own control, in the user's words, before anything is sent.
import { h } from "./dom.js";

/** @typedef {HTMLInputElement | HTMLSelectElement | HTMLTextAreaElement} Entry */
/** @typedef {() => boolean} Rule shows a field's error next to it; true if it has none */

let told = 0;
let pressed = false;
/** @param {Event} event */
const press = ({ type }) => {
  pressed = type === "pointerdown";
};
for (const name of ["pointerdown", "pointerup", "pointercancel"]) window.addEventListener(name, press, true);

/**
 * Put an error next to a control; an empty text removes it.
 * @param {Entry} control
 * @param {string} text
 */
export function tell(control, text) {
  const place = control.closest(".field") ?? control.closest(".row") ?? control.parentElement;
  const described = (control.getAttribute("aria-describedby") ?? "").split(" ").filter(Boolean);
  const known = described
    .map((id) => document.getElementById(id) ?? place?.querySelector(`#${CSS.escape(id)}`))
    .find((node) => node?.classList.contains("error"));
  if (!text) {
    if (!known) return;
    known.remove();
    control.removeAttribute("aria-invalid");
    control.setAttribute("aria-describedby", described.filter((id) => id !== known.id).join(" "));
    return;
  }
  control.setAttribute("aria-invalid", "true");
  if (known) {
    if (known.textContent !== text) known.textContent = text;
    return;
  }
  told += 1;
  const box = h("small.error", { id: `error${told}`, role: "alert" }, text);
  place?.append(box);
  control.setAttribute("aria-describedby", [...described, box.id].join(" "));
}

/**
 * A rule of a field: its error is shown when the field is left or sent, and removed as soon as it is put right.
 * @param {Entry} control
 * @param {(text: string) => string} wrong the error in its text; empty: none
 * @returns {Rule}
 */
export function rule(control, wrong) {
  const check = () => {
    const text =
      control instanceof HTMLInputElement && control.validity.badInput
        ? "This is no number. Write it with a point, such as 12.5."
        : wrong(control.value.trim());
    tell(control, text);
    return !text;
  };
  // a press that leaves the field is a click on something: an error that appears before the click would push the target away
  control.addEventListener("change", () => (pressed ? window.addEventListener("pointerup", () => setTimeout(check), { once: true }) : check()));
  control.addEventListener("input", () => control.getAttribute("aria-invalid") === "true" && check());
  return check;
}

/**
 * Whether a field holds a value within its control's own limits.
 * @param {HTMLInputElement} input
 */
export const correct = (input) => input.value !== "" && input.checkValidity();

/**
 * Check every field; the first that is wrong has the focus.
 * @param {readonly [Entry, Rule][]} rules
 */
export function allRight(rules) {
  const wrong = rules.filter(([, check]) => !check());
  wrong[0]?.[0].closest("details")?.setAttribute("open", ""); // what is folded takes no focus
  wrong[0]?.[0].focus();
  return !wrong.length;
}

/**
 * The error in a number's text by these limits; empty: none.
 * @param {{ low?: number | null, high?: number | null, unit?: string, whole?: boolean, odd?: boolean, required?: boolean, above?: number, what?: string }} limits
 * @returns {(text: string) => string}
 */
export function numberWithin({ low = null, high = null, unit = "", whole = false, odd = false, required = true, above, what = "A number" }) {
  const shown = (/** @type {number} */ value) => `${String(value).replace("-", "−")}${unit ? `\u00a0${unit}` : ""}`;
  return (text) => {
    if (!text) return required ? `${what} is needed here.` : "";
    const value = Number(text);
    if (!Number.isFinite(value)) return "This is no number. Write it with a point, such as 12.5.";
    if (whole && !Number.isInteger(value)) return `Give a whole number, not ${text}.`;
    if (above !== undefined && value <= above) return `Give more than ${shown(above)}, not ${shown(value)}.`;
    if ((low !== null && value < low) || (high !== null && value > high)) {
      if (low === null) return `Give ${shown(/** @type {number} */ (high))} at most, not ${shown(value)}.`;
      if (high === null) return `Give ${shown(low)} at least, not ${shown(value)}.`;
      return `Give ${low} to ${shown(high)}, not ${shown(value)}.`;
    }
    if (odd && value % 2 === 0)
      return `Give an odd number, ${[value - 1, value + 1].filter((near) => (low === null || near >= low) && (high === null || near <= high)).join(" or ")}, not ${shown(value)}: it has a middle.`;
    return "";
  };
}

/**
 * The rule of a number by the limits that its control has: `min`, `max`, and `step`, 1 for whole numbers, 2 for odd ones.
 * @param {HTMLInputElement} control
 * @param {string} what its name in a sentence: "A spacing"
 * @param {{ unit?: string, required?: boolean, more?: (value: number) => string }} [others] `more` is asked once it is a number within its limits
 * @returns {[HTMLInputElement, Rule]}
 */
export function limited(control, what, { unit = "", required = true, more } = {}) {
  const [low, high] = [control.min, control.max].map((text) => (text === "" ? null : Number(text)));
  const within = numberWithin({ low, high, unit, what, required, whole: ["1", "2"].includes(control.step), odd: control.step === "2" });
  return [control, rule(control, (text) => within(text) || (text && more?.(Number(text))) || "")];
}

/**
 * Take back the errors of fields that were put right by something else than typing.
 * @param {readonly [Entry, Rule][]} rules
 */
export function again(rules) {
  for (const [control, check] of rules) if (control.getAttribute("aria-invalid") === "true") check();
}

/**
 * The error in a list of numbers; empty: none.
 * @param {{ low?: number, high?: number, least?: number, unit: string }} limits
 * @returns {(text: string) => string}
 */
export function numbersWithin({ low = -Infinity, high = Infinity, least = 0, unit }) {
  return (text) => {
    const parts = text.split(/[\s;,]+/).filter(Boolean);
    const wrong = parts.find((part) => !Number.isFinite(Number(part)));
    if (wrong !== undefined) return `“${wrong}” is no number. Write ${unit} with a point, between commas: 0, 2.5, 5.`;
    const beyond = parts.map(Number).find((value) => value < low || value > high);
    if (beyond !== undefined) return `The stage goes from ${low} to ${high}\u00a0${unit}; ${beyond}\u00a0${unit} is beyond it.`;
    const different = new Set(parts.map(Number)).size;
    return different < least ? `Give ${least} different positions or more; ${different === 1 ? "there is one" : "there is none"}.` : "";
  };
}
