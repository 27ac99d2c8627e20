// A field over an image, with the values under the mouse.
import * as api from "../lib/api.js";
import { View } from "./view.js";
import { num } from "../lib/dom.js";
import { amount, uncertain } from "../lib/units.js";
import { greyOf } from "./grey.js";
import { statistics } from "../lib/point_grid.js";
/** @import { Result, Shown } from "../screens/results/analysis.js" */
/** @import { Grid, Raster } from "../lib/point_grid.js" */
/** @import { Scale } from "./scale.js" */
/** @typedef {"reference" | "cam1" | "cam2"} Over the image that a field is laid over */
/** @typedef {{ result: Result, n: number, info: Shown, image: Over, grid: Grid, values: ArrayLike<number>, sigma: ArrayLike<number> | null,
 *   positions: ArrayLike<number> | null, statistics: ReturnType<typeof statistics>, withSigma: Promise<unknown> }} Now shown field */

/**
 * Values of the valid points.
 * @param {Grid} grid
 * @param {ArrayLike<number>} values
 */
export function measured(grid, values) {
  const out = new Float64Array(values.length);
  let count = 0;
  for (let i = 0; i < values.length; i += 1) if (grid.valid[i] && Number.isFinite(values[i])) out[count++] = values[i];
  return out.subarray(0, count);
}

