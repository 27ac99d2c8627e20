// Gauges drawn on the picture: a line, extensometers, an area; read by the API's gauges operation.
import { h, notify } from "../../lib/dom.js";
import { aboutText } from "./analysis.js";
import { areaPanel } from "./gauges/area.js";
import { drawing, inReference } from "./gauges/drawing.js";
import { extensometersPanel } from "./gauges/extensometers.js";
import { linePanel } from "./gauges/line.js";
import { keptGauges } from "./kept.js";
import { lines } from "./lines.js";
import { choose as unfold } from "../../widgets/tabs.js";

/** @import { Viewer } from "../results.js" */
/** @import { Gauges, Kind, Request, State, Tool } from "./gauges/shared.js" */

/** @type {[tool: Tool, text: string, title: string][]} */
const TOOLS = [
  ["probe", "Probe", "Click a point for all its values; drag to move the picture"],
  ["line", "Line", "Drag a line: values along it"],
  ["extensometer", "Extensometer", "Two clicks or a drag: elongation over the steps"],
  ["area", "Area", "Drag a rectangle: statistics of it"],
];

/** @param {Viewer} screen */
export function gauges(screen) {
  const { result, interval, map } = screen;
  /** @type {State} */
  const state = { tool: "probe", line: null, area: null, extensometers: [], serial: 0, first: null, kept: [] };
  const rigid = h("input", { type: "checkbox" });
  const keep = keptGauges(screen.workspace, state, rigid);
  /** @type {Gauges} */
  const my = {
    screen,
    state,
    body: (more) => /** @type {Request} */ ({ ...more, ...(rigid.checked ? { remove_rigid: {} } : {}) }),
    draw(mouse = null) {
      keep();
      onPicture(mouse);
    },
    changed(tool) {
      my.draw();
      fill();
      unfold(panels[tool].root);
      return panels[tool].read().catch(notify);
    },
  };
  const more = lines(screen, { kept: state.kept, current: () => state.line, body: my.body, redraw: () => my.draw() });
  const onPicture = drawing(my, more.kept);
  const panels = { line: linePanel(my, more), extensometer: extensometersPanel(my), area: areaPanel(my) };
  const each = Object.values(panels);
  const fill = () => each.forEach((one) => one.fill());
  map.view.tools.append(tools(my, (tool) => panels[tool]));
  map.view.onaim = (aim) => {
    if (state.first) my.draw(aim && [aim.x, aim.y]);
  };
  interval.changed.add(() => Promise.all(each.map((one) => one.draw())));
  rigid.addEventListener("change", () => {
    for (const one of [panels.line, panels.area, panels.extensometer]) one.read().catch(notify);
  });

  let last = "";
  let first = true;
  screen.drawn.add(async () => {
    my.draw();
    if (first) {
      fill();
      if (state.extensometers.length) panels.extensometer.read().catch(notify);
      const kept = state.extensometers.length ? "extensometer" : state.line ? "line" : state.area ? "area" : null;
      if (kept) unfold(panels[kept].root);
    }
    first = false;
    const now = `${screen.step} ${screen.info?.key} ${result.frame}`;
    if (now === last) return;
    last = now;
    // the map does not wait for them: a history is read over all steps
    const line = state.line ? panels.line.read() : more.kept.length ? more.draw() : null;
    line?.catch(notify);
    if (state.area && screen.info) panels.area.read().catch(notify);
  });
  screen.landed.add(() => Promise.all([panels.extensometer.read(), panels.area.read()]).catch(notify)); // histories of all steps
  screen.ends.push(() => each.forEach((one) => one.close()));
  return h(
    "div.gauges",
    h("label.check.apart", rigid, "Gauges without the rigid motion of the whole field"),
    each.map((one) => one.root),
  );
}

/**
 * The buttons that choose a tool.
 * @param {Gauges} my
 * @param {(tool: Kind) => { root: HTMLDetailsElement }} panelOf
 */
function tools(my, panelOf) {
  const { screen, state } = my;
  const { view } = screen.map;
  const buttons = TOOLS.map(([name, text, title]) => {
    const onclick = (/** @type {MouseEvent} */ event) => choose(name, event.detail === 0);
    return h("button", { type: "button", title, "data-tool": name, "aria-pressed": String(name === "probe"), onclick }, text);
  });
  /** @param {Tool} name */
  function choose(name, byKey = false) {
    state.tool = name;
    state.first = null;
    view.drawing = name !== "probe";
    if (view.aim) view.setAim(null);
    if (view.drawing) {
      screen.message.textContent = inReference(my)
        ? "By keyboard: arrow keys move the cross-hair (Shift 10 px, Alt 0.1 px), Enter sets an end, Escape leaves."
        : "Gauges are drawn on the reference image: choose it under Image.";
      if (byKey) view.frame.focus();
    } else screen.message.textContent = screen.info ? aboutText(screen.info) : "";
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.tool === name));
    view.frame.style.cursor = name === "probe" ? "" : "cell";
    if (name !== "probe") unfold(panelOf(name).root);
    my.draw();
  }
  view.onleave = () => choose("probe");
  return h("span.row", { role: "group", "aria-label": "Tool" }, buttons);
}
