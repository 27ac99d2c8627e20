// Results: one analysis' fields over the image and in space.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { Result, aboutText } from "./results/analysis.js";
import { FieldMap, measured } from "../widgets/field_map.js";
import { Scale } from "../widgets/scale.js";
import { about } from "./results/about.js";
import { camerasNote } from "./results/cameras.js";
import { controlsBar } from "./results/controls.js";
import { files } from "./results/export.js";
import { gauges } from "./results/gauges.js";
import { frames } from "./results/frame.js";
import { keptDisplay } from "./results/kept.js";
import { list } from "./results/list.js";
import { overlay } from "./results/overlay.js";
import { pointHistory } from "./results/point_history.js";
import { mark, pinned } from "./results/probe.js";
import { statistics } from "./results/statistics.js";
import { interval } from "./results/uncertainty.js";
import { live } from "./results/live.js";
import { evaluations } from "./results/evaluations.js";
import { models } from "./results/models.js";
import { views } from "./results/views.js";
import { continueButton } from "../widgets/analyses_table.js";
import { choose, tabs } from "../widgets/tabs.js";
import { stateBadge, warningsBox } from "./results/warnings.js";
import { Workspace } from "../lib/workspace.js";
import { strainUnit, useStrainUnit } from "../lib/units.js";
import { h, replace, select, notify, problemText } from "../lib/dom.js";

/** @import { Here } from "../main.js" */
/** @import { Ends } from "#dom" */
/** @import { StepSummary } from "#routes" */
/** @import { Over } from "../widgets/field_map.js" */
/** @import { Shown } from "./results/analysis.js" */
/** @import { Overlay } from "./results/overlay.js" */
/** @import { Interval } from "./results/uncertainty.js" */
/** @import { Mode } from "./results/views.js" */
/** @typedef {{ step: number | null, field: string | null, chosen: boolean, image: Over, mode: Mode, info: Shown | null, playing: object | null, pinned?: number }} State */
/** @typedef {{ result: Result, state: State, map: FieldMap, scale: Scale, interval: Interval, workspace: Workspace, overlay: Overlay, ends: Ends, probe: HTMLElement, message: HTMLElement, readonly step: number | null,
 *   readonly info: Shown | null, picture: (width: number) => string, onpick: (x: number, y: number, event: Event) => unknown, drawn: Set<() => unknown>, landed: Set<() => unknown> }} Viewer shared by the parts of the screen;
 *   `picture`: the visible picture, as SVG; `drawn` is called after each change of step, field or scale, `landed` once more steps are finished */

/**
 * Which axes a step's frame has, in a few words.
 * @param {string | undefined} frame
 */
const axesText = (frame) =>
  frame?.startsWith("aligned")
    ? `the specimen's (${frame
        .split("; before:")[0]
        .replace(/^aligned by /, "")
        .replace(/^plane/, "best plane")})`
    : "the calibration's (system frame)";

/**
 * @param {HTMLElement} root
 * @param {Here} here
 */
export async function open(root, here) {
  const [testId, analysisId] = here.path;
  return testId && analysisId ? show(root, testId, analysisId, here.query) : list(root, testId);
}

/**
 * State of the screen, and what its parts share; the parts that are made later are filled in by `show`.
 * @param {Result} result
 * @param {Workspace} workspace
 * @param {URLSearchParams} query
 * @param {() => unknown} redraw for another scale
 * @returns {Viewer}
 */
function viewerOf(result, workspace, query, redraw) {
  const asked = Number(query.get("step") ?? NaN);
  if (query.get("frame") === "system") result.use("system");
  /** @type {State} */
  const state = {
    step: result.steps.includes(asked) ? asked : (result.steps.at(-1) ?? null),
    field: query.get("field"),
    chosen: Boolean(query.get("field")),
    image: "reference",
    mode: "image",
    info: null,
    playing: null,
  };
  const map = new FieldMap("Field over the image of camera 1", (x, y, event) => screen.onpick(x, y, event));
  /** @type {any} */
  const later = null;
  /** @type {Viewer} */
  const screen = {
    result,
    state,
    map,
    scale: new Scale(redraw),
    workspace,
    ends: [() => map.close(), () => workspace.close()],
    probe: h("div", { "data-role": "probe" }),
    message: h("p.quiet", { role: "status" }),
    interval: later,
    overlay: later,
    picture: later,
    onpick: later,
    get step() {
      return state.step;
    },
    get info() {
      return state.info;
    },
    drawn: new Set(),
    landed: new Set(),
  };
  return screen;
}

