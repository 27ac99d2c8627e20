// Drawing by mouse, finger and pen, and by the cross-hair that keys move.
import { onGrab } from "../view.js";
import { distance, MIN_POINTS, trouble } from "./shapes.js";
/** @import { RegionEditor } from "../region_editor.js" */
/** @import { Spot } from "./shapes.js" */

/** Tools that draw from the button's press to its release. */
const DRAGGED = ["rectangle", "circle"];
const PAINTED = ["brush", "eraser"];

/**
 * @param {RegionEditor} editor
 * @param {number} x
 * @param {number} y
 * @param {Event} event
 */
export function pick(editor, x, y, event) {
  const spot = editor.inside([x, y]);
  const byKey = event.type === "keydown";
  if (editor.tool === "seed") return pickSeed(editor, spot, byKey);
  if (PAINTED.includes(editor.tool)) return byKey ? editor.painting.dab(spot) : undefined;
  if (editor.tool === "move" || (DRAGGED.includes(editor.tool) && !byKey)) return undefined;
  const kind = /** @type {import("../region_editor.js").DraftKind} */ (editor.tool === "hole" ? "polygon" : editor.tool);
  if (!editor.draft) editor.draft = { kind, points: DRAGGED.includes(kind) ? [spot, spot] : [spot] };
  else if (DRAGGED.includes(kind)) {
    editor.draft.points[1] = spot;
    finish(editor);
  } else point(editor, spot);
  editor.draw();
  return undefined;
}

/**
 * One more point of a polygon, a crack, or a circle through three points.
 * @param {RegionEditor} editor
 * @param {Spot} spot
 */
function point(editor, spot) {
  const { draft, one } = editor;
  if (!draft) return;
  const { kind, points } = draft;
  const last = points[points.length - 1];
  const twice = distance(last, spot) * one.scale < 3;
  const least = kind === "crack" ? MIN_POINTS.crack : 3;
  const closed = kind === "polygon" && points.length >= 3 && distance(points[0], spot) * one.scale < 9;
  if (closed || (twice && kind !== "three" && points.length >= least)) finish(editor);
  else if (!twice) {
    points.push(spot);
    if (kind === "three" && points.length === 3) finish(editor);
  }
}

/**
 * End the shape that is being drawn; a dragged one that encloses nothing was a click.
 * @param {RegionEditor} editor
 */
function finish(editor, dragged = false) {
  if (!editor.draft) return;
  const { kind, points } = editor.draft;
  if (kind === "crack") {
    if (points.length < MIN_POINTS.crack) {
      editor.hint.textContent = `At least ${MIN_POINTS.crack} points are needed.`;
      return;
    }
    editor.draft = null;
    editor.change((state) => state.cracks.push(points));
    return;
  }
  const three = kind === "three";
  const shape = kind === "polygon" ? { form: kind, points } : three && points.length < 3 ? null : editor.draftShape;
  const wrong = shape
    ? trouble(shape)
    : three && points.length === 3
      ? "The three points are on one line: no circle goes through them."
      : "Three points are needed.";
  if (dragged || !wrong || (three && points.length === 3)) editor.draft = null;
  if (shape && !wrong) editor.put(shape);
  else {
    if (!dragged) editor.hint.textContent = kind === "polygon" ? "At least 3 points are needed." : String(wrong);
    editor.draw();
  }
}

/**
 * @param {RegionEditor} editor
 * @param {Spot} spot
 * @param {boolean} byKey
 */
function pickSeed(editor, spot, byKey) {
  editor.change((state) => state.seeds.push({ one: spot, two: null }));
  if (!byKey) return;
  editor.hint.textContent =
    "Now the same point in camera 2: the focus is there. Arrow keys begin on its line; with Escape its position is found automatically.";
  editor.two.setAim(null);
  editor.two.frame.focus();
}

/**
 * @param {RegionEditor} editor
 * @param {number} x
 * @param {number} y
 * @param {Event} event
 */
