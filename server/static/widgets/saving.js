// Files that the page makes itself: saved under a name, SVG drawn as PNG, and the buttons for both and for the numbers.
import { h, svg as made, action } from "../lib/dom.js";

/** @typedef {{ csv?: () => string, svg: () => string | Promise<string> }} Forms files that can be saved; a PNG is the SVG, drawn */

/**
 * Save something under a name.
 * @param {Blob | string} what a blob, or the address of a file
 * @param {string} name
 */
export function saveAs(what, name) {
  const link = h("a", { href: typeof what === "string" ? what : URL.createObjectURL(what), download: name });
  document.body.append(link);
  link.click();
  link.remove();
  if (typeof what !== "string") setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/**
 * A drawing on white as the text of an SVG file.
 * @param {number} width
 * @param {number} height
 * @param {SVGElement[]} parts
 */
export function svgText(width, height, parts) {
  const root = made(
    "svg",
    { xmlns: "http://www.w3.org/2000/svg", viewBox: `0 0 ${width} ${height}`, width, height, "font-family": "DejaVu Sans, Arial, sans-serif" },
    made("rect", { width, height, fill: "#fff" }),
    parts,
  );
  return new XMLSerializer().serializeToString(root);
}

/** @param {string} text */
export const svgFile = (text) => new Blob([text], { type: "image/svg+xml" });

/**
 * An SVG as PNG.
 * @param {string} text with its width and height
 * @param {number} times pixels for each of its own
 */
export async function pngOf(text, times = 2) {
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
  await image.decode();
  const canvas = h("canvas", { width: Math.round(times * image.naturalWidth), height: Math.round(times * image.naturalHeight) });
  canvas.getContext("2d")?.drawImage(image, 0, 0, canvas.width, canvas.height);
  return /** @type {Promise<Blob>} */ (
    new Promise((done, fail) => canvas.toBlob((blob) => (blob ? done(blob) : fail(new Error("This browser makes no PNG."))), "image/png"))
  );
}

/** A text as a cell of CSV; an apostrophe comes before a text that a spreadsheet would run (server/formats/csv_cells.py). @param {string} text */
export const cell = (text) =>
  quoted(/^[=+\-@＝＋－＠\t\r\n]/.test(text) && !/^[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)(e[-+]?[0-9]+)?$/i.test(text) ? `'${text}` : text);
/** @param {string} text */
const quoted = (text) => (/[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);

/**
 * Buttons that save a plot or a picture.
 * @param {string} what a group's name for screen readers
 * @param {() => string} name of the files, in any words
 * @param {Forms} forms
 */
export function saveButtons(what, name, { csv, svg }) {
  const file = () =>
    name()
      .replace(/[^\p{L}\p{N}]+/gu, "_")
      .replace(/^_|_$/g, "");
  /** @type {[string, () => Promise<Blob>][]} */
  const all = [
    ["PNG", async () => pngOf(await svg())],
    ["SVG", async () => svgFile(await svg())],
  ];
  if (csv) all.unshift(["CSV", async () => new Blob([csv()], { type: "text/csv" })]);
  return h(
    "div.row.plot-files",
    { role: "group", "aria-label": what },
    h("span.quiet", "Save"),
    all.map(([form, make]) => action(form, async () => saveAs(await make(), `${file()}.${form.toLowerCase()}`), { "aria-label": `Save as ${form}` })),
  );
}
