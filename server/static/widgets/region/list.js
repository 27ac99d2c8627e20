// The drawing, by numbers: for the keyboard, and to be exact.
import { count, h, num } from "../../lib/dom.js";
import { pointsFrom, round, textOf, trouble } from "./shapes.js";
/** @import { RegionEditor } from "../region_editor.js" */
/** @import { Form, Spot, State } from "./shapes.js" */

const NAME = { rectangle: "Rectangle", polygon: "Polygon", circle: "Circle" };

/**
 * A row of the list.
 * @param {RegionEditor} editor
 * @param {string} label
 * @param {Form | "crack" | "seed"} form
 * @param {Spot[]} points
 * @param {(state: State, points: Spot[]) => unknown} put
 * @param {(state: State) => unknown} remove
 */
function row(editor, label, form, points, put, remove) {
  const circle = form === "circle";
  const input = h("input", {
    type: "text",
    value: textOf(points, form),
    "aria-label": circle ? `${label}: x, y of the centre; radius, px` : `${label}: x, y of each point, px`,
  });
  const wrong = h("small.hint", { role: "status" });
  input.addEventListener("change", () => {
    const read = pointsFrom(input.value, form);
    const least = form === "seed" ? 1 : form === "crack" ? 2 : 0;
    if (!read || read.length < least)
      wrong.textContent = circle
        ? "Write x, y of the centre; the radius."
        : `Write x, y between semicolons, at least ${least || (form === "rectangle" ? 2 : 3)} points.`;
    else if (form !== "seed" && form !== "crack" && trouble({ form, points: read })) wrong.textContent = trouble({ form, points: read });
    else
      editor.change((state) =>
        put(
          state,
          circle
            ? [editor.inside(read[0]), [editor.inside(read[0])[0] + read[1][0] - read[0][0], editor.inside(read[0])[1]]]
            : read.map((p) => editor.inside(p)),
        ),
      );
  });
  return h(
    "div.row",
    h("span", { style: { minWidth: "5rem" } }, label),
    h("span", { style: { flex: 1, minWidth: "6rem", display: "grid", gridTemplateColumns: "minmax(0, 1fr)" } }, input, wrong),
    h("button", { type: "button", "aria-label": `Delete ${label}`, onclick: () => editor.change(remove) }, "Delete"),
  );
}

/**
 * Rows of all that is drawn.
 * @param {RegionEditor} editor
 */
export function rows(editor) {
  const { outlines, holes, cracks, seeds, mask } = editor.drawn;
  const number = (/** @type {number} */ i) => (outlines.length > 1 ? ` ${i + 1}` : "");
  const put = (/** @type {"outlines" | "holes"} */ kind, /** @type {number} */ i) => (/** @type {State} */ state, /** @type {Spot[]} */ points) => {
    const own = state[kind][i];
    own.points = own.form === "rectangle" ? points.slice(0, 2) : points;
  };
  return [
    outlines.length || mask !== null
      ? null
      : h("div.row", h("span.quiet", "No region yet."), h("button", { type: "button", onclick: () => middle(editor) }, "Rectangle in the middle")),
    outlines.map((shape, i) => row(editor, NAME[shape.form] + number(i), shape.form, shape.points, put("outlines", i), (state) => state.outlines.splice(i, 1))),
    mask === null
      ? null
      : h(
          "div.row",
          h("span", { style: { minWidth: "6.5rem" } }, "Mask"),
          h(
            "span",
            { style: { flex: 1 }, "data-role": "mask" },
            editor.mask.white ? `${count(editor.mask.white)} px are white; no subset reaches over its border.` : "…",
          ),
          h("button", { type: "button", "aria-label": "Delete Mask", onclick: () => editor.change((state) => Object.assign(state, { mask: null })) }, "Delete"),
        ),
    holes.map((shape, i) => row(editor, `Hole ${i + 1}`, shape.form, shape.points, put("holes", i), (state) => state.holes.splice(i, 1))),
    cracks.map((points, i) =>
      row(
        editor,
        `Crack ${i + 1}`,
        "crack",
        points,
        (state, read) => state.cracks.splice(i, 1, read),
        (state) => state.cracks.splice(i, 1),
      ),
    ),
    seeds.map((seed, i) =>
      row(
        editor,
        `Seed ${i + 1}`,
        "seed",
        seed.two ? [seed.one, seed.two] : [seed.one],
        (state, read) => state.seeds.splice(i, 1, { one: read[0], two: read[1] ?? null }),
        (state) => state.seeds.splice(i, 1),
      ),
    ),
    seeds.map((_, i) => {
      const off = editor.lines[i]?.distance_px;
      return off === null || off === undefined
        ? null
        : h(
            off > 8 ? "p.problem" : "p.quiet",
            `Seed ${i + 1}: its position in camera 2 is ${num(off, 2)} px from its epipolar line${off > 8 ? "; the limit is 8 px: it is another point." : "."}`,
          );
    }),
  ];
}

/** @param {RegionEditor} editor */
function middle(editor) {
  const { width, height } = editor.one;
  editor.change((state) => {
    state.outlines = [
      {
        form: "rectangle",
        points: [
          [round(0.2 * width), round(0.2 * height)],
          [round(0.8 * width), round(0.8 * height)],
        ],
      },
    ];
  });
}
