// Draw a region, holes, crack lines and seeds over the reference images: by mouse, finger, keyboard, numbers, or as a mask.
import { h, replace, svg } from "../lib/dom.js";
import { drawn } from "./region/drawing.js";
import { rows } from "./region/list.js";
import { Painting } from "./region/painting.js";
import { listen, pick, pickInTwo } from "./region/pointing.js";
import { box, distance, nothing, regionOf, round, throughThree } from "./region/shapes.js";
import { hintOf, MODES, TOOLS } from "./region/tools.js";
/** @import { View, Position } from "./view.js" */
/** @import { Model } from "#routes" */
/** @import { Shape, Spot, State } from "./region/shapes.js" */
/** @import { Mode, Tool } from "./region/tools.js" */
/** @typedef {"rectangle" | "polygon" | "circle" | "three" | "crack"} DraftKind */
/** @typedef {{ kind: DraftKind, points: Spot[] }} Draft unfinished shape */

export class RegionEditor {
  /**
   * @param {View} one camera 1's view
   * @param {View} two camera 2's view
   * @param {() => void} onchange after every change
   */
  constructor(one, two, onchange) {
    this.one = one;
    this.two = two;
    this.onchange = onchange;
    this.drawn = nothing();
    /** @type {string[]} states as JSON */
    this.past = [];
    /** @type {string[]} */
    this.future = [];
    /** @type {Draft | null} */
    this.draft = null;
    /** @type {Spot | null} */
    this.tip = null; // where the keyboard's cross-hair or the mouse is while something is drawn
    /** @type {Tool} */
    this.tool = "move";
    /** @type {Mode} */
    this.mode = "new";
    this.painting = new Painting(this);
    this.mask = this.painting.mask;
    one.content.insertBefore(this.mask.canvas, one.svg);
    /** @type {Model<"SeedsReply">["seeds"]} */
    this.lines = []; // epipolar line of each seed in camera 2
    this.layer = svg("g", { "data-role": "region" });
    this.layer2 = svg("g", { "data-role": "seeds2" });
    for (const [view, layer, label] of /** @type {[View, SVGElement, string][]} */ ([
      [one, this.layer, "Region"],
      [two, this.layer2, "Seeds"],
    ])) {
      view.svg.append(layer);
      view.svg.removeAttribute("aria-hidden");
      view.svg.setAttribute("role", "group");
      view.svg.setAttribute("aria-label", `${label} drawn over the picture`);
    }
    one.onpick = (x, y, event) => pick(this, x, y, event);
    two.onpick = (x, y, event) => pickInTwo(this, x, y, event);
    one.onaim = (aim) => this.#aimed(aim);
    one.onleave = () => this.use("move");
    two.onleave = () => this.use("move");
    two.aimFrom = () => this.#onLine();
    one.image.addEventListener("load", () => this.#changed(false));
    this.hint = h("p.quiet", { role: "status", "data-role": "hint" });
    this.buttons = TOOLS.map(([name, text, title]) =>
      h("button", { type: "button", title, "aria-pressed": String(name === this.tool), onclick: (event) => this.use(name, event.detail === 0) }, text),
    );
    this.modes = MODES.map(([name, text, title]) =>
      h("button", { type: "button", title, "aria-pressed": String(name === this.mode), onclick: () => this.as(name) }, text),
    );
    this.undoButton = h("button", { type: "button", title: "Undo (Ctrl+Z)", onclick: () => this.undo() }, "Undo");
    this.redoButton = h("button", { type: "button", title: "Redo (Ctrl+Y)", onclick: () => this.redo() }, "Redo");
    this.bar = h("div.row", { role: "toolbar", "aria-label": "Drawing" }, this.buttons, this.undoButton, this.redoButton);
    this.more = h("div.row", { role: "group", "aria-label": "Action of the next shape" }, this.modes);
    this.masks = h("details", h("summary", "Brush and mask"), h("div.row.region-more", this.painting.controls));
    this.list = h("div", { "data-role": "shapes" });
    listen(this);
    this.draw();
  }

  /**
   * Take a tool; taken by keyboard, the focus moves to the picture.
   * @param {Tool} tool
   */
  use(tool, byKey = false) {
    this.tool = tool;
    this.draft = null;
    if (!this.one.aim) this.tip = null;
    this.one.drawing = tool !== "move";
    this.two.drawing = tool === "seed";
    for (const view of [this.one, this.two]) if (!view.drawing && view.aim) view.setAim(null);
    if (tool === "brush" || tool === "eraser") this.masks.open = true;
    if (byKey && this.one.drawing) this.one.frame.focus();
    TOOLS.forEach(([name], index) => this.buttons[index].setAttribute("aria-pressed", String(name === tool)));
    this.hint.textContent = hintOf(tool);
    this.draw();
  }

  /**
   * Action of the next shape on the region.
   * @param {Mode} mode
   */
  as(mode) {
    this.mode = mode;
    MODES.forEach(([name], index) => this.modes[index].setAttribute("aria-pressed", String(name === mode)));
    this.draw();
  }

  // history

  /** @param {string} before state as JSON */
  #keep(before = JSON.stringify(this.drawn)) {
    this.past.push(before);
    if (this.past.length > 200) this.past.shift();
    this.future = [];
  }

  /** @param {(state: State) => unknown} edit */
  change(edit) {
    this.#keep();
    edit(this.drawn);
    this.#changed();
  }

  /**
   * A handle was let go.
   * @param {string} before state as JSON
   */
  dragged(before) {
    if (before !== JSON.stringify(this.drawn)) this.#keep(before);
    this.#changed();
  }

