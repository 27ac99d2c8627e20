// The legend of vectors: an arrow in a corner of the picture, and the meaning of its length.
import { h, svg, replace } from "../lib/dom.js";

const LONGEST = 140;

/** @param {HTMLElement} frame that it is laid over */
export function arrowLegend(frame) {
  const root = h("div.arrow-legend", { role: "img", "data-role": "arrow-legend", hidden: true });
  frame.append(root);
  /** @type {{ length: number, text: string, scale: () => number } | null} */
  let now = null;
  function again() {
    if (!now) return;
    const px = Math.min(now.length * now.scale(), LONGEST);
    const cut = now.length * now.scale() > LONGEST;
    const long = Math.max(px, 1);
    const wide = Math.max(Math.ceil(long), 8) + 1;
    replace(
      root,
      svg(
        "svg",
        { width: wide, height: 14, viewBox: `0 0 ${wide} 14`, "aria-hidden": "true" },
        svg("path", {
          d: `M${wide - long} 7H${wide - 1}M${wide - 6} 3L${wide - 1} 7L${wide - 6} 11`,
          stroke: "#fff",
          "stroke-width": 1.5,
          fill: "none",
          "stroke-dasharray": cut ? "4 3" : null,
        }),
      ),
      h("span", now.text),
    );
    root.setAttribute("aria-label", `Legend of the vectors: the arrow is ${now.text}`);
    root.dataset.length = String(now.length * now.scale());
    root.dataset.text = now.text;
  }
  return {
    /**
     * @param {number} length of the arrow, in the drawing's unit
     * @param {string} text
     * @param {() => number} scale screen pixels for each of that unit
     */
    show(length, text, scale) {
      now = { length, text, scale };
      root.hidden = !(length > 0);
      again();
    },
    hide() {
      now = null;
      root.hidden = true;
    },
    again,
  };
}
