// Shapes of a region and the virtual gauge: numbers alone. Run by `node --test`.
import assert from "node:assert/strict";
import { test } from "node:test";
import { box, corners, nothing, pointsFrom, radius, regionOf, textOf, throughThree, trouble } from "../../../server/static/widgets/region/shapes.js";
import { gaugePx, gaugeText } from "../../../server/static/widgets/region/gauge.js";

const SIZE = { width: 200, height: 160 };
const CIRCLE = {
  form: "circle",
  points: [
    [100, 80],
    [130, 80],
  ],
};

test("a circle through three points is the one that all three lie on", () => {
  const points = [
    [10 + 20 * Math.cos(0.3), 40 + 20 * Math.sin(0.3)],
    [10 + 20 * Math.cos(2), 40 + 20 * Math.sin(2)],
    [10 + 20 * Math.cos(4.4), 40 + 20 * Math.sin(4.4)],
  ];
  const found = throughThree(points);
  assert.deepEqual(found.points[0], [10, 40]);
  assert.ok(Math.abs(radius(found) - 20) < 0.06); // to a tenth of a pixel
  assert.equal(
    throughThree([
      [0, 0],
      [10, 10],
      [30, 30],
    ]),
    null,
  );
});

test("a circle's corners lie on it, and its area is the circle's to a thousandth", () => {
  const v = corners(CIRCLE);
  for (const [x, y] of v) assert.ok(Math.abs(Math.hypot(x - 100, y - 80) - 30) < 1e-9);
  const area = v.reduce((sum, [x, y], k) => {
    const [u, w] = v[(k + 1) % v.length];
    return sum + (x * w - u * y) / 2;
  }, 0);
  assert.ok(Math.abs(area / (Math.PI * 900) - 1) < 1e-3);
});

test("what the API is sent is the simplest form that says it", () => {
  const rectangle = {
    form: "rectangle",
    points: [
      [90, 70],
      [20, 10],
    ],
  };
  assert.equal(regionOf(nothing(), SIZE), null);
  assert.deepEqual(regionOf({ ...nothing(), outlines: [rectangle] }, SIZE), { rectangle: [20, 10, 90, 70], holes: [], cracks: [] });
  assert.deepEqual(regionOf({ ...nothing(), outlines: [CIRCLE] }, SIZE).outlines, [{ circle: [100, 80, 30] }]);
  assert.deepEqual(regionOf({ ...nothing(), outlines: [CIRCLE, rectangle] }, SIZE).outlines, [{ circle: [100, 80, 30] }, { rectangle: [20, 10, 90, 70] }]);
  const masked = regionOf({ ...nothing(), mask: "AAAA", holes: [CIRCLE] }, SIZE);
  assert.equal(masked.mask_png_base64, "AAAA");
  assert.deepEqual(masked.holes[0], corners(CIRCLE));
  assert.ok(!("rectangle" in masked) && !("outlines" in masked));
});

test("a hole that reaches over the image's border ends there", () => {
  const [hole] = regionOf(
    {
      ...nothing(),
      mask: "A",
      holes: [
        {
          form: "circle",
          points: [
            [5, 5],
            [15, 5],
          ],
        },
      ],
    },
    SIZE,
  ).holes;
  assert.ok(hole.every(([x, y]) => x >= 0 && y >= 0));
});

test("nothing is cut at the border of an image that is still on its way", () => {
  const rectangle = {
    form: "rectangle",
    points: [
      [20, 10],
      [90, 70],
    ],
  };
  assert.deepEqual(regionOf({ ...nothing(), outlines: [rectangle] }, { width: 0, height: 0 }), { rectangle: [20, 10, 90, 70], holes: [], cracks: [] });
});

test("numbers are read as they are written", () => {
  for (const shape of [
    CIRCLE,
    {
      form: "polygon",
      points: [
        [1, 2],
        [30.5, 4],
        [5, 60],
      ],
    },
  ])
    assert.deepEqual(pointsFrom(textOf(shape.points, shape.form), shape.form), shape.points);
  assert.equal(textOf(CIRCLE.points, "circle"), "100, 80; 30");
  for (const [text, form] of [
    ["", "polygon"],
    ["1, 2, 3", "polygon"],
    ["a, b", "crack"],
    ["1, 2; 3, 4", "circle"],
    ["1, 2", "circle"],
  ])
    assert.equal(pointsFrom(text, form), null);
  assert.match(
    trouble({
      form: "circle",
      points: [
        [5, 5],
        [5, 5],
      ],
    }),
    /radius/,
  );
  assert.match(
    trouble({
      form: "rectangle",
      points: [
        [5, 5],
        [6, 50],
      ],
    }),
    /2 px/,
  );
  assert.equal(trouble(CIRCLE), null);
});

test("the box about shapes holds all of them", () => {
  assert.deepEqual(
    box([
      {
        form: "rectangle",
        points: [
          [90, 70],
          [20, 10],
        ],
      },
    ]),
    [20, 10, 90, 70],
  );
  assert.equal(box([]), null);
});

test("the gauge is told in px and mm, with a warning where it takes more than half the region", () => {
  assert.equal(gaugePx(9, 10, 33), 113);
  assert.equal(gaugeText(113, 0.02, 300).text, "Virtual strain gauge: 113.0 px = 2.26 mm wide.");
  assert.equal(gaugeText(113, 0.02, 300).warning, "");
  assert.equal(gaugeText(113, null, null).text, "Virtual strain gauge: 113.0 px wide.");
  assert.match(gaugeText(113, 0.02, 200).warning, /wider than half of the region, which is 200\.0 px = 4\.00 mm/);
  assert.match(gaugeText(113, null, 100).warning, /wider than the region/);
  assert.equal(gaugeText(Number.NaN, 0.02, 100).text, "");
});
