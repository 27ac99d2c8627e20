// Line plots: uPlot with this page's colours, loaded when the first one is drawn.
import { num, tick, h } from "../lib/dom.js";
import { STEPS, colourOf, plotButtons, valueText } from "./plot_files.js";

/** @import uPlot from "uplot" */
/** @typedef {ReturnType<typeof chartIn>} ChartPlace */
/** @typedef {(number | null)[]} Known values; null: none */

/** Of an abscissa that has whole numbers alone. */
const WHOLE = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000];

/** @type {typeof uPlot | null} */
let library = null;
async function uplot() {
  if (!library) {
    document.head.append(h("link", { rel: "stylesheet", href: "/static/vendor/uplot/uPlot.min.css" }));
    library = (await import("../vendor/uplot/uPlot.esm.js")).default;
  }
  return library;
}

/**
 * Width of an axis: its longest number's, so that its name is next to and not over it.
 * @param {uPlot} plot
 * @param {string[] | null} values
 * @param {number} index
 * @param {number} cycle
 */
function wide(plot, values, index, cycle) {
  // uPlot's data of an axis that its types lack
  const axis = /** @type {any} */ (plot.axes[index]);
  if (cycle > 1) return axis._size; // it must not repeat for ever
  const longest = (values ?? []).reduce((longer, one) => (one.length > longer.length ? one : longer), "");
  plot.ctx.font = axis.font[0];
  return Math.max(50, Math.ceil(axis.ticks.size + axis.gap + plot.ctx.measureText(longest).width / (window.devicePixelRatio || 1) + 4));
}

/** The page's colours for an axis, as they are now. */
function axes() {
  const css = getComputedStyle(document.documentElement);
  const probe = h("span", { style: { color: "var(--soft)" } });
  const faint = h("span", { style: { color: "var(--line)" } });
  document.body.append(probe, faint);
  const soft = getComputedStyle(probe).color;
  const grid = getComputedStyle(faint).color;
  probe.remove();
  faint.remove();
  /** @returns {uPlot.Axis} */
  return (/** @type {string} */ text) => ({
    label: text,
    labelSize: 18,
    labelGap: 0,
    stroke: soft,
    size: 50,
    font: `12px ${css.fontFamily}`,
    labelFont: `12px ${css.fontFamily}`,
    grid: { stroke: grid, width: 1 },
    ticks: { stroke: grid, width: 1 },
    values: (_, ticks) => ticks.map(tick),
  });
}

/**
 * Draw into `box`; returns {set(data), close()}.
 * @param {HTMLElement} box
 * @param {object} options
 * @param {string} options.x name and unit of the abscissa
 * @param {string} options.y name and unit of the ordinate
 * @param {import("./plot_files.js").Series[]} options.series `edge`: of a band, without a line of its own; `u`: half width of the band, shown with the value under the mouse
 * @param {boolean|boolean[]} [options.bars] whether (which of) the series are bars
 * @param {number} [options.height]
 * @param {uPlot.AlignedData} options.data
 * @param {string} [options.label] name of the plot for screen readers
 * @param {boolean} [options.files] whether it can be saved as CSV, PNG and SVG
 * @param {string} [options.said] meaning of its band; written into the files
 * @param {() => [number, number]} [options.range] of the ordinate, asked at each drawing; the data's if left out
 * @param {number[][]} [options.bands] pairs of series (counted from 1) between which the ground is shaded
 */
