// Content of the region editor, as it is stored with a test and in a recipe.
/** @import { Model } from "#routes" */
/** @import { RegionEditor } from "../../widgets/region_editor.js" */
/** @import { Shape, Spot, State } from "../../widgets/region/shapes.js" */
/** @typedef {Model<"Recipe">} Recipe */
/** @typedef {{ rectangle?: [number, number, number, number] | null, polygon?: Spot[] | null, circle?: [number, number, number] | null }} Outline */
/** @typedef {Outline & { outlines?: Outline[], holes?: Spot[][], cracks?: Spot[][], mask_png_base64?: string | null }} Region the fields that a schema of alternatives leaves open */

/**
 * Draw the stored drawing, or without one a recipe's region and seeds; one step back undoes it.
 * @param {RegionEditor} editor
 * @param {Recipe} recipe
 */
export function draw(editor, recipe) {
  const now = editor.state();
  const kept = /** @type {{ shapes?: State } | null | undefined} */ (recipe.drawing)?.shapes;
  const fits = kept && Object.keys(now).every((name) => name in kept);
  const wanted = fits ? structuredClone(kept) : shapesOf(recipe);
  editor.change((state) => Object.assign(state, wanted));
}

/**
 * @param {Recipe} recipe
 * @returns {State}
 */
function shapesOf({ region, settings }) {
  const { holes, cracks, mask_png_base64, outlines, ...own } = /** @type {Region} */ (region ?? {});
  const seeds = (settings?.seeds ?? []).map((one, k) => ({ one, two: settings?.seeds_cam2?.[k] ?? null }));
  return structuredClone({
    outlines: [...(own.rectangle || own.polygon ? [own] : []), ...(outlines ?? [])].map(shape),
    holes: (holes ?? []).map((polygon) => shape({ polygon })),
    cracks: cracks ?? [],
    seeds,
    mask: mask_png_base64 ?? null,
  });
}

/**
 * @param {Outline} outline
 * @returns {Shape}
 */
function shape({ rectangle, polygon, circle }) {
  if (rectangle)
    return {
      form: "rectangle",
      points: [
        [rectangle[0], rectangle[1]],
        [rectangle[2], rectangle[3]],
      ],
    };
  if (circle)
    return {
      form: "circle",
      points: [
        [circle[0], circle[1]],
        [circle[0] + circle[2], circle[1]],
      ],
    };
  return { form: "polygon", points: polygon ?? [] };
}
