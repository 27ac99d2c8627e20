// Metadata of a test, stated by the operator for the report.
import * as api from "../../lib/api.js";
import { h, replace, field, number, action, notify, problemText } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"TestMetadata">} Metadata */
/** @typedef {Record<string, unknown>} Read values of the fields */
/** @typedef {readonly [name: string, label: string, unit?: string]} Row */

/** @type {[title: string, rows: Row[]][]} */
const GROUPS = [
  [
    "The test",
    [
      ["purpose", "Purpose"],
      ["laboratory", "Laboratory"],
      ["operator", "Operator"],
      ["specimen", "Specimen"],
      ["material", "Material"],
      ["loading", "Loading"],
      ["environment", "Environment"],
    ],
  ],
  [
    "Light and pattern",
    [
      ["lighting", "Lighting"],
      ["pattern_technique", "Pattern technique"],
      ["pattern_feature_mm", "Feature size", "mm"],
      ["pattern_feature_method", "Method of its measurement"],
    ],
  ],
  [
    "Images",
    [
      ["standoff_mm", "Stand-off distance, lens to specimen", "mm"],
      ["frame_rate_hz", "Frame rate", "Hz"],
      ["exposure_ms", "Exposure", "ms"],
    ],
  ],
];
/** @type {Row[]} */
const CAMERA = [
  ["maker", "Maker"],
  ["model", "Model"],
  ["sensor", "Sensor"],
  ["pixel_um", "Pixel width", "µm"],
];
/** @type {Row[]} */
const LENS = [
  ["maker", "Lens maker"],
  ["model", "Lens model"],
  ["focal_length_mm", "Focal length", "mm"],
  ["f_number", "f-number", "1"],
  ["note", "Filters, tubes"],
];

/** @param {string} id */
export function metadataPanel(id) {
  const body = h("div");
  const panel = h("details", h("summary", "Metadata for the report"), body);
  panel.addEventListener("toggle", () => {
    if (panel.open && !body.childElementCount) load();
  });

  async function load() {
    try {
      const { value, etag } = await api.getTagged(`/tests/${id}/metadata`);
      draw(value, etag);
    } catch (error) {
      replace(body, problemText(error));
    }
  }

  /**
   * @param {Metadata} metadata
   * @param {string | null} etag
   */
  function draw(metadata, etag) {
    /** @type {((out: Read) => void)[]} */
    const readers = [];
    const input = (/** @type {object | null | undefined} */ of, /** @type {Row} */ [name, label, unit]) => {
      const known = /** @type {Record<string, any> | null | undefined} */ (of)?.[name];
      const control = unit ? number(known) : h("input", { type: "text", maxlength: 500, value: known ?? "" });
      readers.push((out) => {
        if (control.value.trim() !== "") out[name] = unit ? Number(control.value) : control.value.trim();
      });
      return field(label, control, unit === "1" ? "" : unit);
    };
    const boxes = GROUPS.map(([title, rows]) =>
      h(
        "fieldset",
        h("legend", title),
        h(
          "div.fields",
          rows.map((row) => input(metadata, row)),
        ),
      ),
    );
    const cameras = /** @type {const} */ (["cam1", "cam2"]).map((cam) => {
      const start = readers.length;
      const own = CAMERA.map((row) => input(metadata[cam], row));
      const middle = readers.length;
      const lens = LENS.map((row) => input(metadata[cam]?.lens, row));
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
    const still = h("input", { type: "text", value: (metadata.static_steps ?? []).join(", "), placeholder: "1, 2, 3" });
    const notes = h("textarea", { rows: 2, maxlength: 20000, value: metadata.notes ?? "" });
    const save = action(
      "Save the metadata",
      async () => {
        /** @type {Read} */
        const out = metadata.gauges ? { gauges: metadata.gauges } : {};
        readers.forEach((read) => read(out));
        const steps = still.value
          .split(/[\s,;]+/)
          .filter(Boolean)
          .map(Number);
        if (steps.length) out.static_steps = steps;
        if (notes.value.trim()) out.notes = notes.value;
        await api.put(`/tests/${id}/metadata`, /** @type {Metadata} */ (out), etag === null ? {} : { "If-Match": etag });
        notify("The metadata are saved.", "good");
        await load();
      },
      { kind: "primary" },
    );
    replace(
      body,
      boxes,
      h("div.grid.two", cameras),
      h("div.fields", field("Static steps", still, "", "load steps without motion: noise floor and bias are computed from them")),
      field("Further notes", notes),
      save,
    );
  }
  return panel;
}
