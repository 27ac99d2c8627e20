// The axes of the numbers, drawn in a corner of the picture.
import { svg } from "../lib/dom.js";

/** @typedef {{ x: [number, number], y: [number, number], towards: boolean }} Axes directions of X and Y in the picture, of length 1 at most; Z points towards the camera or away from it */

const LONG = 30;
const MIDDLE = 44;

/**
 * Directions of X and Y in the picture, from the points' positions.
 * @param {ArrayLike<number>} px columns of the points
 * @param {ArrayLike<number>} py their rows
 * @param {ArrayLike<number>} x their X, mm; NaN for missing points
 * @param {ArrayLike<number>} y
 * @returns {Axes | null} null if there are too few points
 */
export function axesOf(px, py, x, y) {
  let [n, mx, my, mu, mv] = [0, 0, 0, 0, 0];
  for (let i = 0; i < px.length; i += 1) {
    if (!Number.isFinite(x[i])) continue;
    n += 1;
    mx += px[i];
    my += py[i];
    mu += x[i];
    mv += y[i];
  }
  if (n < 3) return null;
  mx /= n;
  my /= n;
  mu /= n;
  mv /= n;
  let [uu, uv, vv, ux, uy, vx, vy] = [0, 0, 0, 0, 0, 0, 0];
  for (let i = 0; i < px.length; i += 1) {
    // pixels as a straight function of millimetres
    if (!Number.isFinite(x[i])) continue;
    const [u, v, a, b] = [x[i] - mu, y[i] - mv, px[i] - mx, py[i] - my];
    uu += u * u;
    uv += u * v;
    vv += v * v;
    ux += u * a;
    uy += u * b;
    vx += v * a;
    vy += v * b;
  }
  const det = uu * vv - uv * uv;
  if (!(det > 1e-12 * uu * vv)) return null;
  const alongX = [(vv * ux - uv * vx) / det, (vv * uy - uv * vy) / det];
  const alongY = [(uu * vx - uv * ux) / det, (uu * vy - uv * uy) / det];
  const longest = Math.max(Math.hypot(alongX[0], alongX[1]), Math.hypot(alongY[0], alongY[1]));
  return {
    x: [alongX[0] / longest, alongX[1] / longest],
    y: [alongY[0] / longest, alongY[1] / longest],
    towards: alongX[0] * alongY[1] - alongX[1] * alongY[0] < 0,
  };
}

const INKS = ["#ff8f7a", "#7be08f", "#6db3ff"];

/**
 * An axis from the middle to its tip, with its name.
 * @param {number[]} to of unit length
 * @param {number[]} head
 * @param {number[]} at place of the name, from the middle
 * @param {number} k
 */
function arrow([x, y], [ex, ey], at, k) {
  const [tx, ty] = [MIDDLE + LONG * x, MIDDLE + LONG * y];
  const d = `M${MIDDLE} ${MIDDLE}L${tx} ${ty}M${tx - ex - ey / 2} ${ty - ey + ex / 2}L${tx} ${ty}L${tx - ex + ey / 2} ${ty - ey - ex / 2}`;
  const font = { "text-anchor": "middle", "dominant-baseline": "central", "font-size": 12, "font-weight": 600 };
  const name = svg("text", { x: MIDDLE + at[0], y: MIDDLE + at[1], fill: INKS[k], ...font }, "XYZ"[k]);
  return [svg("path", { d, stroke: INKS[k], "stroke-width": 2, fill: "none" }), name];
}

/**
 * Put the drawing into a corner of a picture's frame; an earlier one is removed.
 * @param {HTMLElement} frame
 * @param {number[][]} directions
 * @param {string} label
 * @param {SVGElement[]} parts
 */
function put(frame, directions, label, parts) {
  frame.querySelector(".triad")?.remove();
  const data = Object.fromEntries(directions.map((d, k) => [`data-${"xyz"[k]}`, d.map((v) => v.toFixed(3)).join(" ")]));
  const size = { viewBox: "0 0 88 88", width: 88, height: 88 };
  const ground = svg("circle", { cx: MIDDLE, cy: MIDDLE, r: 43, fill: "#0b0d0ebb" });
  frame.append(svg("svg", { class: "triad", ...size, role: "img", ...data, "aria-label": label }, ground, parts));
}

/**
 * Draw the axes into a corner of a picture's frame; an earlier drawing goes.
 * @param {HTMLElement} frame
 * @param {Axes | null} axes
 * @param {string} text which axes they are
 */
export function drawTriad(frame, axes, text) {
  if (!axes) {
    frame.querySelector(".triad")?.remove();
    return;
  }
  const arrows = [axes.x, axes.y].flatMap(([x, y], k) => {
    const size = Math.hypot(x, y) || 1;
    return arrow([x, y], [(6 * x) / size, (6 * y) / size], [LONG * x + (9 * x) / size, LONG * y + (9 * y) / size], k);
  });
  const [middle, ink] = [{ cx: MIDDLE, cy: MIDDLE }, INKS[2]];
  const z = axes.towards
    ? svg("circle", { ...middle, r: 2, fill: ink })
    : svg("path", { d: `M${MIDDLE - 3.5} ${MIDDLE - 3.5}l7 7m0 -7l-7 7`, stroke: ink, "stroke-width": 1.5 });
  const name = svg("text", { x: MIDDLE - 12, y: MIDDLE + 13, fill: ink, "text-anchor": "middle", "font-size": 11 }, "Z");
  const label = `Axes of the numbers, ${text}: X and Y as drawn, Z ${axes.towards ? "towards the camera" : "away from the camera"}`;
  put(frame, [axes.x, axes.y], label, [...arrows, svg("circle", { ...middle, r: 5.5, fill: "none", stroke: ink, "stroke-width": 1.5 }), z, name]);
}

/**
 * Draw the three axes as a view in space shows them; an earlier drawing is removed.
 * @param {HTMLElement} frame
 * @param {number[][]} directions of X, Y and Z: to the right, downwards, towards who looks
 * @param {string} text which axes they are
 */
export function drawTriad3(frame, directions, text) {
  const each = directions.map(([x, y, z], k) => ({ x, y, z, k })).sort((a, b) => a.z - b.z); // the nearest is drawn last
  const parts = each.flatMap(({ x, y, k }) => {
    const size = Math.hypot(x, y);
    const head = size > 0.15 ? [(5 * x) / size, (5 * y) / size] : [0, 0]; // no head on an axis that points at who looks
    return arrow([x, y], head, [(LONG + 8) * x, (LONG + 8) * y], k);
  });
  put(frame, directions, `Axes of the numbers, ${text}: X, Y and Z in this view`, parts);
}
