// Gauges drawn on the picture: a line, extensometers, an area; read by the API's gauges operation.
import * as api from "../../lib/api.js";
import { readGauges } from "../../lib/steps.js";
import { chart } from "../../widgets/plots.js";
import { h, svg, numeric, replace, table, num, tick, count, number, select, field, action, notify, problemText } from "../../lib/dom.js";
import { nudge, onGrab } from "../../widgets/view.js";
import { amount, shown, uncertain } from "../../lib/units.js";
import { aboutText, pretty, shownUnit } from "./analysis.js";
import { keptGauges } from "./kept.js";
import { abscissas, areaChart, isRelative } from "./histories.js";
import { distanceMm } from "../../lib/along.js";
import { lines } from "./lines.js";
import { budgetTable, withBudget } from "./uncertainty.js";
/** @import { Attributes } from "#dom" */
/** @import { Body, GaugeReadings } from "#routes" */
/** @import { Viewer } from "../results.js" */
/** @typedef {[x: number, y: number]} Spot */
/** @typedef {[x0: number, y0: number, x1: number, y1: number]} Four */
/** @typedef {"line" | "extensometer" | "area"} Kind of a gauge */
/** @typedef {Kind | "probe"} Tool */
/** @typedef {"strain" | "elongation_mm" | "length_mm" | "true_strain"} Elongation */
/** @typedef {Body<"post", "/tests/{test_id}/analyses/{analysis_id}/gauges">} Request */

/** @type {[tool: Tool, text: string, title: string][]} */
const TOOLS = [["probe", "Probe", "Click a point for all its values; drag to move the picture"], ["line", "Line", "Drag a line: values along it"],
  ["extensometer", "Extensometer", "Two clicks or a drag: elongation over the steps"], ["area", "Area", "Drag a rectangle: statistics of it"]];
/** @type {Record<Tool, string>} */
const INK = { probe: "#fff", line: "#ff9d1e", extensometer: "#ff5fa2", area: "#5ad1ff" };
const EXTENSOMETER = [["strain", "strain"], ["elongation_mm", "elongation (mm)"], ["length_mm", "length (mm)"], ["true_strain", "true strain"]];

