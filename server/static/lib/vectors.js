// Vectors on the points: the choice of the drawn ones, their lengths, and the meaning of the legend's arrow.
import { round125 } from "./even.js";

/** @import { Grid } from "./point_grid.js" */

/**
 * Every so many points that some fifteen are along the longer side of the grid.
 * @param {Grid} grid
 */
export const usualSpacing = (grid) => Math.max(1, Math.round(Math.max(grid.rows, grid.cols) / 15));

/**
 * Points that carry an arrow: each `every`-th row and column, those without a value left out.
 * @param {Grid} grid
 * @param {number} every
 * @param {(i: number) => boolean} known
 */
export function carriers(grid, every, known) {
  const step = Math.max(1, Math.round(every) || 1);
  const out = [];
  const from = (/** @type {number} */ count) => Math.floor(((count - 1) % step) / 2); // the same margin on both sides
  for (let r = from(grid.rows); r < grid.rows; r += step) {
    for (let c = from(grid.cols); c < grid.cols; c += step) {
      const i = r * grid.cols + c;
      if (grid.valid[i] && known(i)) out.push(i);
    }
  }
  return out;
}

/**
 * Length of an arrow for each unit of its vector, and a round vector for the legend.
 * @param {readonly number[]} sizes of the vectors
 * @param {number} room between two arrows, in the unit of the drawing
 * @param {number} factor asked for
 */
export function arrowScale(sizes, room, factor) {
  const sorted = sizes.filter((v) => Number.isFinite(v) && v > 0).toSorted((a, b) => a - b);
  const typical = sorted[Math.floor(0.95 * (sorted.length - 1))] ?? 0;
  if (!(typical > 0)) return { each: 0, legend: 0 };
  return { each: (factor * room) / typical, legend: round125(typical) };
}