/**
 * @param {HTMLElement} root
 * @param {string} testId
 * @param {string} analysisId
 * @param {URLSearchParams} query
 */
async function show(root, testId, analysisId, query) {
  const [result, workspace] = await Promise.all([Result.open(testId, analysisId), Workspace.open(testId)]);
  const screen = viewerOf(result, workspace, query, () => redraw().catch(notify));
  const { state, map, scale, ends, message } = screen;
  const display = keptDisplay(workspace, scale, state);
  const view = views(screen, () => filesPanel.dispatchEvent(new Event("seen")));
  screen.picture = view.picture;
  screen.onpick = async (x, y) => {
    const { i } = map.nearest(x, y);
    if (i < 0 || !map.now || state.step === null) return;
    const { grid } = map.now;
    state.pinned = i;
    const answer = await api.get(`${result.path}/probe`, { x_px: Math.max(grid.x[i], 0), y_px: Math.max(grid.y[i], 0), step: state.step, frame: result.frame });
    pinned(screen, answer);
    choose(point.root.open ? point.root : numbers);
    point.draw();
  };
  unpin(screen);
  screen.interval = interval(screen);
  screen.overlay = overlay(screen);
  const figures = statistics(screen);
  const bar = controlsBar(screen, { refresh, chosen: display.chosen, moved: () => following.moved() });
  const status = h("div");
  const warned = h("div");
  const cameras = h("div");

  async function refresh() {
    nothing();
    if (state.step === null) return;
    replace(cameras, camerasNote(/** @type {StepSummary | undefined} */ (await result.figures(state.step))));
    bar.counter();
    await bar.fields();
    const own = `#/results/${testId}/${analysisId}`;
    const field = state.chosen ? `&field=${encodeURIComponent(state.field ?? "")}` : "";
    const address = `${own}?step=${state.step}${field}${result.frame === "system" ? "&frame=system" : ""}`;
    if (location.hash !== address && location.hash.startsWith(own)) history.replaceState(null, "", address);
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
    const overAll = scale.overAll && !info.flags && state.info && map.now.n === state.step;
    const each = overAll ? await overSteps(result, info.key) : [];
    if (map.now?.info !== info) return;
    scale.lay(each.length ? each : [map.measured], info.unit, info.flags, Boolean(info.signed));
    map.redraw(scale);
    figures.draw();
    for (const listener of screen.drawn) await listener();
    await figures.principal();
  }

  const goOn = () =>
    continueButton({ testId, analysisId, state: result.analysis.state, failed: result.analysis.n_failed }, async () => {
      await result.refresh();
      drawStatus();
    });
  function drawStatus() {
    const { analysis } = result;
    replace(
      status,
      h("span.row", stateBadge(analysis.state, analysis.warnings), goOn()),
      analysis.problem ? problemText(api.problemOf(analysis.problem)) : null,
    );
    replace(warned, warningsBox(analysis.warnings));
  }

  const following = live(screen, async (n) => {
    state.step = n;
    await refresh();
  });
  const empty = h("div", { "data-role": "empty" });
  const pictured = h("div.pictured", h("div.stage", view.stage, scale.legend, scale.flagList), screen.overlay.root, message, cameras);
  const numbers = numbersPanel(screen, figures.root, strainChoice(screen, bar.fields, redraw));
  const panels = tabs(h("div", h("h2.unseen", "Numbers and plots"), numbers));
  const address = () => api.address(`${result.path}/report`, { frame: result.frame });
  const report = h("a.button", { href: address(), target: "_blank", rel: "noopener" }, "Open the report");
  report.addEventListener("click", () => {
    report.setAttribute("href", address()); // in the axes that are shown
    notify("The report is computed from the steps' files: some seconds, longer for many steps.", "ok");
  });
  const exported = h("button", { type: "button", onclick: () => choose(filesPanel, true) }, "Export");
  const title = h("h1", "Results: ", h("a", { href: `#/results/${testId}` }, result.test.name || testId), ` · ${result.analysis.label || analysisId}`);
  const side = h("div.grid.measured", pictured, panels);
  replace(root, h("div.spread", title, status, h("div.row.top", view.modes, exported, report)), warned, following.root, empty, bar.root, side);
  drawStatus();
  screen.drawn.add(() => mark(screen));
  screen.drawn.add(display.keep);
  const aboutPanel = about(screen);
  const gaugePanels = gauges(screen);
  const axes = frames(screen, async () => {
    scale.forget();
    unpin(screen);
    await refresh();
  });
  bar.axesField.append(h("label", { for: "resultframe" }, "Axes"), axes.choice);
  const filesPanel = files(screen);
  const modelsPanel = models(screen);
  const evaluationsPanel = evaluations(screen);
  const point = pointHistory(screen);
  panels.append(gaugePanels, point.root, axes.root, modelsPanel, evaluationsPanel, filesPanel, aboutPanel.root);

  /** Without a finished step there is nothing to choose: only the reason is shown. */
  function nothing() {
    const none = state.step === null;
    root.classList.toggle("without", none);
    replace(empty, none ? noStep(testId, following.running()) : null);
  }
  await refresh();
  listen(screen, {
    draw() {
      drawStatus();
      aboutPanel.draw();
    },
    nothing,
    async landed() {
      bar.counter();
      await following.landed();
      if (scale.overAll) await redraw();
    },
  });
  return () => ends.forEach((end) => end());
}

