// Checks of a calibration that a user asks for: a known distance, and a second calibration compared in space.
import * as api from "../../lib/api.js";
import { allRight, numberWithin, rule, tell } from "../../lib/fields.js";
import { h, replace, field, number, action, table, definitions, badge, num, quantity, when } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"CalibrationReply">} Calibration */
/** @typedef {Model<"DifferenceReply">} Difference */

const um = (/** @type {number | null | undefined} */ mm) => quantity(mm === null || mm === undefined ? null : 1000 * mm, "µm", 3);

/**
 * The second against the first calibration in space, in units of both covariances.
 * @param {string} one
 * @param {string} other
 */
export async function comparedInSpace(one, other) {
  const found = await api.get(`/calibrations/${/** @type {"{calibration_id}"} */ (one)}/comparison`, { with: other });
  const [word, kind] = found.agrees === null ? ["not known", ""] : found.agrees ? ["agree", "good"] : ["differ", "warn"];
  /** @type {[text: string, difference: Difference, shown: (value: number | null) => string][]} */
  const rows = [
    ["shape, rms", found.shape_rms_mm, um],
    ["shape, largest", found.shape_max_mm, um],
    ["size", found.scale, (value) => quantity(value === null ? null : 1e6 * value, "ppm", 3)],
    ["epipolar distance, rms", found.epipolar_rms_px, (value) => quantity(value, "px", 3)],
    ["epipolar distance, largest", found.epipolar_max_px, (value) => quantity(value, "px", 3)],
  ];
  return h(
    "section",
    { "aria-label": "Compared in space", "data-role": "in-space" },
    h("p", badge(word, kind), " ", found.text),
    table(
      [
        ["Difference in space", (row) => row[0]],
        ["found", (row) => row[2](row[1].value), { numeric: true }],
        ["expected (σ)", (row) => row[2](row[1].sigma), { numeric: true }],
      ],
      rows,
      { caption: `Over ${found.points} points of the common volume` },
    ),
    found.agrees === false ? h("p", found.changes.text) : null,
  );
}

/** @param {Record<string, unknown>} kept */
function distanceFound(kept) {
  const found = /** @type {Model<"DistanceReply">} */ (kept);
  return [
    h("p", badge(found.agrees ? "agrees" : "differs", found.agrees ? "good" : "warn"), " ", found.text),
    definitions([
      ["measured", `${quantity(found.measured_mm, "mm", 6)} of ${quantity(found.known_mm, "mm", 6)}`],
      ["ratio", num(found.ratio, 7)],
      ["uncertainty of the difference", um(found.sigma_mm)],
      ["checked", when(found.checked_utc)],
    ]),
  ];
}

/**
 * Two marks in both images, at a known distance: their places are read off in the live view or an image viewer.
 * @param {Calibration} document_
 */
export function distanceCheck(document_) {
  const kept = document_.kept_checks?.known_distance;
  const found = h("div", { "aria-live": "polite", "data-role": "known-distance" }, kept ? distanceFound(kept) : null);
  const marks = /** @type {const} */ (["cam1", "cam2"]).map((cam) => {
    const most = document_.image_size_px?.[cam]?.map((px) => px - 1);
    const place = (/** @type {number} */ k, /** @type {"x" | "y"} */ axis) =>
      number(null, { step: "any", min: 0, max: most?.[axis === "x" ? 0 : 1], "aria-label": `${cam}, mark ${k + 1}, ${axis}` });
    return { cam, xy: [0, 1].map((k) => ({ x: place(k, "x"), y: place(k, "y") })) };
  });
  const distance = number(null, { min: 0, step: "any" });
  const sigma = number(0, { min: 0, step: "any" });
  const rules = /** @type {[HTMLInputElement, import("../../lib/fields.js").Rule][]} */ ([
    [distance, rule(distance, numberWithin({ above: 0, unit: "mm", what: "The known distance" }))],
    [sigma, rule(sigma, numberWithin({ low: 0, unit: "mm", what: "A standard deviation" }))],
    ...marks.map(({ xy }) => marked(xy.flatMap(({ x, y }) => [x, y]))),
  ]);

  async function check() {
    if (!allRight(rules)) return;
    const of = (/** @type {number} */ c) =>
      /** @type {[[number, number], [number, number]]} */ (marks[c].xy.map(({ x, y }) => [Number(x.value), Number(y.value)]));
    const body = { points_px: { cam1: of(0), cam2: of(1) }, distance_mm: Number(distance.value), distance_sigma_mm: Number(sigma.value) };
    replace(found, distanceFound(await api.post(`/calibrations/${/** @type {"{calibration_id}"} */ (document_.id)}/distance:check`, body)));
  }

  return h(
    "details",
    { open: Boolean(kept) },
    h("summary", "Known distance"),
    h("p.quiet", "A scale or a gauge block in both images: the only check that shows a wrong pitch of the target."),
    found,
    h("div.fields", field("Known distance", distance, "mm"), field("its standard deviation", sigma, "mm")),
    marks.map(({ cam, xy }) =>
      h(
        "fieldset",
        h("legend", `Marks in ${cam}, px`),
        h(
          "div.row",
          xy.map(({ x, y }, k) => h("span.control", `${k + 1}: x`, x, "y", y)),
        ),
      ),
    ),
    h("div.row", action("Check the distance", check)),
  );
}

/**
 * The rule of both marks in an image: one error for the four numbers, at the first that is missing or beyond the image.
 * @param {HTMLInputElement[]} inputs
 * @returns {[HTMLInputElement, import("../../lib/fields.js").Rule]}
 */
function marked(inputs) {
  const wrong = (/** @type {HTMLInputElement} */ input) => {
    const name = input.getAttribute("aria-label")?.split(", ").slice(1).join(", ");
    if (input.value === "" || input.validity.badInput) return `Give ${name}, in px.`;
    const beyond = numberWithin({ low: 0, high: input.max === "" ? null : Number(input.max), unit: "px" })(input.value);
    return beyond && `${name?.[0].toUpperCase()}${name?.slice(1)}, is not in the image. ${beyond}`;
  };
  const check = () => {
    const first = inputs.find((input) => wrong(input));
    for (const input of inputs) tell(input, input === first ? wrong(input) : "");
    return !first;
  };
  for (const input of inputs) {
    input.addEventListener("input", () => inputs.some((one) => one.getAttribute("aria-invalid") === "true") && check());
    // a field that is left with a number beyond the image shows its error at once, an empty one does not
    input.addEventListener("change", () => input.value !== "" && wrong(input) && tell(input, wrong(input)));
  }
  return [inputs[0], check];
}
