// Results: the tests and analyses, and one analysis' fields over the image and in space.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { Result, aboutText, allTests } from "./results/analysis.js";
import { FieldMap, measured } from "../widgets/field_map.js";
import { Scale } from "../widgets/scale.js";
import { about } from "./results/about.js";
import { camerasNote } from "./results/cameras.js";
import { files } from "./results/export.js";
import { gauges } from "./results/gauges.js";
import { frames } from "./results/frame.js";
import { Workspace, keptDisplay } from "./results/kept.js";
import { overlay } from "./results/overlay.js";
import { pointHistory } from "./results/point_history.js";
import { mark, pinned } from "./results/probe.js";
import { interval } from "./results/uncertainty.js";
import { live, usualField } from "./results/live.js";
import { models } from "./results/models.js";
import { stateBadge, warningsBox, warningsCell } from "./results/warnings.js";
import { amount, shown as shown_, strainUnit, useStrainUnit } from "../lib/units.js";
import { seenPicture } from "../widgets/seen_picture.js";
import { h, replace, table, when, num, count, quantity, field, select, definitions, notify, problemText } from "../lib/dom.js";

/** @import { Here } from "../main.js" */
/** @import { Ends } from "#dom" */
/** @import { Over } from "../widgets/field_map.js" */
/** @import { Shown } from "./results/analysis.js" */
/** @import { Overlay } from "./results/overlay.js" */
/** @import { Seen } from "../widgets/seen_picture.js" */
/** @import { Interval } from "./results/uncertainty.js" */
/** @typedef {"image" | "surface" | "compare"} Mode */
/** @typedef {{ step: number | null, field: string | null, chosen: boolean, image: Over, mode: Mode, info: Shown | null, playing: object | null, pinned?: number }} State */
/** @typedef {{ result: Result, state: State, map: FieldMap, scale: Scale, interval: Interval, workspace: Workspace, overlay: Overlay, ends: Ends, probe: HTMLElement, message: HTMLElement, readonly step: number | null,
 *   readonly info: Shown | null, picture: (width: number) => string, onpick: (x: number, y: number, event: Event) => unknown, drawn: Set<() => unknown>, landed: Set<() => unknown> }} Viewer shared by the parts of the screen;
 *   `picture`: what is seen, as SVG; `drawn` is called after each change of step, field or scale, `landed` once more steps are finished */
/** @typedef {{ root: HTMLElement, update: () => Promise<void>, close: () => void, attach?: () => void, seen?: () => Seen[], about?: string, ownScales?: () => boolean }} OtherView shown instead of the map */

/**
 * Which axes a step's frame has, in a few words.
 * @param {string | undefined} frame
 */
const axesText = (frame) => (frame?.startsWith("aligned") ? `the specimen's (${frame.split("; before:")[0].replace(/^aligned by /, "").replace(/^plane/, "best plane")})` : "the calibration's (system frame)");

/**
 * Direction of the larger principal strain of the mean; none where the points scatter more than the two strains differ.
 * @param {Float64Array} exx of the points with a value
 * @param {Float64Array} eyy
 * @param {Float64Array} exy
 */
function axisText(exx, eyy, exy) {
  const mean = (/** @type {Float64Array} */ of) => of.reduce((sum, v) => sum + v, 0) / of.length;
  const [x, y, shear] = [exx, eyy, exy].map(mean);
  const differences = exx.map((v, i) => v - eyy[i] - (x - y));
  const scatter = Math.sqrt(mean(differences.map((v) => v * v)));
  if (!(Math.hypot(x - y, 2 * shear) > scatter)) return "none stands out";
  return `${num((90 / Math.PI) * Math.atan2(2 * shear, x - y), 3)}° from X`;
}

/** @type {[Mode, string][]} */
const MODES = [["image", "Image"], ["surface", "3-D surface"], ["compare", "Side by side"]];

/**
 * @param {HTMLElement} root
 * @param {Here} here
 */
export async function open(root, here) {
  const [testId, analysisId] = here.path;
  return testId && analysisId ? show(root, testId, analysisId, here.query) : list(root, testId);
}

/**
 * @param {HTMLElement} root
 * @param {string | undefined} testId
 */
