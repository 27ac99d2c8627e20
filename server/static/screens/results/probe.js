// The pinned point: all its values.
import { h, svg, replace, table, num, badge, STATE_KIND } from "../../lib/dom.js";
import { shownUnit } from "./analysis.js";

/** @import { Reply } from "#routes" */
/** @import { Viewer } from "../results.js" */

const CORRELATIONS = 3;

/**
 * Show a probe's answer and mark its point in the picture.
 * @param {Viewer} screen
 * @param {Reply<"get", "/tests/{test_id}/analyses/{analysis_id}/probe">} answer
 */
export function pinned(screen, answer) {
  /** @type {{ name: string, value: number | null, unit: string, sigma: number | null }[]} */
  const rows = [];
  for (const [name, { value, units }] of Object.entries(answer.values)) {
    if (name.startsWith("sigma_") || name === "status" || name === "strain_status") continue;
    const { unit, factor } = shownUnit(name, units);
    if (Array.isArray(value)) {
      if (value.length <= CORRELATIONS) rows.push(.../** @type {(number | null)[]} */ (value).map((one, k) => ({ name: `${name} ${k + 1}`, value: one, unit, sigma: null })));
      continue;
    }
    const sigma = /** @type {number | null} */ (answer.values[`sigma_${name}`]?.value ?? null);
    rows.push({ name, value: value === null ? null : value * factor, unit, sigma: sigma === null ? null : sigma * factor });
  }
  replace(screen.probe,
    h("div.spread", h("span", `row ${answer.row}, column ${answer.col}, step ${answer.step}`), badge(answer.status.replace(/_/g, " "), STATE_KIND[answer.status] ?? "warn")),
    table([
      ["Number", (row) => row.name], ["Value ± σ", (row) => `${num(row.value, 5)}${row.sigma === null ? "" : ` ± ${num(row.sigma, 2)}`}${row.unit ? `\u00a0${row.unit}` : ""}`, { numeric: true }],
    ], rows, { caption: "All values of the point" }));
  mark(screen);
}

/**
 * Mark the pinned point in the picture.
 * @param {Viewer} screen
 */
export function mark(screen) {
  const { view, now } = screen.map;
  view.svg.querySelector(".pin")?.remove();
  if (screen.state.pinned === undefined || !now) return;
  const [x, y] = screen.map.positionOf(screen.state.pinned);
  if (!Number.isFinite(x)) return;
  view.svg.append(svg("g", { class: "pin" },
    ...[["#000", 4], ["#fff", 1.5]].map(([stroke, width]) => svg("path", { d: `M${x - 6} ${y}H${x + 6}M${x} ${y - 6}V${y + 6}`, stroke, "stroke-width": width, "vector-effect": "non-scaling-stroke", fill: "none" }))));
}
