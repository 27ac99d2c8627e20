// Shapes of a region as numbers: the drawing, its corners, and its form for the API. Nothing of the screen.
//
// Everything is kept in camera 1's pixels, the first pixel's centre at (0, 0), to a tenth of a pixel.

/** @import { Model } from "#routes" */
/** @typedef {[x: number, y: number]} Spot */
/** @typedef {"rectangle" | "polygon" | "circle"} Form */
/** @typedef {{ form: Form, points: Spot[] }} Shape a rectangle by two opposite corners, a circle by its centre and a point on it */
/** @typedef {{ one: Spot, two: Spot | null }} Seed */
/**
 * The drawing: plain JSON, so that it can be kept and put back.
 * @typedef {{ outlines: Shape[], holes: Shape[], cracks: Spot[][], seeds: Seed[], mask: string | null }} State `mask`: a PNG in base64
 */

export const MIN_POINTS = { rectangle: 2, circle: 2, polygon: 3, crack: 2 };
const CHORD_PX = 0.02;

/** @returns {State} */
export const nothing = () => ({ outlines: [], holes: [], cracks: [], seeds: [], mask: null });

/** @param {number} value */
export const round = (value) => Math.round(value * 10) / 10;

/**
 * @param {readonly number[]} a
 * @param {readonly number[]} b
 */
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

/** @param {Shape} circle */
export const radius = (circle) => distance(circle.points[0], circle.points[1]);

/**
 * Corners of a shape; a circle's are so close that no chord is off by a fiftieth of a pixel.
 * @param {Shape} shape
 * @returns {Spot[]}
 */
export function corners(shape) {
  const [a, b] = shape.points;
  if (shape.form === "polygon") return shape.points;
  if (shape.form === "rectangle") return [a, [b[0], a[1]], b, [a[0], b[1]]];
  const r = radius(shape);
  const n = Math.min(Math.max(Math.ceil(Math.PI / Math.sqrt((2 * CHORD_PX) / Math.max(r, 1))), 12), 360);
  return Array.from({ length: n }, (_, k) => [a[0] + r * Math.cos((2 * Math.PI * k) / n), a[1] + r * Math.sin((2 * Math.PI * k) / n)]);
}

/**
 * The circle through three points, or null if they are on one line.
 * @param {Spot[]} points
 * @returns {Shape | null}
 */
export function throughThree([a, b, c]) {
  const [bx, by, cx, cy] = [b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]];
  const twice = 2 * (bx * cy - by * cx);
  if (Math.abs(twice) < 1e-3 * Math.max(Math.hypot(bx, by) * Math.hypot(cx, cy), 1)) return null;
  const [b2, c2] = [bx * bx + by * by, cx * cx + cy * cy];
  const centre = /** @type {Spot} */ ([a[0] + (cy * b2 - by * c2) / twice, a[1] + (bx * c2 - cx * b2) / twice]);
  const r = distance(centre, a);
  const middle = /** @type {Spot} */ (centre.map(round));
  return { form: "circle", points: [middle, [round(middle[0] + r), middle[1]]] };
}

/**
 * Box about shapes, [x0, y0, x1, y1]; null without any.
 * @param {readonly Shape[]} shapes
 */
export function box(shapes) {
  const all = shapes.flatMap(corners);
  if (!all.length) return null;
  const [xs, ys] = [all.map((p) => p[0]), all.map((p) => p[1])];
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

/**
 * A shape in the API's form.
 * @param {Shape} shape
 * @returns {Model<"Outline">}
 */
function outline(shape) {
  const [a, b] = shape.points;
  if (shape.form === "polygon") return { polygon: shape.points };
  if (shape.form === "circle") return { circle: [a[0], a[1], round(radius(shape))] };
  return { rectangle: [Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.max(a[0], b[0]), Math.max(a[1], b[1])] };
}

/**
 * A corner inside the image, as the API takes corners of holes.
 * @param {Spot[]} points
 * @param {{ width: number, height: number }} size
 */
const inImage = (points, { width, height }) =>
  points.map(([x, y]) => /** @type {Spot} */ ([Math.min(Math.max(x, 0), width - 1), Math.min(Math.max(y, 0), height - 1)]));

/**
 * The region as the API takes it; null if the drawing has no area for points.
 * @param {State} state
 * @param {{ width: number, height: number }} image camera 1's; without a size while it is on its way: nothing is cut at a border that is not known
 * @returns {Model<"Region"> | null}
 */
export function regionOf(state, image) {
  const size = image.width ? image : { width: Infinity, height: Infinity };
  const cuts = { holes: state.holes.map((hole) => inImage(corners(hole), size)), cracks: state.cracks };
  if (state.mask !== null) return { mask_png_base64: state.mask, ...cuts };
  // a circle that reaches over the image's border ends there
  const whole = (/** @type {Shape} */ shape) => {
    const [x0, y0, x1, y1] = box([shape]) ?? [0, 0, 0, 0];
    return x0 >= 0 && y0 >= 0 && x1 <= size.width - 1 && y1 <= size.height - 1;
  };
  const outlines = state.outlines.map((shape) => (whole(shape) ? outline(shape) : { polygon: inImage(corners(shape), size) }));
  if (!outlines.length) return null;
  const [only] = outlines;
  return outlines.length === 1 && !only.circle ? { ...only, ...cuts } : { outlines, ...cuts };
}

/**
 * Why a shape encloses nothing, or null.
 * @param {Shape} shape
 */
export function trouble(shape) {
  const [a, b] = shape.points;
  if (shape.points.length < MIN_POINTS[shape.form]) return `Write x, y between semicolons, at least ${MIN_POINTS[shape.form]} points.`;
  if (shape.form === "rectangle" && (Math.abs(a[0] - b[0]) < 2 || Math.abs(a[1] - b[1]) < 2)) return "A rectangle is 2 px wide and high, or more.";
  if (shape.form === "circle" && radius(shape) < 1) return "A circle's radius is 1 px or more.";
  return null;
}

/**
 * Points that numbers say: "x, y; x, y", of a circle "x, y; radius". Null if they say none.
 * @param {string} text
 * @param {Form | "crack" | "seed"} form
 * @returns {Spot[] | null}
 */
export function pointsFrom(text, form) {
  const read = text
    .split(";")
    .map((one) => one.trim())
    .filter(Boolean)
    .map((one) => one.split(/[\s,]+/).map(Number));
  if (!read.length || !read.flat().every(Number.isFinite)) return null;
  if (form === "circle") {
    const [centre, size] = read;
    return read.length === 2 && centre.length === 2 && size.length === 1
      ? [
          [centre[0], centre[1]],
          [round(centre[0] + size[0]), centre[1]],
        ]
      : null;
  }
  return read.every((p) => p.length === 2) ? /** @type {Spot[]} */ (read) : null;
}

/**
 * The same the other way.
 * @param {readonly Spot[]} points
 * @param {Form | "crack" | "seed"} form
 */
export const textOf = (points, form) =>
  form === "circle" ? `${points[0][0]}, ${points[0][1]}; ${round(distance(points[0], points[1]))}` : points.map((p) => `${p[0]}, ${p[1]}`).join("; ");
