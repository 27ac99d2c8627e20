// Settings of an analysis as fields: correlation and strain, with the virtual strain gauge.
import * as api from "../../lib/api.js";
import { again, correct, limited, numberWithin, rule } from "../../lib/fields.js";
import { gaugePx, gaugeText } from "../../widgets/region/gauge.js";
import { h, field, number, select } from "../../lib/dom.js";

/** @import { Model, Reply } from "#routes" */
/** @typedef {Model<"RecipeSettings">} Settings */
/** @typedef {ReturnType<typeof settingsForm>} Form each control by its setting's name */

const KINDS = [
  ["displacement", "shape and displacement"],
  ["profile", "shape only"],
];
const SHAPES = [
  ["auto", "auto: affine or quadratic"],
  ["affine", "affine (plane)"],
  ["rigid", "rigid (the paper's)"],
  ["quadratic", "quadratic (curved)"],
];
const INTERPOLATIONS = [
  ["quintic", "quintic B-spline"],
  ["cubic", "cubic B-spline"],
];
const ORDERS = [
  ["auto", "planes or quadratics"],
  [1, "planes"],
  [2, "quadratics"],
];
const TENSORS = [
  ["green_lagrange", "Green-Lagrange"],
  ["infinitesimal", "infinitesimal"],
  ["hencky", "Hencky (logarithmic)"],
];
const UPDATES = [
  ["auto", "auto"],
  ["never", "never (total)"],
  ["always", "always (incremental)"],
];
const CHOICES = /** @type {const} */ (["kind", "patch", "interpolation", "reference_update"]);
const NUMBERS = /** @type {const} */ (["subset_px", "spacing_px", "prefilter_px", "max_sigma_px"]);
const OPTIONAL = /** @type {const} */ (["smoothing_window", "dense_step_px"]);

/** @param {Reply<"get", "/noise">["noise"]} noise models that were measured */
export function settingsForm(noise) {
  const known = noise.filter((one) => one.state === "complete" || !one.state).map((one) => [one.id, String(one.plan.label || one.id)]);
  const form = {
    subset_px: number(33, { min: 9, max: 401, step: 2 }),
    spacing_px: number(10, { min: 1, max: 1000, step: 1 }),
    kind: select(KINDS, "displacement"),
    patch: select(SHAPES, "auto"),
    interpolation: select(INTERPOLATIONS, "quintic"),
    prefilter_px: number(0, { min: 0, max: 100.25 }),
    max_sigma_px: number(0.25, { min: 0.001, max: 1, step: "any" }),
    noise_id: select([["", "from the residuals"], ...known], ""),
    reference_update: select(UPDATES, "auto"),
    smoothing_window: number(null, { min: 3, max: 51, step: 2, placeholder: "none" }),
    dense_step_px: number(null, { min: 1, max: 20, step: 1, placeholder: "none" }),
    strain: h("input", { type: "checkbox", checked: true }),
    window: number(9, { min: 3, max: 101, step: 2 }),
    order: select(ORDERS, "auto"),
    tensor: select(TENSORS, "green_lagrange"),
  };
  const { subset_px: subset, spacing_px: spacing, window } = form;
  const windowWrong = numberWithin({ low: Number(window.min), high: Number(window.max), unit: "points", whole: true, odd: true, what: "A window" });
  const rules = /** @type {[HTMLInputElement, import("../../lib/fields.js").Rule][]} */ ([
    limited(subset, "A subset", { unit: "px" }),
    limited(spacing, "A spacing", { unit: "px" }),
    limited(form.prefilter_px, "A prefilter", {
      unit: "px",
      more: (sd) => (sd > Number(subset.value) / 4 ? `Give a quarter of the subset at most, ${Number(subset.value) / 4}\u00a0px, not ${sd}\u00a0px.` : ""),
    }),
    limited(form.max_sigma_px, "A largest sigma", { unit: "px" }),
    limited(form.smoothing_window, "A window", { unit: "points", required: false }),
    limited(form.dense_step_px, "A distance", {
      unit: "px",
      required: false,
      more: (px) => (px > Number(spacing.value) ? `Give the spacing at most, ${spacing.value}\u00a0px, not ${px}\u00a0px: it would be no denser.` : ""),
    }),
    [window, rule(window, (text) => (form.strain.checked ? windowWrong(text) : ""))],
  ]);
  for (const input of [subset, spacing, form.strain]) input.addEventListener("input", () => again(rules)); // others' limits hang on these
  return { ...form, rules };
}

/**
 * The settings as they are given; a number that is being typed is as it was before.
 * @param {Form} form
 * @param {Settings} before
 * @param {Pick<Settings, "seeds" | "seeds_cam2">} seeds
 * @returns {Settings}
 */
