// Region, seeds, subset, texture, settings and start of an analysis.
import * as api from "../../lib/api.js";
import { View, stroke } from "../../widgets/view.js";
import { greyOf } from "../../widgets/grey.js";
import { running } from "./running.js";
import { RegionEditor } from "../../widgets/region_editor.js";
import { Workspace } from "../../lib/workspace.js";
import { again, allRight, rule } from "../../lib/fields.js";
import { draw } from "./drawing.js";
import { recipesBar } from "./recipes.js";
import { gaugeNote, settingsFields, settingsForm, settingsOf, showSettings } from "./settings.js";
import { textureRating } from "./texture.js";
import { h, replace, svg, field, select, action, notify } from "../../lib/dom.js";

/** @import { Attributes, Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @import { Running } from "./running.js" */
/** @import { Form } from "./settings.js" */
/** @typedef {Model<"RecipeSettings"> & { region: Model<"Region">, reference: number, steps?: number[], follow?: boolean, label: string }} Request */
/** @typedef {Model<"Recipe">} Recipe */
/** @typedef {Model<"TestReply">} Test */
/** @typedef {{ id: string, test: () => Test, views: View[], editor: RegionEditor, form: Form, reference: HTMLSelectElement, asked: ReturnType<typeof askedOf>,
 *   workspace: Workspace, finder: ReturnType<typeof finderOf> }} Panel what the panel's parts share; `asked`: steps and label */

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
    building ??= build(id, () => test, ends, { body, jobs, done });
    (await building).steps();
  }

  await steps(test);
  return { root, head: jobs.head, steps: (/** @type {Test} */ fresh) => steps(fresh).catch(notify) };
}

/**
 * @param {string} id
 * @param {() => Test} test
 * @param {Ends} ends
 * @param {{ body: HTMLElement, jobs: Running, done: () => Promise<unknown> }} to
 */
