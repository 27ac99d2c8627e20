// The pinned point: all its values.
import { h, svg, replace, table, num, badge, STATE_KIND } from "../../lib/dom.js";
import { INTERNALS, groupOf, isListed, pretty, shownUnit } from "./analysis.js";
import { budgetTable, withBudget, withUncertainty } from "./uncertainty.js";

/** @import { Reply } from "#routes" */
/** @import { Viewer } from "../results.js" */

const CORRELATIONS = 3;
/** @typedef {Reply<"get", "/tests/{test_id}/analyses/{analysis_id}/probe">} Answer */
/** @type {WeakMap<Viewer, Answer>} */
const answers = new WeakMap(); // the one shown, for another interval
/** @type {WeakMap<Answer, string[]>} */
const correlations = new WeakMap(); // names of its correlations, in their order

/**
 * Show a probe's answer and mark its point in the picture.
 * @param {Viewer} screen
 * @param {Answer} answer
 */
export async function pinned(screen, answer) {
  const { shown } = await screen.result.fields(answer.step);
  correlations.set(
    answer,
    shown.filter((one) => one.name === "zncc").map((one) => one.text.replace("correlation ", "ZNCC ").replace(" with ", ", ")),
  );
  if (!answers.has(screen)) screen.interval.changed.add(() => draw(screen, /** @type {Answer} */ (answers.get(screen))));
  answers.set(screen, answer);
  draw(screen, answer);
}

/**
 * @param {Viewer} screen
 * @param {Answer} answer
 */
function draw(screen, answer) {
  /** @typedef {{ name: string, title: string, at: number, group: string, text: string | HTMLElement }} Row */
  /** @type {Row[]} */
  const rows = [];
  const sizes = sizesOf(answer);
  for (const [name, { value, units, sigma, not_included: lacking, budget }] of Object.entries(answer.values)) {
    if (!isListed(name)) continue;
    const { unit, factor } = shownUnit(name, units);
    const row = { name: pretty(name), title: name, ...groupOf(name) };
    if (Array.isArray(value)) {
      if (value.length <= CORRELATIONS)
        rows.push(
          .../** @type {(number | null)[]} */ (value).map((one, k) => ({
            ...row,
            name: (name === "zncc" && correlations.get(answer)?.[k]) || `${row.name} ${k + 1}`,
            text: num(one, 5),
          })),
        );
      continue;
    }
    const shown = value === null || value === undefined ? null : value * factor;
    const u = sigma === null || sigma === undefined || shown === null ? null : sigma * factor;
    const text = withUncertainty(shown, u, unit, screen.interval.factor, sizes.get(`${groupOf(name).group} ${unit}`));
    rows.push({ ...row, text: u === null ? text : /** @type {string | HTMLElement} */ (withBudget(text, budgetTable(budget, unit, factor, lacking ?? ""))) });
  }
  rows.sort((p, q) => p.at - q.at); // the most important first
  const columns = /** @type {import("#dom").Column<Row>[]} */ ([
    ["Number", (row) => h("span", { title: row.title }, row.name)],
    [`Value ± ${screen.interval.symbol}`, (row) => row.text, { numeric: true }],
  ]);
  const kept = screen.probe.querySelector("details")?.open ?? false;
  /** @param {Row[]} of */
  const groups = (of) =>
    [...new Set(of.map((row) => row.group))].map((group) =>
      h(
        "div",
        { "data-group": group },
        table(
          columns,
          of.filter((row) => row.group === group),
          { caption: group },
        ),
      ),
    );
  replace(
    screen.probe,
    h(
      "div.spread",
      h("span", `row ${answer.row}, column ${answer.col}, step ${answer.step}`),
      badge(answer.status.replace(/_/g, " "), STATE_KIND[answer.status] ?? "warn"),
    ),
    groups(rows.filter((row) => row.group !== INTERNALS)),
    h(
      "details",
      { open: kept },
      h("summary", "Internals"),
      h(
        "div",
        { "data-group": INTERNALS },
        table(
          columns,
          rows.filter((row) => row.group === INTERNALS),
        ),
      ),
    ),
  );
  mark(screen);
}

/**
 * Largest number of each group and unit: X, Y and Z have one unit, though their sizes differ.
 * @param {Answer} answer
 */
function sizesOf(answer) {
  /** @type {Map<string, number>} */
  const sizes = new Map();
  for (const [name, { value, units }] of Object.entries(answer.values)) {
    if (typeof value !== "number" || !isListed(name)) continue;
    const { unit, factor } = shownUnit(name, units);
    const key = `${groupOf(name).group} ${unit}`;
    sizes.set(key, Math.max(sizes.get(key) ?? 0, Math.abs(value * factor)));
  }
  return sizes;
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
  view.svg.append(
    svg(
      "g",
      { class: "pin" },
      ...[
        ["#000", 4],
        ["#fff", 1.5],
      ].map(([stroke, width]) =>
        svg("path", {
          d: `M${x - 6} ${y}H${x + 6}M${x} ${y - 6}V${y + 6}`,
          stroke,
          "stroke-width": width,
          "vector-effect": "non-scaling-stroke",
          fill: "none",
        }),
      ),
    ),
  );
}
