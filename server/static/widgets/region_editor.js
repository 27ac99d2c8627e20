// Draw a region, holes, crack lines and seeds over the reference images: by mouse, by keyboard, by numbers.
//
// Everything is kept in camera 1's pixels, the first pixel's centre at (0, 0), to a tenth of a pixel.
import { h, svg, replace, num } from "../lib/dom.js";
import { nudge, onGrab, stroke } from "./view.js";
/** @import { View, Position } from "./view.js" */
/** @import { Model } from "#routes" */
/** @typedef {[x: number, y: number]} Spot */
/** @typedef {{ form: "rectangle" | "polygon", points: Spot[] }} Outline a rectangle by two opposite corners */
/** @typedef {{ outline: Outline | null, holes: Spot[][], cracks: Spot[][], seeds: { one: Spot, two: Spot | null }[] }} State */
/** @typedef {"move" | "rectangle" | "polygon" | "hole" | "crack" | "seed"} Tool */
/** @typedef {{ kind: "rectangle", points: [Spot, Spot] } | { kind: keyof typeof MIN_POINTS, points: Spot[] }} Draft unfinished shape */

/** @type {[tool: Tool, text: string, title: string][]} */
const TOOLS = [
  ["move", "Move", "Drag corners; arrow keys move the corner in focus, Delete removes it"],
  ["rectangle", "Rectangle", "Drag from corner to corner"],
  ["polygon", "Polygon", "Click each corner; Enter or a click on the first one ends it, Backspace takes one back"],
  ["hole", "Hole", "Click each corner of an area where nothing is measured; Enter ends it"],
  ["crack", "Crack line", "Click the points that the crack goes through; Enter ends it"],
  ["seed", "Seed", "Click a point in camera 1, then the same point in camera 2 on the line that appears there"],
];
const KEYS = "By keyboard: arrow keys move the cross-hair (Shift 10 px, Alt 0.1 px), Enter sets a point, Enter there again ends, Escape leaves.";
const COLOUR = { outline: "#ffd23e", hole: "#ff6a5c", crack: "#ff3df2", seed: "#33e0a0", draft: "#ffffff" };
const round = (/** @type {number} */ value) => Math.round(value * 10) / 10;
const MIN_POINTS = { outline: 3, hole: 3, crack: 2 };

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
    /** @type {State} */
    this.state = { outline: null, holes: [], cracks: [], seeds: [] };
    /** @type {string[]} states as JSON */
    this.past = [];
    /** @type {string[]} */
    this.future = [];
    /** @type {Draft | null} */
    this.draft = null;
    /** @type {Spot | null} */
    this.tip = null; // where the keyboard's cross-hair is while something is drawn
    /** @type {Tool} */
    this.tool = "move";
    /** @type {Model<"SeedsReply">["seeds"]} */
    this.lines = []; // epipolar line of each seed in camera 2
    this.layer = svg("g", { "data-role": "region" });
    this.layer2 = svg("g", { "data-role": "seeds2" });
    for (const [view, layer, label] of /** @type {[View, SVGElement, string][]} */ ([[one, this.layer, "Region"], [two, this.layer2, "Seeds"]])) {
      view.svg.append(layer);
      view.svg.removeAttribute("aria-hidden");
      view.svg.setAttribute("role", "group");
      view.svg.setAttribute("aria-label", `${label} drawn over the picture`);
    }
    one.onpick = (x, y, event) => this.#pick(x, y, event);
    two.onpick = (x, y, event) => this.#pick2(x, y, event);
    one.onaim = (aim) => this.#aimed(aim);
    one.onleave = () => this.use("move");
    two.onleave = () => this.use("move");
    two.aimFrom = () => this.#onLine();
    this.hint = h("p.quiet", { role: "status", style: { minHeight: "1.5em", margin: "0.25rem 0 0" } });
    this.buttons = TOOLS.map(([name, text, title]) => h("button", { type: "button", title, "aria-pressed": String(name === this.tool), onclick: (event) => this.use(name, event.detail === 0) }, text));
    this.undoButton = h("button", { type: "button", title: "Undo (Ctrl+Z)", onclick: () => this.undo() }, "Undo");
    this.redoButton = h("button", { type: "button", title: "Redo (Ctrl+Y)", onclick: () => this.redo() }, "Redo");
    this.bar = h("div.row", { role: "toolbar", "aria-label": "Drawing" }, this.buttons, this.undoButton, this.redoButton);
    this.list = h("div", { "data-role": "shapes" });
    this.#drag();
    one.frame.addEventListener("keydown", (event) => this.#key(event), true);
    this.draw();
  }

  /**
   * Take a tool; taken by keyboard, the focus moves to the picture.
   * @param {Tool} tool
   */
  use(tool, byKey = false) {
    this.tool = tool;
    this.draft = null;
    this.one.drawing = tool !== "move";
    this.two.drawing = tool === "seed";
    for (const view of [this.one, this.two]) if (!view.drawing && view.aim) view.setAim(null);
    if (byKey && this.one.drawing) this.one.frame.focus();
    TOOLS.forEach(([name], index) => this.buttons[index].setAttribute("aria-pressed", String(name === tool)));
    this.hint.textContent = `${TOOLS.find(([name]) => name === tool)?.[2]}. ${tool === "move" ? "" : KEYS}`;
    this.draw();
  }

  // history

  #keep() {
    this.past.push(JSON.stringify(this.state));
    if (this.past.length > 200) this.past.shift();
    this.future = [];
  }

  /** @param {(state: State) => unknown} edit */
  change(edit) {
    this.#keep();
    edit(this.state);
    this.#changed();
  }

  undo() {
    if (this.draft) {
      this.draft = null;
      this.draw();
      return;
    }
    const last = this.past.pop();
    if (last === undefined) return;
    this.future.push(JSON.stringify(this.state));
    this.state = JSON.parse(last);
    this.#changed();
  }

  redo() {
    const next = this.future.pop();
    if (next === undefined) return;
    this.past.push(JSON.stringify(this.state));
    this.state = JSON.parse(next);
    this.#changed();
  }

  #changed() {
    this.draw();
    this.drawList();
    this.onchange();
  }

  // values for the API

  /** @returns {Model<"Region"> | null} */
  region() {
    const { outline, holes, cracks } = this.state;
    if (!outline) return null;
    const p = outline.points;
    const region = outline.form === "rectangle"
      ? { rectangle: [Math.min(p[0][0], p[1][0]), Math.min(p[0][1], p[1][1]), Math.max(p[0][0], p[1][0]), Math.max(p[0][1], p[1][1])] }
      : { polygon: p };
    return { ...region, holes, cracks };
  }

  /** @returns {{ seeds?: Spot[], seeds_cam2?: (Spot | null)[] }} */
  seeds() {
    const { seeds } = this.state;
    if (!seeds.length) return {};
    return { seeds: seeds.map((seed) => seed.one), ...(seeds.some((seed) => seed.two) ? { seeds_cam2: seeds.map((seed) => seed.two) } : {}) };
  }

  /**
   * Middle of the region, where samples are shown.
   * @returns {Spot}
   */
  middle() {
    const outline = this.#corners(this.state.outline);
    if (!outline.length) return [this.one.width / 2, this.one.height / 2];
    const [xs, ys] = [outline.map((p) => p[0]), outline.map((p) => p[1])];
    return [(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...ys) + Math.max(...ys)) / 2];
  }

  /**
   * @param {Outline | null} outline
   * @returns {Spot[]}
   */
  #corners(outline) {
    if (!outline) return [];
    if (outline.form !== "rectangle") return outline.points;
    const [[x0, y0], [x1, y1]] = outline.points;
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
  }

  /**
   * @param {readonly number[]} at
   * @returns {Spot}
   */
  #inside([x, y], view = this.one) {
    return [round(Math.min(Math.max(x, 0), view.width - 1)), round(Math.min(Math.max(y, 0), view.height - 1))];
  }

  // mouse, and the cross-hair that keys move

  /** @param {Position | null} aim */
  #aimed(aim) {
    this.tip = aim && this.#inside([aim.x, aim.y]);
    if (this.draft?.kind === "rectangle" && this.tip) this.draft.points[1] = this.tip;
    if (this.draft) this.draw();
  }

  /** Point of the epipolar line of a seed without a position in camera 2: the one nearest to its position in camera 1. */
  #onLine() {
    const open = this.state.seeds.findLastIndex((seed) => !seed.two);
    if (open < 0) return null;
    const [x, y] = this.state.seeds[open].one;
    const away = (/** @type {readonly number[]} */ p) => Math.hypot(p[0] - x, p[1] - y);
    const course = this.lines[open]?.line_px ?? [];
    const [u, v] = course.length ? course.reduce((a, b) => (away(b) < away(a) ? b : a)) : [x, y];
    return { x: u, y: v };
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {Event} event
   */
  #pick(x, y, event) {
    const spot = this.#inside([x, y]);
    const byKey = event.type === "keydown";
    if (this.tool === "seed") {
      this.change((state) => state.seeds.push({ one: spot, two: null }));
      if (byKey) {
        this.hint.textContent = "Now the same point in camera 2: the focus is there. Arrow keys begin on its line; with Escape its position is found automatically.";
        this.two.setAim(null);
        this.two.frame.focus();
      }
      return;
    }
    if (this.tool === "rectangle" && byKey) {
      if (!this.draft) this.draft = { kind: "rectangle", points: [spot, spot] };
      else {
        const [from] = this.draft.points;
        if (Math.abs(spot[0] - from[0]) < 2 || Math.abs(spot[1] - from[1]) < 2) return;
        this.draft = null;
        this.change((state) => { state.outline = { form: "rectangle", points: [from, spot] }; });
      }
      this.draw();
      return;
    }
    if (this.tool !== "polygon" && this.tool !== "hole" && this.tool !== "crack") return;
    this.draft ??= { kind: this.tool === "polygon" ? "outline" : this.tool, points: [] };
    const { kind, points } = this.draft;
    if (kind === "rectangle") return;
    const first = points[0];
    const near = first && Math.hypot(first[0] - spot[0], first[1] - spot[1]) * this.one.scale < 9;
    const last = points.at(-1);
    const twice = last && Math.hypot(last[0] - spot[0], last[1] - spot[1]) * this.one.scale < 3;
    if ((near && kind !== "crack" && points.length >= 3) || (twice && points.length >= MIN_POINTS[kind])) this.finish();
    else if (!twice) {
      points.push(spot);
      this.draw();
    }
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {Event} event
   */
  #pick2(x, y, event) {
    if (this.tool !== "seed") return;
    const spot = this.#inside([x, y], this.two);
    const open = this.state.seeds.findLastIndex((seed) => !seed.two);
    if (open < 0) {
      this.hint.textContent = "Click the point in camera 1 first.";
      return;
    }
    this.change((state) => { state.seeds[open].two = spot; });
    if (event.type === "keydown") {
      this.two.setAim(null);
      this.one.frame.focus();
    }
  }

  finish() {
    if (!this.draft || this.draft.kind === "rectangle") return;
    const { kind, points } = this.draft;
    if (points.length < MIN_POINTS[kind]) {
      this.hint.textContent = `At least ${MIN_POINTS[kind]} points are needed.`;
      return;
    }
    this.draft = null;
    this.change((state) => {
      if (kind === "outline") state.outline = { form: "polygon", points };
      else state[kind === "hole" ? "holes" : "cracks"].push(points);
    });
  }

  #drag() {
    const frame = this.one.frame;
    /** @type {Spot | null} */
    let from = null;
    frame.addEventListener("pointerdown", (event) => {
      if (this.tool !== "rectangle" || event.button !== 0 || onGrab(event)) return;
      event.stopImmediatePropagation();
      event.preventDefault();
      frame.focus();
      frame.setPointerCapture(event.pointerId);
      const at = this.one.at(event);
      from = this.#inside([at.x, at.y]);
      this.draft = { kind: "rectangle", points: [from, from] };
    }, true);
    frame.addEventListener("pointermove", (event) => {
      if (!from) return;
      const at = this.one.at(event);
      this.draft = { kind: "rectangle", points: [from, this.#inside([at.x, at.y])] };
      this.draw();
    }, true);
    frame.addEventListener("pointerup", (event) => {
      if (!from) return;
      const at = this.one.at(event);
      const to = this.#inside([at.x, at.y]);
      const start = from;
      from = null;
      this.draft = null;
      if (Math.abs(to[0] - start[0]) < 2 || Math.abs(to[1] - start[1]) < 2) this.draw();
      else this.change((state) => { state.outline = { form: "rectangle", points: [start, to] }; });
    }, true);
    frame.addEventListener("pointercancel", () => { from = null; this.draft = null; this.draw(); });
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") {
      if (event.shiftKey) this.redo();
      else this.undo();
    } else if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "y") this.redo();
    else if (event.key === "Enter" && this.draft && !this.one.aim) this.finish();
    else if (event.key === "Backspace" && this.draft) {
      this.draft.points.pop();
      if (!this.draft.points.length) this.draft = null;
      this.draw();
    } else if (event.key === "Escape" && this.draft && !this.one.aim) {
      this.draft = null;
      this.draw();
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }

  // drawing

  draw() {
    const { outline, holes, cracks, seeds } = this.state;
    /** @type {SVGElement[]} */
    const parts = [];
    /** @type {(points: Spot[], colour: string, closed: boolean, fill?: string) => SVGElement} */
    const line = (points, colour, closed, fill = "none") => svg("path", { d: points.map((p, k) => `${k ? "L" : "M"}${p[0]} ${p[1]}`).join("") + (closed ? "Z" : ""), ...stroke(colour, 2), fill });
    const corners = this.#corners(outline);
    if (corners.length) parts.push(line(corners, COLOUR.outline, true, "#ffd23e14"));
    for (const hole of holes) parts.push(line(hole, COLOUR.hole, true, "#ff6a5c40"));
    for (const crack of cracks) parts.push(line(crack, COLOUR.crack, false));
    if (this.draft) parts.push(line(this.draft.kind === "rectangle" ? this.#corners({ form: "rectangle", points: this.draft.points }) : this.tip ? [...this.draft.points, this.tip] : this.draft.points, COLOUR.draft, this.draft.kind !== "crack", "none"), ...this.draft.points.map((p) => this.#dot(p, COLOUR.draft)));
    if (outline?.form === "rectangle") {
      corners.forEach((p, k) => parts.push(this.#handle(`outline.${k}`, p, COLOUR.outline, `Corner ${k + 1} of the region`, (to, state) => {
        if (!state.outline) return;
        const own = state.outline.points;
        own[k === 0 || k === 3 ? 0 : 1][0] = to[0];
        own[k < 2 ? 0 : 1][1] = to[1];
      }, (state) => { state.outline = null; })));
    } else corners.forEach((p, k) => parts.push(this.#handle(`outline.${k}`, p, COLOUR.outline, `Corner ${k + 1} of the region`, (to, state) => { if (state.outline) state.outline.points[k] = to; }, (state) => { state.outline?.points.splice(k, 1); if (state.outline && state.outline.points.length < 3) state.outline = null; })));
    for (const [kind, name] of /** @type {const} */ ([["holes", "hole"], ["cracks", "crack"]])) {
      this.state[kind].forEach((points, i) => points.forEach((p, k) => parts.push(this.#handle(`${kind}.${i}.${k}`, p, COLOUR[name], `Point ${k + 1} of ${name} ${i + 1}`,
        (to, state) => { state[kind][i][k] = to; }, (state) => { state[kind][i].splice(k, 1); if (state[kind][i].length < MIN_POINTS[name]) state[kind].splice(i, 1); }))));
    }
    /** @type {SVGElement[]} */
    const second = [];
    seeds.forEach((seed, k) => {
      parts.push(this.#seed(seed.one, k), this.#handle(`seed.${k}`, seed.one, COLOUR.seed, `Seed ${k + 1} in camera 1`, (to, state) => { state.seeds[k].one = to; }, (state) => { state.seeds.splice(k, 1); }));
      const course = this.lines[k]?.line_px ?? [];
      if (course.length > 1) second.push(svg("path", { d: course.map((p, i) => `${i ? "L" : "M"}${p[0]} ${p[1]}`).join(""), ...stroke(COLOUR.seed, 1.5, [5, 4]), opacity: seed.two ? 0.5 : 1, "data-role": "epipolar" }));
      if (seed.two) second.push(this.#seed(seed.two, k), this.#handle(`seed2.${k}`, seed.two, COLOUR.seed, `Seed ${k + 1} in camera 2`, (to, state) => { state.seeds[k].two = to; }, (state) => { state.seeds[k].two = null; }, this.two));
    });
    replace(this.layer, parts);
    replace(this.layer2, second);
    this.undoButton.setAttribute("aria-disabled", String(!this.past.length && !this.draft));
    this.redoButton.setAttribute("aria-disabled", String(!this.future.length));
  }

  /**
   * @param {Spot} at
   * @param {string} colour
   */
  #dot([x, y], colour) {
    return svg("path", { d: `M${x} ${y}h0.001`, ...stroke(colour, 6), "stroke-linecap": "round" });
  }

  /**
   * @param {Spot} at
   * @param {number} k
   */
  #seed([x, y], k) {
    return svg("text", { x, y, fill: COLOUR.seed, "aria-hidden": "true", style: "font: bold calc(15px * var(--px, 1)) sans-serif; paint-order: stroke; stroke: #000; stroke-width: calc(3px * var(--px, 1)); transform: translate(calc(9px * var(--px, 1)), calc(-7px * var(--px, 1)))" }, String(k + 1));
  }

  /**
   * @param {string} name
   * @param {Spot} at
   * @param {string} colour
   * @param {string} label
   * @param {(to: Spot, state: State) => unknown} move
   * @param {(state: State) => unknown} remove
   */
  #handle(name, [x, y], colour, label, move, remove, view = this.one) {
    // existing shapes do not catch the clicks that draw another one
    const idle = ["polygon", "hole", "crack"].includes(this.tool) || (this.tool === "seed" && !name.startsWith("seed"));
    const node = svg("circle", { class: idle ? "handle" : "grab", "data-handle": name, cx: x, cy: y, r: 6, stroke: colour, fill: `${colour}66`, style: "r: calc(6px * var(--px, 1)); stroke-width: calc(2px * var(--px, 1))", tabindex: 0, role: "button", "aria-label": `${label}, at ${num(x, 5)}, ${num(y, 5)} px` });
    let moving = false;
    node.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.stopPropagation();
      event.preventDefault();
      moving = true;
      const before = JSON.stringify(this.state);
      const follow = (/** @type {PointerEvent} */ next) => {
        const at = view.at(next);
        move(this.#inside([at.x, at.y], view), this.state);
        this.draw();
      };
      const end = () => {
        window.removeEventListener("pointermove", follow);
        window.removeEventListener("pointerup", end);
        window.removeEventListener("pointercancel", end);
        if (moving && before !== JSON.stringify(this.state)) {
          this.past.push(before);
          this.future = [];
        }
        moving = false;
        this.#changed();
        /** @type {SVGElement | null} */ (document.querySelector(`[data-handle="${name}"]`))?.focus();
      };
      window.addEventListener("pointermove", follow);
      window.addEventListener("pointerup", end);
      window.addEventListener("pointercancel", end);
    });
    node.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey) return;
      const by = nudge(event);
      if (by) this.change((state) => move(this.#inside([x + by[0], y + by[1]], view), state));
      else if (event.key === "Delete" || event.key === "Backspace") this.change((state) => remove(state));
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
    return node;
  }

  /** The same by numbers: for the keyboard, and to be exact. */
  drawList() {
    const { outline, holes, cracks, seeds } = this.state;
    const text = (/** @type {Spot[]} */ points) => points.map((p) => `${p[0]}, ${p[1]}`).join("; ");
    /** @type {(label: string, points: Spot[], minPoints: number, put: (state: State, points: Spot[]) => unknown, remove: (state: State) => unknown) => HTMLElement} */
    const row = (label, points, minPoints, put, remove) => {
      const input = h("input", { type: "text", value: text(points), "aria-label": `${label}: x, y of each point, px` });
      const trouble = h("small.hint");
      input.addEventListener("change", () => {
        const read = input.value.split(";").map((one) => one.trim()).filter(Boolean).map((one) => one.split(/[\s,]+/).map(Number));
        if (read.length < minPoints || read.some((p) => p.length !== 2 || !p.every(Number.isFinite))) {
          trouble.textContent = `Write x, y between semicolons, at least ${minPoints} points.`;
          return;
        }
        this.change((state) => put(state, read.map((p) => this.#inside(p))));
      });
      return h("div.row", h("span", { style: { minWidth: "6.5rem" } }, label), h("span", { style: { flex: 1, minWidth: "9rem", display: "grid" } }, input, trouble), h("span.unit", "px"),
        h("button", { type: "button", "aria-label": `Delete ${label}`, onclick: () => this.change(remove) }, "Delete"));
    };
    replace(this.list,
      outline ? row(outline.form === "rectangle" ? "Rectangle" : "Polygon", outline.points, outline.form === "rectangle" ? 2 : 3, (state, points) => { if (state.outline) state.outline.points = outline.form === "rectangle" ? points.slice(0, 2) : points; }, (state) => { state.outline = null; })
        : h("div.row", h("span.quiet", "No region yet."), h("button", { type: "button", onclick: () => this.change((state) => { const [w, k] = [this.one.width, this.one.height]; state.outline = { form: "rectangle", points: [[round(0.2 * w), round(0.2 * k)], [round(0.8 * w), round(0.8 * k)]] }; }) }, "Rectangle in the middle")),
      holes.map((points, i) => row(`Hole ${i + 1}`, points, 3, (state, read) => { state.holes[i] = read; }, (state) => { state.holes.splice(i, 1); })),
      cracks.map((points, i) => row(`Crack ${i + 1}`, points, 2, (state, read) => { state.cracks[i] = read; }, (state) => { state.cracks.splice(i, 1); })),
      seeds.map((seed, i) => row(`Seed ${i + 1}`, seed.two ? [seed.one, seed.two] : [seed.one], 1, (state, read) => { state.seeds[i] = { one: read[0], two: read[1] ?? null }; }, (state) => { state.seeds.splice(i, 1); })),
      seeds.map((_, i) => { const off = this.lines[i]?.distance_px; return off === null || off === undefined ? null : h(off > 8 ? "p.problem" : "p.quiet", `Seed ${i + 1}: its position in camera 2 is ${num(off, 2)} px from its epipolar line${off > 8 ? "; the limit is 8 px: it is another point." : "."}`); }));
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
