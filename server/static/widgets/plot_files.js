// A plot's numbers as CSV, and the plot as SVG and PNG: light, with axes, units, bands and names, with any colours of the screen.
import { num, svg, tick } from "../lib/dom.js";
import { cell, saveButtons, svgText } from "./saving.js";

/** @typedef {{ label: string, points?: boolean, dots?: boolean, edge?: boolean, colour?: number, u?: (number | null)[] }} Series */
/** @typedef {{ x: string, y: string, series: Series[], data: readonly ArrayLike<number | null | undefined>[], bars?: boolean | boolean[], bands?: number[][], label?: string, file?: string, said?: string }} Plot
 *   data: abscissa, then each series; `u`: of each value, as it is shown; `said`: meaning of the band */

/** Name of the abscissa that counts steps. */
export const STEPS = "step number";
export const COLOURS = ["#1f83b4", "#e07b00", "#29a37a", "#b5486e", "#7a6bd0", "#8a7a2d"];
const [WIDTH, HEIGHT] = [900, 480];
const EDGE = { left: 84, right: 24, top: 40, bottom: 92 };

/** @param {Series} one @param {number} index */
export const colourOf = (one, index) => COLOURS[(one.colour ?? index) % COLOURS.length];

/**
 * The plot's numbers: a column for each series, and for its uncertainty; nothing for a value that is missing.
 * @param {Plot} plot
 */
export function csvOf({ x, y, series, data, said }) {
  /** @type {[string, ArrayLike<number | null | undefined>][]} */
  const columns = [[x, data[0]]];
  const unit = / \([^()]+\)$/.exec(y)?.[0] ?? "";
  series.forEach((one, index) => {
    if (one.edge && !one.dots) return; // of a band, whose half width follows its values
    columns.push([series.filter((other) => !other.edge).length > 1 ? `${one.label}${unit}` : y, data[index + 1]]);
    if (one.u) columns.push([`u of ${one.label}${unit}`, one.u]);
  });
  const lines = Array.from(data[0], (_, k) =>
    columns
      .map(([, of]) => {
        const v = of[k];
        return v === null || v === undefined || !Number.isFinite(v) ? "" : String(v);
      })
      .join(","),
  );
  return `${said ? `# ${said.replace(/\s+/g, " ")}\n` : ""}${columns.map(([name]) => cell(name)).join(",")}\n${lines.join("\n")}\n`;
}

/**
 * Round numbers that span an interval.
 * @param {number} low
 * @param {number} high
 */
export function roundTicks(low, high, about = 6) {
  const decade = 10 ** Math.floor(Math.log10((high - low) / about));
  const step = [1, 2, 5, 10].map((one) => one * decade).find((one) => (high - low) / one <= about) ?? 10 * decade;
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) out.push(Number((k * step).toPrecision(12)));
  return out;
}

/** @param {Iterable<number | null | undefined>} values */
function span(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const v of values)
    if (v !== null && v !== undefined && Number.isFinite(v)) {
      low = Math.min(low, v);
      high = Math.max(high, v);
    }
  if (!(low <= high)) return [0, 1];
  if (low === high) {
    const pad = Math.abs(low) * 0.1 || 1;
    return [low - pad, high + pad];
  }
  return [low, high];
}

