// The grid of points: values between them, never over a missing point or a cut. The gauges have the same rule:
// bilinear from four corners; from three, in their triangle, if the fourth is missing or beyond a cut.

const NEAR = 1e-6;

/**
 * Return true if the straight lines a-b and c-d meet.
 * @param {number} ax
 * @param {number} ay
 * @param {number} bx
 * @param {number} by
 * @param {number} cx
 * @param {number} cy
 * @param {number} dx
 * @param {number} dy
 */
function meet(ax, ay, bx, by, cx, cy, dx, dy) {
  /** @type {(px: number, py: number, qx: number, qy: number, rx: number, ry: number) => number} */
  const side = (px, py, qx, qy, rx, ry) => (qx - px) * (ry - py) - (qy - py) * (rx - px);
  const s1 = side(ax, ay, bx, by, cx, cy);
  const s2 = side(ax, ay, bx, by, dx, dy);
  const s3 = side(cx, cy, dx, dy, ax, ay);
  const s4 = side(cx, cy, dx, dy, bx, by);
  if (s1 === 0 && s2 === 0 && s3 === 0 && s4 === 0) {
    /** @type {(a: number, b: number, c: number, d: number) => boolean} */
    const over = (a, b, c, d) => Math.max(Math.min(a, b), Math.min(c, d)) <= Math.min(Math.max(a, b), Math.max(c, d));
    return over(ax, bx, cx, dx) && over(ay, by, cy, dy);
  }
  return s1 * s2 <= 0 && s3 * s4 <= 0;
}

/** @typedef {[x0: number, y0: number, x1: number, y1: number]} Piece of a cut */
/** @typedef {ReturnType<typeof statistics>} Statistics */
/** @typedef {{ x: number, y: number, width: number, height: number, values: Float32Array }} Raster a part of an image */

export class Grid {
  /**
   * @param {object} of
   * @param {number} of.rows
   * @param {number} of.cols
   * @param {ArrayLike<number>} of.x columns of the points in camera 1's reference image, row by row
   * @param {ArrayLike<number>} of.y their rows
   * @param {ArrayLike<number>} of.status
   * @param {Piece[]} [of.cuts] pieces of the cuts
   */
  constructor({ rows, cols, x, y, status, cuts = [] }) {
    this.rows = rows;
    this.cols = cols;
    this.x = x;
    this.y = y;
    this.status = status;
    this.cuts = cuts;
    this.x0 = x[0];
    this.y0 = y[0];
    this.dx = cols > 1 ? x[1] - x[0] : rows > 1 ? y[cols] - y[0] : 1;
    this.dy = rows > 1 ? y[cols] - y[0] : this.dx;
    this.valid = new Uint8Array(status.length);
    for (let i = 0; i < status.length; i += 1) this.valid[i] = status[i] === 0 || status[i] === 10 ? 1 : 0; // ok, extrapolated
    this.cutCells = this.#cutCells();
  }

  /** Cell number -> the pieces of cuts that meet it, its border included. */
  #cutCells() {
    /** @type {Map<number, Piece[]>} */
    const cells = new Map();
    for (const piece of this.cuts) {
      const [x0, y0, x1, y1] = piece;
      const column = (/** @type {number} */ x) => Math.floor((x - this.x0) / this.dx);
      const row = (/** @type {number} */ y) => Math.floor((y - this.y0) / this.dy);
      for (let r = Math.max(row(Math.min(y0, y1) - NEAR), 0); r <= Math.min(row(Math.max(y0, y1) + NEAR), this.rows - 2); r += 1) {
        for (let c = Math.max(column(Math.min(x0, x1) - NEAR), 0); c <= Math.min(column(Math.max(x0, x1) + NEAR), this.cols - 2); c += 1) {
          const cell = r * this.cols + c;
          if (this.#meets(cell, piece)) cells.set(cell, [...(cells.get(cell) ?? []), piece]);
        }
      }
    }
    return cells;
  }

