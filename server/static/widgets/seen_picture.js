// The visible content of a picture's frame as SVG: image, colours, lines, axes and words, with the colour bar below.
import { svg } from "../lib/dom.js";
import { svgText } from "./saving.js";

/** @import { Scale } from "./scale.js" */
/** @typedef {{ frame: HTMLElement, within?: HTMLElement | null, title?: string, scale?: Scale }} Seen a frame; `within`: its picture, whose surroundings are left out; `scale`: a colour bar of its own */
/** @typedef {{ x: number, y: number, width: number, height: number }} Box */

const INK = [
  "fill",
  "stroke",
  "stroke-width",
  "stroke-dasharray",
  "stroke-linecap",
  "stroke-linejoin",
  "opacity",
  "fill-opacity",
  "font-size",
  "font-weight",
  "text-anchor",
  "dominant-baseline",
  "r",
];
const EDGE = 12;
const BAR = 16;

/** @type {(what: string, more: Record<string, string | number | null>) => SVGElement} */
const text = (what, more) => Object.assign(svg("text", { fill: "#222", "font-size": 14, ...more }), { textContent: what });

/**
 * A drawing that needs no style sheet, at its place over the picture.
 * @param {SVGSVGElement} node
 * @param {Box} at
 */
function unstyled(node, at) {
  const copy = /** @type {SVGSVGElement} */ (node.cloneNode(true));
  const view = node.viewBox.baseVal;
  // such a stroke keeps its width at the drawing's own size, and is magnified with the picture
  const scale = view?.width ? (node.clientWidth || at.width) / view.width : 1;
  const originals = [...node.querySelectorAll("*")];
  const gone = /** @type {Element[]} */ ([]);
  [...copy.querySelectorAll("*")].forEach((one, k) => {
    const look = getComputedStyle(originals[k]);
    if (look.display === "none" || look.visibility === "hidden") return void gone.push(one);
    const fixed = look.getPropertyValue("vector-effect") === "non-scaling-stroke";
    one.removeAttribute("style");
    one.removeAttribute("vector-effect");
    for (const name of INK) {
      const value = look.getPropertyValue(name);
      if (value && value !== "auto")
        one.setAttribute(name, fixed && name === "stroke-width" ? String(Number.parseFloat(value) / scale) : value.replace(/px/g, ""));
    }
  });
  for (const one of gone) one.remove();
  for (const name of ["style", "class", "role", "aria-label", "aria-hidden"]) copy.removeAttribute(name);
  for (const [name, value] of Object.entries({ ...at, overflow: "visible", preserveAspectRatio: "none" })) copy.setAttribute(name, String(value));
  return copy;
}

/**
 * Pixels of an image or a canvas, in a file of their own.
 * @param {HTMLImageElement | HTMLCanvasElement} node
 */
function pixels(node) {
  if (node instanceof HTMLCanvasElement) return node.width && node.height ? node.toDataURL("image/png") : "";
  if (!node.complete || !node.naturalWidth) return "";
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [node.naturalWidth, node.naturalHeight];
  canvas.getContext("2d")?.drawImage(node, 0, 0);
  return canvas.toDataURL("image/png");
}

/**
 * The visible parts of a frame, from the lowest to the topmost.
 * @param {HTMLElement} frame
 * @param {(node: Element) => Box} place
 */
function layers(frame, place) {
  /** @type {SVGElement[]} */
  const out = [];
  /** @param {Element} parent */
  const walk = (parent) => {
    for (const node of parent.children) {
      if (!node.checkVisibility({ visibilityProperty: true, opacityProperty: true })) continue;
      const at = place(node);
      if (node instanceof SVGSVGElement) out.push(unstyled(node, at));
      else if (node instanceof HTMLImageElement || node instanceof HTMLCanvasElement) {
        const href = pixels(node);
        const look = getComputedStyle(node);
        if (href)
          out.push(
            svg("image", {
              ...at,
              href,
              opacity: look.opacity,
              preserveAspectRatio: "none",
              style: look.imageRendering === "pixelated" ? "image-rendering: pixelated" : null,
            }),
          );
      } else {
        const look = getComputedStyle(node);
        if (!/, 0\)$|transparent/.test(look.backgroundColor)) out.push(svg("rect", { ...at, fill: look.backgroundColor }));
        const words = [...node.childNodes]
          .filter((one) => one instanceof Text)
          .map((one) => one.textContent)
          .join("")
          .trim();
        if (words)
          out.push(
            text(words, {
              x: at.x + at.width / 2,
              y: at.y + at.height / 2,
              "text-anchor": "middle",
              "dominant-baseline": "central",
              fill: look.color,
              "font-size": Number.parseFloat(look.fontSize),
            }),
          );
        walk(node);
      }
    }
  };
  walk(frame);
  return out;
}

