// The recent history of a camera's focus figure: its peak is kept, and the figure's distance from it is shown.
import { chart } from "../../widgets/plots.js";
import { h, replace, badge, num } from "../../lib/dom.js";

const KEPT = 120; // samples that are shown
const AT_PEAK = 0.97; // of the peak; the figure's own noise is some thousandths
const HEADROOM = 1.15;

/** @typedef {[at: number, focus: number | null]} Sample */

/**
 * Middle one of the last three figures: a single odd frame makes no peak.
 * @param {Sample[]} course
 */
export function steady(course) {
  const last = course.slice(-3).map(([, value]) => value);
  if (last.length < 3 || last.includes(null)) return null;
  return /** @type {number[]} */ (last).toSorted((a, b) => a - b)[1];
}

/** @param {string} cam */
export function focusCourse(cam) {
  /** @type {Sample[]} */
  let course = [];
  /** @type {{ at: number, value: number } | null} */
  let peak = null;
  /** @type {Awaited<ReturnType<typeof chart>> | null} */
  let plot = null;
  let drawing = false;
  const box = h("div");
  const reading = h("div.row.reading", { "data-role": "focus" });
  const again = h("button", { type: "button", onclick: forget }, "New peak");
  const said = h("span");
  reading.append(said, again);

  /** @param {number | null} now */
  function say(now) {
    if (peak === null || now === null) {
      replace(said, badge(now === null && peak ? "no figure" : "looking for the peak", now === null && peak ? "warn" : ""), ` now ${num(now, 3)}`);
      return;
    }
    const share = now / peak.value;
    replace(
      said,
      badge(share >= AT_PEAK ? "at the peak" : `back to the peak: ${Math.round(100 * share)} %`, share >= AT_PEAK ? "good" : "warn"),
      ` now ${num(now, 3)}, peak ${num(peak.value, 3)}`,
    );
  }

  function forget() {
    peak = null;
    course = [];
    say(null);
  }

  /**
   * @param {number} at time, s
   * @param {number | null} value
   */
  async function add(at, value) {
    course.push([at, value]);
    if (course.length > KEPT) course.shift();
    const now = steady(course);
    if (now !== null && (peak === null || now > peak.value)) peak = { at, value: now };
    say(value === null ? null : (now ?? value));
    const times = course.map(([t]) => t);
    const top = peak?.value ?? null;
    /** @type {[number[], (number | null)[], (number | null)[]]} */
    const data = [times, course.map(([, figure]) => figure), times.map(() => top)];
    if (plot) return plot.set(data);
    if (drawing || !box.clientWidth || course.length < 2) return undefined;
    drawing = true;
    plot = await chart(box, {
      files: false,
      x: "time (s)",
      y: "focus",
      height: 150,
      series: [{ label: "focus" }, { label: "peak" }],
      data,
      label: `Recent history of the focus figure of ${cam}`,
      range: () => [0, HEADROOM * Math.max(peak?.value ?? 0, ...course.map(([, figure]) => figure ?? 0), 0.05)], // not its own noise
    });
    return undefined;
  }
  say(null);
  return {
    root: h("div", reading, box),
    add,
    forget,
    close: () => plot?.close(),
  };
}
