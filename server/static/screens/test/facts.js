// What only people know about a test: fields for the report.
import * as api from "../../lib/api.js";
import { h, replace, field, number, action, notify, problemText } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"TestMetadata">} Facts */
/** @typedef {Record<string, unknown>} Read what the fields say */
/** @typedef {readonly [name: string, label: string, unit?: string]} Row */

/** @type {[title: string, rows: Row[]][]} */
const GROUPS = [
  ["The test", [["purpose", "Purpose"], ["laboratory", "Laboratory"], ["operator", "Operator"], ["specimen", "Specimen"], ["material", "Material"], ["loading", "Loading"], ["environment", "Environment"]]],
  ["Light and pattern", [["lighting", "Lighting"], ["pattern_technique", "How the pattern was made"], ["pattern_feature_mm", "Size of its features", "mm"], ["pattern_feature_method", "How that is known"]]],
  ["Images", [["standoff_mm", "Lens to specimen, by a ruler", "mm"], ["frame_rate_hz", "Frame rate", "Hz"], ["exposure_ms", "Exposure", "ms"]]],
];
/** @type {Row[]} */
const CAMERA = [["maker", "Maker"], ["model", "Model"], ["sensor", "Sensor"], ["pixel_um", "Pixel width", "µm"]];
/** @type {Row[]} */
const LENS = [["maker", "Lens maker"], ["model", "Lens model"], ["focal_length_mm", "Focal length", "mm"], ["f_number", "f-number", "1"], ["note", "Filters, tubes"]];

/** @param {string} id */
export function factsPanel(id) {
  const body = h("div");
  const panel = h("details", h("summary", "Facts for the report: what no device can say"), body);
  panel.addEventListener("toggle", () => { if (panel.open && !body.childElementCount) load(); });

  async function load() {
    try {
      const { value, etag } = await api.getTagged(`/tests/${id}/metadata`);
      draw(value, etag);
    } catch (error) {
      replace(body, problemText(error));
    }
  }

  /**
   * @param {Facts} facts
   * @param {string | null} etag
   */
  function draw(facts, etag) {
    /** @type {((out: Read) => void)[]} */
    const readers = [];
    const input = (/** @type {object | null | undefined} */ of, /** @type {Row} */ [name, label, unit]) => {
      const known = /** @type {Record<string, any> | null | undefined} */ (of)?.[name];
      const control = unit ? number(known) : h("input", { type: "text", maxlength: 500, value: known ?? "" });
      readers.push((out) => { if (control.value.trim() !== "") out[name] = unit ? Number(control.value) : control.value.trim(); });
      return field(label, control, unit === "1" ? "" : unit);
    };
    const boxes = GROUPS.map(([title, rows]) => h("fieldset", h("legend", title), h("div.fields", rows.map((row) => input(facts, row)))));
    const cameras = /** @type {const} */ (["cam1", "cam2"]).map((cam) => {
      const start = readers.length;
      const own = CAMERA.map((row) => input(facts[cam], row));
      const middle = readers.length;
      const lens = LENS.map((row) => input(facts[cam]?.lens, row));
      const [ofCamera, ofLens] = [readers.splice(start, middle - start), readers.splice(start)];
      readers.push((out) => {
        /** @type {Read} */
        const made = {};
        ofCamera.forEach((read) => read(made));
        /** @type {Read} */
        const glass = {};
        ofLens.forEach((read) => read(glass));
        if (Object.keys(glass).length) made.lens = glass;
        if (Object.keys(made).length) out[cam] = made;
      });
      return h("fieldset", h("legend", cam === "cam1" ? "Camera 1 and its lens" : "Camera 2 and its lens"), h("div.fields", own, lens));
    });
    const still = h("input", { type: "text", value: (facts.static_steps ?? []).join(", "), placeholder: "1, 2, 3" });
    const notes = h("textarea", { rows: 2, maxlength: 20000, value: facts.notes ?? "" });
    const save = action("Save the facts", async () => {
      /** @type {Read} */
      const out = facts.gauges ? { gauges: facts.gauges } : {};
      readers.forEach((read) => read(out));
      const steps = still.value.split(/[\s,;]+/).filter(Boolean).map(Number);
      if (steps.length) out.static_steps = steps;
      if (notes.value.trim()) out.notes = notes.value;
      await api.put(`/tests/${id}/metadata`, /** @type {Facts} */ (out), etag === null ? {} : { "If-Match": etag });
      notify("The facts are kept.", "good");
      await load();
    }, { kind: "primary" });
    replace(body, boxes, h("div.grid.two", cameras), h("div.fields", field("Static steps", still, "", "steps in which nothing moved: noise floor and bias come from them")), field("Anything else", notes), save);
  }
  return panel;
}