/**
 * The colour bar, or the meaning of the flags; its height.
 * @param {Scale} scale
 * @param {number} x
 * @param {number} y
 * @param {number} width
 * @returns {[SVGElement[], number]}
 */
function legendOf(scale, x, y, width) {
  if (scale.flags) {
    const each = 170;
    const columns = Math.max(Math.floor(width / each), 1);
    const list = [...scale.flagList.children].map((one) => ({
      colour: getComputedStyle(/** @type {Element} */ (one.firstElementChild)).backgroundColor,
      word: one.textContent ?? "",
    }));
    return [
      list.flatMap(({ colour, word }, k) => {
        const [left, top] = [x + each * (k % columns), y + 20 * Math.floor(k / columns)];
        return [
          svg("rect", { x: left, y: top, width: 14, height: 14, fill: colour, stroke: "#777" }),
          text(word, { x: left + 20, y: top + 12, "font-size": 13 }),
        ];
      }),
      20 * Math.ceil(list.length / columns),
    ];
  }
  const { shares, texts, unit } = scale.marked;
  const inset = 30; // numbers reach beyond the bar's ends
  const long = width - 2 * inset;
  return [
    [
      svg("image", {
        x: x + inset,
        y,
        width: long,
        height: BAR,
        href: scale.bar.toDataURL("image/png"),
        preserveAspectRatio: "none",
        style: "image-rendering: pixelated",
      }),
      svg("rect", { x: x + inset, y, width: long, height: BAR, fill: "none", stroke: "#777", "data-role": "bar" }),
      ...shares.map((share, k) => text(texts[k], { x: x + inset + share * long, y: y + BAR + 17, "text-anchor": "middle" })),
      text(unit, { x: x + width / 2, y: y + BAR + 35, "text-anchor": "middle" }),
    ],
    BAR + 40,
  ];
}

/**
 * Frames side by side as they are seen, under a title, with the colour bar and notes below.
 * @param {Seen[]} frames drawn just before this is called, since a canvas may not keep its drawing
 * @param {{ title: string, notes?: string[], scale?: Scale | null, width?: number }} more `width`: of the picture
 */
export function seenPicture(frames, { title, notes = [], scale = null, width = 1200 }) {
  const each = (width - EDGE * (frames.length + 1)) / frames.length;
  /** @type {SVGElement[]} */
  const parts = [text(title, { x: EDGE, y: 26, "font-size": 16, fill: "#111" })];
  let bottom = 40;
  frames.forEach(({ frame, within, title: name, scale: own_ }, k) => {
    const own = frame.getBoundingClientRect();
    const inner = (within ?? frame).getBoundingClientRect();
    const [left, top] = [Math.max(own.left, inner.left), Math.max(own.top, inner.top)];
    const [wide, high] = [Math.min(own.right, inner.right) - left, Math.min(own.bottom, inner.bottom) - top];
    if (!(wide > 0 && high > 0)) throw new Error("Nothing of the picture is in its frame: press Fit.");
    const place = (/** @type {Element} */ node) => {
      const box = node.getBoundingClientRect();
      return { x: box.left - left, y: box.top - top, width: box.width, height: box.height };
    };
    const at = { x: EDGE + k * (each + EDGE), y: name ? 62 : 40, width: each, height: (each * high) / wide };
    if (name) parts.push(text(name, { x: at.x, y: 54 }));
    parts.push(
      svg(
        "svg",
        { ...at, viewBox: `0 0 ${wide} ${high}`, overflow: "hidden", "data-role": "seen" },
        svg("rect", { width: wide, height: high, fill: getComputedStyle(frame).backgroundColor }),
        layers(frame, place),
      ),
    );
    const [drawn, more] = own_ ? legendOf(own_, at.x, at.y + at.height + EDGE, each) : [[], 0];
    parts.push(...drawn);
    bottom = Math.max(bottom, at.y + at.height + (own_ ? EDGE + more : 0));
  });
  bottom += EDGE;
  if (scale) {
    const [drawn, high] = legendOf(scale, EDGE, bottom, width - 2 * EDGE);
    parts.push(...drawn);
    bottom += high;
  }
  for (const note of notes) {
    bottom += 16;
    parts.push(text(note, { x: EDGE, y: bottom, "font-size": 12, fill: "#555" }));
  }
  const height = Math.ceil(bottom + EDGE);
  return svgText(width, height, parts);
}