async function build(id, test, ends, { body, jobs, done }) {
  const form = settingsForm((await api.get("/noise").catch(() => ({ noise: [] }))).noise ?? []);
  const { subset_px: subset, spacing_px: spacing, noise_id: noise, rules } = form;
  const workspace = await Workspace.open(id);
  ends.push(() => {
    workspace.close();
  });
  const views = ["cam1", "cam2"].map(
    (cam) => new View({ label: `Reference image of ${cam}`, grey: (x, y) => greyOf({ test: id, step: Number(reference.value), cam }, x, y) }),
  );
  ends.push(() => views.forEach((view) => view.close()));
  const editor = new RegionEditor(views[0], views[1], () => changed());
  const reference = select([], 0, { id: "reference-step", "aria-label": "Reference step" });
  const use = (/** @type {number} */ px) => {
    subset.value = String(px);
    again(rules);
    changed();
  };
  const sample = sampleOf(views[0], editor, form);
  const texture = textureRating(id, views, editor, { reference, subset, spacing, noise }, { use, ends });
  const gauge = gaugeNote(id, form, () => editor.width());
  const checkSeeds = seedsCheck(id, editor, reference);
  const finder = finderOf(id, editor, form, reference);
  const asked = askedOf(test);
  rules.push(asked.rule);
  asked.follow.addEventListener("input", () => again(rules));
  /** @type {Panel} */
  const my = { id, test, views, editor, form, reference, asked, workspace, finder };

  let ready = false;
  const keep = () => {
    if (ready) keepDrawing(my);
  };
  function changed() {
    keep();
    finder.missing.hidden ||= editor.region() !== null;
    sample.draw();
    gauge.draw();
    checkSeeds();
    texture.soon();
  }
  for (const input of [subset, spacing]) input.addEventListener("input", changed);
  noise.addEventListener("change", changed);
  views[0].image.addEventListener("load", () => {
    sample.draw();
    texture.soon();
  });
  body.addEventListener("input", keep);
  body.addEventListener("change", keep);

  /** @type {number | null} */
  let shownStep = null;
  function showReference() {
    const n = Number(reference.value);
    if (n === shownStep) return;
    shownStep = n;
    views.forEach((view, k) => view.show(api.address(`/tests/${id}/steps/${n}/cam${k + 1}/preview`)));
    gauge.scale(n, Boolean(test().calibration_id));
    changed();
  }
  reference.addEventListener("change", showReference);

  /** @param {Recipe} recipe */
  function show(recipe) {
    showSettings(form, recipe.settings ?? {});
    draw(editor, recipe);
    gauge.draw();
  }
  /** @param {Recipe} recipe */
  function take(recipe) {
    const [w, k] = recipe.image_size_px ?? [];
    if (w && k && views[0].width && (w !== views[0].width || k !== views[0].height)) {
      throw api.problemOf({
        detail: `It was drawn over an image of ${w} × ${k} px, camera 1's is ${views[0].width} × ${views[0].height} px.`,
        remedy: "Draw the region anew, or take one that was drawn over such images.",
      });
    }
    show({ ...recipe, drawing: null });
    workspace.change({ ...(recipe.gauges ? { gauges: recipe.gauges } : {}), ...(recipe.display ? { display: recipe.display } : {}) });
  }
  const start = action("Measure", () => measure(my, jobs, done), { kind: "primary" });
  replace(
    body,
    layout(my, {
      sample,
      texture,
      gauge: gauge.parts,
      recipes: await recipesBar(id, { take, now: () => recipeOf(my) }),
      end: [h("div.row.start", start, workspace.state), jobs.root],
    }),
  );
  editor.use("rectangle");
  editor.drawList();
  gauge.draw();
  const before = /** @type {Recipe} */ (workspace.value);
  let chosen = asked.show(before.drawing);
  if (before.settings || before.region || before.drawing) show(before);
  ready = true;

  return {
    steps() {
      const kept = String(chosen ?? reference.value);
      chosen = undefined;
      replace(
        reference,
        (test().steps ?? [])
          .filter((one, k) => k < MOST_REFERENCES || String(one.n) === kept)
          .map((one) => h("option", { value: one.n, selected: String(one.n) === kept }, `step ${one.n}${one.label ? `: ${one.label}` : ""}`)),
      );
      if (reference.selectedIndex < 0) reference.selectedIndex = 0;
      showReference();
    },
  };
}

/**
 * The subsets to scale, in the middle of the region.
 * @param {View} view
 * @param {RegionEditor} editor
 * @param {Form} form
 */
function sampleOf(view, editor, form) {
  const layer = svg("g", { "aria-hidden": "true", "data-role": "sample" });
  view.svg.insertBefore(layer, view.svg.firstChild);
  const shown = h("input", { type: "checkbox", checked: true });
  /** @type {(d: string, colour: string, width: number, more?: Attributes, dashes?: number[]) => SVGElement} */
  const path = (d, colour, width, more = {}, dashes = []) => svg("path", { d, ...stroke(colour, width, dashes), ...more });
  function draw() {
    const parts = [];
    const [cx, cy] = editor.middle().map(Math.round);
    const half = Number(form.subset_px.value) / 2;
    const spacingPx = Number(form.spacing_px.value);
    if (shown.checked && half > 0 && spacingPx > 0) {
      const square = (/** @type {number} */ x, /** @type {number} */ y) => `M${x - half} ${y - half}h${2 * half}v${2 * half}h${-2 * half}z`;
      parts.push(
        path(square(cx + spacingPx, cy) + square(cx, cy + spacingPx), "#33c6ff", 1, {}, [4, 3]),
        path(square(cx, cy), "#33c6ff", 2, { "data-role": "subset" }),
      );
      const dots = [];
      for (let i = -3; i <= 3; i += 1) for (let k = -3; k <= 3; k += 1) dots.push(`M${cx + i * spacingPx} ${cy + k * spacingPx}h0.001`);
      parts.push(path(dots.join(""), "#33c6ff", 4, { "stroke-linecap": "round", "data-role": "points" }));
    }
    replace(layer, parts);
  }
  shown.addEventListener("change", draw);
  return { shown, draw };
}

