// The axes of the numbers, drawn in a corner of the picture.
import { svg } from "../lib/dom.js";

/** @typedef {{ x: [number, number], y: [number, number], towards: boolean }} Axes directions of X and Y in the picture, of length 1 at most; Z points towards the camera or away from it */

const LONG = 30;
const MIDDLE = 44;

/**
 * Directions of X and Y in the picture, from the points' positions.
 * @param {ArrayLike<number>} px columns of the points
 * @param {ArrayLike<number>} py their rows
 * @param {ArrayLike<number>} x their X, mm; NaN where there is none
 * @param {ArrayLike<number>} y
 * @returns {Axes | null} null where too few points tell
 */
export function axesOf(px, py, x, y) {
  let [n, mx, my, mu, mv] = [0, 0, 0, 0, 0];
  for (let i = 0; i < px.length; i += 1) {
    if (!Number.isFinite(x[i])) continue;
    n += 1; mx += px[i]; my += py[i]; mu += x[i]; mv += y[i];
  }
  if (n < 3) return null;
  mx /= n; my /= n; mu /= n; mv /= n;
  let [uu, uv, vv, ux, uy, vx, vy] = [0, 0, 0, 0, 0, 0, 0];
  for (let i = 0; i < px.length; i += 1) { // pixels as a straight function of millimetres
    if (!Number.isFinite(x[i])) continue;
    const [u, v, a, b] = [x[i] - mu, y[i] - mv, px[i] - mx, py[i] - my];
    uu += u * u; uv += u * v; vv += v * v; ux += u * a; uy += u * b; vx += v * a; vy += v * b;
  }
  const det = uu * vv - uv * uv;
  if (!(det > 1e-12 * uu * vv)) return null;
  const alongX = [(vv * ux - uv * vx) / det, (vv * uy - uv * vy) / det];
  const alongY = [(uu * vx - uv * ux) / det, (uu * vy - uv * uy) / det];
  const longest = Math.max(Math.hypot(alongX[0], alongX[1]), Math.hypot(alongY[0], alongY[1]));
  return { x: [alongX[0] / longest, alongX[1] / longest], y: [alongY[0] / longest, alongY[1] / longest], towards: alongX[0] * alongY[1] - alongX[1] * alongY[0] < 0 };
}

/**
 * Draw the axes into a corner of a picture's frame; an earlier drawing goes.
 * @param {HTMLElement} frame
 * @param {Axes | null} axes
 * @param {string} text which axes they are
 */
export function drawTriad(frame, axes, text) {
  frame.querySelector(".triad")?.remove();
  if (!axes) return;
  /** @type {(to: [number, number], name: string, colour: string) => SVGElement[]} */
  const arrow = ([dx, dy], name, colour) => {
    const [tx, ty] = [MIDDLE + LONG * dx, MIDDLE + LONG * dy];
    const size = Math.hypot(dx, dy) || 1;
    const [ex, ey] = [(6 * dx) / size, (6 * dy) / size];
    return [svg("path", { d: `M${MIDDLE} ${MIDDLE}L${tx} ${ty}M${tx - ex - ey / 2} ${ty - ey + ex / 2}L${tx} ${ty}L${tx - ex + ey / 2} ${ty - ey - ex / 2}`, stroke: colour, "stroke-width": 2, fill: "none" }),
      Object.assign(svg("text", { x: tx + (9 * dx) / size, y: ty + (9 * dy) / size, fill: colour, "text-anchor": "middle", "dominant-baseline": "central", "font-size": 12, "font-weight": 600 }), { textContent: name })];
  };
  const z = axes.towards ? svg("circle", { cx: MIDDLE, cy: MIDDLE, r: 2, fill: "#6db3ff" }) : svg("path", { d: `M${MIDDLE - 3.5} ${MIDDLE - 3.5}l7 7m0 -7l-7 7`, stroke: "#6db3ff", "stroke-width": 1.5 });
  frame.append(svg("svg", { class: "triad", viewBox: "0 0 88 88", width: 88, height: 88, role: "img", "data-x": axes.x.map((v) => v.toFixed(3)).join(" "), "data-y": axes.y.map((v) => v.toFixed(3)).join(" "),
    "aria-label": `Axes of the numbers, ${text}: X and Y as drawn, Z ${axes.towards ? "towards the camera" : "away from the camera"}` },
  svg("circle", { cx: MIDDLE, cy: MIDDLE, r: 43, fill: "#0b0d0ebb" }), ...arrow(axes.x, "X", "#ff8f7a"), ...arrow(axes.y, "Y", "#7be08f"),
  svg("circle", { cx: MIDDLE, cy: MIDDLE, r: 5.5, fill: "none", stroke: "#6db3ff", "stroke-width": 1.5 }), z,
  Object.assign(svg("text", { x: MIDDLE - 12, y: MIDDLE + 13, fill: "#6db3ff", "text-anchor": "middle", "font-size": 11 }), { textContent: "Z" })));
}

const INKS = ["#ff8f7a", "#7be08f", "#6db3ff"];

/**
 * Draw the three axes as they stand in a view in space; an earlier drawing goes.
 * @param {HTMLElement} frame
 * @param {number[][]} directions of X, Y and Z: to the right, downwards, towards who looks
 * @param {string} text which axes they are
 */
export function drawTriad3(frame, directions, text) {
  frame.querySelector(".triad")?.remove();
  const each = directions.map(([x, y, z], k) => ({ x, y, z, name: "XYZ"[k], colour: INKS[k] })).sort((a, b) => a.z - b.z); // the nearest is drawn last
  const parts = each.flatMap(({ x, y, name, colour }) => {
    const [tx, ty] = [MIDDLE + LONG * x, MIDDLE + LONG * y];
    const size = Math.hypot(x, y);
    const [ex, ey] = size > 0.15 ? [(5 * x) / size, (5 * y) / size] : [0, 0]; // no head on an axis that points at who looks
    return [svg("path", { d: `M${MIDDLE} ${MIDDLE}L${tx} ${ty}M${tx - ex - ey / 2} ${ty - ey + ex / 2}L${tx} ${ty}L${tx - ex + ey / 2} ${ty - ey - ex / 2}`, stroke: colour, "stroke-width": 2, fill: "none" }),
      Object.assign(svg("text", { x: MIDDLE + (LONG + 8) * x, y: MIDDLE + (LONG + 8) * y, fill: colour, "text-anchor": "middle", "dominant-baseline": "central", "font-size": 12, "font-weight": 600 }), { textContent: name })];
  });
  const data = Object.fromEntries(directions.map((d, k) => [`data-${"xyz"[k]}`, d.map((v) => v.toFixed(3)).join(" ")]));
  frame.append(svg("svg", { class: "triad", viewBox: "0 0 88 88", width: 88, height: 88, role: "img", ...data, "aria-label": `Axes of the numbers, ${text}: X, Y and Z as they stand in this view` },
    svg("circle", { cx: MIDDLE, cy: MIDDLE, r: 43, fill: "#0b0d0ebb" }), ...parts));
}