export function settingsOf(form, before, seeds) {
  /** @type {Settings} */
  const found = {
    kind: /** @type {Settings["kind"]} */ (form.kind.value),
    patch: /** @type {Settings["patch"]} */ (form.patch.value),
    interpolation: /** @type {Settings["interpolation"]} */ (form.interpolation.value),
    reference_update: /** @type {Settings["reference_update"]} */ (form.reference_update.value),
    noise_id: form.noise_id.value || null,
    ...seeds,
    strain: null,
  };
  for (const name of NUMBERS) {
    const value = correct(form[name]) ? Number(form[name].value) : before[name]; // one that is being typed is not kept yet
    if (value !== undefined) found[name] = value;
  }
  if ((found.prefilter_px ?? 0) > (found.subset_px ?? 0) / 4) found.prefilter_px = 0; // as one that is being typed
  for (const name of OPTIONAL) found[name] = form[name].value === "" ? null : correct(form[name]) ? Number(form[name].value) : (before[name] ?? null);
  if ((found.dense_step_px ?? 0) > (found.spacing_px ?? 0)) found.dense_step_px = null;
  if (form.strain.checked)
    found.strain = /** @type {Settings["strain"]} */ ({
      ...(correct(form.window) ? { window: Number(form.window.value) } : {}),
      order: form.order.value === "auto" ? "auto" : Number(form.order.value),
      tensor: form.tensor.value,
    });
  return found;
}

/**
 * @param {Form} form
 * @param {Partial<Settings>} set
 */
export function showSettings(form, set) {
  for (const name of [...CHOICES, ...NUMBERS]) if (set[name] !== undefined) form[name].value = String(set[name]);
  for (const name of OPTIONAL) if (set[name] !== undefined) form[name].value = String(set[name] ?? "");
  const noise = set.noise_id ?? "";
  if (set.noise_id !== undefined && [...form.noise_id.options].some((one) => one.value === noise)) form.noise_id.value = noise;
  if (set.strain !== undefined) form.strain.checked = set.strain !== null;
  if (set.strain?.window) form.window.value = String(set.strain.window);
  if (set.strain?.order) form.order.value = String(set.strain.order);
  if (set.strain?.tensor) form.tensor.value = set.strain.tensor;
  again(form.rules);
}

/**
 * What is seldom changed, folded.
 * @param {Form} form
 */
export const settingsFields = (form) =>
  h(
    "details.advanced",
    h("summary", "Advanced"),
    h("label.check", form.strain, "compute strain"),
    h(
      "div.fields",
      field("Strain fit", form.order),
      field("Tensor", form.tensor),
      field("Measure", form.kind),
      field("Shape function", form.patch),
      field("Interpolation", form.interpolation),
      field("Prefilter, sd", form.prefilter_px, "px", "0: none"),
      field("Largest sigma of a match", form.max_sigma_px, "px", "points beyond it are rejected"),
      field("Noise", form.noise_id),
      field("Reference is updated", form.reference_update),
      field("Smoothing window", form.smoothing_window, "points", "odd; empty: none"),
      field("Dense field, a vector every", form.dense_step_px, "px", "in addition to the ordinary field; empty: none"),
    ),
  );

/**
 * Length of the virtual strain gauge, and a warning if it is long for the region.
 * @param {string} id of the test
 * @param {Form} form
 * @param {() => number | null} width of the region, px
 */
export function gaugeNote(id, form, width) {
  const gauge = h("small.hint");
  const warned = h("p.problem", { role: "status", "data-role": "gauge-warning", hidden: true });
  /** @type {number | null} */
  let mmPerPx = null;
  let step = -1;
  function draw() {
    const { strain, window, spacing_px: spacing, subset_px: subset } = form;
    const { text, warning } =
      strain.checked && [window, spacing, subset].every(correct)
        ? gaugeText(gaugePx(Number(window.value), Number(spacing.value), Number(subset.value)), mmPerPx, width())
        : { text: "", warning: "" };
    gauge.textContent = text;
    warned.textContent = warning;
    warned.hidden = !warning;
  }
  for (const input of [form.window, form.strain]) input.addEventListener("input", draw);
  return {
    parts: [gauge, warned],
    draw,
    /** Read the scale of a step's images. @param {number} n @param {boolean} calibrated */
    async scale(n, calibrated) {
      step = n;
      const found = calibrated ? await api.get(`/tests/${id}/scale`, { step: n }).catch(() => null) : null;
      if (step === n) mmPerPx = found?.mm_per_px ?? null;
      draw();
    },
  };
}