/**
 * The search for the specimen, and a note if a region is missing.
 * @param {string} id of the test
 * @param {RegionEditor} editor
 * @param {Form} form
 * @param {HTMLSelectElement} reference
 */
function finderOf(id, editor, form, reference) {
  const found = h("span.quiet", { role: "status", "data-role": "found" });
  const missing = h("small.error", { role: "alert", hidden: true }); // data that a measurement lacks here
  const find = action("Find the specimen", async () => {
    found.textContent = "";
    if (!allRight(form.rules.filter(([control]) => control === form.subset_px))) return;
    const answer = await api.post(`/tests/${id}/region:find`, { reference: Number(reference.value), subset_px: Number(form.subset_px.value) });
    const region = /** @type {{ polygon: [number, number][], holes?: [number, number][][] }} */ (answer.region);
    editor.change((state) =>
      Object.assign(state, {
        outlines: [{ form: "polygon", points: region.polygon }],
        holes: (region.holes ?? []).map((points) => ({ form: "polygon", points })),
        mask: null,
      }),
    );
    found.textContent = `Found: ${answer.text}. Correct it by its corners.`;
  });
  return { find, found, missing };
}

/**
 * Shows for changed seeds where camera 2 sees them.
 * @param {string} id of the test
 * @param {RegionEditor} editor
 * @param {HTMLSelectElement} reference
 */
function seedsCheck(id, editor, reference) {
  let asked = "";
  return async () => {
    const { seeds, seeds_cam2 } = editor.seeds();
    const question = JSON.stringify([seeds, seeds_cam2, reference.value]);
    if (question === asked) return;
    asked = question;
    if (!seeds) {
      editor.setLines([]);
      return;
    }
    try {
      const answer = await api.post(`/tests/${id}/seeds:check`, { seeds, seeds_cam2, reference: Number(reference.value) });
      if (question === asked) editor.setLines(answer.seeds);
    } catch (error) {
      notify(error);
    }
  };
}

/** Steps and label of an analysis. @param {() => Test} test */
function askedOf(test) {
  const which = h("input", { type: "text", placeholder: "all", "aria-describedby": "which-hint" });
  const follow = h("input", { type: "checkbox" });
  const label = h("input", { type: "text", maxlength: 300 });
  /** @param {string} text of the steps */
  function wrong(text) {
    try {
      const there = (test().steps ?? []).map((one) => one.n);
      const missing = follow.checked ? undefined : stepList(text)?.find((n) => !there.includes(n));
      return missing === undefined
        ? ""
        : `There is no step ${missing}: the test has ${there.length === 1 ? `step ${there[0]}` : `steps ${there[0]} to ${there.at(-1)}`}.`;
    } catch (error) {
      const { message, remedy } = /** @type {api.Problem} */ (error);
      return `${message} ${remedy}`;
    }
  }
  /** Show them as they were kept. @param {Recipe["drawing"]} drawing @returns the reference step, if one was kept */
  function show(drawing) {
    const before = /** @type {{ steps?: string, label?: string, follow?: boolean, reference?: number } | null | undefined} */ (drawing);
    if (before) [which.value, label.value, follow.checked] = [before.steps ?? "", before.label ?? "", Boolean(before.follow)];
    return before?.reference;
  }
  return { which, follow, label, rule: /** @type {Form["rules"][number]} */ ([which, rule(which, wrong)]), show };
}

/**
 * The panel's drawing and settings, to be taken elsewhere.
 * @param {Panel} my
 * @returns {Recipe}
 */
const recipeOf = ({ views, editor, form, workspace }) => ({
  image_size_px: [views[0].width, views[0].height],
  region: editor.region(),
  settings: settingsOf(form, workspace.value.settings ?? {}, editor.seeds()),
  drawing: null,
  ...(workspace.value.gauges ? { gauges: workspace.value.gauges } : {}),
  ...(workspace.value.display ? { display: workspace.value.display } : {}),
});

