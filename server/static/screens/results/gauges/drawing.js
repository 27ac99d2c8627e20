// Gauges on the picture: drawn and moved by mouse, finger and keyboard.
import { svg, replace, num } from "../../../lib/dom.js";
import { nudge, onGrab } from "../../../widgets/view.js";
import { nextName } from "./shared.js";

/** @import { Attributes } from "#dom" */
/** @import { Four, Gauges, Kind, Line, Spot, Tool } from "./shared.js" */
/** @typedef {{ id: number, from: Spot, to: Spot, at: Spot, last: Spot, moved: boolean }} Drag `at`, `last`: in the window */

/** @type {Record<Tool, string>} */
const INK = { probe: "#fff", line: "#ff9d1e", extensometer: "#ff5fa2", area: "#5ad1ff" };

/** Whether the picture is the reference, in which gauges are defined. @param {Gauges} my */
export const inReference = ({ screen }) => screen.map.now?.image === "reference";

/**
 * The layer of the gauges; returns what draws it, with the mouse's place while an end is missing.
 * @param {Gauges} my
 * @param {Line[]} kept
 */
export function drawing(my, kept) {
  const { screen, state } = my;
  const { view } = screen.map;
  const layer = svg("g", { class: "gauges" });
  view.svg.append(layer);
  view.svg.removeAttribute("aria-hidden");
  view.svg.setAttribute("role", "group");
  view.svg.setAttribute("aria-label", "Gauges drawn over the picture");
  /** @type {Drag | null} */
  let drag = null;
  const probe = screen.onpick;
  screen.onpick = (x, y, event) => {
    if (state.tool === "probe") return void probe(x, y, event);
    if (event.type !== "keydown" || !inReference(my)) return; // the mouse draws below
    if (!state.first) {
      state.first = [x, y];
      my.draw([x, y]);
      return;
    }
    const from = state.first;
    state.first = null;
    made(my, from, [x, y]);
  };
  const down = (/** @type {PointerEvent} */ event) => {
    if (state.tool === "probe" || event.button !== 0 || !inReference(my) || onGrab(event)) return;
    if (drag) {
      // a second finger: both move and zoom the picture, nothing is drawn
      view.hold(drag.id, drag.last);
      drag = null;
      return my.draw();
    }
    event.stopImmediatePropagation();
    event.preventDefault();
    view.frame.focus();
    view.frame.setPointerCapture(event.pointerId);
    const { x, y } = view.at(event);
    drag = { id: event.pointerId, from: [x, y], to: [x, y], at: [event.clientX, event.clientY], last: [event.clientX, event.clientY], moved: false };
  };
  view.frame.addEventListener("pointerdown", down, true);
  view.frame.addEventListener("pointermove", (event) => {
    const { x, y } = view.at(event);
    if (drag) {
      drag.to = [x, y];
      drag.last = [event.clientX, event.clientY];
      if (Math.hypot(event.clientX - drag.at[0], event.clientY - drag.at[1]) > 4) drag.moved = true;
      my.draw();
    } else if (state.first) my.draw([x, y]);
  });
  const up = (/** @type {PointerEvent} */ event) => {
    if (!drag) return;
    const done = drag;
    drag = null;
    if (event.type === "pointercancel") return my.draw();
    if (!done.moved) {
      // the first of two clicks
      if (!state.first) {
        state.first = done.from;
        return my.draw();
      }
      done.from = state.first;
    }
    state.first = null;
    made(my, done.from, done.to);
  };
  view.frame.addEventListener("pointerup", up);
  view.frame.addEventListener("pointercancel", up);
  view.frame.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !(drag || state.first) || view.aim) return;
    drag = null;
    state.first = null;
    my.draw();
  });
  const handle = handles(my);
  return (/** @type {Spot | null} */ mouse) => {
    const going = drag ? /** @type {const} */ ([drag.from, drag.to]) : state.first && mouse ? /** @type {const} */ ([state.first, mouse]) : null;
    replace(layer, inReference(my) ? parts(my, kept, handle, going) : []);
  };
}

/**
 * Gauges are inside the grid of points.
 * @param {Gauges} my
 * @param {readonly number[]} at
 * @returns {Spot}
 */
function within({ screen: { map } }, [x, y]) {
  if (!map.now) return [x, y];
  const { grid } = map.now;
  /** @type {(v: number, a: number, b: number) => number} */
  const clip = (v, a, b) => Math.round(10 * Math.min(Math.max(v, Math.min(a, b)), Math.max(a, b))) / 10;
  return [clip(x, grid.x0, grid.x0 + (grid.cols - 1) * grid.dx), clip(y, grid.y0, grid.y0 + (grid.rows - 1) * grid.dy)];
}

/**
 * A gauge of the tool was drawn.
 * @param {Gauges} my
 * @param {Spot} a
 * @param {Spot} b
 */
function made(my, a, b) {
  const { state } = my;
  const [from, to] = [within(my, a), within(my, b)];
  if (Math.hypot(from[0] - to[0], from[1] - to[1]) < 1) {
    my.draw();
    return;
  }
  if (state.tool === "line") state.line = [from, to];
  if (state.tool === "area") state.area = [Math.min(from[0], to[0]), Math.min(from[1], to[1]), Math.max(from[0], to[0]), Math.max(from[1], to[1])];
  if (state.tool === "extensometer") state.extensometers.push({ name: nextName(state), a: from, b: to });
  if (state.tool !== "probe") my.changed(state.tool);
}

