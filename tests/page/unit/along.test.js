// Positions and values along lines, against figures worked out by hand.
import assert from "node:assert/strict";
import { test } from "node:test";
import { distanceMm, resampled } from "../../../server/static/lib/along.js";

test("the distance runs along the surface, and is unknown beyond a missing point", () => {
  assert.deepEqual(
    distanceMm([
      [0, 3, 3],
      [0, 4, 4],
      [0, 0, 12],
    ]),
    [0, 5, 17],
  );
  assert.equal(
    distanceMm([
      [0, null, 3],
      [0, 4, 4],
      [0, 0, 12],
    ]),
    null,
  );
});

test("values between two positions lie on a straight line, and none is invented", () => {
  assert.deepEqual(resampled([0, 2, 4, 6], [0, 10, null, 30], [0, 1, 2, 3, 4, 5, 6, 7]), [0, 5, 10, null, null, null, 30, null]);
  assert.deepEqual(resampled([1, 3], [5, 7], [0, 1, 2, 3]), [null, 5, 6, 7]);
});
