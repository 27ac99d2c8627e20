// The surface's shape as it is shown: displacement and depth magnified, in a box with axes.
import { tick } from "../../../lib/dom.js";
import { marks, round125 } from "../../../lib/even.js";
import { trianglesOf } from "../../../lib/isolines.js";

/** @import { Grid } from "../../../lib/point_grid.js" */
/** @typedef {[number, number, number]} Triple */
/** @typedef {ArrayLike<number>[]} Each of three coordinates, a number a point */
/** @typedef {{ n: number, grid: Grid, position: Each, motion: Each | null }} Measured a step's points */
/** @typedef {NonNullable<ReturnType<typeof extentOf>>} Extent */
/** @typedef {ReturnType<typeof shapeOf>} Shape `at`: positions from the origin; `lines`: pairs of neighbours in the grid */

export const MAX_TIMES = 1000;

/**
 * Box of the measured shape, and the usual magnification of its displacement; null if no point is valid.
 * @param {Measured} of
 */
export function extentOf({ grid, position, motion }) {
  let largest = 0;
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < grid.x.length; i += 1) {
    if (!grid.valid[i]) continue;
    for (let k = 0; k < 3; k += 1) {
      if (position[k][i] < low[k]) low[k] = position[k][i];
      if (position[k][i] > high[k]) high[k] = position[k][i];
    }
    if (motion) largest = Math.max(largest, Math.hypot(motion[0][i], motion[1][i], motion[2][i]));
  }
  if (!(high[0] >= low[0])) return null;
  const size = Math.hypot(...[0, 1, 2].map((k) => high[k] - low[k])) || 1;
  const usual = largest > 0 ? Math.min(Math.max(round125((0.12 * size) / largest), 1), MAX_TIMES) : 1;
  return { low, high, size, usual };
}

/**
 * Triangles over cells whose corners all have a position: never over a missing point or a cut.
 * @param {Measured} of
 * @param {Extent} extent
 * @param {number} times magnification of the displacement
 * @param {number} deep magnification of the depth
 */
export function shapeOf({ grid, position, motion }, { low, high, size }, times, deep) {
  const middle = (low[2] + high[2]) / 2;
  const at = new Float32Array(3 * grid.x.length);
  /** @type {[number, number][]} */
  const span = [0, 1, 2].map(() => [Infinity, -Infinity]);
  const origin = [0, 1, 2].map((k) => (low[k] + high[k]) / 2);
  for (let i = 0; i < grid.x.length; i += 1) {
    if (!grid.valid[i]) continue;
    for (let k = 0; k < 3; k += 1) {
      let v = position[k][i];
      if (k === 2) v = middle + deep * (v - middle);
      if (motion) v += times * motion[k][i];
      if (Number.isFinite(v)) {
        span[k][0] = Math.min(span[k][0], v);
        span[k][1] = Math.max(span[k][1], v);
      }
      at[3 * i + k] = v - origin[k];
    }
  }
  /** @type {number[]} */
  const lines = [];
  const whole = (/** @type {number} */ i) => grid.valid[i] && Number.isFinite(at[3 * i]) && (!motion || Number.isFinite(motion[0][i]));
  const triangles = trianglesOf(grid, whole, (cell, [p, q, s], good) => {
    if (good[0] && good[1] && !grid.parted(cell, p, q)) lines.push(p, q);
    if (good[0] && good[2] && !grid.parted(cell, p, s)) lines.push(p, s);
  });
  // a flat surface needs a box of some depth
  for (const one of span)
    if (one[1] - one[0] < 0.02 * size) {
      const m = (one[0] + one[1]) / 2;
      one[0] = m - 0.01 * size;
      one[1] = m + 0.01 * size;
    }
  return { at, span, origin, size, times, deep, triangles, lines };
}

/**
 * Edges of the box with the marks of its axes, and the texts at them.
 * @param {Shape} shape
 */
export function axesOf({ span, origin, size, times, deep }) {
  /** @type {number[]} */
  const edges = [];
  const corner = (/** @type {number} */ i, /** @type {number} */ j, /** @type {number} */ k) => [
    span[0][i] - origin[0],
    span[1][j] - origin[1],
    span[2][k] - origin[2],
  ];
  const edge = (/** @type {number[]} */ a, /** @type {number[]} */ b) => edges.push(...a, ...b);
  for (const j of [0, 1])
    for (const k of [0, 1]) {
      edge(corner(0, j, k), corner(1, j, k));
      edge(corner(j, 0, k), corner(j, 1, k));
      edge(corner(j, k, 0), corner(j, k, 1));
    }
  const long = 0.015 * size;
  /** @type {(axis: number, value: number, from: number[]) => number[]} */
  const on = (axis, value, from) => from.map((x, k) => (k === axis ? value - origin[axis] : x));
  /** @type {(from: number[], out: Triple, by: number) => number[]} */
  const off = (from, out, by) => from.map((x, k) => x + by * out[k] * long);
  const magnified = times > 1 || deep !== 1;
  /** @type {{ at: number[], text: string }[]} */
  const ticks = [];
  // X along the lower edge of the picture, Y along the left one, Z along the far left corner; Y_sys points down in it
  /** @type {{ from: number[], out: Triple, away: Triple, name: string }[]} */
  const axes = [
    { from: corner(0, 1, 0), out: [0, 1, 0], away: [0, 1, 0], name: "X (mm)" },
    { from: corner(0, 0, 0), out: [-1, 0, 0], away: [-1, 0, 0], name: "Y (mm)" },
    { from: corner(1, 1, 0), out: [1, 0, 0], away: [0.6, 0, 0], name: magnified ? "Z (magnified)" : "Z (mm)" },
  ];
  for (const [axis, { from, out }] of axes.entries()) {
    const most = Math.max(2, Math.min(5, Math.round((6 * (span[axis][1] - span[axis][0])) / size)));
    for (const value of axis === 2 && magnified ? [] : marks(...span[axis], most)) {
      const a = on(axis, value, from);
      edge(a, off(a, out, 1));
      ticks.push({ at: off(a, out, 3), text: tick(value) });
    }
  }
  for (const [axis, { from, away, name }] of axes.entries()) ticks.push({ at: off(on(axis, (span[axis][0] + span[axis][1]) / 2, from), away, 7), text: name });
  return { edges, ticks };
}