  /**
   * @param {number} cell
   * @param {Piece} piece
   */
  #meets(cell, piece) {
    const left = this.x[cell] - NEAR;
    const top = this.y[cell] - NEAR;
    const right = this.x[cell] + this.dx + NEAR;
    const bottom = this.y[cell] + this.dy + NEAR;
    const [x0, y0] = piece;
    const within = x0 >= left && x0 <= right && y0 >= top && y0 <= bottom;
    // a line that enters and leaves a rectangle meets one of its diagonals; one that ends in it has an end within, or meets a side
    return (
      within ||
      meet(left, top, right, bottom, ...piece) ||
      meet(right, top, left, bottom, ...piece) ||
      (piece[2] >= left && piece[2] <= right && piece[3] >= top && piece[3] <= bottom)
    );
  }

  /**
   * Return true if no cut meets a side of the triangle of three points, and none is inside it.
   * @param {number} cell that the three are corners of
   * @param {number[]} three numbers of points
   */
  whole(cell, three) {
    const pieces = this.cutCells.get(cell);
    if (!pieces) return true;
    const inside = (/** @type {number} */ px, /** @type {number} */ py) => {
      const turns = three.map((a, k) => {
        const b = three[(k + 1) % 3];
        return (this.x[b] - this.x[a]) * (py - this.y[a]) - (this.y[b] - this.y[a]) * (px - this.x[a]);
      });
      return turns.every((turn) => turn >= 0) || turns.every((turn) => turn <= 0);
    };
    return (
      pieces.every((piece) => !inside(piece[0], piece[1]) || !inside(piece[2], piece[3])) && three.every((a, k) => !this.parted(cell, a, three[(k + 1) % 3]))
    );
  }

  /**
   * Return true if a cut meets the side between two corners of a cell.
   * @param {number} cell
   * @param {number} a
   * @param {number} b
   */
  parted(cell, a, b) {
    return (this.cutCells.get(cell) ?? []).some((piece) => meet(this.x[a], this.y[a], this.x[b], this.y[b], ...piece));
  }

  /**
   * Nearest point of the grid to a position in the reference image.
   * @param {number} x
   * @param {number} y
   */
  nearest(x, y) {
    const c = Math.min(Math.max(Math.round((x - this.x0) / this.dx), 0), this.cols - 1);
    const r = Math.min(Math.max(Math.round((y - this.y0) / this.dy), 0), this.rows - 1);
    return r * this.cols + c;
  }

  /**
   * Nearest of points at `positions`; -1 if none has a position.
   * @param {ArrayLike<number>} positions
   * @param {number} x
   * @param {number} y
   */
  nearestOf(positions, x, y) {
    let best = -1;
    let min = Infinity;
    for (let i = 0; i < this.x.length; i += 1) {
      const d = (positions[2 * i] - x) ** 2 + (positions[2 * i + 1] - y) ** 2;
      if (d < min) {
        min = d;
        best = i;
      }
    }
    return best;
  }

  /** @param {number} cell */
  corners(cell) {
    return [cell, cell + 1, cell + this.cols, cell + this.cols + 1];
  }

  /**
   * Bits of a cell's corners that have a value.
   * @param {ArrayLike<number>} values
   * @param {number} cell
   */
  good(values, cell) {
    const below = cell + this.cols;
    let bits = 0;
    if (this.valid[cell] && Number.isFinite(values[cell])) bits |= 1;
    if (this.valid[cell + 1] && Number.isFinite(values[cell + 1])) bits |= 2;
    if (this.valid[below] && Number.isFinite(values[below])) bits |= 4;
    if (this.valid[below + 1] && Number.isFinite(values[below + 1])) bits |= 8;
    return bits;
  }

  /**
   * Value in a cell at shares s, t of its width and height; NaN if it has none.
   * @param {ArrayLike<number>} values
   * @param {number} cell
   * @param {number} s
   * @param {number} t
   */
  inside(values, cell, s, t, bits = this.good(values, cell)) {
    const pieces = this.cutCells.get(cell);
    const corners = this.corners(cell);
    const weight = [(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t];
    let needed = 0;
    for (let k = 0; k < 4; k += 1) if (weight[k] > 0) needed |= 1 << k;
    let bad = needed & ~bits;
    if (pieces) {
      const px = this.x[cell] + s * this.dx;
      const py = this.y[cell] + t * this.dy;
      for (let k = 0; k < 4; k += 1) {
        if (needed & (1 << k) && pieces.some((p) => meet(px, py, this.x[corners[k]], this.y[corners[k]], ...p))) bad |= 1 << k;
      }
    }
    if (!bad) {
      let sum = 0;
      for (let k = 0; k < 4; k += 1) if (weight[k] > 0) sum += weight[k] * values[corners[k]];
      return sum;
    }
    if (needed !== 15 || bad & (bad - 1)) return NaN;
    const o = 3 - Math.log2(bad);
    const a = o & 1 ? 1 - s : s;
    const b = o & 2 ? 1 - t : t;
    if (a + b > 1 + NEAR) return NaN;
    return (1 - a - b) * values[corners[o]] + a * values[corners[o ^ 1]] + b * values[corners[o ^ 2]];
  }

  /**
   * Value at a position in the reference image; NaN if it has none.
   * @param {ArrayLike<number>} values
   * @param {number} x
   * @param {number} y
   */
  at(values, x, y) {
    const fx = (x - this.x0) / this.dx;
    const fy = (y - this.y0) / this.dy;
    if (!(fx >= -NEAR && fy >= -NEAR && fx <= this.cols - 1 + NEAR && fy <= this.rows - 1 + NEAR)) return NaN;
    if (this.cols < 2 || this.rows < 2) return this.valid[this.nearest(x, y)] ? values[this.nearest(x, y)] : NaN;
    const c = Math.min(Math.max(Math.floor(fx), 0), this.cols - 2);
    const r = Math.min(Math.max(Math.floor(fy), 0), this.rows - 2);
    return this.inside(values, r * this.cols + c, Math.min(Math.max(fx - c, 0), 1), Math.min(Math.max(fy - r, 0), 1));
  }

  /**
   * Values over the pixels of an image.
   * @param {ArrayLike<number>} values of the points
   * @param {number} width of the image, px
   * @param {number} height of the image, px
   * @param {ArrayLike<number> | null} positions of the points in it (x, y, x, y ...); null: the reference image
   * @param {boolean} steps each pixel takes its nearest point's value, failed or not (for a status)
   * @returns {Raster} the part of the image that has points
   */
  raster(values, width, height, positions = null, steps = false) {
    let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = 0; i < this.x.length; i += 1) {
      const x = positions ? positions[2 * i] : this.x[i];
      const y = positions ? positions[2 * i + 1] : this.y[i];
      if (x < left) left = x;
      if (x > right) right = x;
      if (y < top) top = y;
      if (y > bottom) bottom = y;
    }
    const margin = steps ? Math.ceil(Math.max(Math.abs(this.dx), Math.abs(this.dy)) / 2) : 1;
    left = Math.max(Math.floor(left) - margin, 0);
    top = Math.max(Math.floor(top) - margin, 0);
    right = Math.min(Math.ceil(right) + margin, width - 1);
    bottom = Math.min(Math.ceil(bottom) + margin, height - 1);
    if (!(right >= left && bottom >= top)) return { x: 0, y: 0, width: 0, height: 0, values: new Float32Array(0) };
    const out = {
      x: left,
      y: top,
      width: right - left + 1,
      height: bottom - top + 1,
      values: new Float32Array((right - left + 1) * (bottom - top + 1)).fill(NaN),
    };
    if (steps && !positions) this.#nearestEach(values, out);
    else this.#cells(values, out, positions);
    return out;
  }

  /**
   * @param {ArrayLike<number>} values
   * @param {Raster} out
   */
  #nearestEach(values, out) {
    const half = [Math.abs(this.dx) / 2, Math.abs(this.dy) / 2];
    for (let y = 0; y < out.height; y += 1) {
      const fy = out.y + y;
      if (fy < this.y0 - half[1] || fy > this.y0 + (this.rows - 1) * this.dy + half[1]) continue;
      for (let x = 0; x < out.width; x += 1) {
        const fx = out.x + x;
        if (fx < this.x0 - half[0] || fx > this.x0 + (this.cols - 1) * this.dx + half[0]) continue;
        out.values[y * out.width + x] = values[this.nearest(fx, fy)];
      }
    }
  }

  /**
   * @param {ArrayLike<number>} values
   * @param {Raster} out
   * @param {ArrayLike<number> | null} positions
   */
  #cells(values, out, positions) {
    const used = new Uint8Array(this.x.length);
    for (let r = 0; r < this.rows - 1; r += 1) {
      for (let c = 0; c < this.cols - 1; c += 1) {
        const cell = r * this.cols + c;
        const bits = this.good(values, cell);
        if (bits === 0) continue;
        const lone = bits !== 15 && ![14, 13, 11, 7].includes(bits);
        if (lone) continue;
        for (const corner of this.corners(cell)) used[corner] = 1;
        if (!positions) this.#rectangle(values, out, cell, bits);
        else if (bits === 15) {
          this.#triangle(values, out, positions, cell, 0, bits);
          this.#triangle(values, out, positions, cell, 3, bits);
        } else this.#triangle(values, out, positions, cell, 3 - Math.log2(15 & ~bits), bits);
      }
    }
    // a point without neighbours is drawn as a dot
    for (let i = 0; i < used.length; i += 1) {
      if (used[i] || !this.valid[i] || !Number.isFinite(values[i])) continue;
      const x = Math.round(positions ? positions[2 * i] : this.x[i]) - out.x;
      const y = Math.round(positions ? positions[2 * i + 1] : this.y[i]) - out.y;
      for (let v = Math.max(y - 1, 0); v <= Math.min(y + 1, out.height - 1); v += 1) {
        for (let u = Math.max(x - 1, 0); u <= Math.min(x + 1, out.width - 1); u += 1) out.values[v * out.width + u] = values[i];
      }
    }
  }

  /**
   * @param {ArrayLike<number>} values
   * @param {Raster} out
   * @param {number} cell
   * @param {number} bits
   */
  #rectangle(values, out, cell, bits) {
    const x0 = this.x[cell];
    const y0 = this.y[cell];
    const from = [Math.max(Math.ceil(x0 - NEAR), out.x), Math.max(Math.ceil(y0 - NEAR), out.y)];
    const to = [Math.min(Math.floor(x0 + this.dx + NEAR), out.x + out.width - 1), Math.min(Math.floor(y0 + this.dy + NEAR), out.y + out.height - 1)];
    if (bits === 15 && !this.cutCells.has(cell)) {
      const [v0, v1, v2, v3] = this.corners(cell).map((i) => values[i]);
      for (let y = from[1]; y <= to[1]; y += 1) {
        const t = (y - y0) / this.dy;
        const left = v0 + (v2 - v0) * t;
        const slope = (v1 + (v3 - v1) * t - left) / this.dx;
        let at = (y - out.y) * out.width + from[0] - out.x;
        for (let x = from[0]; x <= to[0]; x += 1, at += 1) out.values[at] = left + slope * (x - x0);
      }
      return;
    }
    for (let y = from[1]; y <= to[1]; y += 1) {
      for (let x = from[0]; x <= to[0]; x += 1) {
        const value = this.inside(values, cell, Math.min(Math.max((x - x0) / this.dx, 0), 1), Math.min(Math.max((y - y0) / this.dy, 0), 1), bits);
        if (!Number.isNaN(value)) out.values[(y - out.y) * out.width + x - out.x] = value;
      }
    }
  }

  /**
   * The half of a cell at its corner `o`, with its corners at `positions`.
   * @param {ArrayLike<number>} values
   * @param {Raster} out
   * @param {ArrayLike<number>} positions
   * @param {number} cell
   * @param {number} o
   * @param {number} bits
   */
  #triangle(values, out, positions, cell, o, bits) {
    const corner = (/** @type {number} */ k) => cell + (k & 1) + (k & 2 ? this.cols : 0);
    const [io, ia, ib, id] = [corner(o), corner(o ^ 1), corner(o ^ 2), corner(o ^ 3)];
    const px = positions[2 * io];
    const py = positions[2 * io + 1];
    const ax = positions[2 * ia];
    const ay = positions[2 * ia + 1];
    const bx = positions[2 * ib];
    const by = positions[2 * ib + 1];
    const ux = ax - px;
    const uy = ay - py;
    const vx = bx - px;
    const vy = by - py;
    const area = ux * vy - uy * vx;
    if (!Number.isFinite(area) || Math.abs(area) < 1e-9) return;
    const from = [Math.max(Math.ceil(Math.min(px, ax, bx) - NEAR), out.x), Math.max(Math.ceil(Math.min(py, ay, by) - NEAR), out.y)];
    const to = [
      Math.min(Math.floor(Math.max(px, ax, bx) + NEAR), out.x + out.width - 1),
      Math.min(Math.floor(Math.max(py, ay, by) + NEAR), out.y + out.height - 1),
    ];
    const plain = !this.cutCells.has(cell);
    const vo = values[io];
    const va = values[ia];
    const vb = values[ib];
    const twist = bits === 15 ? vo - va - vb + values[id] : 0;
    const da = vy / area;
    const db = -uy / area;
    for (let y = from[1]; y <= to[1]; y += 1) {
      let a = ((from[0] - px) * vy - (y - py) * vx) / area - da;
      let b = (ux * (y - py) - uy * (from[0] - px)) / area - db;
      for (let x = from[0]; x <= to[0]; x += 1) {
        a += da;
        b += db;
        if (a < -NEAR || b < -NEAR || a + b > 1 + NEAR) continue;
        if (plain) {
          out.values[(y - out.y) * out.width + x - out.x] = vo + a * (va - vo) + b * (vb - vo) + a * b * twist;
          continue;
        }
        const clip = (/** @type {number} */ share) => Math.min(Math.max(share, 0), 1);
        const value = this.inside(values, cell, clip(o & 1 ? 1 - a : a), clip(o & 2 ? 1 - b : b), bits);
        if (!Number.isNaN(value)) out.values[(y - out.y) * out.width + x - out.x] = value;
      }
    }
  }

  /**
   * Return true if another grid has the same points.
   * @param {Grid} other
   */
  same(other) {
    return (
      this.rows === other.rows &&
      this.cols === other.cols &&
      /** @type {const} */ (["x0", "y0", "dx", "dy"]).every((name) => Math.abs(this[name] - other[name]) < 1e-3)
    );
  }
}

/**
 * Min, max, mean, sd and number of the values of valid points, and the number of points inside the region.
 * @param {Grid} grid
 * @param {ArrayLike<number>} values
 */
export function statistics(grid, values) {
  let [count, sum, squares, min, max, within] = [0, 0, 0, Infinity, -Infinity, 0];
  for (let i = 0; i < values.length; i += 1) {
    if (grid.status[i] !== 2) within += 1;
    const v = values[i];
    if (!grid.valid[i] || !Number.isFinite(v)) continue;
    count += 1;
    sum += v;
    squares += v * v;
    if (v < min) min = v;
    if (v > max) max = v;
  }
  if (!count) return { count, within, min: null, max: null, mean: null, sd: null, rms: null };
  const mean = sum / count;
  return { count, within, min, max, mean, sd: Math.sqrt(Math.max(squares / count - mean * mean, 0)), rms: Math.sqrt(squares / count) };
}
