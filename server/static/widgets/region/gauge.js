// The virtual strain gauge: how wide it is on the specimen, and whether the region has room for it.
import { num } from "../../lib/dom.js";

/**
 * Width of the virtual gauge, px: from the outer edge of the first subset to the last one's.
 * @param {number} window points across
 * @param {number} spacing px
 * @param {number} subset px
 */
export const gaugePx = (window, spacing, subset) => (window - 1) * spacing + subset;

/**
 * Text about the gauge, and true if it is a warning.
 * @param {number} px its width
 * @param {number | null} mmPerPx scale of camera 1's image at the surface, or null
 * @param {number | null} regionPx shorter side of the box about the region, or null
 * @returns {{ text: string, warning: string }}
 */
export function gaugeText(px, mmPerPx, regionPx) {
  if (!(px > 0)) return { text: "", warning: "" };
  const mm = mmPerPx ? ` = ${num(px * mmPerPx, 3)} mm` : "";
  const text = `Virtual strain gauge: ${num(px, 4)} px${mm} wide.`;
  if (regionPx === null || 2 * px <= regionPx) return { text, warning: "" };
  const across = `${num(regionPx, 4)} px${mmPerPx ? ` = ${num(regionPx * mmPerPx, 3)} mm` : ""}`;
  const much = px > regionPx ? "wider than the region" : "wider than half of the region";
  return { text, warning: `That is ${much}, which is ${across} across: the strain is averaged over most of it. Take a smaller window or spacing.` };
}