/** @param {Viewer} screen */
export function gauges(screen) {
  const { result, map, interval } = screen;
  const { view } = map;
  const layer = svg("g", { class: "gauges" });
  view.svg.append(layer);
  view.svg.removeAttribute("aria-hidden");
  view.svg.setAttribute("role", "group");
  view.svg.setAttribute("aria-label", "Gauges drawn over the picture");
  /** @type {{ tool: Tool, line: [Spot, Spot] | null, area: Four | null, extensometers: { name: string, a: Spot, b: Spot }[], serial: number, first: Spot | null, kept: { name: string, ends: [Spot, Spot] }[] }} `kept`: lines beside the one that is drawn now */
  const state = { tool: "probe", line: null, area: null, extensometers: [], serial: 0, first: null, kept: [] };
  const rigid = h("input", { type: "checkbox" });
  const keep = keptGauges(screen.workspace, state, rigid);
  /** @type {(more: Partial<Request>) => Request} */
  const body = (more) => /** @type {Request} */ ({ ...more, ...(rigid.checked ? { remove_rigid: {} } : {}) });

  // tools ------------------------------------------------------------------------------------------------------
  const buttons = TOOLS.map(([name, text, title]) => h("button", { type: "button", title, "data-tool": name, "aria-pressed": String(name === "probe"), onclick: (event) => choose(name, event.detail === 0) }, text));
  view.tools.append(h("span.row", { role: "group", "aria-label": "Tool" }, buttons));
  /** @param {Tool} name */
  function choose(name, byKey = false) {
    state.tool = name;
    state.first = null;
    view.drawing = name !== "probe";
    if (view.aim) view.setAim(null);
    if (view.drawing) {
      screen.message.textContent = inReference() ? "By keyboard: arrow keys move the cross-hair (Shift 10 px, Alt 0.1 px), Enter sets an end, Escape leaves." : "Gauges are drawn on the reference image: choose it under Image.";
      if (byKey) view.frame.focus();
    } else screen.message.textContent = screen.info ? aboutText(screen.info) : "";
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.tool === name));
    view.frame.style.cursor = name === "probe" ? "" : "cell";
    if (name !== "probe") panels[name].open = true;
    draw();
  }

  const inReference = () => map.now?.image === "reference";
  view.onleave = () => choose("probe");
  view.onaim = (aim) => { if (state.first) draw(aim && [aim.x, aim.y]); };
  const probe = screen.onpick;
  screen.onpick = (x, y, event) => {
    if (state.tool === "probe") return void probe(x, y, event);
    if (event.type !== "keydown" || !inReference()) return; // the mouse draws below
    if (!state.first) {
      state.first = [x, y];
      draw([x, y]);
      return;
    }
    const from = state.first;
    state.first = null;
    made(state.tool, from, [x, y]);
  };
  /** @type {{ id: number, from: Spot, to: Spot, at: Spot, last: [number, number], moved: boolean } | null} `at`, `last`: in the window */
  let drag = null;
  view.frame.addEventListener("pointerdown", (event) => {
    if (state.tool === "probe" || event.button !== 0 || !inReference() || onGrab(event)) return;
    if (drag) { // a second finger: both move and zoom the picture, nothing is drawn
      view.hold(drag.id, drag.last);
      drag = null;
      return draw();
    }
    event.stopImmediatePropagation();
    event.preventDefault();
    view.frame.focus();
    view.frame.setPointerCapture(event.pointerId);
    const { x, y } = view.at(event);
    drag = { id: event.pointerId, from: [x, y], to: [x, y], at: [event.clientX, event.clientY], last: [event.clientX, event.clientY], moved: false };
  }, true);
  view.frame.addEventListener("pointermove", (event) => {
    const { x, y } = view.at(event);
    if (drag) {
      drag.to = [x, y];
      drag.last = [event.clientX, event.clientY];
      if (Math.hypot(event.clientX - drag.at[0], event.clientY - drag.at[1]) > 4) drag.moved = true;
      draw();
    } else if (state.first) draw([x, y]);
  });
  const up = (/** @type {PointerEvent} */ event) => {
    if (!drag) return;
    const done = drag;
    drag = null;
    if (event.type === "pointercancel") return draw();
    if (!done.moved) { // the first of two clicks
      if (!state.first) { state.first = done.from; return draw(); }
      done.from = state.first;
    }
    state.first = null;
    made(state.tool, done.from, done.to);
  };
  view.frame.addEventListener("pointerup", up);
  view.frame.addEventListener("pointercancel", up);
  view.frame.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !(drag || state.first) || view.aim) return;
    drag = null;
    state.first = null;
    draw();
  });

  /**
   * Gauges lie inside the grid of points.
   * @param {readonly number[]} at
   * @returns {Spot}
   */
  function within([x, y]) {
    if (!map.now) return [x, y];
    const { grid } = map.now;
    /** @type {(v: number, a: number, b: number) => number} */
    const clip = (v, a, b) => Math.round(10 * Math.min(Math.max(v, Math.min(a, b)), Math.max(a, b))) / 10;
    return [clip(x, grid.x0, grid.x0 + (grid.cols - 1) * grid.dx), clip(y, grid.y0, grid.y0 + (grid.rows - 1) * grid.dy)];
  }

  /**
   * @param {Tool} tool
   * @param {Spot} a
   * @param {Spot} b
   */
  function made(tool, a, b) {
    const [from, to] = [within(a), within(b)];
    if (Math.hypot(from[0] - to[0], from[1] - to[1]) < 1) {
      draw();
      return;
    }
    if (tool === "line") state.line = [from, to];
    if (tool === "area") state.area = [Math.min(from[0], to[0]), Math.min(from[1], to[1]), Math.max(from[0], to[0]), Math.max(from[1], to[1])];
    if (tool === "extensometer") state.extensometers.push({ name: nextName(), a: from, b: to });
    if (tool !== "probe") changed(tool);
  }

  /** E1, E2 ...: e1 and e2 are the principal strains. Gauges that were saved under other names keep them. */
  function nextName() {
    do state.serial += 1; while (state.extensometers.some((one) => one.name === `E${state.serial}`));
    return `E${state.serial}`;
  }

  /** @param {Kind} tool */
  function changed(tool) {
    draw();
    fillInputs();
    const read = { line: readLine, area: readArea, extensometer: readExtensometers }[tool];
    panels[tool].open = true;
    return read().catch(notify);
  }

  // drawing ----------------------------------------------------------------------------------------------------
  /** @type {(colour: string, extra?: Attributes) => Attributes} */
  const stroke = (colour, extra = {}) => ({ stroke: colour, fill: "none", "stroke-width": 2, "vector-effect": "non-scaling-stroke", ...extra });
  /**
   * @param {string} d
   * @param {string} colour
   */
  function path(d, colour) {
    return [svg("path", { d, ...stroke("#000", { "stroke-width": 4, opacity: 0.6 }) }), svg("path", { d, ...stroke(colour) })];
  }
  /** @type {(ends: [Spot, Spot], name: string) => SVGElement} */
  const label = ([a, b], name) => svg("text", { x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, fill: "#fff", stroke: "#000", "stroke-width": 3, "paint-order": "stroke", style: { fontSize: "calc(13px * var(--px))", strokeWidth: "calc(3px * var(--px))" } }, ` ${name}`);
  const more = lines(screen, { kept: state.kept, current: () => state.line, body, redraw: () => draw() });
  /** @type {number | undefined} */
  let later;
  screen.ends.push(() => clearTimeout(later));
  /**
   * @param {Spot} at
   * @param {string} colour
   * @param {(x: number, y: number) => void} move
   * @param {Kind} tool
   * @param {string} name
   */
  function handle(at, colour, move, tool, name) {
    const grab = svg("circle", { class: "grab", tabindex: 0, role: "button", "data-handle": name, "aria-label": `${name}, at ${num(at[0], 5)}, ${num(at[1], 5)} px`, cx: at[0], cy: at[1], fill: colour, stroke: "#000", "stroke-width": 1, "vector-effect": "non-scaling-stroke", style: { r: "calc(6px * var(--px))" } });
    grab.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      grab.setPointerCapture(event.pointerId);
      const moving = (/** @type {PointerEvent} */ e) => { const { x, y } = view.at(e); const [u, v] = within([x, y]); move(u, v); grab.setAttribute("cx", String(u)); grab.setAttribute("cy", String(v)); };
      grab.addEventListener("pointermove", moving);
      grab.addEventListener("pointerup", () => { grab.removeEventListener("pointermove", moving); changed(tool); }, { once: true });
    });
    grab.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey) return;
      const by = nudge(event);
      if (!by) return;
      event.preventDefault();
      event.stopPropagation();
      move(...within([at[0] + by[0], at[1] + by[1]]));
      draw();
      clearTimeout(later); // read once the keys rest
      later = setTimeout(() => changed(tool), 300);
    });
    return grab;
  }
  /** @param {Spot | null} mouse */
  function draw(mouse = null) {
    keep();
    const { area, line } = state;
    const parts = [];
    if (inReference()) {
      const segment = (/** @type {Spot} */ a, /** @type {Spot} */ b) => `M${a[0]} ${a[1]}L${b[0]} ${b[1]}`;
      const box = (/** @type {Four} */ [x0, y0, x1, y1]) => `M${x0} ${y0}H${x1}V${y1}H${x0}Z`;
      if (area) {
        parts.push(...path(box(area), INK.area),
          handle([area[0], area[1]], INK.area, (x, y) => { area.splice(0, 2, Math.min(x, area[2] - 1), Math.min(y, area[3] - 1)); }, "area", "Upper left corner of the area"),
          handle([area[2], area[3]], INK.area, (x, y) => { area.splice(2, 2, Math.max(x, area[0] + 1), Math.max(y, area[1] + 1)); }, "area", "Lower right corner of the area"));
      }
      for (const one of more.kept) parts.push(svg("path", { d: segment(...one.ends), ...stroke(INK.line, { "stroke-width": 1.5, "stroke-dasharray": "6 4" }) }), label(one.ends, one.name));
      if (line) parts.push(...path(segment(...line), INK.line), ...line.map((end, k) => handle(end, INK.line, (x, y) => { line[k] = [x, y]; }, "line", `${k ? "End" : "Beginning"} of the line`)));
      for (const one of state.extensometers) {
        parts.push(...path(segment(one.a, one.b), INK.extensometer), .../** @type {const} */ (["a", "b"]).map((k) => handle(one[k], INK.extensometer, (x, y) => { one[k] = [x, y]; }, "extensometer", `End ${k} of extensometer ${one.name}`)),
          label([one.a, one.b], one.name));
      }
      /** @type {[Spot, Spot] | null} */
      const going = drag ? [drag.from, drag.to] : state.first && mouse ? [state.first, mouse] : null;
      if (going) parts.push(...path(state.tool === "area" ? box(/** @type {Four} */ (going.flat())) : segment(...going), INK[state.tool]));
      else if (state.first) parts.push(svg("circle", { cx: state.first[0], cy: state.first[1], fill: INK[state.tool], style: { r: "calc(5px * var(--px))" } }));
    }
    replace(layer, parts);
  }

  // numbers by keyboard ----------------------------------------------------------------------------------------
  /** @type {(names: string[], set: (v: Four) => unknown) => { inputs: HTMLInputElement[], row: HTMLElement }} */
  const four = (names, set) => {
    const inputs = names.map((name) => number(null, { "aria-label": name, style: "width:5em" }));
    const use = action("Use", async () => {
      const v = inputs.map((one) => Number(one.value));
      if (inputs.some((one) => one.value === "") || !v.every(Number.isFinite)) throw new Error("Give all four numbers, in pixels of camera 1's reference image.");
      await set(/** @type {Four} */ (v));
    });
    return { inputs, row: h("div.row", inputs.map((one, k) => h("label.field", h("small.hint", names[k].split(" ").slice(1).join(" ")), one)), h("span.unit", "px"), use) };
  };
  const lineInputs = four(["Line from x", "Line from y", "Line to x", "Line to y"], ([x0, y0, x1, y1]) => { state.line = [[x0, y0], [x1, y1]]; return changed("line"); });
  const areaInputs = four(["Area left", "Area top", "Area right", "Area bottom"], (v) => { state.area = v; return changed("area"); });
  const extInputs = four(["Extensometer a x", "Extensometer a y", "Extensometer b x", "Extensometer b y"], ([x0, y0, x1, y1]) => { state.extensometers.push({ name: nextName(), a: [x0, y0], b: [x1, y1] }); return changed("extensometer"); });
  function fillInputs() {
    if (state.line) state.line.flat().forEach((v, k) => { lineInputs.inputs[k].value = String(v); });
    if (state.area) state.area.forEach((v, k) => { areaInputs.inputs[k].value = String(v); });
  }

  // reading ----------------------------------------------------------------------------------------------------
  /** @typedef {NonNullable<GaugeReadings["lines"]>[number]} Line */
  /** @type {{ line: { line: Line, from: [Spot, Spot], name: string } | null, extensometer: GaugeReadings[] | null, area: { name: string, steps: GaugeReadings[] } | null }} */
  const answers = { line: null, extensometer: null, area: null };
  /** @type {Partial<Record<Kind, Awaited<ReturnType<typeof chart>> | null>>} */
  const plots = {};
  /**
   * @param {Kind} name
   * @param {HTMLElement} box
   * @param {Parameters<typeof chart>[1]} options
   */
  async function plot(name, box, options) {
    plots[name]?.close();
    plots[name] = null;
    plots[name] = await chart(box, options);
  }

  const lineChart = h("div", { "data-role": "line-chart" });
  const lineText = h("div");
  const along = select([["mm", "mm along the surface"], ["px", "pixels of the image"]], "mm");
  along.addEventListener("change", () => drawLine().catch(notify));
  async function readLine() {
    if (!state.line || !screen.info || screen.step === null) return;
    const from = state.line;
    if (screen.info.component !== null) return void replace(lineText, h("p.quiet", "A line needs a scalar field; choose another field."));
    const name = screen.info.name;
    replace(lineText, h("p.quiet", "Reading …"));
    const answer = await api.post(`${result.path}/gauges`, body({ lines: [{ vertices_px: from }], variables: [name, "x_mm", "y_mm", "z_mm"].filter((v, k, each) => each.indexOf(v) === k), steps: [screen.step] }), { frame: result.frame });
    const [step] = answer.steps;
    if (step.problem) return void replace(lineText, problemText(api.problemOf(step.problem)));
    const [line] = step.lines ?? [];
    answers.line = { line, from, name };
    await drawLine();
    await more.draw();
  }
  /** @type {(values: (number | null)[], sigma: (number | null)[], sign: 1 | -1) => (number | null)[]} */
  const beside = (values, sigma, sign) => values.map((v, k) => { const s = sigma[k]; return v === null || s === null ? null : v + sign * s; });
  /** @type {(budget: { [cause: string]: (number | null)[] } | null | undefined) => { [cause: string]: number | null }} */
  const rms = (budget) => Object.fromEntries(Object.entries(budget ?? {}).map(([cause, parts]) => {
    const known = parts.filter((part) => part !== null);
    return [cause, known.length ? Math.sqrt(known.reduce((sum, part) => sum + part * part, 0) / known.length) : null];
  }));
  async function drawLine() {
    if (!answers.line) return;
    const { line, from, name } = answers.line;
    const { value, sigma, units, budget, not_included: lacking } = line.values[name];
    const { unit: base, factor: toBase } = shownUnit(name, units);
    const to = shown(base, toBase * value.reduce((/** @type {number} */ most, v) => Math.max(most, Math.abs(v ?? 0)), 0));
    const [unit, factor] = [to.unit, to.factor * toBase];
    const scaled = (/** @type {(number | null)[]} */ list) => list.map((v) => (v === null ? null : v * factor));
    const values = scaled(value);
    const errors = scaled(sigma).map((v) => (v === null ? null : interval.factor * v));
    const mm = distanceMm(["x_mm", "y_mm", "z_mm"].map((axis) => line.values[axis].value));
    const inMm = along.value === "mm" && mm !== null;
    const x = inMm ? mm : line.distance_px;
    const band = (/** @type {1 | -1} */ sign) => beside(values, errors, sign);
    const missing = value.filter((v) => v === null).length;
    replace(lineText, h("p.quiet", `${count(value.length)} positions from (${from[0].join(", ")}) to (${from[1].join(", ")}) px`,
      missing ? `; ${missing} without a value: ${[...new Set(line.missing.filter(Boolean))].join(", ").replace(/_/g, " ")}` : "",
      along.value === "mm" && !mm ? "; the distance in mm is unknown where points are missing, so it is given in px" : "", errors.some((v) => v !== null) ? `; the band is ± ${interval.symbol}: ${interval.text}` : "; no standard uncertainty is known"),
      budgetTable(rms(budget), unit, factor, lacking ?? ""));
    lineChart.dataset.answer = JSON.stringify({ x, value, sigma });
    await plot("line", lineChart, { x: inMm ? "distance (mm)" : "distance (px)", y: `${screen.info?.text ?? name}${unit ? ` (${unit})` : ""}`, height: 320, said: interval.text,
      series: [{ label: pretty(name), u: errors }, { label: `+ ${interval.symbol}`, edge: true, colour: 0 }, { label: `− ${interval.symbol}`, edge: true, colour: 0 }], bands: [[2, 3]], data: [x, values, band(1), band(-1)], label: `${pretty(name)} along the line` });
  }

  const extChart = h("div", { "data-role": "extensometer-chart" });
  const extTable = h("div");
  const what = select(EXTENSOMETER, "strain");
  const against = abscissas(result);
  const over = against.choice;
  what.addEventListener("change", () => drawExtensometers().catch(notify));
  over.addEventListener("change", () => drawExtensometers().catch(notify));
  async function readExtensometers() {
    if (!state.extensometers.length) {
      answers.extensometer = null;
      plots.extensometer?.close();
      plots.extensometer = null;
      extChart.replaceChildren();
      extTable.replaceChildren();
      return;
    }
    if (!answers.extensometer) replace(extTable, h("p.quiet", "Reading …"));
    answers.extensometer = await readGauges(result.path, body({ extensometers: state.extensometers.map((one) => ({ name: one.name, a_px: one.a, b_px: one.b })) }), { frame: result.frame });
    await against.fill();
    await drawExtensometers();
  }
  async function drawExtensometers() {
    if (!answers.extensometer) return;
    const name = what.value;
    const steps = answers.extensometer.filter((one) => !one.problem);
    const start = isRelative(name) ? result.reference : null; // where it is zero, though nothing was measured there
    const label = (start === null ? undefined : result.entry(start))?.label ?? "";
    const rows = [...(start === null || steps.some((one) => one.n === start) ? [] : [{ n: start, label, extensometers: [] }]), ...steps]
      .map((one) => ({ n: one.n, label: one.label, x: against.at(one.n) ?? NaN, each: one.extensometers ?? [] })).filter((one) => Number.isFinite(one.x)).sort((p, q) => p.x - q.x);
    const strain = name.endsWith("strain");
    const base = strain ? "µm/m" : "mm";
    const most = Math.max(0, ...rows.flatMap((one) => one.each.map((gauge) => Math.abs(gauge?.values[name]?.value ?? 0) * (strain ? 1e6 : 1))));
    const { unit, factor: to } = shown(base, most);
    const factor = (strain ? 1e6 : 1) * to;
    /** @typedef {typeof rows[number]} Row */
    const of = (/** @type {Row} */ one, /** @type {number} */ k, /** @type {"value" | "sigma"} */ part) => one.each[k]?.values[name]?.[part] ?? (one.n === start ? 0 : null);
    /** @type {Parameters<typeof chart>[1]["series"]} */
    const series = [];
    /** @type {number[][]} */
    const bands = [];
    /** @type {[number[], ...(number | null)[][]]} */
    const data = [rows.map((one) => one.x)];
    state.extensometers.forEach((gauge, k) => {
      const value = rows.map((one) => of(one, k, "value")).map((v) => (v === null ? null : v * factor));
      const sigma = rows.map((one) => of(one, k, "sigma")).map((v) => (v === null ? null : v * factor * interval.factor));
      const at = data.length;
      data.push(value, beside(value, sigma, 1), beside(value, sigma, -1));
      series.push({ label: gauge.name, colour: k, dots: true, u: sigma }, ...["+", "−"].map((sign) => ({ label: `${gauge.name} ${sign} ${interval.symbol}`, edge: true, colour: k })));
      bands.push([at + 1, at + 2]);
    });
    extChart.dataset.answer = JSON.stringify({ x: data[0], value: rows.map((one) => state.extensometers.map((_, k) => of(one, k, "value"))), sigma: rows.map((one) => state.extensometers.map((_, k) => of(one, k, "sigma"))) });
    await plot("extensometer", extChart, { x: against.text, y: `${what.selectedOptions[0].text.replace(" (mm)", "")} (${unit})`, height: 320, said: interval.text, series, bands, data, label: `${name} of the extensometers` });
    const valueText = (/** @type {Row} */ one, /** @type {number} */ k) => {
      const [v, s] = [of(one, k, "value"), of(one, k, "sigma")];
      if (v === null) return one.each[k]?.missing?.replace(/_/g, " ") || "–";
      if (one.n === start && !s) return "0";
      if (s === null) return amount((v * factor) / to, base, 4, most);
      const { budget, not_included: lacking } = one.each[k]?.values[name] ?? {};
      return withBudget(uncertain((v * factor) / to, (s * factor * interval.factor) / to, base, most), budgetTable(budget, base, factor / to, lacking ?? ""));
    };
    replace(extTable, table([
      ["Step", (one) => one.n], ["Label", (one) => one.label], ...(over.value === "n" ? [] : [numeric(against.text, (/** @type {Row} */ one) => tick(one.x))]),
      ...state.extensometers.map((gauge, k) => numeric(gauge.name, (/** @type {Row} */ one) => valueText(one, k))),
    ], rows, { caption: `± ${interval.text}` }),
    h("div.row", state.extensometers.map((gauge) => h("button", { type: "button", onclick: () => { state.extensometers = state.extensometers.filter((one) => one !== gauge); changed("extensometer"); } }, `Remove ${gauge.name}`))));
  }

  const areaBox = h("div", { "data-role": "area" });
  const areaPlot = h("div", { "data-role": "area-chart" });
  const areaAgainst = abscissas(result);
  areaAgainst.choice.addEventListener("change", () => { if (answers.area) drawArea(answers.area.name, answers.area.steps); });
  async function readArea() {
    if (!state.area || !screen.info) return;
    if (screen.info.component !== null) return void replace(areaBox, h("p.quiet", "An area needs a scalar field; choose another field."));
    const { name } = screen.info;
    if (!areaBox.firstChild) replace(areaBox, h("p.quiet", "Reading …"));
    const steps = await readGauges(result.path, body({ areas: [{ rectangle_px: state.area }], variables: [name] }), { frame: result.frame });
    await areaAgainst.fill();
    drawArea(name, steps);
  }
  /**
   * @param {string} name
   * @param {GaugeReadings[]} steps
   */
  function drawArea(name, steps) {
    answers.area = { name, steps };
    const { unit, factor } = shownUnit(name, steps.at(-1)?.areas?.[0]?.values[name]?.units ?? "");
    const zero = isRelative(name) ? result.reference : null; // where it is zero by definition
    const most = factor * Math.max(0, ...steps.map((one) => Math.abs(one.areas?.[0]?.values[name]?.mean ?? 0)));
    /** @type {(one: GaugeReadings, part: "mean" | "mean_sigma" | "sd" | "rms" | "min" | "max", digits?: number) => string} */
    const cell = (one, part, digits = 4) => (one.n === zero ? "0" : amount((one.areas?.[0]?.values[name]?.[part] ?? NaN) * factor, unit, digits, most));
    const mean = (/** @type {GaugeReadings} */ one) => {
      const v = one.areas?.[0]?.values[name];
      if (!v || v.mean_sigma === null) return cell(one, "mean");
      return withBudget(uncertain((v.mean ?? NaN) * factor, v.mean_sigma * factor * interval.factor, unit, most), budgetTable(v.mean_budget, unit, factor, v.not_included ?? ""));
    };
    const to = shown(unit, most);
    plots.area?.close();
    plots.area = null;
    areaChart(areaPlot, { result, against: areaAgainst, name, text: pretty(name), unit: to.unit, factor: factor * to.factor, interval, steps }).then((made) => { plots.area?.close(); plots.area = made; }, notify);
    areaBox.dataset.answer = JSON.stringify(steps.map((one) => one.areas?.[0]?.values[name] ?? null));
    replace(areaBox, table([
      ["Step", (one) => one.n], ["Label", (one) => one.label], [`Mean ± ${interval.symbol}`, mean, { numeric: true }],
      ["sd", (one) => cell(one, "sd", 3), { numeric: true }], ["rms", (one) => cell(one, "rms"), { numeric: true }], ["Min", (one) => cell(one, "min"), { numeric: true }], ["Max", (one) => cell(one, "max"), { numeric: true }],
      ["Points", (one) => (one.problem ? one.problem.cause ?? "–" : `${one.areas?.[0].valid} of ${one.areas?.[0].points}`), { numeric: true }],
    ], steps, { caption: `${pretty(name)} over the rectangle; ${interval.text}` }));
  }

  interval.changed.add(() => Promise.all([drawLine(), drawExtensometers(), answers.area && drawArea(answers.area.name, answers.area.steps)]));
  rigid.addEventListener("change", () => { for (const read of [readLine, readArea, readExtensometers]) read().catch(notify); });
  const clear = (/** @type {"line" | "area"} */ tool) => h("button", { type: "button", onclick: () => { state[tool] = null; if (tool === "line") { answers.line = null; plots.line?.close(); plots.line = null; lineChart.replaceChildren(); lineText.replaceChildren(); } else { answers.area = null; plots.area?.close(); plots.area = null; areaPlot.replaceChildren(); areaBox.replaceChildren(); } draw(); } }, "Clear");
  const panels = {
    line: h("details.panel", h("summary", "Line"), h("p.quiet", "Choose the tool Line above the picture and drag, or give its ends."), lineInputs.row, h("div.row", field("Along", along), clear("line")), lineText, lineChart, more.root),
    extensometer: h("details.panel", h("summary", "Extensometers"), h("p.quiet", "Choose the tool Extensometer and click its two ends, or give them."), extInputs.row, h("div.row", field("Show", what), field("Against", over)), extChart, extTable),
    area: h("details.panel", h("summary", "Area"), h("p.quiet", "Choose the tool Area and drag a rectangle, or give its corners."), h("div.row", areaInputs.row, field("Area against", areaAgainst.choice), clear("area")), areaPlot, areaBox),
  };
  const root = h("div", h("label.check.apart", rigid, "Gauges without the rigid motion of the whole field"), panels.line, panels.extensometer, panels.area);

  let last = "";
  let first = true;
  screen.drawn.add(async () => {
    draw();
    if (first) fillInputs();
    if (first && state.extensometers.length) { panels.extensometer.open = true; readExtensometers().catch(notify); }
    if (first) for (const name of /** @type {const} */ (["line", "area"])) panels[name].open = Boolean(state[name]);
    first = false;
    const now = `${screen.step} ${screen.info?.key} ${result.frame}`;
    if (now === last) return;
    last = now;
    if (state.line) await readLine().catch(notify);
    else if (more.kept.length) await more.draw().catch(notify);
    if (state.area && screen.info) await readArea().catch(notify);
  });
  screen.landed.add(() => Promise.all([readExtensometers(), readArea()]).catch(notify)); // histories of all steps
  screen.ends.push(() => Object.values(plots).forEach((one) => one?.close()));
  return root;
}
