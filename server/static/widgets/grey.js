// Grey levels of recorded images: read in tiles, so that a moving mouse needs few requests.
import * as api from "../lib/api.js";
import { num } from "../lib/dom.js";

const TILE = 64;
const MAX_TILES = 256; // in the cache

/** @import { Reply } from "#routes" */
/** @typedef {{ test: string, step: number, cam: string }} StepImage */
/** @typedef {Reply<"get", "/tests/{test_id}/steps/{n}/{cam}/pixels">} Pixels */

/** @type {Map<string, Promise<Pixels>>} */
const tiles = new Map();

/**
 * @param {StepImage} image
 * @param {number} column
 * @param {number} row
 */
function tile(image, column, row) {
  const path = /** @type {const} */ (`/tests/${image.test}/steps/${image.step}/${image.cam}/pixels`);
  const query = { x_px: column * TILE, y_px: row * TILE, columns: TILE, rows: TILE };
  const key = api.address(path, query);
  const held = tiles.get(key) ?? api.get(path, query);
  tiles.delete(key); // dropped least recently used first
  tiles.set(key, held);
  held.catch(() => tiles.delete(key));
  const [oldest] = tiles.keys();
  if (tiles.size > MAX_TILES) tiles.delete(oldest);
  return held;
}

/**
 * Text about a pixel of a step's image.
 * @param {StepImage} image
 * @param {number} x
 * @param {number} y
 */
export async function greyOf(image, x, y) {
  const { values, grey_scale: scale, full_scale: full } = await tile(image, Math.floor(x / TILE), Math.floor(y / TILE));
  const value = values[y % TILE]?.[x % TILE];
  return value === undefined ? null : `grey ${scale === 1 ? value : num(value / scale, 5)} of ${full / scale}`;
}