export function pickInTwo(editor, x, y, event) {
  if (editor.tool !== "seed") return;
  const open = editor.drawn.seeds.findLastIndex((seed) => !seed.two);
  if (open < 0) {
    editor.hint.textContent = "Click the point in camera 1 first.";
    return;
  }
  editor.change((state) => {
    state.seeds[open].two = editor.inside([x, y], editor.two);
  });
  if (event.type === "keydown") {
    editor.two.setAim(null);
    editor.one.frame.focus();
  }
}

/**
 * Rectangles and circles from corner to corner, paint along the way, and a rubber band to the mouse.
 * @param {RegionEditor} editor
 */
export function listen(editor) {
  const { one } = editor;
  const frame = one.frame;
  /** @type {{ id: number, points: Spot[], at: [number, number] } | null} `at`: in the window */
  let held = null;
  const spotOf = (/** @type {PointerEvent} */ event) => {
    const { x, y } = one.at(event);
    return editor.inside([x, y]);
  };
  const drop = () => {
    if (held && PAINTED.includes(editor.tool)) editor.repaint();
    held = null;
    editor.draft = null;
    editor.draw();
  };
  frame.addEventListener(
    "pointerdown",
    (event) => {
      const painted = PAINTED.includes(editor.tool);
      if (!(painted || DRAGGED.includes(editor.tool)) || event.button !== 0 || onGrab(event) || !one.width) return;
      if (held) {
        // a second finger: both move and zoom the picture, nothing is drawn
        one.hold(held.id, held.at);
        return drop();
      }
      event.stopImmediatePropagation();
      event.preventDefault();
      frame.focus();
      frame.setPointerCapture(event.pointerId);
      held = { id: event.pointerId, points: [spotOf(event)], at: [event.clientX, event.clientY] };
      const [from] = held.points;
      if (!painted) editor.draft = { kind: editor.tool === "circle" ? "circle" : "rectangle", points: [from, from] };
      else if (!editor.painting.begin()) held = null;
      else editor.painting.strokeTo(from, from);
      return undefined;
    },
    true,
  );
  frame.addEventListener(
    "pointermove",
    (event) => {
      if (!held) {
        if (event.pointerType === "touch" || one.aim || !(PAINTED.includes(editor.tool) || editor.draft)) return;
        editor.tip = spotOf(event);
        editor.draw();
        return;
      }
      if (event.pointerId !== held.id) return;
      const spot = spotOf(event);
      held.at = [event.clientX, event.clientY];
      if (editor.draft) editor.draft.points[1] = spot;
      else editor.painting.strokeTo(held.points[held.points.length - 1], spot);
      held.points.push(spot);
      editor.tip = PAINTED.includes(editor.tool) ? spot : null;
      editor.draw();
    },
    true,
  );
  frame.addEventListener(
    "pointerup",
    (event) => {
      if (!held || event.pointerId !== held.id) return;
      held = null;
      if (!editor.draft) {
        editor.painting.end();
        return;
      }
      editor.draft.points[1] = spotOf(event);
      finish(editor, true);
    },
    true,
  );
  frame.addEventListener("pointercancel", drop);
  frame.addEventListener("pointerleave", () => {
    if (held || one.aim || !editor.tip) return;
    editor.tip = null;
    editor.draw();
  });
  frame.addEventListener("keydown", (event) => key(editor, event), true);
}

/**
 * @param {RegionEditor} editor
 * @param {KeyboardEvent} event
 */
function key(editor, event) {
  const command = event.ctrlKey || event.metaKey;
  const letter = event.key.toLowerCase();
  const { draft } = editor;
  if (command && letter === "z") {
    if (event.shiftKey) editor.redo();
    else editor.undo();
  } else if (command && letter === "y") editor.redo();
  else if (event.key === "Enter" && draft && !editor.one.aim) finish(editor);
  else if (event.key === "Backspace" && draft) {
    draft.points.pop();
    if (!draft.points.length || DRAGGED.includes(draft.kind)) editor.draft = null;
    editor.draw();
  } else if (event.key === "Escape" && draft && !editor.one.aim) {
    editor.draft = null;
    editor.draw();
  } else if ((event.key === "[" || event.key === "]") && PAINTED.includes(editor.tool))
    editor.painting.setBrush(editor.painting.brush * (event.key === "[" ? 0.8 : 1.25));
  else return;
  event.preventDefault();
  event.stopPropagation();
}
