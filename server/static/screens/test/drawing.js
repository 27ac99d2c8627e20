// What the region editor holds, as it is kept with a test and as a recipe has it.
/** @import { Model } from "#routes" */
/** @import { RegionEditor } from "../../widgets/region_editor.js" */
/** @typedef {Model<"Recipe">} Recipe */
/** @typedef {{ [name: string]: unknown }} Shapes */

const copied = (/** @type {unknown} */ value) => JSON.parse(JSON.stringify(value));

/**
 * What is drawn now, shapes without an outline about them too.
 * @param {RegionEditor} editor
 * @returns {Shapes}
 */
export function drawn(editor) {
  const { state } = /** @type {{ state: any }} */ (/** @type {unknown} */ (editor));
  return copied(typeof state === "function" ? state.call(editor) : state);
}

/**
 * Draw what was kept, or a recipe's region and seeds where the drawing was not kept; one step back undoes it.
 * @param {RegionEditor} editor
 * @param {Recipe} recipe
 */
export function draw(editor, recipe) {
  const now = drawn(editor);
  const kept = /** @type {{ shapes?: Shapes } | null | undefined} */ (recipe.drawing)?.shapes;
  const fits = kept && Object.keys(now).every((name) => name in kept);
  const wanted = fits ? copied(kept) : shapesOf(recipe, "outlines" in now);
  editor.change((state) => Object.assign(state, wanted));
}

/**
 * @param {Recipe} recipe
 * @param {boolean} several the editor holds several outlines
 * @returns {Shapes}
 */
function shapesOf({ region, settings }, several) {
  const found = /** @type {any} */ (region ?? {});
  const shape = (/** @type {any} */ one) => (one.rectangle
    ? { form: "rectangle", points: [[one.rectangle[0], one.rectangle[1]], [one.rectangle[2], one.rectangle[3]]] }
    : one.circle ? { form: "circle", points: [[one.circle[0], one.circle[1]], [one.circle[0] + one.circle[2], one.circle[1]]] } : { form: "polygon", points: one.polygon });
  const outlines = [...(found.rectangle || found.polygon ? [found] : []), ...(found.outlines ?? [])].map(shape);
  const seeds = (settings?.seeds ?? []).map((one, k) => ({ one, two: settings?.seeds_cam2?.[k] ?? null }));
  const both = copied({ cracks: found.cracks ?? [], seeds });
  const holes = copied(found.holes ?? []);
  return several
    ? { ...both, outlines, holes: holes.map((/** @type {unknown} */ points) => ({ form: "polygon", points })), mask: found.mask_png_base64 ?? null }
    : { ...both, outline: outlines[0] ?? null, holes };
}