/** Keep the drawing with the test. @param {Panel} my */
function keepDrawing(my) {
  const { views, editor, asked, reference, workspace } = my;
  if (!views[0].width) return;
  const { gauges: _, display: __, ...own } = recipeOf(my);
  workspace.change({
    ...own,
    drawing: /** @type {Recipe["drawing"]} */ ({
      shapes: editor.state(),
      steps: asked.which.value,
      label: asked.label.value,
      follow: asked.follow.checked,
      reference: Number(reference.value),
    }),
  });
}

/**
 * Begin the analysis.
 * @param {Panel} my
 * @param {Running} jobs
 * @param {() => Promise<unknown>} done
 */
async function measure(my, jobs, done) {
  const { id, editor, form, reference, asked, finder, workspace } = my;
  if (!allRight(form.rules)) return;
  const region = editor.region();
  if (!region) {
    finder.missing.textContent = "There is no region. Draw a rectangle or a polygon over camera 1's image.";
    finder.missing.hidden = false;
    finder.find.scrollIntoView({ block: "center" });
    finder.find.focus({ preventScroll: true });
    return;
  }
  const settings = settingsOf(form, workspace.value.settings ?? {}, editor.seeds());
  /** @type {Request} */
  const body = { ...settings, region, reference: Number(reference.value), label: asked.label.value };
  const wanted = stepList(asked.which.value);
  if (wanted) body.steps = wanted;
  if (asked.follow.checked) body.follow = true;
  const { job, analysis_id: analysis } = await api.post(`/tests/${id}/analyses`, body).catch((error) => {
    if (error.code !== "not_calibrated") throw error;
    throw api.problemOf({ detail: "This test has no calibration.", remedy: "Choose one at the head of this screen." });
  });
  jobs.show(job, analysis, asked.follow.checked);
  await done();
}

/**
 * The pictures, and beside them all that is set: the region, three settings, the others folded, and the button.
 * @param {Panel} my
 * @param {{ sample: ReturnType<typeof sampleOf>, texture: ReturnType<typeof textureRating>, gauge: HTMLElement[], recipes: HTMLElement, end: HTMLElement[] }} parts
 */
function layout({ views, editor, form, reference, asked, finder }, { sample, texture, gauge, recipes, end }) {
  const region = h(
    "fieldset",
    { "data-on": "region" },
    h("legend", "Region"),
    h("div.row", h("label", { for: "reference-step" }, "Reference step"), reference),
    h("div.row", finder.find, finder.found),
    finder.missing,
    editor.list,
    editor.masks,
  );
  const zoom = h("button", { type: "button", onclick: () => views[0].centreOn(...editor.middle(), 6) }, "Zoom to the subsets");
  const basic = h(
    "fieldset",
    h("legend", "Subsets and strain"),
    h("div.fields.three", field("Subset", form.subset_px, "px"), field("Spacing", form.spacing_px, "px"), field("Window", form.window, "points")),
    gauge,
    h(
      "div.row",
      { "data-on": "region" },
      h("label.check", sample.shown, "draw them to scale"),
      h("label.check", texture.showMap, "texture map"),
      zoom,
      texture.legend,
    ),
    texture.rating,
  );
  const pictured = (/** @type {View} */ view, /** @type {number} */ k) => h("div", h("h3", `cam${k + 1}`), view.root);
  const steps = h("div.fields", field("Steps", asked.which, "", "such as 1-5, 8; empty: all"), field("Label", asked.label));
  return h(
    "div.work",
    h("div.pictured", { "data-on": "region" }, editor.bar, h("div.row", editor.more, editor.hint), h("div.grid.two.views", views.map(pictured))),
    h("div.set", h("div", region, recipes, basic, settingsFields(form), steps, h("label.check", asked.follow, "continue with each new step")), end),
  );
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
    if (!found) throw api.problemOf({ detail: `“${part}” is not a step.`, remedy: "Write numbers and spans between commas: 1-5, 8." });
    const last = Number(found[2] ?? found[1]);
    for (let n = Number(found[1]); n <= last && out.length <= 10000; n += 1) out.push(n);
  }
  return out;
}
