// Drawings over the colours, on the map and in space: contour lines, displacement vectors, principal strains.
import { axesOf } from "../../widgets/triad.js";
import { isolines, levelsOf, trianglesOf } from "../../lib/isolines.js";
import { arrowScale, carriers, usualSpacing } from "../../lib/vectors.js";
import { arrowLegend } from "../../widgets/arrow_legend.js";
import { h, svg, select, number, tick, notify } from "../../lib/dom.js";
import { shown } from "../../lib/units.js";

/** @import { Grid } from "../../lib/point_grid.js" */
/** @import { FieldMap } from "../../widgets/field_map.js" */
/** @import { Axes } from "../../widgets/triad.js" */
/** @import { Viewer } from "../results.js" */
/** @import { Result } from "./analysis.js" */
/** @typedef {"none" | "displacement" | "principal"} Kind */
/** @typedef {{ i: number, to: [number, number, number], size: number, both: boolean, inward: boolean }} Arrow at point i; `to` has unit length, along the shown axes; `both`: of a strain, to both sides */
/** @typedef {{ kind: Kind, arrows: Arrow[], each: (room: number, plane?: boolean) => { each: number, legend: number }, every: number, unit: string }} Vectors */

const KINDS = [
  ["none", "none"],
  ["displacement", "displacement"],
  ["principal", "principal strains"],
];
const INK = { tension: "#ffffff", compression: "#ff9d1e" };

/** @param {Viewer} screen */
export function overlay(screen) {
  const { result, map, scale } = screen;
  const { view } = map;
  const lines = h("input", { type: "checkbox", "data-role": "contours" });
  const count = number(10, { min: 2, max: 50, step: 1, "aria-label": "Number of contour lines", style: "width:4.5em" });
  const kind = select(KINDS, "none", { "aria-label": "Vectors" });
  const every = number(null, { min: 1, max: 100, step: 1, "aria-label": "A vector every so many points", style: "width:4.5em" });
  const length = number(1, { min: 0.1, max: 20, step: "any", "aria-label": "Length of the vectors", style: "width:4.5em" });
  const note = h("span.quiet", { role: "status", "data-role": "overlay-note" });
  const root = h(
    "div.row.overlay",
    { role: "group", "aria-label": "Lines and vectors" },
    h("label.check", lines, "contour lines, about"),
    count,
    h("span", "Vectors"),
    kind,
    h("span", "every"),
    every,
    h("span", "points, length ×"),
    length,
    note,
  );
  const layer = svg("g", { class: "overlay", "aria-hidden": "true" });
  view.svg.prepend(layer);
  const legend = arrowLegend(view.frame);
  /** @type {Set<() => unknown>} */
  const changed = new Set();
  const within = (/** @type {HTMLInputElement} */ input, /** @type {number} */ usual) => {
    const v = Number(input.value);
    return input.value === "" || !Number.isFinite(v) ? usual : Math.min(Math.max(v, Number(input.min)), Number(input.max));
  };

  /** Levels of the contour lines that are asked for; null: none. */
  function levels() {
    return lines.checked && !scale.flags ? levelsOf(scale.low, scale.high, within(count, 10)) : null;
  }

  /**
   * Vectors of a step that are asked for; null: none, or the step has none.
   * @returns {Promise<Vectors | null>}
   */
  async function vectors() {
    const of = /** @type {Kind} */ (kind.value);
    if (of === "none" || !map.now) return null;
    const { grid, n } = map.now;
    const spacing = within(every, usualSpacing(grid));
    every.placeholder = String(usualSpacing(grid));
    const arrows = await arrowsOf(of, result, n, grid, spacing);
    if (!arrows.length) return null;
    // only the part in the picture's plane is drawn
    const sizes = (/** @type {boolean} */ plane) => arrows.map((one) => one.size * (plane ? Math.hypot(one.to[0], one.to[1]) : 1));
    return {
      kind: of,
      arrows,
      every: spacing,
      unit: of === "displacement" ? "mm" : "1",
      each: (room, plane = false) => arrowScale(sizes(plane), (of === "displacement" ? 0.9 : 0.45) * room, within(length, 1)),
    };
  }

  let asked = 0;
  async function draw() {
    asked += 1;
    const mine = asked;
    const found = await vectors();
    if (mine !== asked || !map.now) return;
    const { grid } = map.now;
    const at = levels();
    const contours = at ? contourLines(map, at.levels) : { d: "", pieces: 0 };
    const parts = at ? outlined(contours.d, "#fff", 1) : [];
    layer.dataset.lines = String(contours.pieces);
    layer.dataset.vectors = String(found?.arrows.length ?? 0);
    if (found) {
      const [x, y] = [0, 1].map((k) => Float64Array.from({ length: grid.x.length }, (_, i) => map.positionOf(i)[k]));
      const held = await Promise.all(["x_mm", "y_mm"].map((name) => result.array(map.now?.n ?? 0, name).then((one) => one.data)));
      if (mine !== asked) return;
      const axes = axesOf(x, y, held[0], held[1]);
      if (axes) {
        const { each, legend: round } = found.each(found.every * Math.abs(grid.dx), true);
        for (const [ink, d] of Object.entries(paths(found.arrows, axes, each, map))) if (d) parts.push(...outlined(d, ink, 1.2));
        legend.show(round * each, legendText(found, round), () => view.scale);
      }
    }
    if (!found) legend.hide();
    layer.replaceChildren(...parts);
    view.svg.prepend(layer);
    const texts = [];
    if (at?.levels.length) texts.push(`a line every ${amount(at.step, scale.unit)}`);
    if (kind.value !== "none" && !found) texts.push(kind.value === "displacement" ? "this step has no displacement" : "this step has no strain");
    if (found?.kind === "principal") texts.push("compression: orange");
    note.textContent = texts.join("; ");
  }
  async function tell() {
    await draw();
    for (const listener of changed) await listener();
  }
  for (const control of [lines, count, kind, every, length]) control.addEventListener("change", () => tell().catch(notify));
  view.root.addEventListener("viewchange", () => legend.again());
  screen.drawn.add(draw);
  return {
    root,
    levels,
    vectors,
    changed,
    /** Whether any are asked for. */ get on() {
      return lines.checked || kind.value !== "none";
    },
  };
}