/**
 * Why no step is shown.
 * @param {string} testId
 * @param {boolean} running
 */
const noStep = (testId, running) =>
  running
    ? h("p.quiet", { role: "status" }, "No step is finished yet. The page updates by itself.")
    : h("p.quiet", "No step was measured. ", h("a", { href: `#/test/${testId}` }, "Back to the test"), " to draw the region and measure again.");

/**
 * @param {Viewer} screen
 * @param {HTMLElement} figures
 * @param {HTMLElement} strain
 */
const numbersPanel = ({ scale, interval, probe }, figures, strain) =>
  h(
    "details.panel.figures",
    { open: true },
    h("summary", "Statistics"),
    figures,
    h("div.row", h("span", "Strain in"), strain),
    interval.root,
    h("h2", "Probe"),
    probe,
    h("h2", "Colours"),
    scale.root,
  );

/** @param {Viewer} screen */
function unpin({ state, probe }) {
  state.pinned = undefined;
  replace(probe, h("p.quiet", "Click a point to see all its values."));
}

/**
 * Values of a field in each step that has it.
 * @param {Result} result
 * @param {string} key
 */
async function overSteps(result, key) {
  const each = [];
  for (const n of result.steps) {
    const { shown } = await result.fields(n);
    if (!shown.some((one) => one.key === key)) continue;
    const [grid, of] = await Promise.all([result.grid(n), result.values(n, key)]);
    each.push(measured(grid, of));
  }
  return each;
}

/**
 * The choice of the unit of strain.
 * @param {Viewer} screen
 * @param {() => Promise<void>} fields lists the fields with their units
 * @param {() => Promise<void>} redraw
 */
function strainChoice(screen, fields, redraw) {
  const units = [
    ["µm/m", "µm/m, % from 1 % on"],
    ["%", "%"],
  ];
  const choice = select(units, strainUnit(), { "aria-label": "Unit of strain", "data-role": "strain-unit" });
  choice.addEventListener("change", async () => {
    useStrainUnit(choice.value === "%" ? "%" : "µm/m");
    try {
      await fields();
      await redraw();
      for (const listener of screen.interval.changed) await listener();
    } catch (error) {
      notify(error);
    }
  });
  return choice;
}

/**
 * Read the analysis again after its events.
 * @param {Viewer} screen
 * @param {{ draw: () => void, nothing: () => void, landed: () => Promise<void> }} to
 *   `draw` shows its state, `nothing` whether there is a step, `landed`: more steps are finished
 */
function listen({ result, state, ends, landed }, to) {
  ends.push(
    events.on("result", async (event) => {
      if (event.analysis_id !== result.analysisId) return;
      await result.refresh();
      to.draw();
      await to.landed();
      for (const listener of landed) await listener();
    }),
    events.on("step_failed", async (event) => {
      if (event.analysis_id !== result.analysisId) return;
      await result.refresh();
      to.draw();
    }),
    events.on("job", async (job) => {
      if (job.id !== result.analysis.job_id || job.state === result.analysis.state) return;
      await result.refresh();
      to.nothing();
      to.draw();
    }),
    () => {
      state.playing = null;
    },
  );
}
