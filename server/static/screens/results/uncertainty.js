// Display of uncertainties: one standard uncertainty or an interval of 95 %, and the included terms.
import * as api from "../../lib/api.js";
import { h, replace, select, badge, notify, num } from "../../lib/dom.js";
import { amount, uncertain } from "../../lib/units.js";

/** @import { Model } from "#routes" */
/** @import { Viewer } from "../results.js" */
/** @typedef {Model<"Uncertainty">} Stated an answer's statement about its uncertainties */
/** @typedef {{ root: HTMLElement, readonly factor: number, readonly symbol: string, readonly text: string, changed: Set<() => unknown> }} Interval
 *   factor of the standard uncertainties shown; `changed` is called after it became another */
/** @typedef {{ [cause: string]: number | null }} Budget standard uncertainty by cause; null if it is not known */

export const NOT_INCLUDED = "calibration not included";
/** @type {[value: string, text: string][]} */
const INTERVALS = [
  ["", "u (k = 1)"],
  ["0.95", "95 %"],
];

/**
 * The switch of the interval, with the terms that the step's uncertainties include; it reads its factor from the service.
 * @param {Viewer} screen
 * @returns {Interval}
 */
export function interval(screen) {
  const { result, map } = screen;
  const choice = select(INTERVALS, "", { "aria-label": "Uncertainties shown", "data-role": "interval" });
  const says = h("p.quiet", { role: "status", "data-role": "includes" });
  /** @type {Map<string, Promise<Stated>>} */
  const known = new Map(); // by step and interval
  /** @type {Stated | null} */
  let now = null;
  /** @type {Interval} */
  const made = {
    root: h("div", h("div.row", h("span", "Uncertainties"), choice), says),
    get factor() {
      return now?.k ?? 1;
    },
    get symbol() {
      return choice.value ? "U" : "u";
    },
    get text() {
      return now?.text ?? "";
    },
    changed: new Set(),
  };

  async function update() {
    const { step } = screen;
    if (step === null) return;
    const key = `${step} ${choice.value}`;
    if (!known.has(key)) known.set(key, stated(step));
    const before = made.factor;
    try {
      now = await /** @type {Promise<Stated>} */ (known.get(key));
    } catch (error) {
      known.delete(key);
      throw error;
    }
    const lacks = now.not_included.includes("calibration");
    replace(
      says,
      lacks ? [badge(NOT_INCLUDED, "warn"), " "] : null,
      h("span", { title: `Not included: ${now.not_included.join("; ")}. ${now.distribution}.` }, now.text),
    );
    map.factor = now.k;
    map.lacking = lacks ? NOT_INCLUDED : "";
    if (now.k === before) return;
    map.view.reread();
    for (const listener of made.changed) await listener();
  }
  /** @param {number} step */
  async function stated(step) {
    if (!choice.value) return (await result.fields(step)).uncertainty;
    return (await api.get(`${result.path}/steps/${step}/fields`, { coverage: Number(choice.value) })).uncertainty;
  }
  choice.addEventListener("change", () => update().catch(notify));
  screen.drawn.add(() => update().catch(notify));
  return made;
}

/**
 * A value with its uncertainty as it is shown.
 * @param {number | null} value
 * @param {number | null} sigma standard uncertainty
 * @param {string} unit
 * @param {number} factor
 * @param {number} [size] of the largest number in its group: they have one unit
 */
export function withUncertainty(value, sigma, unit, factor, size = 0) {
  return uncertain(value, sigma === null ? null : factor * sigma, unit, size);
}

/**
 * A standard uncertainty's parts by cause, as a small table: each part, and its share of the variance.
 * @param {Budget | null | undefined} budget
 * @param {string} unit
 * @param {number} scale from the budget's unit to the one shown
 * @param {string} lacking the missing terms; empty: none
 */
export function budgetTable(budget, unit, scale, lacking) {
  const parts = Object.entries(budget ?? {}).filter(([, part]) => part !== null);
  if (!parts.length) return lacking ? h("p.quiet", lacking) : null;
  const whole = parts.reduce((sum, [, part]) => sum + Number(part) ** 2, 0);
  return h(
    "table.budget",
    { "data-role": "budget" },
    h("caption", "Budget of u (k = 1)", lacking ? `; ${lacking}` : ""),
    h(
      "tbody",
      parts.map(([cause, part]) =>
        h(
          "tr",
          h("th", { scope: "row" }, cause),
          h("td.numeric", amount(scale * Number(part), unit, 2)),
          h("td.numeric", whole > 0 ? `${num((100 * Number(part) ** 2) / whole, 2)} %` : "–"),
        ),
      ),
    ),
  );
}

/**
 * A button with a value that shows and hides its budget below.
 * @param {string} text
 * @param {HTMLElement | null} budget
 */
export function withBudget(text, budget) {
  if (!budget) return text;
  budget.hidden = true;
  const button = h("button.plain", { type: "button", "aria-expanded": "false", title: "Budget: what the uncertainty is made of" }, text);
  button.addEventListener("click", () => {
    budget.hidden = !budget.hidden;
    button.setAttribute("aria-expanded", String(!budget.hidden));
  });
  return h("span", button, budget);
}