  undo() {
    if (this.draft) {
      this.draft = null;
      this.draw();
    } else this.#step(this.past, this.future);
  }

  redo() {
    this.#step(this.future, this.past);
  }

  /**
   * @param {string[]} from
   * @param {string[]} to
   */
  #step(from, to) {
    const next = from.pop();
    if (next === undefined) return;
    to.push(JSON.stringify(this.drawn));
    this.drawn = JSON.parse(next);
    this.#changed();
  }

  /** Draw the kept drawing again; `told`: it has changed. */
  #changed(told = true) {
    this.mask
      .show(this.drawn.mask, this.one)
      .then((other) => {
        if (!other) return;
        this.drawList();
        this.onchange();
      })
      .catch(() => this.painting.say("The mask cannot be read."));
    this.draw();
    if (!told) return;
    this.drawList();
    this.onchange();
  }

  /** Show the kept mask again, where another one was painted over it. */
  repaint() {
    this.mask.shown = "";
    this.#changed(false);
  }

  /** The drawing, as plain JSON. */
  state() {
    return structuredClone(this.drawn);
  }

  /**
   * Restore a drawing of `state()`; the present one and its history are lost.
   * @param {Partial<State>} state
   */
  restore(state) {
    this.drawn = { ...nothing(), ...structuredClone(state) };
    this.past = [];
    this.future = [];
    this.draft = null;
    this.#changed();
  }

  // values for the API

  /** @returns {Model<"Region"> | null} */
  region() {
    return regionOf(this.drawn, this.one);
  }

  /** @returns {{ seeds?: Spot[], seeds_cam2?: (Spot | null)[] }} */
  seeds() {
    const { seeds } = this.drawn;
    if (!seeds.length) return {};
    return { seeds: seeds.map((seed) => seed.one), ...(seeds.some((seed) => seed.two) ? { seeds_cam2: seeds.map((seed) => seed.two) } : {}) };
  }

  /** Box about the region, [x0, y0, x1, y1] in px; null without a region. */
  box() {
    return this.drawn.mask === null ? box(this.drawn.outlines) : this.mask.box;
  }

  /** Shorter side of the box about the region, px; null without a region. */
  width() {
    const about = this.box();
    return about && Math.min(about[2] - about[0], about[3] - about[1]) + 1;
  }

  /**
   * Middle of the region, where samples are shown.
   * @returns {Spot}
   */
  middle() {
    const about = this.box();
    return about ? [(about[0] + about[2]) / 2, (about[1] + about[3]) / 2] : [this.one.width / 2, this.one.height / 2];
  }

  /**
   * @param {readonly number[]} at
   * @returns {Spot}
   */
  inside([x, y], view = this.one) {
    return [round(Math.min(Math.max(x, 0), view.width - 1)), round(Math.min(Math.max(y, 0), view.height - 1))];
  }

  // drawing

  /** @param {Position | null} aim */
  #aimed(aim) {
    this.tip = aim && this.inside([aim.x, aim.y]);
    if ((this.draft?.kind === "rectangle" || this.draft?.kind === "circle") && this.tip) this.draft.points[1] = this.tip;
    if (this.draft || this.tool === "brush" || this.tool === "eraser") this.draw();
  }

  /** Point of the epipolar line of a seed without a position in camera 2: the one nearest to its position in camera 1. */
  #onLine() {
    const open = this.drawn.seeds.findLastIndex((seed) => !seed.two);
    if (open < 0) return null;
    const at = this.drawn.seeds[open].one;
    const course = this.lines[open]?.line_px ?? [];
    const [u, v] = course.length ? course.reduce((a, b) => (distance(b, at) < distance(a, at) ? b : a)) : at;
    return { x: u, y: v };
  }

  /** The unfinished shape, as far as it is one; null for lines. @returns {Shape | null} */
  get draftShape() {
    if (!this.draft) return null;
    const { kind, points } = this.draft;
    if (kind === "rectangle" || kind === "circle") return { form: kind, points };
    const three = kind === "three" && this.tip && points.length === 2 ? [...points, this.tip] : points;
    return kind === "three" && three.length === 3 ? throughThree(three) : null;
  }

  /**
   * Put a finished shape into the region, as the tool and the mode say.
   * @param {Shape} shape
   */
  put(shape) {
    const cut = this.tool === "hole" || this.mode === "cut";
    if (!cut && this.mode === "add" && this.drawn.mask !== null) {
      this.mask.begin({ ...this.drawn, outlines: [shape] }, this.one);
      this.painting.end();
      return;
    }
    this.change((state) => {
      if (cut) state.holes.push(shape);
      else if (this.mode === "add") state.outlines.push(shape);
      else Object.assign(state, { outlines: [shape], mask: null });
    });
  }

  draw() {
    const [parts, second] = drawn(this);
    replace(this.layer, parts);
    replace(this.layer2, second);
    this.two.root.parentElement?.classList.toggle("inset", !this.drawn.seeds.length && this.tool !== "seed");
    this.undoButton.setAttribute("aria-disabled", String(!this.past.length && !this.draft));
    this.redoButton.setAttribute("aria-disabled", String(!this.future.length));
  }

  drawList() {
    replace(this.list, rows(this));
  }

  /**
   * Show the epipolar lines of the seeds.
   * @param {Model<"SeedsReply">["seeds"]} lines
   */
  setLines(lines) {
    this.lines = lines;
    this.draw();
    this.drawList();
  }
}
