// Contour lines and vectors on the surface in space, with the legend of the vectors.
import { isolines } from "../../../lib/isolines.js";
import { arrowLegend } from "../../../widgets/arrow_legend.js";
import { legendText } from "../overlay.js";

/** @import { Vectors } from "../overlay.js" */
/** @typedef {typeof import("../../../vendor/three/three.module.js")} Three */

const HEAD = 0.28;

/**
 * @param {Three} THREE
 * @param {import("three").Scene} scene
 * @param {HTMLElement} space
 */
export function spaceOverlay(THREE, scene, space) {
  const made = (/** @type {number} */ color) => new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color }));
  const lines = made(0x101417);
  const tension = made(0x101417);
  // arrows reach beyond the surface: they have the colour of the page's text
  const ink = () => {
    tension.material.color.setStyle(getComputedStyle(space).color);
  };
  ink();
  const compression = made(0xd14a00);
  const all = [lines, tension, compression];
  for (const one of all) one.frustumCulled = false;
  scene.add(...all);
  const legend = arrowLegend(space);
  let scale = 1;

  /**
   * @param {import("three").LineSegments} of
   * @param {number[]} points
   */
  function put(of, points) {
    of.geometry.dispose();
    of.geometry = new THREE.BufferGeometry();
    of.geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  }

  /**
   * @param {Float32Array} at positions of the points as they are shown
   * @param {readonly number[]} triangles
   * @param {ArrayLike<number>} values
   * @param {readonly number[]} levels
   */
  function contours(at, triangles, values, levels) {
    /** @type {number[]} */
    const points = [];
    for (const one of isolines(triangles, values, levels)) {
      for (const [i, j, s] of [
        [one.a, one.b, one.s],
        [one.c, one.d, one.t],
      ])
        for (let k = 0; k < 3; k += 1) points.push(at[3 * i + k] + s * (at[3 * j + k] - at[3 * i + k]));
    }
    put(lines, points);
    space.dataset.lines = String(points.length / 6);
  }

  /**
   * @param {Float32Array} at
   * @param {Vectors | null} of
   * @param {number} room between two arrows, mm
   */
  function arrows(at, of, room) {
    ink();
    /** @type {[number[], number[]]} */
    const points = [[], []];
    const { each, legend: round } = of?.each(room) ?? { each: 0, legend: 0 };
    for (const one of of?.arrows ?? []) {
      const from = [0, 1, 2].map((k) => at[3 * one.i + k]);
      for (const sign of one.both ? [1, -1] : [1])
        shaft(
          points[one.inward ? 1 : 0],
          from,
          one.to.map((v) => sign * v * one.size * each),
          one.inward,
        );
    }
    put(tension, points[0]);
    put(compression, points[1]);
    space.dataset.vectors = String(of?.arrows.length ?? 0);
    if (of) legend.show(round * each, legendText(of, round), () => scale);
    else legend.hide();
  }

  /**
   * @param {number[]} out
   * @param {number[]} from
   * @param {number[]} by
   * @param {boolean} inward true: the head is at its beginning
   */
  function shaft(out, from, by, inward) {
    if (!(Math.hypot(...by) > 0) || !Number.isFinite(from[0])) return;
    const to = from.map((v, k) => v + by[k]);
    const across = Math.abs(by[2]) > 0.9 * Math.hypot(...by) ? [by[2], 0, -by[0]] : [-by[1], by[0], 0]; // at right angles to it, in the surface if the arrow is in it
    const wide = (0.5 * HEAD * Math.hypot(...by)) / (Math.hypot(...across) || 1);
    const [tip, s] = inward ? [from, -1] : [to, 1];
    out.push(...from, ...to);
    for (const side of [1, -1]) out.push(...tip, ...tip.map((v, k) => v - s * HEAD * by[k] + side * wide * across[k]));
  }

  return {
    contours,
    arrows,
    /** @param {number} pxPerMm at the middle of the view */
    place(pxPerMm) {
      if (Math.abs(pxPerMm - scale) < 1e-6 * pxPerMm) return;
      scale = pxPerMm;
      legend.again();
    },
    close() {
      for (const one of all) {
        one.geometry.dispose();
        one.material.dispose();
      }
    },
  };
}
