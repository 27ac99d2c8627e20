// A region painted pixel by pixel: a canvas over the picture, white kept as a PNG in base64.
import { h, pen } from "../../lib/dom.js";
import { corners } from "./shapes.js";
/** @import { Shape, Spot, State } from "./shapes.js" */

const COLOUR = "#ffd23e";

/**
 * @param {CanvasRenderingContext2D} context
 * @param {Shape} shape
 */
function fillShape(context, shape) {
  context.beginPath();
  // a pixel's centre is at whole numbers
  corners(shape).forEach(([x, y], k) => (k ? context.lineTo(x + 0.5, y + 0.5) : context.moveTo(x + 0.5, y + 0.5)));
  context.closePath();
  context.fill();
}

export class Mask {
  constructor() {
    this.canvas = h("canvas.region-mask", { "aria-hidden": "true", hidden: true });
    /** @type {string | null} the PNG that the canvas shows */
    this.shown = null;
    /** @type {[x0: number, y0: number, x1: number, y1: number] | null} box about the white */
    this.box = null;
    this.white = 0;
  }

  /** @param {{ width: number, height: number }} size */
  #size({ width, height }) {
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    return pen(this.canvas);
  }

  #forget() {
    this.shown = null;
    this.box = null;
    this.white = 0;
    this.canvas.hidden = true;
  }

  /**
   * Show a kept mask; true if another one is shown now.
   * @param {string | null} png
   * @param {{ width: number, height: number }} size
   */
  async show(png, size) {
    if (png === this.shown) return false;
    if (png === null || !size.width) {
      this.#forget();
      return true;
    }
    this.shown = png;
    const image = new Image();
    image.src = `data:image/png;base64,${png}`;
    await image.decode();
    if (this.shown !== png) return false; // another one came since
    this.#draw(image, size);
    this.#measure();
    return true;
  }

  /**
   * @param {CanvasImageSource} image
   * @param {{ width: number, height: number }} size
   */
  #draw(image, size) {
    const context = this.#size(size);
    context.clearRect(0, 0, size.width, size.height);
    context.drawImage(image, 0, 0);
    const data = context.getImageData(0, 0, size.width, size.height);
    const [r, g, b] = [1, 3, 5].map((k) => Number.parseInt(COLOUR.slice(k, k + 2), 16));
    for (let k = 0; k < data.data.length; k += 4) {
      // brighter than half of full scale is white, as the service reads it
      const grey = (0.299 * data.data[k] + 0.587 * data.data[k + 1] + 0.114 * data.data[k + 2]) * (data.data[k + 3] / 255);
      data.data.set([r, g, b, grey > 127 ? 255 : 0], k);
    }
    context.putImageData(data, 0, 0);
    this.canvas.hidden = false;
  }

  /** @returns {ImageData} with each pixel wholly in or out */
  #measure() {
    const { width, height } = this.canvas;
    const data = pen(this.canvas).getImageData(0, 0, width, height);
    let [x0, y0, x1, y1] = [width, height, -1, -1];
    this.white = 0;
    for (let y = 0; y < height; y += 1)
      for (let x = 0; x < width; x += 1) {
        if (data.data[4 * (y * width + x) + 3] <= 127) continue;
        this.white += 1;
        x0 = Math.min(x0, x);
        x1 = Math.max(x1, x);
        y0 = Math.min(y0, y);
        y1 = Math.max(y1, y);
      }
    this.box = this.white ? [x0, y0, x1, y1] : null;
    return data;
  }

  /**
   * Begin to paint: the drawn outlines become white.
   * @param {State} state
   * @param {{ width: number, height: number }} size
   * @param {boolean} [holes] whether holes become black too
   */
  begin(state, size, holes = false) {
    const context = this.#size(size);
    if (state.mask === null) context.clearRect(0, 0, size.width, size.height);
    context.fillStyle = COLOUR;
    for (const shape of state.outlines) fillShape(context, shape);
    if (holes) {
      context.globalCompositeOperation = "destination-out";
      for (const shape of state.holes) fillShape(context, shape);
      context.globalCompositeOperation = "source-over";
    }
    this.canvas.hidden = false;
  }

  /**
   * Paint, or take away, along a line.
   * @param {Spot} from
   * @param {Spot} to
   * @param {number} width px
   * @param {boolean} erase
   */
  stroke(from, to, width, erase) {
    const context = pen(this.canvas);
    context.globalCompositeOperation = erase ? "destination-out" : "source-over";
    Object.assign(context, { strokeStyle: COLOUR, lineWidth: width, lineCap: "round" });
    context.beginPath();
    context.moveTo(from[0] + 0.5, from[1] + 0.5);
    context.lineTo(to[0] + 0.5, to[1] + 0.5);
    context.stroke();
    context.globalCompositeOperation = "source-over";
  }

  invert() {
    const context = pen(this.canvas);
    context.globalCompositeOperation = "source-out";
    context.fillStyle = COLOUR;
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    context.globalCompositeOperation = "source-over";
  }

  /**
   * Keep the painting.
   * @returns {string | null} PNG in base64, white on black; null if nothing is white
   */
  kept() {
    const data = this.#measure();
    if (!this.white) {
      this.#forget();
      return null;
    }
    pen(this.canvas).putImageData(sharp(data), 0, 0);
    this.shown = pngOf(data);
    return this.shown;
  }

  /**
   * Read a mask's file.
   * @param {File} file
   * @param {{ width: number, height: number }} size of camera 1's image
   * @returns {Promise<string>} why it cannot be used; empty if it is drawn now
   */
  async read(file, size) {
    const image = await createImageBitmap(file).catch(() => null);
    if (!image) return `${file.name} is no picture that can be read: give a PNG.`;
    if (image.width !== size.width || image.height !== size.height)
      return `The mask is ${image.width} x ${image.height} px, camera 1's image ${size.width} x ${size.height} px: draw it over camera 1's reference image.`;
    this.#draw(image, size);
    return this.#measure() && this.white ? "" : `${file.name} has no white: paint white where points are allowed.`;
  }
}

/**
 * Each pixel wholly in or out: a stroke's edge is smoothed.
 * @param {ImageData} data
 */
function sharp(data) {
  for (let k = 3; k < data.data.length; k += 4) data.data[k] = data.data[k] > 127 ? 255 : 0;
  return data;
}

/** @param {ImageData} data */
function pngOf(data) {
  const canvas = Object.assign(document.createElement("canvas"), { width: data.width, height: data.height });
  const grey = new ImageData(data.width, data.height);
  for (let k = 0; k < data.data.length; k += 4) {
    const value = data.data[k + 3];
    grey.data.set([value, value, value, 255], k);
  }
  pen(canvas).putImageData(grey, 0, 0);
  return canvas.toDataURL("image/png").split(",")[1];
}

/**
 * The whole region as a mask's file: outlines and paint, without the holes.
 * @param {State} state
 * @param {{ width: number, height: number }} size
 */
export async function wholeMask(state, size) {
  const mask = new Mask();
  await mask.show(state.mask, size);
  mask.begin(state, size, true);
  return mask.kept();
}
