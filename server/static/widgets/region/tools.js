// The tools of the region's editor, and their descriptions.
/** @typedef {"move" | "rectangle" | "polygon" | "circle" | "three" | "brush" | "eraser" | "hole" | "crack" | "seed"} Tool */
/** @typedef {"new" | "add" | "cut"} Mode action of a finished shape on the region */

/** @type {[tool: Tool, text: string, title: string][]} */
export const TOOLS = [
  ["move", "Move", "Drag corners; arrow keys move the corner in focus, Delete removes it"],
  ["rectangle", "Rectangle", "Drag from corner to corner"],
  ["polygon", "Polygon", "Click each corner; Enter or a click on the first one ends it, Backspace takes one back"],
  ["circle", "Circle", "Drag from the centre to the rim"],
  ["three", "3-point circle", "Click three points of the rim"],
  ["hole", "Hole", "Click each corner of an area where nothing is measured; Enter ends it"],
  ["brush", "Brush", "Paint where points are allowed; the region becomes a mask, over whose border no subset reaches. [ and ] change the size"],
  ["eraser", "Eraser", "Paint where no points are allowed; the region becomes a mask, over whose border no subset reaches. [ and ] change the size"],
  ["crack", "Crack line", "Click the points that the crack goes through; Enter ends it"],
  [
    "seed",
    "Seed",
    "Click a point in camera 1, then the same point in camera 2 on the line that appears there; three that are not on one line on a periodic texture. Without any they are searched for",
  ],
];
/** @type {[mode: Mode, text: string, title: string][]} */
export const MODES = [
  ["new", "New region", "The next rectangle, polygon or circle takes the place of the region"],
  ["add", "Add", "The next rectangle, polygon or circle is added to the region"],
  ["cut", "Cut out", "Nothing is measured in the next rectangle, polygon or circle, and no subset crosses its border"],
];
const KEYS = "By keyboard: arrow keys move the cross-hair (Shift 10 px, Alt 0.1 px), Enter sets a point, Enter there again ends, Escape leaves.";

/** @param {Tool} tool */
export const hintOf = (tool) => `${TOOLS.find(([name]) => name === tool)?.[2]}. ${tool === "move" ? "" : KEYS}`;
