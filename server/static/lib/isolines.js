// Triangles over the grid of points, and lines of equal value on them: neither over a missing point nor across a cut.
import { round125 } from "./even.js";

/** @import { Grid } from "./point_grid.js" */
/** @typedef {{ level: number, a: number, b: number, s: number, c: number, d: number, t: number }} Piece of a line: from the share s of the way from point a to b, to the share t from c to d */

/**
 * Triangles of points, row by row: two a cell, one where a corner is missing.
 * @param {Grid} grid
 * @param {(i: number) => unknown} whole whether a point may be a corner
 * @param {(cell: number, corners: number[], good: boolean[]) => void} [onCell] called for each cell that has a triangle
 * @returns {number[]} three numbers of points each
 */
export function trianglesOf(grid, whole, onCell) {
  /** @type {number[]} */
  const out = [];
  for (let r = 0; r < grid.rows - 1; r += 1) {
    for (let c = 0; c < grid.cols - 1; c += 1) {
      const cell = r * grid.cols + c;
      const corners = grid.corners(cell);
      const [p, q, s, t] = corners;
      const good = corners.map((i) => Boolean(whole(i)));
      const number = good.filter(Boolean).length;
      const each =
        number === 4
          ? [
              [p, s, q],
              [q, s, t],
            ]
          : number === 3
            ? [[p, s, t, q].filter((_, k) => good[[0, 2, 3, 1][k]])]
            : [];
      for (const three of each) if (grid.whole(cell, three)) out.push(...three);
      if (each.length) onCell?.(cell, corners, good);
    }
  }
  return out;
}

/**
 * Levels of about `count` lines between two limits, at even and round values.
 * @param {number} low
 * @param {number} high
 * @param {number} count
 */
export function levelsOf(low, high, count) {
  if (!(high > low) || !(count >= 1)) return { step: NaN, levels: [] };
  const step = round125((1.5 * (high - low)) / count);
  const levels = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step && levels.length < 200; k += 1) levels.push(Number((k * step).toPrecision(12)));
  return { step, levels };
}

/**
 * Pieces of the lines of equal value.
 * @param {readonly number[]} triangles three numbers of points each
 * @param {ArrayLike<number>} values
 * @param {readonly number[]} levels in rising order
 */
export function isolines(triangles, values, levels) {
  /** @type {Piece[]} */
  const out = [];
  for (let k = 0; k < triangles.length; k += 3) {
    const three = [triangles[k], triangles[k + 1], triangles[k + 2]];
    const v = three.map((i) => values[i]);
    const [min, max] = [Math.min(...v), Math.max(...v)];
    if (!(max > min)) continue; // flat, or a value is missing
    for (const level of levels) {
      if (level < min || level > max) continue;
      const crossed = [];
      for (let e = 0; e < 3; e += 1) {
        const [i, j] = [e, (e + 1) % 3];
        if (v[i] < level !== v[j] < level) crossed.push([three[i], three[j], (level - v[i]) / (v[j] - v[i])]);
      }
      if (crossed.length !== 2) continue;
      const [[a, b, s], [c, d, t]] = crossed;
      out.push({ level, a, b, s, c, d, t });
    }
  }
  return out;
}