/** @typedef {ReturnType<typeof overlay>} Overlay */

/**
 * Arrows of a step; empty if it has none.
 * @param {Kind} kind
 * @param {Result} result
 * @param {number} n
 * @param {Grid} grid
 * @param {number} spacing in points
 */
async function arrowsOf(kind, result, n, grid, spacing) {
  const { all } = await result.fields(n);
  const read = (/** @type {string[]} */ names) => Promise.all(names.map((name) => result.array(n, name).then((one) => one.data)));
  /** @type {Arrow[]} */
  const arrows = [];
  if (kind === "displacement" && all.has("u_mm")) {
    const [u, v, w] = await read(["u_mm", "v_mm", "w_mm"]);
    for (const i of carriers(grid, spacing, (k) => Number.isFinite(u[k]))) {
      const size = Math.hypot(u[i], v[i], w[i]);
      arrows.push({ i, to: size ? [u[i] / size, v[i] / size, w[i] / size] : [0, 0, 0], size, both: false, inward: false });
    }
  }
  if (kind === "principal" && all.has("strain_angle_rad")) {
    const [e1, e2, angle, nx, ny, nz] = await read(["e1", "e2", "strain_angle_rad", "normal_x", "normal_y", "normal_z"]);
    for (const i of carriers(grid, spacing, (k) => Number.isFinite(e1[k]) && Number.isFinite(angle[k]))) {
      const [one, two] = tangents([nx[i], ny[i], nz[i]]);
      const [c, s] = [Math.cos(angle[i]), Math.sin(angle[i])];
      arrows.push(
        { i, to: mixed(one, c, two, s), size: Math.abs(e1[i]), both: true, inward: e1[i] < 0 },
        { i, to: mixed(one, -s, two, c), size: Math.abs(e2[i]), both: true, inward: e2[i] < 0 },
      );
    }
  }
  return arrows;
}

/**
 * Contour lines over the picture, as a path.
 * @param {FieldMap} map
 * @param {number[]} levels
 */