async function list(root, testId) {
  const tests = await allTests();
  const detail = h("section.panel", { "aria-live": "polite" });
  const chosen = tests.find((one) => one.id === testId) ?? tests[0];
  /** @param {{ id: string }} test */
  async function choose(test) {
    replace(detail, h("p.quiet", "Loading …"));
    try {
      const whole = await api.get(`/tests/${test.id}`);
      replace(detail, h("div.spread", h("h2", whole.name), h("a", { href: `#/test/${whole.id}` }, "the test")),
        definitions([["specimen", whole.specimen || "–"], ["made", when(whole.created_utc)], ["steps", count(whole.n_steps)], ["calibration", whole.calibration_id ?? "–"]]),
        h("h3", "Analyses"),
        table([
          ["Analysis", (one) => h("a", { href: `#/results/${test.id}/${one.id}` }, one.label || one.id)],
          ["Kind", (one) => one.kind],
          ["Checks", warningsCell],
          ["Begun", (one) => when(one.created_utc)],
        ], (whole.analyses ?? []).toReversed(), { caption: "Analyses of this test, newest first", empty: "This test has not been measured yet.",
          onrow: (one) => { location.hash = `#/results/${test.id}/${one.id}`; } }),
        whole.analyses?.length ? null : h("a.button", { href: `#/test/${test.id}?at=region` }, "Measure it"));
    } catch (error) {
      replace(detail, problemText(error));
    }
  }
  replace(root, h("h1", "Results"), h("div.grid.two",
    h("section.panel", table([
      ["Test", (one) => h("button.plain", { type: "button", onclick: () => choose(one) }, one.name || one.id)],
      ["Specimen", (one) => one.specimen],
      ["Made", (one) => when(one.created_utc)],
    ], tests, { caption: "Tests, newest first", onrow: choose, empty: "There is no test yet." })),
    detail));
  if (chosen) choose(chosen);
  else replace(detail, h("p.quiet", "Results appear here once a test was measured."), h("a.button.primary", { href: "#/test" }, "Make a test"));
  return events.on("result", (event) => { if (event.test_id === chosen?.id) choose(chosen); });
}

/**
 * @param {HTMLElement} root
 * @param {string} testId
 * @param {string} analysisId
 * @param {URLSearchParams} query
 */
