// The region over the picture: shapes, handles that can be dragged and moved by arrow keys, seeds.
import { num, svg } from "../../lib/dom.js";
import { nudge, stroke } from "../view.js";
import { corners, MIN_POINTS, radius } from "./shapes.js";
/** @import { RegionEditor } from "../region_editor.js" */
/** @import { View } from "../view.js" */
/** @import { Shape, Spot, State } from "./shapes.js" */
/** @typedef {{ name: string, at: Spot, colour: string, label: string, move: (to: Spot, state: State) => unknown, remove: (state: State) => unknown, view?: View }} Handle */

const COLOUR = { outline: "#ffd23e", hole: "#ff6a5c", crack: "#ff3df2", seed: "#33e0a0", draft: "#ffffff" };
/** Tools whose clicks existing shapes must not catch. */
const CLICKS = ["polygon", "hole", "crack", "three", "brush", "eraser"];

/** @param {readonly Spot[]} points */
const through = (points) => points.map((p, k) => `${k ? "L" : "M"}${p[0]} ${p[1]}`).join("");

/** @type {(points: readonly Spot[], colour: string, closed: boolean, fill?: string) => SVGElement} */
const line = (points, colour, closed, fill = "none") => svg("path", { d: through(points) + (closed ? "Z" : ""), ...stroke(colour, 2), fill });

/**
 * @param {Spot} at
 * @param {string} colour
 */
const dot = ([x, y], colour) => svg("path", { d: `M${x} ${y}h0.001`, ...stroke(colour, 6), "stroke-linecap": "round" });

/**
 * @param {Spot} at
 * @param {number} k
 */
const seedNumber = ([x, y], k) =>
  svg(
    "text",
    {
      x,
      y,
      fill: COLOUR.seed,
      "aria-hidden": "true",
      style:
        "font: bold calc(15px * var(--px, 1)) sans-serif; paint-order: stroke; stroke: #000; stroke-width: calc(3px * var(--px, 1)); transform: translate(calc(9px * var(--px, 1)), calc(-7px * var(--px, 1)))",
    },
    String(k + 1),
  );

/**
 * Everything over camera 1's and camera 2's picture.
 * @param {RegionEditor} editor
 * @returns {[SVGElement[], SVGElement[]]}
 */
export function drawn(editor) {
  const { outlines, holes, cracks, seeds } = editor.drawn;
  const parts = [
    ...outlines.map((shape) => line(corners(shape), COLOUR.outline, true, "#ffd23e14")),
    ...holes.map((shape) => line(corners(shape), COLOUR.hole, true, "#ff6a5c40")),
    ...cracks.map((points) => line(points, COLOUR.crack, false)),
    ...unfinished(editor),
    ...outlines.flatMap((shape, i) => shapeHandles(editor, "outlines", i, shape)),
    ...holes.flatMap((shape, i) => shapeHandles(editor, "holes", i, shape)),
  ];
  const add = (/** @type {Handle} */ handle) => grip(editor, handle);
  cracks.forEach((points, i) =>
    points.forEach((at, k) =>
      parts.push(
        add({
          name: `cracks.${i}.${k}`,
          at,
          colour: COLOUR.crack,
          label: `Point ${k + 1} of crack ${i + 1}`,
          move: (to, state) => {
            state.cracks[i][k] = to;
          },
          remove: (state) => {
            state.cracks[i].splice(k, 1);
            if (state.cracks[i].length < MIN_POINTS.crack) state.cracks.splice(i, 1);
          },
        }),
      ),
    ),
  );
  /** @type {SVGElement[]} */
  const second = [];
  seeds.forEach((seed, k) => {
    parts.push(
      seedNumber(seed.one, k),
      add({
        name: `seed.${k}`,
        at: seed.one,
        colour: COLOUR.seed,
        label: `Seed ${k + 1} in camera 1`,
        move: (to, state) => {
          state.seeds[k].one = to;
        },
        remove: (state) => {
          state.seeds.splice(k, 1);
        },
      }),
    );
    const course = /** @type {Spot[]} */ (editor.lines[k]?.line_px ?? []);
    if (course.length > 1)
      second.push(svg("path", { d: through(course), ...stroke(COLOUR.seed, 1.5, [5, 4]), opacity: seed.two ? 0.5 : 1, "data-role": "epipolar" }));
    if (seed.two)
      second.push(
        seedNumber(seed.two, k),
        add({
          name: `seed2.${k}`,
          at: seed.two,
          colour: COLOUR.seed,
          label: `Seed ${k + 1} in camera 2`,
          move: (to, state) => {
            state.seeds[k].two = to;
          },
          remove: (state) => {
            state.seeds[k].two = null;
          },
          view: editor.two,
        }),
      );
  });
  return [parts, second];
}

/**
 * The unfinished drawing, with a rubber band to the mouse or the cross-hair.
 * @param {RegionEditor} editor
 */