export async function chart(box, { x, y, series, height = 200, data, bars = false, bands = [], label, files = true, said = "", range }) {
  const Plot = await uplot();
  const isBar = (/** @type {number} */ index) => (Array.isArray(bars) ? bars[index] : bars);
  /** @returns {uPlot.Options} */
  const options = () => {
    const axis = axes();
    return {
      width: Math.max(box.clientWidth, 200),
      height,
      scales: { x: { time: false }, ...(range ? { y: { range: () => range() } } : {}) },
      axes: [
        { ...axis(x), size: 34, ...(x === STEPS ? { incrs: WHOLE } : {}) },
        { ...axis(y), size: wide },
      ],
      legend: { show: files || series.filter((one) => !one.edge).length > 1, live: true },
      cursor: { y: false },
      series: [
        { label: x, value: (_, v) => num(v, 5) },
        ...series.map((one, index) => {
          const colour = colourOf(one, index);
          return {
            label: one.label,
            class: one.edge ? "edge" : undefined,
            stroke: colour,
            width: one.points || one.edge ? 0 : 1.5,
            points: { show: Boolean(one.points || one.dots), size: 5 },
            value: (/** @type {uPlot} */ _, /** @type {number | null} */ v, /** @type {number} */ __, /** @type {number | null} */ at) =>
              valueText(v, at === null ? null : one.u?.[at]),
            spanGaps: false,
            paths: isBar(index) ? Plot.paths.bars?.({ size: [1, 100] }) : undefined,
            fill: isBar(index) ? `${colour}99` : undefined,
          };
        }),
      ],
      bands: bands.map(([high, low]) => ({ series: [high, low], fill: `${colourOf(series[high - 1], high - 1)}40` })),
    };
  };
  box.replaceChildren();
  box.classList.add("chart");
  let now = data;
  const drawn = h("div", { role: "img", "aria-label": label ?? `${y} over ${x}` }); // the buttons below are no part of the picture
  box.append(drawn);
  if (files) box.append(plotButtons(() => ({ x, y, series, data: now, bars, bands, label, said })));
  let plot = new Plot(options(), now, drawn);
  // a canvas keeps the colours that it was drawn with
  const recolour = () => {
    plot.destroy();
    plot = new Plot(options(), now, drawn);
  };
  const system = matchMedia("(prefers-color-scheme: dark)");
  window.addEventListener("themechange", recolour);
  system.addEventListener("change", recolour);
  const observer = new ResizeObserver(() => box.clientWidth > 0 && plot.setSize({ width: box.clientWidth, height }));
  observer.observe(box);
  return {
    set: (/** @type {uPlot.AlignedData} */ next) => {
      now = next;
      plot.setData(next);
    },
    close: () => {
      observer.disconnect();
      window.removeEventListener("themechange", recolour);
      system.removeEventListener("change", recolour);
      plot.destroy();
    },
  };
}

/**
 * Place of one chart at a time: the next one replaces it.
 * @param {HTMLElement} box
 */
export function chartIn(box) {
  /** @type {Awaited<ReturnType<typeof chart>> | null} */
  let now = null;
  function close() {
    now?.close();
    now = null;
  }
  return {
    box,
    close,
    /** @param {Parameters<typeof chart>[1]} options */
    async draw(options) {
      close();
      const made = await chart(box, options);
      close();
      now = made;
    },
  };
}

/**
 * Curves over an abscissa, each with the band of its uncertainty.
 * @param {number[]} x
 * @param {{ label: string, edge?: string, dots?: boolean, value: Known, u: Known }[]} each `edge`: name of its band's edges, before the sign
 * @param {string} symbol of the uncertainty
 */
export function banded(x, each, symbol) {
  const series = each.flatMap(({ label, edge = "", dots, u }, colour) => [
    { label, colour, dots, u },
    ...["+", "−"].map((sign) => ({ label: `${edge}${sign} ${symbol}`, edge: true, colour })),
  ]);
  /** @type {(one: { value: Known, u: Known }, sign: 1 | -1) => Known} */
  const limit = ({ value, u }, sign) =>
    value.map((v, k) => {
      const half = u[k];
      return v === null || half === null ? null : v + sign * half;
    });
  /** @type {[number[], ...Known[]]} */
  const data = [x, ...each.flatMap((one) => [one.value, limit(one, 1), limit(one, -1)])];
  return { series, bands: each.map((_, k) => [3 * k + 2, 3 * k + 3]), data };
}