async function show(root, testId, analysisId, query) {
  const [result, workspace] = await Promise.all([Result.open(testId, analysisId), Workspace.open(testId)]);
  /** @type {Ends} */
  const ends = [];
  const asked = Number(query.get("step") ?? NaN);
  if (query.get("frame") === "system") result.use("system");
  /** @type {State} */
  const state = {
    step: result.steps.includes(asked) ? asked : result.steps.at(-1) ?? null, field: query.get("field"), chosen: Boolean(query.get("field")), image: "reference", mode: "image", info: null, playing: null,
  };

  const map = new FieldMap("Field over the image of camera 1", (x, y, event) => screen.onpick(x, y, event));
  ends.push(() => map.close());
  const scale = new Scale(() => redraw().catch(notify));
  ends.push(() => { workspace.close(); });
  const display = keptDisplay(workspace, scale, state);
  const fieldChoice = h("select", { "aria-label": "Field" });
  const imageChoice = select([["reference", "reference, camera 1"], ["cam1", "this step, camera 1"], ["cam2", "this step, camera 2"]], "reference");
  const opacity = h("input", { type: "range", min: 0, max: 100, value: 75 });
  const slider = h("input", { type: "range", min: 0, max: Math.max(result.steps.length - 1, 0), step: 1, "aria-label": "Step" });
  const stepText = h("output", { "data-role": "step" });
  const status = h("div");
  const warned = h("div");
  const statistics = h("dl.definitions", { "data-role": "statistics" });
  const probe = h("div", { "data-role": "probe" }, h("p.quiet", "Click a point to see all its values."));
  const message = h("p.quiet", { role: "status" });
  const cameras = h("div");
  const modes = h("div.row", { role: "group", "aria-label": "View" }, MODES.map(([name, text]) =>
    h("button", { type: "button", "data-mode": name, "aria-pressed": String(name === "image"), onclick: () => setMode(name).catch(notify) }, text)));
  const stage = h("div", map.view.root);
  const below = h("div");
  const strainChoice = select([["µm/m", "µm/m"], ["%", "%"]], strainUnit(), { "aria-label": "Unit of strain", "data-role": "strain-unit" });
  strainChoice.addEventListener("change", async () => {
    useStrainUnit(strainChoice.value === "%" ? "%" : "µm/m");
    try {
      await drawFields();
      await redraw();
      for (const listener of screen.interval.changed) await listener();
    } catch (error) {
      notify(error);
    }
  });
  const axesField = h("div.field");
  const play = h("button", { type: "button", "aria-pressed": "false", title: "Play through the steps", onclick: () => playing(!state.playing) }, "▶ Play");
  /** @type {Viewer} */
  const screen = {
    result, state, map, scale, workspace, ends, probe, message, interval: /** @type {any} */ (null), overlay: /** @type {any} */ (null),
    get step() { return state.step; },
    get info() { return state.info; },
    picture: (width) => seenPicture(other?.seen?.() ?? [{ frame: map.view.frame, within: map.view.content }], {
      title: `${result.test.name || testId}: ${state.info?.text ?? state.field}, ${state.step === null ? "" : result.stepText(state.step)}`, scale: other?.ownScales?.() ? null : scale, width,
      notes: [`axes of the ${result.frame === "system" ? "calibration" : "specimen"}; ${other?.about ?? `over the image: ${imageChoice.selectedOptions[0].textContent}`}; ${message.textContent}`, `test ${testId}, analysis ${analysisId}, calibration ${result.analysis.calibration_id ?? result.test.calibration_id ?? "not stated"}`],
    }),
    onpick: (x, y) => pick(x, y),
    drawn: new Set(),
    landed: new Set(),
  };
  screen.interval = interval(screen);
  screen.overlay = overlay(screen);

  async function drawFields() {
    if (state.step === null) return;
    const { shown } = await result.fields(state.step);
    // a field that was chosen and that this step lacks (a shape has no displacement) stays chosen for the others
    if (!state.chosen) state.field = usualField(shown.map((one) => one.key));
    state.info = shown.find((one) => one.key === state.field) ?? null;
    const groups = [...new Set(shown.map((one) => one.group))];
    replace(fieldChoice, state.info ? null : h("option", { value: state.field, selected: true }, `${state.field} (not in this step)`),
      groups.map((group) => h("optgroup", { label: group }, shown.filter((one) => one.group === group).map((one) =>
        h("option", { value: one.key, selected: one.key === state.field, title: one.about }, one.unit ? `${one.text} (${shown_(one.unit).unit})` : one.text)))));
  }

  /** Which step is shown, of how many. */
  function counter() {
    if (state.step === null) return;
    const at = result.steps.indexOf(state.step);
    slider.max = String(Math.max(result.steps.length - 1, 0));
    slider.value = String(at);
    slider.setAttribute("aria-valuetext", result.stepText(state.step));
    replace(stepText, h("span.of", `${at + 1} of ${result.steps.length}`), h("span.name", { title: result.stepText(state.step) }, result.stepText(state.step)));
  }

  /** Without a finished step there is nothing to choose: what is the matter stands alone. */
  function nothing() {
    const none = state.step === null;
    for (const part of dependent) part.hidden = none;
    replace(empty, !none ? null : following.running() ? h("p.quiet", { role: "status" }, "No step is finished yet. The page updates by itself.")
      : h("p.quiet", "No step was measured. ", h("a", { href: `#/test/${testId}` }, "Back to the test"), " to draw the region and measure again."));
  }

  async function refresh() {
    nothing();
    if (state.step === null) return;
    replace(cameras, camerasNote(/** @type {import("#routes").StepSummary | undefined} */ (await result.figures(state.step))));
    counter();
    await drawFields();
    const address = `#/results/${testId}/${analysisId}?step=${state.step}${state.chosen ? `&field=${encodeURIComponent(state.field ?? "")}` : ""}${result.frame === "system" ? "&frame=system" : ""}`;
    if (location.hash !== address && location.hash.startsWith(`#/results/${testId}/${analysisId}`)) history.replaceState(null, "", address);
    if (!state.info) {
      message.textContent = `Step ${state.step} has no ${state.field}: ${state.step === result.reference ? "it is the reference of the displacements." : "choose another field."}`;
      const z = (await result.fields(state.step)).shown.find((one) => one.key === "z_mm");
      if (!z || !(await map.load(result, state.step, z, state.image))) return;
      const none = String(state.field);
      map.put(new Float32Array(map.now?.values.length ?? 0).fill(NaN), { ...z, key: none, text: none, unit: "" });
      await redraw();
      return;
    }
    const { frame } = await result.fields(state.step);
    if (!(await map.load(result, state.step, state.info, state.image))) return;
    message.textContent = `${aboutText(state.info)} · axes: ${axesText(frame)}`;
    await redraw();
  }

  async function redraw() {
    if (!map.now) return;
    const { info } = map.now;
    let values = [map.measured];
    if (scale.overAll && !info.flags && state.info && map.now.n === state.step) {
      const each = [];
      for (const n of result.steps) {
        const { shown } = await result.fields(n);
        if (!shown.some((one) => one.key === info.key)) continue;
        const [grid, of] = await Promise.all([result.grid(n), result.values(n, info.key)]);
        each.push(measured(grid, of));
      }
      if (map.now?.info !== info) return;
      if (each.length) values = each;
    }
    scale.lay(values, info.unit, info.flags, Boolean(info.signed));
    map.redraw(scale);
    const s = map.now.statistics;
    const { unit, factor } = shown_(info.unit, Math.max(Math.abs(s.min ?? 0), Math.abs(s.max ?? 0))); // one unit for all
    const text = (/** @type {number | null} */ v, digits = 4) => quantity(v === null ? null : factor * v, unit, digits);
    replace(statistics, [...definitions([
      ["min", text(s.min)], ["max", text(s.max)], ["mean", text(s.mean)], ["sd", text(s.sd, 3)],
      ["valid", h("span.whole", { title: "points with a value, of those in the region" }, `${count(s.count)} of ${count(s.within)} (${num(s.within ? (100 * s.count) / s.within : null, 3)} %)`)],
    ]).children]);
    for (const listener of screen.drawn) await listener();
    await principal();
  }

  /** Principal strains beside a component of strain: no axes matter to them. */
  async function principal() {
    const { step, info } = state;
    if (step === null || info?.group !== "Strain" || !map.now) return;
    const { all } = await result.fields(step);
    if (!all.has("e1") || !all.has("e2")) return;
    const [e1, e2, exx, eyy, exy] = await Promise.all(["e1", "e2", "exx", "eyy", "exy"].map((name) => result.values(step, name)));
    if (state.step !== step || state.info !== info || !map.now) return;
    const { grid } = map.now;
    const mean = (/** @type {ArrayLike<number>} */ of) => { const known = measured(grid, of); return known.length ? known.reduce((sum, v) => sum + v, 0) / known.length : null; };
    statistics.append(...definitions([["principal strains, mean", h("span.whole", `${amount(mean(e1), "µm/m")}, ${amount(mean(e2), "µm/m")}`)], ["axis of the larger", h("span.whole", { "data-role": "principal-axis", title: "of the mean strain, from X towards Y: a specimen that stands askew in the picture has shear in axes along the image's rows" }, axisText(measured(grid, exx), measured(grid, eyy), measured(grid, exy)))]]).children);
  }

  /** @param {number | null} n */
  async function setStep(n) {
    state.step = n;
    await refresh();
  }

  /** A step chosen by hand. @param {number} n */
  async function choose(n) {
    state.step = n;
    following.moved();
    await refresh();
  }

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
        await setStep(result.steps[at]);
      } catch (error) {
        notify(error);
        playing(false);
        return;
      }
      await new Promise((resolve) => setTimeout(resolve, Math.max(400 - (performance.now() - began), 30)));
    }
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  async function pick(x, y) {
    const { i } = map.nearest(x, y);
    if (i < 0 || !map.now || state.step === null) return;
    const { grid } = map.now;
    state.pinned = i;
    const answer = await api.get(`${result.path}/probe`, { x_px: Math.max(grid.x[i], 0), y_px: Math.max(grid.y[i], 0), step: state.step, frame: result.frame });
    pinned(screen, answer);
    point.draw();
  }

  /** @type {OtherView | null} */
  let other = null; // shown instead of the map: the surface, or two maps
  /** @param {Mode} name */
  async function setMode(name) {
    state.mode = name;
    for (const button of modes.querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.dataset.mode === name));
    if (other) {
      screen.drawn.delete(other.update);
      other.close();
      other = null;
    }
    replace(stage, map.view.root);
    filesPanel.dispatchEvent(new Event("seen"));
    if (name === "image") {
      map.view.fit();
      return;
    }
    /** @type {OtherView} */
    const made = name === "surface" ? await (await import("./results/surface.js")).surface(screen) : await (await import("./results/compare.js")).compare(screen);
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
  ends.push(() => other?.close());

  fieldChoice.addEventListener("change", () => { state.field = fieldChoice.value; state.chosen = true; display.chosen(); refresh().catch(notify); });
  imageChoice.addEventListener("change", () => { state.image = /** @type {Over} */ (imageChoice.value); refresh().catch(notify); });
  slider.addEventListener("input", () => choose(result.steps[Number(slider.value)]).catch(notify));
  const opacityText = h("span", { "data-role": "opacity", "aria-hidden": "true" }); // the slider says its own value
  const fade = () => {
    map.view.canvas.style.opacity = String(Number(opacity.value) / 100);
    opacityText.textContent = `${opacity.value}\u00a0%`;
  };
  opacity.addEventListener("input", fade);
  fade();
  const move = (/** @type {number} */ by) => choose(result.steps[Math.min(Math.max(result.steps.indexOf(state.step ?? NaN) + by, 0), result.steps.length - 1)]).catch(notify);

  function drawStatus() {
    const { analysis } = result;
    replace(status, h("span.row", stateBadge(analysis.state, analysis.warnings)), analysis.problem ? problemText(api.problemOf(analysis.problem)) : null);
    replace(warned, warningsBox(analysis.warnings));
  }

  const following = live(screen, setStep);
  const empty = h("div", { "data-role": "empty" });
  const controls = h("div.row.controls", h("div.field", h("label", { for: "resultfield" }, "Field"), Object.assign(fieldChoice, { id: "resultfield" })),
    axesField, field("Image", imageChoice), h("div.field", h("label", { for: "opacity" }, "Opacity"), h("span.control", Object.assign(opacity, { id: "opacity" }), opacityText)),
    h("div.field.grow", h("label", { for: "resultstep" }, "Step "), h("span.control",
      h("button", { type: "button", "aria-label": "Step before", onclick: () => move(-1) }, "◂"), Object.assign(slider, { id: "resultstep" }),
      h("button", { type: "button", "aria-label": "Next step", onclick: () => move(1) }, "▸"), play, stepText)));
  const pictured = h("div", stage, screen.overlay.root, message, cameras);
  const figures = h("section.panel.figures", { "aria-label": "Figures" }, scale.root, h("h2", "Statistics"), statistics, h("div.row", h("span", "Strain in"), strainChoice), screen.interval.root, h("h2", "Probe"), probe);
  replace(root,
    h("div.spread", h("h1", "Results: ", h("a", { href: `#/results/${testId}` }, result.test.name || testId), ` · ${result.analysis.label || analysisId}`), status, modes), warned, following.root, empty, controls, h("div.grid.side.measured", pictured, figures, below));

  drawStatus();
  screen.drawn.add(() => mark(screen));
  screen.drawn.add(display.keep);
  const aboutPanel = about(screen);
  const gaugePanels = gauges(screen);
  const axes = frames(screen, async () => { scale.forget(); state.pinned = undefined; replace(probe, h("p.quiet", "Click a point to see all its values.")); await refresh(); });
  axesField.append(h("label", { for: "resultframe" }, "Axes"), axes.choice);
  const filesPanel = files(screen);
  const modelsPanel = models(screen);
  const point = pointHistory(screen);
  below.append(point.root, gaugePanels, axes.root, modelsPanel, filesPanel, aboutPanel.root);
  const dependent = [modes, controls, pictured, figures, point.root, gaugePanels, axes.root, modelsPanel, filesPanel]; // on a finished step
  await refresh();
  ends.push(events.on("result", async (event) => {
    if (event.analysis_id !== analysisId) return;
    await result.refresh();
    drawStatus();
    counter();
    aboutPanel.draw();
    await following.landed();
    if (scale.overAll) await redraw();
    for (const listener of screen.landed) await listener();
  }), events.on("step_failed", async (event) => {
    if (event.analysis_id !== analysisId) return;
    await result.refresh();
    drawStatus();
    aboutPanel.draw();
  }), events.on("job", async (job) => {
    if (job.id !== result.analysis.job_id || job.state === result.analysis.state) return;
    await result.refresh();
    drawStatus();
    nothing();
    aboutPanel.draw();
  }), () => { state.playing = null; });
  return () => ends.forEach((end) => end());
}
