// Contour lines and vectors against figures worked out by hand.
import assert from "node:assert/strict";
import { test } from "node:test";
import { marks, round125 } from "../../../server/static/lib/even.js";
import { isolines, levelsOf, trianglesOf } from "../../../server/static/lib/isolines.js";
import { Grid } from "../../../server/static/lib/point_grid.js";
import { arrowScale, carriers } from "../../../server/static/lib/vectors.js";

/** A grid with 10 px between its points, cut along `cuts`. */
function grid(rows, cols, { missing = [], cuts = [] } = {}) {
  const each = Array.from({ length: rows * cols }, (_, i) => i);
  return new Grid({
    rows,
    cols,
    x: each.map((i) => 10 * (i % cols)),
    y: each.map((i) => 10 * Math.floor(i / cols)),
    status: each.map((i) => (missing.includes(i) ? 6 : 0)),
    cuts,
  });
}
const ends = (of, { a, b, s, c, d, t }) =>
  [
    [a, b, s],
    [c, d, t],
  ].map(([i, j, share]) => [of.x[i] + share * (of.x[j] - of.x[i]), of.y[i] + share * (of.y[j] - of.y[i])]);

test("a contour of a plane lies where the plane has its value", () => {
  const of = grid(4, 5);
  const plane = Float64Array.from(of.x, (x, i) => 2 * x + 3 * of.y[i]);
  const lines = isolines(
    trianglesOf(of, (i) => of.valid[i]),
    plane,
    [37],
  );
  assert.ok(lines.length > 0);
  for (const line of lines) for (const [x, y] of ends(of, line)) assert.ok(Math.abs(2 * x + 3 * y - 37) < 1e-9);
});

test("no contour crosses a cut or reaches over a missing point", () => {
  const of = grid(3, 4, { missing: [11], cuts: [[15, -5, 15, 25]] });
  const values = Float64Array.from(of.y);
  const lines = isolines(
    trianglesOf(of, (i) => of.valid[i]),
    values,
    [5, 15],
  );
  for (const line of lines) {
    const [[x0], [x1]] = ends(of, line);
    assert.ok(!(Math.min(x0, x1) < 15 && Math.max(x0, x1) > 15), `${x0} ${x1}`);
  }
  // right of the cut one cell has lost its corner: its triangle alone is left at the lower level
  const last = lines
    .filter((one) => one.level === 15)
    .flatMap((one) => ends(of, one))
    .map(([x]) => x);
  assert.equal(Math.max(...last), 25);
});

test("levels are round, even, and within the limits", () => {
  assert.deepEqual(levelsOf(-0.0234, 0.041, 10), {
    step: 0.005,
    levels: [-0.02, -0.015, -0.01, -0.005, 0, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.035, 0.04],
  });
  assert.deepEqual(levelsOf(1, 1, 10).levels, []);
  assert.deepEqual(marks(0, 10), [0, 2, 4, 6, 8, 10]);
  assert.deepEqual([0.0999, 0.1, 7, 1000].map(round125), [0.05, 0.1, 5, 1000]);
});

test("arrows stand on each n-th point that has a value, evenly from both borders", () => {
  const of = grid(5, 6, { missing: [8] });
  assert.deepEqual(
    carriers(of, 2, (i) => i !== 10),
    [0, 2, 4, 12, 14, 16, 24, 26, 28],
  );
  assert.deepEqual(
    carriers(of, 4, () => true),
    [0, 4, 24, 28],
  );
  assert.deepEqual(
    carriers(of, 3, () => true),
    [1, 4, 19, 22],
  );
});

test("the legend's arrow has the length that its figure says", () => {
  const { each, legend } = arrowScale([0.001, 0.0024, 0.0025, Number.NaN], 40, 1.5);
  assert.equal(legend, 0.002);
  assert.ok(Math.abs(each - (1.5 * 40) / 0.0024) < 1e-9);
  assert.deepEqual(arrowScale([0, Number.NaN], 40, 1), { each: 0, legend: 0 });
});
