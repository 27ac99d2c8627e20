// Even parts of a list, against parts chosen by hand.
import assert from "node:assert/strict";
import { test } from "node:test";
import { spread } from "../../../server/static/lib/even.js";

test("a long list is thinned evenly, with its ends; a short one is whole", () => {
  const steps = Array.from({ length: 101 }, (_, k) => 10 * k);
  assert.deepEqual(spread(steps, 5), [0, 250, 500, 750, 1000]);
  assert.deepEqual(spread([3, 4, 9], 5), [3, 4, 9]);
  const many = spread(
    Array.from({ length: 5000 }, (_, k) => k),
    300,
  );
  assert.equal(new Set(many).size, 300);
  assert.deepEqual([many[0], many[299]], [0, 4999]);
  const gaps = many.slice(1).map((n, k) => n - many[k]);
  assert.deepEqual([Math.min(...gaps), Math.max(...gaps)], [16, 17]);
});
