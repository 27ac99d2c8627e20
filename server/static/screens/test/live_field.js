// The newest displacements of a live measurement, as colours over the reference image, ten pictures a second.
import * as api from "../../lib/api.js";
import { Grid } from "../../lib/point_grid.js";
import { percentiles } from "../../lib/colour.js";
import { amount } from "../../lib/units.js";
import { h, field, select } from "../../lib/dom.js";
import { Scale } from "../../widgets/scale.js";
import { View } from "../../widgets/view.js";

const RATE_HZ = 10;
const COMPONENTS = /** @type {const} */ ([
  ["u_mm", "U"],
  ["v_mm", "V"],
  ["w_mm", "W"],
]);
const MOST_POINTS = 1000;
const LEAST_SPACING_PX = 10;
const ROOM = 0.1; // of the range, beyond the values, so that limits stay from picture to picture

/** @typedef {{ number: number, x_px: number[], y_px: number[] } & Record<"u_mm" | "v_mm" | "w_mm", (number | null)[][]>} Picture */

/**
 * Region and spacing of a coarse field: the test's drawing, or the middle of the image.
 * @param {any} drawn region of the workspace
 * @param {number[]} size of the image, px
 */
export function coarse(drawn, [width, height]) {
  const { mask: _, ...region } = drawn ?? {};
  const left = Math.round(width / 5);
  const top = Math.round(height / 5);
  return {
    field: true,
    region: drawn ? region : { rectangle: [left, top, width - left, height - top] },
    spacing_px: Math.max(LEAST_SPACING_PX, Math.ceil(Math.sqrt((width * height) / MOST_POINTS))),
  };
}

/** @param {string} testId */
export function liveField(testId) {
  /** @type {EventSource | null} */
  let source = null;
  /** @type {number | null} step of the reference; null: nothing is shown */
  let reference = null;
  /** @type {Grid | null} */
  let grid = null;
  let values = new Float64Array();
  /** @type {[number, number] | null} */
  let limits = null;
  const view = new View({ label: "Live field over the reference image of camera 1", tools: false, grey: async (x, y) => under(x, y) });
  view.canvas.dataset.role = "live-field";
  view.canvas.style.opacity = "0.8";
  const scale = new Scale(() => {}, false);
  scale.legend.style.marginTop = "0.6rem";
  const component = select(COMPONENTS, "w_mm");
  const root = h("div", { hidden: true }, h("div.row", field("Displacement", component)), scale.legend, view.root);

  /**
   * @param {number} x
   * @param {number} y
   */
  function under(x, y) {
    const value = grid?.at(values, x, y);
    return value === undefined || Number.isNaN(value) ? null : amount(value, "mm");
  }

  /** @param {Picture} picture */
  function take(picture) {
    const rows = picture[/** @type {"u_mm" | "v_mm" | "w_mm"} */ (component.value)];
    if (!rows) return; // of the component before
    const [cols, count] = [picture.x_px.length, picture.x_px.length * picture.y_px.length];
    values = Float64Array.from(rows.flat(), (value) => value ?? NaN);
    grid ??= new Grid({
      rows: picture.y_px.length,
      cols,
      status: new Uint8Array(count),
      x: Float64Array.from({ length: count }, (_, i) => picture.x_px[i % cols]),
      y: Float64Array.from({ length: count }, (_, i) => picture.y_px[Math.floor(i / cols)]),
    });
    const found = percentiles(values, 0, 100);
    if (found) {
      const [low, high] = found;
      if (!limits || low < limits[0] || high > limits[1] || high - low < 0.5 * (limits[1] - limits[0])) {
        const room = ROOM * (high - low);
        limits = [low - room, high + room];
        scale.lay([limits], "mm");
      }
    }
    if (!view.width) return; // drawn when the picture has come
    scale.paint(view.canvas, view.width, view.height, grid.raster(values, view.width, view.height));
    view.canvas.dataset.frame = String(picture.number);
    view.reread();
  }

  function listen() {
    source?.close();
    limits = null;
    source = new EventSource(api.address(`/tests/${testId}/live/field/events`, { component: component.value, rate_hz: RATE_HZ }));
    source.addEventListener("field", (event) => take(JSON.parse(event.data)));
  }
  component.addEventListener("change", listen);

  /** @param {number | null} step of the reference that is measured against, or null: hide it */
  function follow(step) {
    if (step === reference) return;
    reference = step;
    root.hidden = step === null;
    source?.close();
    grid = null;
    if (step === null) return;
    view.show(api.address(`/tests/${testId}/steps/${step}/cam1/preview`));
    listen();
  }
  return {
    root,
    follow,
    close: () => {
      source?.close();
      view.close();
    },
  };
}
