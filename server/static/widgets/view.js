// A picture that can be zoomed and read, with a canvas and an SVG laid over it in its own pixels.
//
// Pixel coordinates as in the API: the first pixel's centre is (0, 0).
import { h, svg, num } from "../lib/dom.js";

/** @typedef {{ x: number, y: number }} Position in the picture, px */

/** By one step where an arrow key points. @type {Record<string, [number, number]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const STEP = 1.25;
const MAX_SCALE = 64;

export class View {
  /**
   * @param {object} options
   * @param {string} options.label name of the picture for screen readers
   * @param {((x: number, y: number) => Promise<string | null>) | null} [options.grey] text about the pixel under the mouse
   * @param {((x: number, y: number, event: Event) => void) | null} [options.onpick] a click without dragging
   * @param {boolean} [options.tools] false: without buttons
   *
   * By keyboard, Enter shows a cross-hair that arrow keys move and that Enter picks with; Escape leaves it. A drawing
   * tool sets `drawing` (arrow keys begin at once), `onaim` (called with its position), `onleave` and `aimFrom` (its first position).
   */
  constructor({ label, grey = null, onpick = null, tools = true }) {
    this.width = 0;
    this.height = 0;
    this.scale = 1;
    this.left = 0;
    this.top = 0;
    this.grey = grey;
    this.onpick = onpick;
    this.fitted = true;
    /** @type {Position | null} */
    this.cross = null;
    /** @type {Position | null} */
    this.aim = null;
    /** @type {Position | null} */
    this.hover = null;
    this.asking = false;
    this.outdated = false;
    this.drawing = false;
    /** @type {((aim: Position | null) => void) | null} */
    this.onaim = null;
    /** @type {(() => void) | null} */
    this.onleave = null;
    /** @type {(() => Position | null) | null} */
    this.aimFrom = null;
    /** Take a finger that a drawing tool had, so that a second one zooms. @type {(pointerId: number, at: [number, number]) => void} */
    this.hold = () => {};

    this.image = h("img", { alt: label, draggable: "false" });
    this.canvas = h("canvas", { "aria-hidden": "true" });
    this.svg = svg("svg", { "aria-hidden": "true" });
    this.content = h("div.content", this.image, this.canvas, this.svg);
    this.empty = h("div.empty", { hidden: true });
    this.frame = h(
      "div.frame",
      {
        tabindex: 0,
        role: "application",
        "aria-roledescription": "zoomable picture",
        "aria-label": `${label}: arrow keys move, + and − zoom, 0 fits, 1 shows pixels one to one, Enter begins to point`,
      },
      this.content,
      this.empty,
    );
    this.readout = h("div.readout", { "data-role": "readout" });
    this.crossButton = h(
      "button",
      {
        type: "button",
        "aria-pressed": "false",
        title: "Cross-hair through the middle of the picture (c); double-click puts it elsewhere",
        onclick: () => this.toggleCross(),
      },
      svg(
        "svg",
        { viewBox: "0 0 16 16", width: 16, height: 16, "aria-hidden": "true" },
        svg("path", { d: "M8 1v14M1 8h14", stroke: "currentColor", fill: "none", "stroke-width": 1.5 }),
      ),
    );
    this.tools = h(
      "div.tools",
      h("button", { type: "button", "aria-label": "Zoom in", onclick: () => this.zoom(STEP) }, "+"),
      h("button", { type: "button", "aria-label": "Zoom out", onclick: () => this.zoom(1 / STEP) }, "−"),
      h("button", { type: "button", title: "Fit the whole picture (0)", onclick: () => this.fit() }, "Fit"),
      h("button", { type: "button", title: "One picture pixel on one screen pixel (1)", onclick: () => this.one() }, "1:1"),
      this.crossButton,
    );
    this.crossButton.setAttribute("aria-label", "Cross-hair");
    this.root = h("div.view", tools ? this.tools : h("div"), this.frame, this.readout);

    this.image.addEventListener("load", () => this.#sized(this.image.naturalWidth, this.image.naturalHeight));
    this.frame.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    this.frame.addEventListener("keydown", (event) => this.#key(event));
    this.frame.addEventListener("dblclick", (event) => this.cross && this.#putCross(this.at(event)));
    this.#pointers();
    this.observer = new ResizeObserver(() => this.fitted && this.fit());
    this.observer.observe(this.frame);
  }

  /**
   * Show an address; an MJPEG stream keeps on loading by itself.
   * @param {string} address
   */
  show(address) {
    this.empty.hidden = true;
    this.image.src = address;
  }

  /**
   * Show the reason for a missing picture.
   * @param {string} text
   */
  blank(text) {
    this.image.removeAttribute("src");
    this.empty.textContent = text;
    this.empty.hidden = false;
  }

  /**
   * Fix the size before a picture has come.
   * @param {number} width
   * @param {number} height
   */
  size(width, height) {
    this.#sized(width, height);
  }

  close() {
    this.observer.disconnect();
    this.image.removeAttribute("src"); // ends a stream
  }

  /**
   * @param {number} width
   * @param {number} height
   */
  #sized(width, height) {
    if (!width || (width === this.width && height === this.height)) return;
    this.width = width;
    this.height = height;
    this.content.style.width = `${width}px`;
    this.content.style.height = `${height}px`;
    this.svg.setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
    this.fit();
    this.#drawCross();
  }

  /**
   * Pixel coordinates under a mouse or pen.
   * @param {MouseEvent} event
   */
  at(event) {
    const box = this.frame.getBoundingClientRect();
    return { x: (event.clientX - box.left - this.left) / this.scale - 0.5, y: (event.clientY - box.top - this.top) / this.scale - 0.5 };
  }

  /**
   * Position of a pixel in the page.
   * @param {number} x
   * @param {number} y
   */
  where(x, y) {
    const box = this.frame.getBoundingClientRect();
    return { clientX: box.left + this.left + (x + 0.5) * this.scale, clientY: box.top + this.top + (y + 0.5) * this.scale };
  }

  fit() {
    if (!this.width) return;
    const box = this.frame.getBoundingClientRect();
    if (!box.width) return;
    this.scale = Math.min(box.width / this.width, box.height / this.height);
    this.left = (box.width - this.width * this.scale) / 2;
    this.top = (box.height - this.height * this.scale) / 2;
    this.fitted = true;
    this.#transform();
  }

  one() {
    const box = this.frame.getBoundingClientRect();
    this.#scaleTo(1 / (window.devicePixelRatio || 1), box.width / 2, box.height / 2);
  }

  /**
   * @param {number} factor
   * @param {number} [x] fixed position, in the frame
   * @param {number} [y]
   */
  zoom(factor, x, y) {
    const box = this.frame.getBoundingClientRect();
    this.#scaleTo(this.scale * factor, x ?? box.width / 2, y ?? box.height / 2);
  }

  /**
   * Put a pixel into the middle, at so many screen pixels a picture pixel.
   * @param {number} x
   * @param {number} y
   */
  centreOn(x, y, scale = this.scale) {
    const box = this.frame.getBoundingClientRect();
    this.scale = Math.min(Math.max(scale, 0.01), MAX_SCALE);
    this.left = box.width / 2 - (x + 0.5) * this.scale;
    this.top = box.height / 2 - (y + 0.5) * this.scale;
    this.fitted = false;
    this.#transform();
  }

  /**
   * @param {number} scale
   * @param {number} x
   * @param {number} y
   */
  #scaleTo(scale, x, y) {
    const next = Math.min(Math.max(scale, 0.01), MAX_SCALE);
    this.left = x - ((x - this.left) * next) / this.scale;
    this.top = y - ((y - this.top) * next) / this.scale;
    this.scale = next;
    this.fitted = false;
    this.#transform();
  }

  #transform() {
    this.content.style.transform = `translate(${this.left}px, ${this.top}px) scale(${this.scale})`;
    this.content.classList.toggle("pixels", this.scale >= 2);
    // lines and handles keep their width on the screen
    this.svg.style.setProperty("--px", String(1 / this.scale));
    this.#drawAim();
    this.root.dispatchEvent(new CustomEvent("viewchange"));
  }

  /** @param {WheelEvent} event */
  #wheel(event) {
    event.preventDefault();
    const box = this.frame.getBoundingClientRect();
    this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.clientX - box.left, event.clientY - box.top);
    this.#read(event);
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    if (event.ctrlKey || event.metaKey) return;
    const by = ARROWS[event.key];
    const own = event.target === this.frame; // not a handle that is drawn over it
    const zoom = (/** @type {number} */ factor) => {
      const at = this.aim && this.#onFrame(this.aim);
      this.zoom(factor, at?.[0], at?.[1]);
    };
    const far = nudge(event);
    if (far && own && (this.aim || this.drawing)) {
      this.setAim(this.aim ? { x: this.aim.x + far[0], y: this.aim.y + far[1] } : this.#aimStart());
    } else if (event.altKey) return;
    else if (by) {
      const step = event.shiftKey ? 120 : 30;
      this.left -= step * by[0];
      this.top -= step * by[1];
      this.fitted = false;
      this.#transform();
    } else if (event.key === "Enter" && own && (this.onpick || this.grey)) {
      if (this.aim) this.onpick?.(this.aim.x, this.aim.y, event);
      else this.setAim(this.#aimStart());
    } else if (event.key === "Escape") {
      if (!own) this.frame.focus();
      else if (this.aim || this.drawing) {
        this.setAim(null);
        this.onleave?.();
      } else return;
    } else if (event.key === "+" || event.key === "=") zoom(STEP);
    else if (event.key === "-") zoom(1 / STEP);
    else if (event.key === "0") this.fit();
    else if (event.key === "1") this.one();
    else if (event.key === "c") this.toggleCross();
    else return;
    event.preventDefault();
  }

  /** @param {Position} position */
  #onFrame({ x, y }) {
    return [this.left + (x + 0.5) * this.scale, this.top + (y + 0.5) * this.scale];
  }

  /** Middle of the visible part of the picture, or the first position given by `aimFrom`. */
  #aimStart() {
    const from = this.aimFrom?.();
    if (from) return from;
    const box = this.frame.getBoundingClientRect();
    return { x: Math.round((box.width / 2 - this.left) / this.scale - 0.5), y: Math.round((box.height / 2 - this.top) / this.scale - 0.5) };
  }

  /**
   * Put the cross-hair of the keyboard onto a pixel, and into view; null removes it.
   * @param {Position | null} position
   */
  setAim(position) {
    if (position && !this.width) return;
    const inside = (/** @type {number} */ value, /** @type {number} */ size) => Math.round(10 * Math.min(Math.max(value, 0), size - 1)) / 10;
    this.aim = position && { x: inside(position.x, this.width), y: inside(position.y, this.height) };
    if (this.aim) {
      this.readout.setAttribute("aria-live", "polite");
      const box = this.frame.getBoundingClientRect();
      const [x, y] = this.#onFrame(this.aim);
      const off = (/** @type {number} */ at, /** @type {number} */ size) => (at < 0 || at > size ? size / 2 - at : 0);
      const [right, down] = [off(x, box.width), off(y, box.height)];
      if (right || down) {
        this.left += right;
        this.top += down;
        this.fitted = false;
        this.#transform();
      }
      this.hover = this.aim;
      this.#updateReadout();
    } else {
      this.readout.removeAttribute("aria-live"); // mouse motion would be announced all the time
      this.hover = null;
    }
    this.#drawAim();
    this.onaim?.(this.aim);
  }

  #drawAim() {
    this.svg.querySelector(".aim")?.remove();
    if (!this.aim) return;
    const { x, y } = this.aim;
    const gap = 5 / this.scale; // the pixel itself stays visible
    const d = `M${x} -0.5V${y - gap}M${x} ${y + gap}V${this.height - 0.5}M-0.5 ${y}H${x - gap}M${x + gap} ${y}H${this.width - 0.5}`;
    this.svg.append(
      svg(
        "g",
        { class: "aim", "data-x": x, "data-y": y },
        svg("path", { ...stroke("#000", 3), d, opacity: 0.55 }),
        svg("path", { ...stroke("#ff9d1e", 1.5), d }),
      ),
    );
  }

  #pointers() {
    /** @typedef {[x: number, y: number]} Spot */
    /** @type {Map<number, Spot>} */
    const down = new Map();
    /** @type {Spot | null} */
    let start = null;
    let moved = false;
    this.hold = (id, at) => {
      down.set(id, at);
      moved = true;
    };
    this.frame.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || onGrab(event)) return;
      this.frame.setPointerCapture(event.pointerId);
      down.set(event.pointerId, [event.clientX, event.clientY]);
      start = [event.clientX, event.clientY];
      moved = down.size > 1;
    });
    this.frame.addEventListener("pointermove", (event) => {
      this.#read(event);
      const before = down.get(event.pointerId);
      if (!before) return;
      /** @type {Spot} */
      const now = [event.clientX, event.clientY];
      if (start && Math.hypot(now[0] - start[0], now[1] - start[1]) > 4) moved = true;
      if (down.size === 2) {
        const [other] = [...down].filter(([id]) => id !== event.pointerId).map(([, position]) => position);
        const span = (/** @type {Spot} */ a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
        const box = this.frame.getBoundingClientRect();
        // the point between the two fingers stays there
        this.left += (now[0] - before[0]) / 2;
        this.top += (now[1] - before[1]) / 2;
        if (span(before) > 5) this.zoom(span(now) / span(before), (now[0] + other[0]) / 2 - box.left, (now[1] + other[1]) / 2 - box.top);
      } else if (moved) {
        this.left += now[0] - before[0];
        this.top += now[1] - before[1];
        this.fitted = false;
        this.#transform();
      }
      down.set(event.pointerId, now);
    });
    const up = (/** @type {PointerEvent} */ event) => {
      if (!down.delete(event.pointerId)) return;
      if (!moved && event.type === "pointerup" && this.onpick) {
        const { x, y } = this.at(event);
        if (x >= -0.5 && y >= -0.5 && x <= this.width - 0.5 && y <= this.height - 0.5) this.onpick(x, y, event);
      }
    };
    this.frame.addEventListener("pointerup", up);
    this.frame.addEventListener("pointercancel", up);
    this.frame.addEventListener("pointerleave", () => {
      this.hover = this.aim;
    });
  }

  /** @param {MouseEvent} event */
  #read(event) {
    const { x, y } = this.at(event);
    const inside = x >= -0.5 && y >= -0.5 && x < this.width - 0.5 && y < this.height - 0.5;
    this.hover = inside ? { x, y } : null;
    if (!inside) {
      this.readout.textContent = "";
      return;
    }
    this.#updateReadout();
  }

  /** The values under a resting mouse have changed: another field or step, or the uncertainty has arrived. */
  reread() {
    this.outdated = true;
    this.#updateReadout();
  }

  async #updateReadout() {
    // one request at a time: positions passed in between are not requested
    if (this.asking) return;
    this.asking = true;
    try {
      while (this.hover) {
        const { x, y } = this.hover;
        this.outdated = false;
        const column = Math.round(x);
        const row = Math.round(y);
        const position = `x ${num(x, 5)} px   y ${num(y, 5)} px`;
        if (!this.readout.textContent) this.readout.textContent = position;
        const text = this.grey ? await this.grey(column, row).catch(() => null) : null;
        if (this.hover) this.readout.textContent = text ? `${position}   ${text}` : position;
        this.readout.dataset.column = String(column);
        this.readout.dataset.row = String(row);
        if (this.hover && this.hover.x === x && this.hover.y === y && !this.outdated) return;
      }
    } finally {
      this.asking = false;
    }
  }

  toggleCross() {
    this.cross = this.cross ? null : (this.aim ?? { x: (this.width - 1) / 2, y: (this.height - 1) / 2 });
    this.crossButton.setAttribute("aria-pressed", String(Boolean(this.cross)));
    this.#drawCross();
  }

  /** @param {Position} position */
  #putCross(position) {
    this.cross = position;
    this.#drawCross();
  }

  #drawCross() {
    this.svg.querySelector(".crosshair")?.remove();
    if (!this.cross || !this.width) return;
    const { x, y } = this.cross;
    const style = { class: "crosshair", ...stroke("#ff9d1e", 1.5), d: `M${x} -0.5V${this.height - 0.5}M-0.5 ${y}H${this.width - 0.5}` };
    this.svg.append(svg("path", style));
  }
}

/**
 * Attributes of a line over a picture that keeps its width, and its dashes, on the screen at any zoom.
 * @param {string} colour
 * @param {number} width
 * @param {number[]} dashes
 */
export function stroke(colour, width, dashes = []) {
  const fixed = (/** @type {number} */ value) => `calc(${value}px * var(--px, 1))`;
  return { stroke: colour, fill: "none", style: `stroke-width: ${fixed(width)}${dashes.length ? `; stroke-dasharray: ${dashes.map(fixed).join(" ")}` : ""}` };
}

/**
 * Step of an arrow key, px: with Shift farther, with Alt finer; null for other keys.
 * @param {KeyboardEvent} event
 * @returns {[number, number] | null}
 */
export function nudge(event) {
  const by = ARROWS[event.key];
  const step = event.shiftKey ? 10 : event.altKey ? 0.1 : 1;
  return by ? [step * by[0], step * by[1]] : null;
}

/**
 * Return true if a handle over the picture was grabbed.
 * @param {Event} event
 */
export const onGrab = (event) => event.target instanceof Element && event.target.closest(".grab") !== null;
