// Region, seeds, subset, texture, settings and start of an analysis.
import * as api from "../../lib/api.js";
import { View, stroke } from "../../widgets/view.js";
import { greyOf } from "../../widgets/grey.js";
import { running } from "./running.js";
import { RegionEditor } from "../../widgets/region_editor.js";
import { Workspace } from "../../lib/workspace.js";
import { again, allRight, correct, limited, numberWithin, rule } from "../../lib/fields.js";
import { draw } from "./drawing.js";
import { recipesBar } from "./recipes.js";
import { textureRating } from "./texture.js";
import { gaugePx, gaugeText } from "../../widgets/region/gauge.js";
import { h, replace, svg, field, number, select, action, notify } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"RecipeSettings"> & { region: Model<"Region">, reference: number, steps?: number[], follow?: boolean, label: string }} Request */
/** @typedef {Model<"Recipe">} Recipe */
/** @typedef {Model<"TestReply">} Test */

/** A list to choose from is no place for thousands of steps: the first ones can be the reference, or the one that is. */
const MOST_REFERENCES = 200;

/**
 * @param {string} id
 * @param {Test} test
 * @param {Ends} ends
 * @param {() => Promise<unknown>} done
 */
export async function measurePanel(id, test, ends, done) {
  const root = h("section.panel", { "aria-label": "Region and analysis" }, h("h2", "Region and analysis"));
  const body = h("div");
  root.append(body);
  const jobs = running(id, ends, done);
  /** @type {ReturnType<typeof build> | null} */
  let building = null;

  /** @param {Test} fresh */
  async function steps(fresh) {
    test = fresh;
    if (!test.steps?.length) {
      replace(body, h("p.quiet", "The region is drawn over the reference step: capture or import it first."));
      return;
    }
    building ??= build();
    (await building).steps();
  }

  async function build() {
    const noise = (await api.get("/noise").catch(() => ({ noise: [] }))).noise ?? [];
    const views = ["cam1", "cam2"].map((cam) => new View({ label: `Reference image of ${cam}`, grey: (x, y) => greyOf({ test: id, step: Number(reference.value), cam }, x, y) }));
    ends.push(() => views.forEach((view) => view.close()));
    const editor = new RegionEditor(views[0], views[1], () => changed());
    const sample = svg("g", { "aria-hidden": "true", "data-role": "sample" });
    views[0].svg.insertBefore(sample, views[0].svg.firstChild);

    const reference = select([], 0, { "aria-label": "Reference step" });
    const subset = number(33, { min: 9, max: 401, step: 2 });
    const spacing = number(10, { min: 1, max: 1000, step: 1 });
    const showSample = h("input", { type: "checkbox", checked: true });
    const noiseChoice = select([["", "from the residuals"], ...noise.filter((one) => one.state === "complete" || !one.state).map((one) => [one.id, String(one.plan.label || one.id)])], "");
    const use = (/** @type {number} */ px) => { subset.value = String(px); again(rules); changed(); };
    const texture = textureRating(id, views, editor, { reference, subset, spacing, noise: noiseChoice }, { use, ends });

    /** @type {number | null} */
    let shownStep = null;
    function showReference() {
      const n = Number(reference.value);
      if (n === shownStep) return;
      shownStep = n;
      views.forEach((view, k) => view.show(api.address(`/tests/${id}/steps/${n}/cam${k + 1}/preview`)));
      readScale();
      changed();
    }
    reference.addEventListener("change", showReference);

    // the subsets, to scale
    function drawSample() {
      const parts = [];
      const [cx, cy] = editor.middle().map(Math.round);
      const half = Number(subset.value) / 2;
      const spacingPx = Number(spacing.value);
      /** @type {(d: string, colour: string, width: number, more?: import("#dom").Attributes, dashes?: number[]) => SVGElement} */
      const path = (d, colour, width, more = {}, dashes = []) => svg("path", { d, ...stroke(colour, width, dashes), ...more });
      if (showSample.checked && half > 0 && spacingPx > 0) {
        const square = (/** @type {number} */ x, /** @type {number} */ y) => `M${x - half} ${y - half}h${2 * half}v${2 * half}h${-2 * half}z`;
        parts.push(path(square(cx + spacingPx, cy) + square(cx, cy + spacingPx), "#33c6ff", 1, {}, [4, 3]), path(square(cx, cy), "#33c6ff", 2, { "data-role": "subset" }));
        const dots = [];
        for (let i = -3; i <= 3; i += 1) for (let k = -3; k <= 3; k += 1) dots.push(`M${cx + i * spacingPx} ${cy + k * spacingPx}h0.001`);
        parts.push(path(dots.join(""), "#33c6ff", 4, { "stroke-linecap": "round", "data-role": "points" }));
      }
      replace(sample, parts);
    }

      const found = h("span.quiet", { role: "status", "data-role": "found" });
    const missing = h("small.error", { role: "alert", hidden: true }); // what a measurement lacks here
    const find = action("Find the specimen", async () => {
      found.textContent = "";
      if (!allRight(rules.filter(([control]) => control === subset))) return;
      const answer = await api.post(`/tests/${id}/region:find`, { reference: Number(reference.value), subset_px: Number(subset.value) });
      const region = /** @type {{ polygon: [number, number][], holes?: [number, number][][] }} */ (answer.region);
      editor.change((state) => Object.assign(state, { outlines: [{ form: "polygon", points: region.polygon }], holes: (region.holes ?? []).map((points) => ({ form: "polygon", points })), mask: null }));
      found.textContent = `Found: ${answer.text}. Correct it by its corners.`;
    });

    let seedsAsked = "";
    async function checkSeeds() {
      const { seeds, seeds_cam2 } = editor.seeds();
      const question = JSON.stringify([seeds, seeds_cam2, reference.value]);
      if (question === seedsAsked) return;
      seedsAsked = question;
      if (!seeds) {
        editor.setLines([]);
        return;
      }
      try {
        const answer = await api.post(`/tests/${id}/seeds:check`, { seeds, seeds_cam2, reference: Number(reference.value) });
        if (question === seedsAsked) editor.setLines(answer.seeds);
      } catch (error) {
        notify(error);
      }
    }

    function changed() {
      keep();
      missing.hidden ||= editor.region() !== null;
      drawSample();
      drawGauge();
      checkSeeds();
      texture.soon();
    }
    for (const input of [subset, spacing]) input.addEventListener("input", changed);
    showSample.addEventListener("change", drawSample);
    views[0].image.addEventListener("load", () => { drawSample(); texture.soon(); });

    // settings
    const kind = select([["displacement", "shape and displacement"], ["profile", "shape only"]], "displacement");
    const patch = select([["auto", "auto: affine or quadratic"], ["affine", "affine (plane)"], ["rigid", "rigid (the paper's)"], ["quadratic", "quadratic (curved)"]], "auto");
    const interpolation = select([["quintic", "quintic B-spline"], ["cubic", "cubic B-spline"]], "quintic");
    const prefilter = number(0, { min: 0, max: 100.25 });
    const maxSigma = number(0.1, { min: 0.001, max: 1, step: "any" });
    const smoothing = number(null, { min: 3, max: 51, step: 2, placeholder: "none" });
    const dense = number(null, { min: 1, max: 20, step: 1, placeholder: "none" });
    const strain = h("input", { type: "checkbox", checked: true });
    const window_ = number(9, { min: 3, max: 101, step: 2 });
    const order = select([["auto", "planes or quadratics"], [1, "planes"], [2, "quadratics"]], "auto");
    const tensor = select([["green_lagrange", "Green-Lagrange"], ["infinitesimal", "infinitesimal"], ["hencky", "Hencky (logarithmic)"]], "green_lagrange");
    noiseChoice.addEventListener("change", changed);
    const update = select([["auto", "auto"], ["never", "never (total)"], ["always", "always (incremental)"]], "auto");
    const which = h("input", { type: "text", placeholder: "all", "aria-describedby": "which-hint" });
    const follow_ = h("input", { type: "checkbox" });
    const label = h("input", { type: "text", maxlength: 300 });
    const gauge = h("small.hint");
    const gaugeWarning = h("p.problem", { role: "status", "data-role": "gauge-warning", hidden: true });
    /** @type {number | null} */
    let mmPerPx = null;
    async function readScale() {
      const step = Number(reference.value);
      const scale = test.calibration_id ? await api.get(`/tests/${id}/scale`, { step }).catch(() => null) : null;
      if (step === Number(reference.value)) mmPerPx = scale?.mm_per_px ?? null;
      drawGauge();
    }
    function drawGauge() {
      const { text, warning } = strain.checked && [window_, spacing, subset].every(correct) ? gaugeText(gaugePx(Number(window_.value), Number(spacing.value), Number(subset.value)), mmPerPx, editor.width()) : { text: "", warning: "" };
      gauge.textContent = text;
      gaugeWarning.textContent = warning;
      gaugeWarning.hidden = !warning;
    }
    for (const input of [window_, strain]) input.addEventListener("input", drawGauge);
    const rules = /** @type {[HTMLInputElement, import("../../lib/fields.js").Rule][]} */ ([
      limited(subset, "A subset", { unit: "px" }), limited(spacing, "A spacing", { unit: "px" }),
      limited(prefilter, "A prefilter", { unit: "px", more: (sd) => (sd > Number(subset.value) / 4 ? `Give a quarter of the subset at most, ${Number(subset.value) / 4}\u00a0px, not ${sd}\u00a0px.` : "") }),
      limited(maxSigma, "A largest sigma", { unit: "px" }), limited(smoothing, "A window", { unit: "points", required: false }),
      limited(dense, "A distance", { unit: "px", required: false, more: (px) => (px > Number(spacing.value) ? `Give the spacing at most, ${spacing.value}\u00a0px, not ${px}\u00a0px: it would be no denser.` : "") }),
      [window_, rule(window_, (text) => (strain.checked ? windowWrong(text) : ""))], [which, rule(which, stepsWrong)],
    ]);
    for (const input of [subset, spacing, strain, follow_]) input.addEventListener("input", () => again(rules)); // others' limits hang on these
    const windowWrong = numberWithin({ low: Number(window_.min), high: Number(window_.max), unit: "points", whole: true, odd: true, what: "A window" });
    /** @param {string} text of the steps */
    function stepsWrong(text) {
      try {
        const there = (test.steps ?? []).map((one) => one.n);
        const missing = follow_.checked ? undefined : stepList(text)?.find((n) => !there.includes(n));
        return missing === undefined ? "" : `There is no step ${missing}: the test has ${there.length === 1 ? `step ${there[0]}` : `steps ${there[0]} to ${there.at(-1)}`}.`;
      } catch (error) {
        const { message, remedy } = /** @type {api.Problem} */ (error);
        return `${message} ${remedy}`;
      }
    }

    // kept with the test as it is drawn; taken from elsewhere
    const workspace = await Workspace.open(id);
    ends.push(() => { workspace.close(); });
    let ready = false;
    /** @returns {Model<"RecipeSettings">} */
    function settings() {
      const before = /** @type {Model<"RecipeSettings">} */ (workspace.value.settings ?? {});
      /** @type {Model<"RecipeSettings">} */
      const found = {
        kind: /** @type {Request["kind"]} */ (kind.value), patch: /** @type {Request["patch"]} */ (patch.value), interpolation: /** @type {Request["interpolation"]} */ (interpolation.value),
        reference_update: /** @type {Request["reference_update"]} */ (update.value), noise_id: noiseChoice.value || null, ...editor.seeds(), strain: null,
      };
      for (const [name, input] of /** @type {const} */ ([["subset_px", subset], ["spacing_px", spacing], ["prefilter_px", prefilter], ["max_sigma_px", maxSigma]])) {
        const value = correct(input) ? Number(input.value) : before[name]; // one that is being typed is not kept yet
        if (value !== undefined) found[name] = value;
      }
      if ((found.prefilter_px ?? 0) > (found.subset_px ?? 0) / 4) found.prefilter_px = 0; // as one that is being typed
      for (const [name, input] of /** @type {const} */ ([["smoothing_window", smoothing], ["dense_step_px", dense]])) {
        found[name] = input.value === "" ? null : correct(input) ? Number(input.value) : before[name] ?? null;
      }
      if ((found.dense_step_px ?? 0) > (found.spacing_px ?? 0)) found.dense_step_px = null;
      if (strain.checked) found.strain = /** @type {Request["strain"]} */ ({ ...(correct(window_) ? { window: Number(window_.value) } : {}), order: order.value === "auto" ? "auto" : Number(order.value), tensor: tensor.value });
      return found;
    }
    /** @returns {Recipe} */
    const now = () => ({ image_size_px: [views[0].width, views[0].height], region: editor.region(), settings: settings(), drawing: null, ...(workspace.value.gauges ? { gauges: workspace.value.gauges } : {}), ...(workspace.value.display ? { display: workspace.value.display } : {}) });
    function keep() {
      if (!ready || !views[0].width) return;
      const { gauges: _, display: __, ...own } = now();
      workspace.change({ ...own, drawing: /** @type {Recipe["drawing"]} */ ({ shapes: editor.state(), steps: which.value, label: label.value, follow: follow_.checked, reference: Number(reference.value) }) });
    }
    /** @param {Recipe} recipe */
    function show(recipe) {
      const set = /** @type {Partial<Request>} */ (recipe.settings ?? {});
      for (const [name, control] of /** @type {const} */ ([["kind", kind], ["patch", patch], ["interpolation", interpolation], ["reference_update", update], ["subset_px", subset], ["spacing_px", spacing], ["prefilter_px", prefilter], ["max_sigma_px", maxSigma]])) {
        if (set[name] !== undefined) control.value = String(set[name]);
      }
      for (const [name, control] of /** @type {const} */ ([["smoothing_window", smoothing], ["dense_step_px", dense]])) {
        if (set[name] !== undefined) control.value = String(set[name] ?? "");
      }
      if (set.noise_id !== undefined && [...noiseChoice.options].some((one) => one.value === (set.noise_id ?? ""))) noiseChoice.value = set.noise_id ?? "";
      if (set.strain !== undefined) strain.checked = set.strain !== null;
      if (set.strain?.window) window_.value = String(set.strain.window);
      if (set.strain?.order) order.value = String(set.strain.order);
      if (set.strain?.tensor) tensor.value = set.strain.tensor;
      draw(editor, recipe);
      again(rules);
      drawGauge();
    }
    /** @param {Recipe} recipe */
    function take(recipe) {
      const [w, k] = recipe.image_size_px ?? [];
      if (w && k && views[0].width && (w !== views[0].width || k !== views[0].height)) {
        throw api.problemOf({ cause: `It was drawn over an image of ${w} × ${k} px, camera 1's is ${views[0].width} × ${views[0].height} px.`, remedy: "Draw the region anew, or take one that was drawn over such images." });
      }
      show({ ...recipe, drawing: null });
      workspace.change({ ...(recipe.gauges ? { gauges: recipe.gauges } : {}), ...(recipe.display ? { display: recipe.display } : {}) });
    }
    body.addEventListener("input", keep);
    body.addEventListener("change", keep);
    const start = action("Measure", async () => {
      if (!allRight(rules)) return;
      const region = editor.region();
      if (!region) {
        missing.textContent = "There is no region. Draw a rectangle or a polygon over camera 1's image.";
        missing.hidden = false;
        find.scrollIntoView({ block: "center" });
        find.focus({ preventScroll: true });
        return;
      }
      /** @type {Request} */
      const body_ = { ...settings(), region, reference: Number(reference.value), label: label.value };
      const wanted = stepList(which.value);
      if (wanted) body_.steps = wanted;
      if (follow_.checked) body_.follow = true;
      const { job, analysis_id: analysis } = await api.post(`/tests/${id}/analyses`, body_).catch((error) => {
        if (error.code !== "not_calibrated") throw error;
        throw api.problemOf({ cause: "This test has no calibration.", remedy: "Choose one at the head of this screen." });
      });
      jobs.show(job, analysis, follow_.checked);
      await done();
    }, { kind: "primary" });

    replace(body,
      h("div.row", h("label", { for: "reference-step" }, "Reference step"), Object.assign(reference, { id: "reference-step" }), editor.bar), editor.more, editor.hint,
      h("div.grid.two.views", { style: { marginTop: "0.5rem" } }, views.map((view, k) => h("div", h("h3", `cam${k + 1}`), view.root))),
      h("div.grid.two", { style: { marginTop: "var(--gap)" } },
        h("div",
          h("fieldset", h("legend", "Region and seeds"), h("div.row", find, found), missing, editor.list,
            h("p.hint", "Seeds are searched for automatically if none are given. On a periodic texture, click three points that are not on one line, each in both views.")),
          h("fieldset", h("legend", "Subsets and texture"),
            h("div.fields", field("Subset", subset, "px", "odd"), field("Spacing", spacing, "px", "distance of neighbouring points")),
            h("div.row", h("label.check", showSample, "draw them to scale"), h("button", { type: "button", onclick: () => views[0].centreOn(...editor.middle(), 6) }, "Zoom to the subsets"), h("label.check", texture.showMap, "texture map"), texture.legend), texture.rating)),
        h("div",
          h("fieldset", h("legend", "Correlation"),
            h("div.fields", field("Measure", kind), field("Shape function", patch), field("Interpolation", interpolation), field("Prefilter, sd", prefilter, "px", "0: none"), field("Largest sigma of a match", maxSigma, "px", "points beyond it are rejected"), field("Noise", noiseChoice),
              field("Reference is updated", update), field("Smoothing window", smoothing, "points", "odd; empty: none"), field("Dense field, a vector every", dense, "px", "beside the ordinary field; empty: none"))),
          h("fieldset", h("legend", "Strain"), h("label.check", strain, "compute strain"), h("div.fields", field("Window", window_, "points", "odd"), field("Fit", order), field("Tensor", tensor)), gauge, gaugeWarning),
          h("div.fields", field("Steps", which, "", "such as 1-5, 8; empty: all"), field("Label", label)), h("label.check", follow_, "continue with each new step"),
          h("div.row", { style: { marginTop: "0.5rem" } }, start), jobs.root)));
    body.before(await recipesBar(id, workspace.state, { take, now }));
    editor.use("rectangle");
    editor.drawList();
    drawGauge();
    const before = /** @type {Recipe} */ (workspace.value);
    const form = /** @type {{ steps?: string, label?: string, follow?: boolean, reference?: number } | null | undefined} */ (before.drawing);
    if (form) [which.value, label.value, follow_.checked] = [form.steps ?? "", form.label ?? "", Boolean(form.follow)];
    if (before.settings || before.region || before.drawing) show(before);
    let chosen = form?.reference;
    ready = true;

    return {
      steps() {
        const kept = String(chosen ?? reference.value);
        chosen = undefined;
        replace(reference, (test.steps ?? []).filter((one, k) => k < MOST_REFERENCES || String(one.n) === kept).map((one) => h("option", { value: one.n, selected: String(one.n) === kept }, `${one.n} ${one.label ?? ""}`)));
        if (reference.selectedIndex < 0) reference.selectedIndex = 0;
        showReference();
      },
    };
  }

  await steps(test);
  return { root, head: jobs.head, steps: (/** @type {Test} */ fresh) => steps(fresh).catch(notify) };
}

/**
 * "1-5, 8" -> [1, 2, 3, 4, 5, 8]; null for all.
 * @param {string} text
 */
export function stepList(text) {
  if (!text.trim() || text.trim() === "all") return null;
  const out = [];
  for (const part of text.split(/[\s,;]+/).filter(Boolean)) {
    const found = /^(\d+)(?:[-–](\d+))?$/.exec(part);
    if (!found) throw api.problemOf({ cause: `“${part}” is not a step.`, remedy: "Write numbers and spans between commas: 1-5, 8." });
    const last = Number(found[2] ?? found[1]);
    for (let n = Number(found[1]); n <= last && out.length <= 10000; n += 1) out.push(n);
  }
  return out;
}