export class FieldMap {
  /**
   * @param {string} label name for screen readers
   * @param {((x: number, y: number, event: Event) => void) | null} onpick called on clicks and the Enter key, in pixels of the picture shown
   */
  constructor(label, onpick = null) {
    this.view = new View({ label, grey: (x, y) => this.#under(x, y), onpick: (x, y, event) => onpick?.(x, y, event) });
    this.view.canvas.dataset.role = "map";
    /** @type {Now | null} */
    this.now = null;
    this.asked = 0;
    this.factor = 1; // of the standard uncertainties shown under the mouse
    this.lacking = ""; // the terms that they do not include
    this.noImage = false;
    this.address = "";
    /** @type {Raster | null} */
    this.raster = null;
    this.size = ""; // of the picture that the raster was made for
    /** @type {Scale | null} */
    this.scale = null;
    this.view.image.addEventListener("load", () => {
      this.noImage = false;
      this.redraw();
    });
    this.view.image.addEventListener("error", () => {
      if (!this.view.image.getAttribute("src")) return;
      this.noImage = true;
      this.redraw();
    });
  }

  close() {
    this.asked += 1;
    this.view.close();
  }

  /**
   * Read a field and its image.
   * @param {Result} result
   * @param {number} n step
   * @param {Shown} info entry of `result.fields`
   * @param {Over} image
   * @returns {Promise<boolean>} false if a newer one was requested since
   */
  async load(result, n, info, image) {
    this.asked += 1;
    const mine = this.asked;
    const of = image === "reference" ? [result.reference, "cam1"] : [n, image];
    const address = api.address(`/tests/${result.testId}/steps/${of[0]}/${of[1]}/preview`);
    if (!this.address) {
      // the first picture comes while the numbers do; later ones come with their numbers
      this.address = address;
      this.view.show(address);
    }
    const [grid, values, positions] = await Promise.all([
      result.grid(n),
      result.values(n, info.key),
      image === "reference" ? null : result.positions(n, image).then((one) => one.data),
    ]);
    if (mine !== this.asked) return false;
    if (this.address !== address) {
      this.address = address;
      this.view.show(address);
    }
    /** @type {Now} */
    const now = { result, n, info, image, grid, values, sigma: null, positions, statistics: statistics(grid, values), withSigma: Promise.resolve() };
    this.now = now;
    // not needed for the picture: it may arrive later
    now.withSigma = result.sigma(n, info.key).then(
      (sigma) => {
        if (now.info === info) now.sigma = sigma;
        if (this.now === now) this.view.reread();
        return sigma;
      },
      () => null,
    );
    this.raster = null;
    this.view.readout.textContent = ""; // its text belonged to another field or step
    this.view.reread();
    return true;
  }

  /**
   * Show other values on the same points (a difference).
   * @param {ArrayLike<number>} values
   * @param {Shown} info
   * @param {ArrayLike<number> | null} sigma
   */
  put(values, info, sigma = null) {
    const { now } = this;
    if (now) Object.assign(now, { values, info, sigma, statistics: statistics(now.grid, values) });
    this.raster = null;
  }

  /** Measured values, for the colour scale. */
  get measured() {
    if (!this.now) return new Float64Array();
    const { grid, values } = this.now;
    return measured(grid, values);
  }

  redraw(scale = this.scale) {
    this.scale = scale;
    if (!this.now || !scale) return;
    if (this.noImage && this.now.image === "reference") {
      // no picture: its size follows from the points
      const { grid } = this.now;
      this.view.size(
        Math.ceil(Math.max(...[0, grid.cols - 1].map((c) => grid.x0 + c * grid.dx)) + grid.x0),
        Math.ceil(grid.y0 * 2 + (grid.rows - 1) * grid.dy),
      );
    }
    const { width, height } = this.view;
    if (!width) return; // drawn when the picture has come
    const size = `${width} ${height}`;
    if (!this.raster || this.size !== size) {
      const { grid, values, positions, info } = this.now;
      this.raster = grid.raster(values, width, height, positions, Boolean(info.flags));
      this.size = size;
    }
    scale.paint(this.view.canvas, width, height, this.raster);
    this.view.canvas.dataset.shown = `${this.now.n} ${this.now.info.key} ${this.now.image}`;
    this.view.root.dispatchEvent(new CustomEvent("drawn"));
  }

  /**
   * Index of the point nearest to a position in the picture shown, and its distance, px.
   * @param {number} x
   * @param {number} y
   */
  nearest(x, y) {
    if (!this.now) return { i: -1, distance: Infinity };
    const { grid, positions } = this.now;
    const i = positions ? grid.nearestOf(positions, x, y) : grid.nearest(x, y);
    if (i < 0) return { i, distance: Infinity };
    const at = this.positionOf(i);
    return { i, distance: Math.hypot(at[0] - x, at[1] - y) };
  }

  /**
   * Position of a point in the picture shown.
   * @param {number} i
   * @returns {[number, number]}
   */
  positionOf(i) {
    if (!this.now) return [NaN, NaN];
    const { grid, positions } = this.now;
    return positions ? [positions[2 * i], positions[2 * i + 1]] : [grid.x[i], grid.y[i]];
  }

  /**
   * @param {number} column
   * @param {number} row
   */
  async #under(column, row) {
    const hover = this.view.hover;
    if (!hover || !this.now) return null;
    const { result, n, image } = this.now;
    const [step, cam] = image === "reference" ? [result.reference, "cam1"] : [n, image];
    const value = this.#value(this.now, hover);
    const grey = await greyOf({ test: result.testId, step, cam }, column, row).catch(() => null); // its image may be gone
    return [value, grey].filter(Boolean).join("   ") || null;
  }

  /**
   * @param {Now} now
   * @param {{ x: number, y: number }} hover
   */
  #value({ grid, values, sigma, info }, hover) {
    const { i, distance } = this.nearest(hover.x, hover.y);
    const step = Math.max(Math.abs(grid.dx), Math.abs(grid.dy));
    if (i < 0 || distance > 1.5 * step) return null;
    this.view.readout.dataset.point = String(i);
    this.view.readout.dataset.value = String(values[i]);
    if (info.flags) return `${info.text}: ${(info.flags[values[i]] ?? values[i]).toString().replace(/_/g, " ")}`;
    if (!grid.valid[i] || !Number.isFinite(values[i])) return `${info.text}: no valid value`;
    if (!sigma || !Number.isFinite(sigma[i])) return `${info.text} ${amount(values[i], info.unit)}`;
    const k = this.factor === 1 ? "u, k = 1" : `U, k = ${num(this.factor, 3)}`;
    return `${info.text} ${uncertain(values[i], this.factor * sigma[i], info.unit)} (${k}${this.lacking ? `; ${this.lacking}` : ""})`;
  }
}
