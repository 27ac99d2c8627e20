// How good the speckle is for such subsets: rated over the region, and as a map over both pictures.
import * as api from "../../lib/api.js";
import { correct } from "../../lib/fields.js";
import { h, replace, table, badge, num, count, quantity, notify, problemText } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { RegionEditor } from "../../widgets/region_editor.js" */
/** @import { View } from "../../widgets/view.js" */

const LATER_MS = 300;
/** @type {Record<string, string>} */
const LEVEL = { good: "good", usable: "warn", poor: "bad" };

/**
 * The rating, the switch of the map and its legend; `soon` rates again once nothing has changed for a moment.
 * @param {string} id of the test
 * @param {View[]} views
 * @param {RegionEditor} editor
 * @param {{ reference: HTMLSelectElement, subset: HTMLInputElement, spacing: HTMLInputElement, noise: HTMLSelectElement }} controls
 * @param {{ use: (subsetPx: number) => void, ends: Ends }} others `use` takes a proposed subset
 */
export function textureRating(id, views, editor, { reference, subset, spacing, noise }, { use, ends }) {
  const rating = h("div", { role: "status", "data-role": "texture" });
  const showMap = h("input", { type: "checkbox" });
  const legend = h("span.quiet");
  const overlays = views.map((view) => {
    const image = h("img", { alt: "", hidden: true });
    view.content.insertBefore(image, view.svg);
    return image;
  });

  let asked = 0;
  async function rate() {
    if (!views[0].width) return; // a region is cut at the image's border: it is rated once the image is there
    asked += 1;
    const mine = asked;
    const region = editor.region();
    if (!region || ![subset, spacing].every(correct)) {
      replace(rating, h("p.quiet", region ? "Correct the fields that are marked." : "Draw a region to rate its speckle quality for such subsets."));
      return;
    }
    try {
      const rated = await api.post(`/tests/${id}/steps/${reference.value}/texture`, {
        region,
        subset_px: Number(subset.value),
        spacing_px: Number(spacing.value),
        noise_id: noise.value || null,
      });
      if (mine !== asked) return;
      const proposed = rated.proposed_subset_px;
      replace(
        rating,
        h(
          "p",
          badge(`${rated.level} speckle quality`, LEVEL[rated.level] ?? ""),
          ` ${num(100 * rated.good_share, 3)} % of ${count(rated.subsets)} subsets with an expected error below ${rated.good_px} px, ${num(100 * rated.usable_share, 3)} % below ${rated.usable_px} px; median ${quantity(rated.median_error_px, "px", 2)} at a noise of ${num(rated.noise_grey, 3)} grey levels.`,
        ),
        proposed && proposed !== rated.subset_px
          ? h("p.row", `Min. subset for this texture: ${proposed} px. `, h("button", { type: "button", onclick: () => use(proposed) }, `Use ${proposed} px`))
          : null,
        proposed ? null : h("p", "No subset up to 91 px is sufficient: the contrast is too low, or the speckles are too coarse."),
        h(
          "details",
          h("summary", "Other sizes"),
          table(
            [
              ["Subset", (row) => quantity(row.subset_px, "px"), { numeric: true }],
              [`below ${rated.good_px} px`, (row) => quantity(100 * row.good_share, "%", 3), { numeric: true }],
              [`below ${rated.usable_px} px`, (row) => quantity(100 * row.usable_share, "%", 3), { numeric: true }],
            ],
            rated.sizes,
            { caption: "Share of the region's subsets with an expected random error" },
          ),
        ),
      );
    } catch (error) {
      if (mine === asked) replace(rating, problemText(error));
    }
  }

  /** @type {string[]} */
  let shownMaps = [];
  async function layMap() {
    overlays.forEach((image) => {
      image.hidden = !showMap.checked;
    });
    legend.textContent = "";
    if (!showMap.checked || !correct(subset)) return;
    const answers = await Promise.all(
      views.map((_, k) => api.raw(`/tests/${id}/steps/${reference.value}/cam${k + 1}/maps/texture`, { subset_px: Number(subset.value) })),
    );
    legend.textContent = answers[0].headers.get("X-Legend") ?? "";
    const fresh = await Promise.all(answers.map(async (answer) => URL.createObjectURL(await answer.blob())));
    overlays.forEach((image, k) => {
      image.src = fresh[k];
    });
    shownMaps.forEach((url) => URL.revokeObjectURL(url));
    shownMaps = fresh;
  }
  ends.push(() => shownMaps.forEach((url) => URL.revokeObjectURL(url)));
  showMap.addEventListener("change", () => layMap().catch(notify));

  /** @type {number | undefined} */
  let timer;
  ends.push(() => clearTimeout(timer));
  function soon() {
    clearTimeout(timer);
    timer = setTimeout(() => {
      rate();
      if (showMap.checked) layMap().catch(notify);
    }, LATER_MS);
  }
  return { rating, showMap, legend, soon };
}