/** @param {Plot} plot */
export function svgOf({ x, y, series, data, bars = false, bands = [], label, said }) {
  const isBar = (/** @type {number} */ k) => (Array.isArray(bars) ? Boolean(bars[k]) : bars);
  const shown = series.map((_, k) => k);
  let [x0, x1] = span(Array.from(data[0]));
  const half = shown.some(isBar) && data[0].length > 1 ? (Number(data[0][1]) - Number(data[0][0])) / 2 : 0;
  [x0, x1] = half ? [x0 - half, x1 + half] : [x0 - 0.02 * (x1 - x0), x1 + 0.02 * (x1 - x0)];
  let [y0, y1] = span(shown.flatMap((k) => Array.from(data[k + 1])));
  if (shown.some(isBar)) y0 = Math.min(y0, 0);
  const room = 0.05 * (y1 - y0);
  [y0, y1] = [shown.some(isBar) && y0 === 0 ? 0 : y0 - room, y1 + room];
  const px = (/** @type {number} */ v) => EDGE.left + ((v - x0) / (x1 - x0)) * (WIDTH - EDGE.left - EDGE.right);
  const py = (/** @type {number} */ v) => HEIGHT - EDGE.bottom - ((v - y0) / (y1 - y0)) * (HEIGHT - EDGE.top - EDGE.bottom);
  const at = (/** @type {number} */ k, /** @type {number} */ i) => {
    const v = data[k + 1][i];
    const u = data[0][i];
    return v === null || v === undefined || !Number.isFinite(v) || u === null || u === undefined ? null : [px(u), py(v)].map((p) => p.toFixed(2)).join(" ");
  };
  /** Pieces of a line between the missing values. @param {number} k */
  const pieces = (k) => {
    const out = /** @type {string[][]} */ ([[]]);
    for (let i = 0; i < data[0].length; i += 1) {
      const p = at(k, i);
      if (p) out[out.length - 1].push(p);
      else if (out[out.length - 1].length) out.push([]);
    }
    return out.filter((one) => one.length);
  };
  const text = (/** @type {string} */ what, /** @type {Record<string, string | number>} */ more) =>
    Object.assign(svg("text", { fill: "#333", "font-size": 14, ...more }), { textContent: what });
  /** @type {SVGElement[]} */
  const parts = [text(label ?? `${y} over ${x}`, { x: EDGE.left, y: 24, "font-size": 15, fill: "#111" })];
  for (const v of roundTicks(x0, x1, 8).filter((at) => x !== STEPS || Number.isInteger(at)))
    parts.push(
      svg("path", { d: `M${px(v)} ${EDGE.top}V${HEIGHT - EDGE.bottom}`, stroke: "#e3e3e3" }),
      text(tick(v), { x: px(v), y: HEIGHT - EDGE.bottom + 19, "text-anchor": "middle" }),
    );
  for (const v of roundTicks(y0, y1))
    parts.push(
      svg("path", { d: `M${EDGE.left} ${py(v)}H${WIDTH - EDGE.right}`, stroke: v === 0 ? "#9a9a9a" : "#e3e3e3" }),
      text(tick(v), { x: EDGE.left - 7, y: py(v) + 5, "text-anchor": "end" }),
    );
  parts.push(
    text(x, { x: (EDGE.left + WIDTH - EDGE.right) / 2, y: HEIGHT - EDGE.bottom + 42, "text-anchor": "middle" }),
    text(y, { transform: `translate(18 ${(EDGE.top + HEIGHT - EDGE.bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }),
  );
  for (const [high, low] of bands) {
    const colour = colourOf(series[high - 1], high - 1);
    const [up, down] = [pieces(high - 1), pieces(low - 1)];
    up.forEach((one, k) => {
      if (down[k]?.length === one.length) parts.push(svg("path", { d: `M${one.join("L")}L${[...down[k]].reverse().join("L")}Z`, fill: colour, opacity: 0.25 }));
    });
  }
  series.forEach((one, k) => {
    const colour = colourOf(one, k);
    if (isBar(k))
      for (let i = 0; i < data[0].length; i += 1) {
        const v = data[k + 1][i];
        if (v)
          parts.push(
            svg("rect", {
              x: px(Number(data[0][i]) - half),
              width: Math.max(px(2 * half) - px(0), 0.5),
              y: py(v),
              height: Math.max(py(0) - py(v), 0),
              fill: colour,
              opacity: 0.6,
            }),
          );
      }
    else if (!one.edge && !one.points)
      for (const piece of pieces(k)) parts.push(svg("path", { d: `M${piece.join("L")}`, fill: "none", stroke: colour, "stroke-width": 2 }));
    if (one.points || one.dots)
      for (const p of pieces(k).flat()) {
        const [cx, cy] = p.split(" ");
        parts.push(svg("circle", { cx, cy, r: 3.5, fill: colour }));
      }
  });
  parts.push(
    svg("rect", { x: EDGE.left, y: EDGE.top, width: WIDTH - EDGE.left - EDGE.right, height: HEIGHT - EDGE.top - EDGE.bottom, fill: "none", stroke: "#777" }),
  );
  let from = EDGE.left;
  series.forEach((one, k) => {
    if (one.edge) return;
    parts.push(
      svg("rect", { x: from, y: HEIGHT - 34, width: 16, height: 4, fill: colourOf(one, k) }),
      text(one.label, { x: from + 22, y: HEIGHT - 27, "font-size": 13 }),
    );
    from += 44 + 7.4 * one.label.length;
  });
  if (said) parts.push(text(said, { x: EDGE.left, y: HEIGHT - 8, "font-size": 11, fill: "#666" }));
  return svgText(WIDTH, HEIGHT, parts);
}

/**
 * Buttons that save a plot.
 * @param {() => Plot} now
 */
export const plotButtons = (now) =>
  saveButtons("Save this plot", () => now().file ?? now().label ?? "plot", { csv: () => csvOf(now()), svg: () => svgOf(now()) });

/**
 * A value with its uncertainty: as many digits as the uncertainty warrants.
 * @param {number | null | undefined} value
 * @param {number | null | undefined} u
 */
export function valueText(value, u) {
  if (value === null || value === undefined || !u) return num(value, 5);
  const decimals = Math.min(Math.max(1 - Math.floor(Math.log10(u)), 0), 9);
  return `${value.toFixed(decimals)} ± ${u.toFixed(decimals)}`.replace("-", "−");
}