function contourLines(map, levels) {
  const { grid, values } = /** @type {NonNullable<FieldMap["now"]>} */ (map.now);
  const usable = (/** @type {number} */ i) => grid.valid[i] && Number.isFinite(values[i]);
  const pieces = isolines(trianglesOf(grid, usable), values, levels);
  const spot = (/** @type {number} */ i, /** @type {number} */ j, /** @type {number} */ s) => {
    const [p, q] = [map.positionOf(i), map.positionOf(j)];
    return `${(p[0] + s * (q[0] - p[0])).toFixed(2)} ${(p[1] + s * (q[1] - p[1])).toFixed(2)}`;
  };
  return { d: pieces.map((one) => `M${spot(one.a, one.b, one.s)}L${spot(one.c, one.d, one.t)}`).join(""), pieces: pieces.length };
}

/**
 * Arrows over the picture, as a path of each ink.
 * @param {Arrow[]} arrows
 * @param {Axes} axes
 * @param {number} each length of a size of one
 * @param {FieldMap} map
 */
function paths(arrows, axes, each, map) {
  const d = { [INK.tension]: "", [INK.compression]: "" };
  for (const one of arrows) {
    const by = [0, 1].map((k) => (one.to[0] * axes.x[k] + one.to[1] * axes.y[k]) * one.size * each);
    const from = map.positionOf(one.i);
    const ink = one.inward ? INK.compression : INK.tension;
    d[ink] += arrow(from, by, one.inward);
    if (one.both)
      d[ink] += arrow(
        from,
        by.map((v) => -v),
        one.inward,
      );
  }
  return d;
}

/**
 * @param {number} value
 * @param {string} unit
 */
export function amount(value, unit) {
  const { factor, unit: name } = shown(unit, value);
  return `${tick(Number((value * factor).toPrecision(3)))}\u00a0${name}`;
}

/**
 * Meaning of the legend's arrow.
 * @param {Vectors} of
 * @param {number} round
 */
export function legendText(of, round) {
  return of.kind === "displacement" ? amount(round, "mm") : amount(1e6 * round, "µm/m");
}

/**
 * Axes 1 and 2 of the strain: X projected into the tangent plane (Y if the surface faces along X), and the direction at right angles to it.
 * @param {number[]} n normal of the surface
 * @returns {[number[], number[]]}
 */
export function tangents([x, y, z]) {
  if (!Number.isFinite(x))
    return [
      [1, 0, 0],
      [0, 1, 0],
    ];
  const axis = Math.abs(x) > 0.999 ? [0, 1, 0] : [1, 0, 0];
  const along = axis[0] * x + axis[1] * y;
  const laid = [axis[0] - along * x, axis[1] - along * y, -along * z];
  const one = laid.map((v) => v / Math.hypot(...laid));
  return [one, [y * one[2] - z * one[1], z * one[0] - x * one[2], x * one[1] - y * one[0]]];
}

/** @type {(a: number[], s: number, b: number[], t: number) => [number, number, number]} */
const mixed = (a, s, b, t) => [s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]];

/** @type {(d: string, ink: string, width: number) => SVGElement[]} */
const outlined = (d, ink, width) =>
  [
    ["#000", width + 1.2, 0.5],
    [ink, width, 1],
  ].map(([stroke, wide, opacity]) =>
    svg("path", { d, stroke, "stroke-width": wide, opacity, fill: "none", "vector-effect": "non-scaling-stroke", "stroke-linecap": "round" }),
  );

/**
 * Path of an arrow, its head included.
 * @param {[number, number]} from
 * @param {number[]} by
 * @param {boolean} inward true: the head is at its beginning
 */
function arrow([x, y], [dx, dy], inward) {
  if (!Number.isFinite(x) || !(Math.hypot(dx, dy) > 0)) return "";
  const f = (/** @type {number} */ v) => v.toFixed(2);
  const head = 0.28;
  const [tx, ty, s] = inward ? [x, y, -1] : [x + dx, y + dy, 1];
  const back = (/** @type {number} */ side) => `${f(tx - s * head * (dx + side * 0.5 * dy))} ${f(ty - s * head * (dy - side * 0.5 * dx))}`;
  return `M${f(x)} ${f(y)}L${f(x + dx)} ${f(y + dy)}M${back(1)}L${f(tx)} ${f(ty)}L${back(-1)}`;
}