/** @type {(colour: string, extra?: Attributes) => Attributes} */
const stroke = (colour, extra = {}) => ({ stroke: colour, fill: "none", "stroke-width": 2, "vector-effect": "non-scaling-stroke", ...extra });
/** @type {(d: string, colour: string) => SVGElement[]} */
const path = (d, colour) => [svg("path", { d, ...stroke("#000", { "stroke-width": 4, opacity: 0.6 }) }), svg("path", { d, ...stroke(colour) })];
const segment = (/** @type {Spot} */ a, /** @type {Spot} */ b) => `M${a[0]} ${a[1]}L${b[0]} ${b[1]}`;
const box = (/** @type {Four} */ [x0, y0, x1, y1]) => `M${x0} ${y0}H${x1}V${y1}H${x0}Z`;

/** @type {(ends: [Spot, Spot], name: string) => SVGElement} */
function label([a, b], name) {
  const style = { fontSize: "calc(13px * var(--px))", strokeWidth: "calc(3px * var(--px))" };
  const ink = { fill: "#fff", stroke: "#000", "stroke-width": 3, "paint-order": "stroke", style };
  return svg("text", { x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2, ...ink }, ` ${name}`);
}

/**
 * The drawn gauges, and the one that is being drawn.
 * @param {Gauges} my
 * @param {Line[]} kept
 * @param {ReturnType<typeof handles>} handle
 * @param {readonly [Spot, Spot] | null} going
 */
function parts({ state }, kept, handle, going) {
  const { area, line, tool } = state;
  const out = [];
  if (area) {
    const lower = (/** @type {number} */ x, /** @type {number} */ y) => area.splice(0, 2, Math.min(x, area[2] - 1), Math.min(y, area[3] - 1));
    const upper = (/** @type {number} */ x, /** @type {number} */ y) => area.splice(2, 2, Math.max(x, area[0] + 1), Math.max(y, area[1] + 1));
    out.push(...path(box(area), INK.area));
    out.push(handle("area", "Upper left corner of the area", [area[0], area[1]], lower));
    out.push(handle("area", "Lower right corner of the area", [area[2], area[3]], upper));
  }
  for (const { ends, name } of kept) {
    out.push(svg("path", { d: segment(...ends), ...stroke(INK.line, { "stroke-width": 1.5, "stroke-dasharray": "6 4" }) }), label(ends, name));
  }
  if (line) {
    out.push(...path(segment(...line), INK.line));
    for (const [k, end] of line.entries()) out.push(handle("line", `${k ? "End" : "Beginning"} of the line`, end, (x, y) => line.splice(k, 1, [x, y])));
  }
  for (const one of state.extensometers) {
    out.push(...path(segment(one.a, one.b), INK.extensometer));
    for (const k of /** @type {const} */ (["a", "b"])) {
      out.push(handle("extensometer", `End ${k} of extensometer ${one.name}`, one[k], (x, y) => Object.assign(one, { [k]: [x, y] })));
    }
    out.push(label([one.a, one.b], one.name));
  }
  if (going) out.push(...path(tool === "area" ? box([...going[0], ...going[1]]) : segment(...going), INK[tool]));
  else if (state.first) out.push(svg("circle", { cx: state.first[0], cy: state.first[1], fill: INK[tool], style: { r: "calc(5px * var(--px))" } }));
  return out;
}

/** Makes handles of a gauge's ends, for mouse and keyboard. @param {Gauges} my */
function handles(my) {
  const { view } = my.screen.map;
  /** @type {number | undefined} */
  let later;
  my.screen.ends.push(() => clearTimeout(later));
  /** @type {(tool: Kind, name: string, at: Spot, move: (x: number, y: number) => unknown) => SVGElement} */
  return (tool, name, at, move) => {
    const role = { class: "grab", tabindex: 0, role: "button", "data-handle": name, "aria-label": `${name}, at ${num(at[0], 5)}, ${num(at[1], 5)} px` };
    const ink = { fill: INK[tool], stroke: "#000", "stroke-width": 1, "vector-effect": "non-scaling-stroke", style: { r: "calc(6px * var(--px))" } };
    const grab = svg("circle", { ...role, cx: at[0], cy: at[1], ...ink });
    grab.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      grab.setPointerCapture(event.pointerId);
      const moving = (/** @type {PointerEvent} */ e) => {
        const { x, y } = view.at(e);
        const [u, v] = within(my, [x, y]);
        move(u, v);
        grab.setAttribute("cx", String(u));
        grab.setAttribute("cy", String(v));
      };
      const up = () => {
        grab.removeEventListener("pointermove", moving);
        my.changed(tool);
      };
      grab.addEventListener("pointermove", moving);
      grab.addEventListener("pointerup", up, { once: true });
    });
    grab.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey) return;
      const by = nudge(event);
      if (!by) return;
      event.preventDefault();
      event.stopPropagation();
      move(...within(my, [at[0] + by[0], at[1] + by[1]]));
      my.draw();
      clearTimeout(later); // read once the keys rest
      later = setTimeout(() => my.changed(tool), 300);
    });
    return grab;
  };
}