function unfinished({ draft, draftShape, tip, tool, painting }) {
  /** @type {SVGElement[]} */
  const parts = [];
  if (draft) {
    const shape = draftShape;
    const band = tip && draft.kind !== "rectangle" && draft.kind !== "circle" ? [...draft.points, tip] : draft.points;
    parts.push(
      shape ? line(corners(shape), COLOUR.draft, true) : line(band, COLOUR.draft, draft.kind === "polygon"),
      ...draft.points.map((p) => dot(p, COLOUR.draft)),
    );
    if (shape?.form === "circle") parts.push(dot(shape.points[0], COLOUR.draft));
  }
  if (tip && (tool === "brush" || tool === "eraser"))
    parts.push(
      svg("circle", { cx: tip[0], cy: tip[1], r: painting.brush / 2, ...stroke(tool === "brush" ? COLOUR.outline : COLOUR.hole, 1.5), "data-role": "brush" }),
    );
  return parts;
}

/**
 * @param {RegionEditor} editor
 * @param {"outlines" | "holes"} kind
 * @param {number} i
 * @param {Shape} shape
 */
function shapeHandles(editor, kind, i, shape) {
  const colour = kind === "holes" ? COLOUR.hole : COLOUR.outline;
  const of = kind === "holes" ? `hole ${i + 1}` : editor.drawn.outlines.length > 1 ? `outline ${i + 1}` : "the region";
  const whole = (/** @type {State} */ state) => {
    state[kind].splice(i, 1);
  };
  const add = (
    /** @type {number} */ k,
    /** @type {Spot} */ at,
    /** @type {string} */ label,
    /** @type {(to: Spot, own: Spot[]) => unknown} */ move,
    remove = whole,
  ) => grip(editor, { name: `${kind}.${i}.${k}`, at, colour, label, move: (to, state) => move(to, state[kind][i].points), remove });
  if (shape.form === "circle") {
    const [centre, rim] = shape.points;
    return [
      add(0, centre, `Centre of ${of}`, (to, own) => {
        const [[x, y], [u, v]] = own;
        own[1] = [u + to[0] - x, v + to[1] - y];
        own[0] = to;
      }),
      add(1, rim, `Rim of ${of}, radius ${num(radius(shape), 4)} px`, (to, own) => {
        own[1] = to;
      }),
    ];
  }
  if (shape.form === "rectangle")
    return corners(shape).map((at, k) =>
      add(k, at, `Corner ${k + 1} of ${of}`, (to, own) => {
        own[k === 0 || k === 3 ? 0 : 1][0] = to[0];
        own[k < 2 ? 0 : 1][1] = to[1];
      }),
    );
  return shape.points.map((at, k) =>
    add(
      k,
      at,
      kind === "holes" ? `Point ${k + 1} of ${of}` : `Corner ${k + 1} of ${of}`,
      (to, own) => {
        own[k] = to;
      },
      (state) => {
        state[kind][i].points.splice(k, 1);
        if (state[kind][i].points.length < MIN_POINTS.polygon) whole(state);
      },
    ),
  );
}

/**
 * A point that can be dragged, moved by arrow keys and deleted.
 * @param {RegionEditor} editor
 * @param {Handle} handle
 */
function grip(editor, { name, at: [x, y], colour, label, move, remove, view = editor.one }) {
  // existing shapes do not catch the clicks that draw another one
  const idle =
    CLICKS.includes(editor.tool) ||
    (editor.mode !== "new" && editor.tool !== "move" && editor.tool !== "seed") ||
    (editor.tool === "seed" && !name.startsWith("seed"));
  const node = svg("circle", {
    class: idle ? "handle" : "grab",
    "data-handle": name,
    cx: x,
    cy: y,
    r: 6,
    stroke: colour,
    fill: `${colour}66`,
    style: "r: calc(6px * var(--px, 1)); stroke-width: calc(2px * var(--px, 1))",
    tabindex: 0,
    role: "button",
    "aria-label": `${label}, at ${num(x, 5)}, ${num(y, 5)} px`,
  });
  node.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    event.stopPropagation();
    event.preventDefault();
    const before = JSON.stringify(editor.drawn);
    const follow = (/** @type {PointerEvent} */ next) => {
      const at = view.at(next);
      move(editor.inside([at.x, at.y], view), editor.drawn);
      editor.draw();
    };
    const end = () => {
      window.removeEventListener("pointermove", follow);
      window.removeEventListener("pointerup", end);
      window.removeEventListener("pointercancel", end);
      editor.dragged(before);
      /** @type {SVGElement | null} */ (document.querySelector(`[data-handle="${name}"]`))?.focus();
    };
    window.addEventListener("pointermove", follow);
    window.addEventListener("pointerup", end);
    window.addEventListener("pointercancel", end);
  });
  node.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey) return;
    const by = nudge(event);
    if (by) editor.change((state) => move(editor.inside([x + by[0], y + by[1]], view), state));
    else if (event.key === "Delete" || event.key === "Backspace") editor.change((state) => remove(state));
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  return node;
}
