// A calibration from images of the target that are at hand: both cameras' images, the target, how they were taken.
import * as api from "../../lib/api.js";
import { allRight, limited, numbersWithin, rule } from "../../lib/fields.js";
import { pairsOf } from "../test/import_pairs.js";
import { course } from "./course.js";
import { h, replace, field, number, select, action, problemText } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */

const KINDS = [
  ["checkerboard", "checkerboard"],
  ["charuco", "ChArUco board"],
  ["circles", "dots"],
  ["circles_asymmetric", "dots, every second row shifted"],
  ["line_grid", "line grid"],
];
const MOVES = [
  ["free", "free poses: held or laid down anyhow"],
  ["target", "a stage moved the target"],
  ["cameras", "each camera moved along its own axis"],
  ["both_cameras", "one stage moved both cameras"],
];
const DICTIONARIES = ["DICT_4X4_50", "DICT_4X4_100", "DICT_5X5_50", "DICT_5X5_100", "DICT_5X5_250", "DICT_6X6_250", "DICT_ARUCO_ORIGINAL"];

/**
 * @param {Ends} ends
 * @param {(id: string) => Promise<unknown>} done
 */
export function fromImages(ends, done) {
  const accept = ".tif,.tiff,.png,.bmp,.jpg,.jpeg";
  const one = h("input", { type: "file", multiple: true, accept });
  const two = h("input", { type: "file", multiple: true, accept });
  const kind = select(KINDS, "checkerboard");
  const across = number(null, { min: 3, max: 201, step: 1, required: true });
  const down = number(null, { min: 3, max: 201, step: 1, required: true });
  const [pitch, width, marker, focal, pixel, standoff, angle] = Array.from({ length: 7 }, () => number(null, { min: 0 }));
  const dictionary = select(
    DICTIONARIES.map((name) => [name, name]),
    "DICT_5X5_100",
  );
  const moves = select(MOVES, "free");
  const travel = h("input", { type: "text", inputmode: "decimal", autocomplete: "off", placeholder: "0, 2.5, 5" });
  const name = h("input", { type: "text", maxlength: 300 });
  const matched = h("div", { role: "status", "data-role": "pairs" });
  const progress = h("div", { role: "status" });
  const stopped = new AbortController();
  ends.push(() => stopped.abort());

  const only = {
    board: [marker, dictionary].map((control, k) => field(["Side of a marker", "Dictionary"][k], control, k ? "" : "mm")),
    lines: [field("Width of a line", width, "mm")],
    moved: [
      field("Travel at each pair", travel, "mm", "in the order of the images"),
      field("Stand-off", standoff, "mm", "from the pinhole to the target, roughly"),
      field("Angle between the cameras", angle, "°", "roughly"),
    ],
  };
  const positive = (/** @type {HTMLInputElement} */ control, /** @type {string} */ what) =>
    limited(control, what, { more: (value) => (value > 0 ? "" : "Give more than 0.") });
  const always = [
    limited(across, "A number of points"),
    limited(down, "A number of points"),
    positive(pitch, "A distance"),
    positive(focal, "A focal length"),
    positive(pixel, "A pixel's width"),
  ];
  const ruled = {
    board: [positive(marker, "A marker's side")],
    lines: [positive(width, "A width")],
    moved: [
      positive(standoff, "A stand-off"),
      positive(angle, "An angle"),
      /** @type {typeof always[number]} */ ([travel, rule(travel, numbersWithin({ least: 2, unit: "mm" }))]),
    ],
  };
  const wanted = () => ({ board: kind.value === "charuco", lines: kind.value === "line_grid", moved: moves.value !== "free" });

  function lay() {
    for (const [part, is] of Object.entries(wanted())) for (const node of only[/** @type {keyof typeof only} */ (part)]) node.hidden = !is;
  }
  function match() {
    if (!one.files?.length || !two.files?.length) return replace(matched);
    try {
      const pairs = pairsOf(one.files, two.files);
      return replace(matched, h("p.quiet", `${pairs.length} pairs, in the order of their names: ${pairs[0].map((file) => file.name).join(" with ")} first.`));
    } catch (error) {
      return replace(matched, problemText(error));
    }
  }
  for (const input of [one, two]) input.addEventListener("change", match);
  for (const choice of [kind, moves]) choice.addEventListener("change", lay);
  lay();

  /** The plan as the API takes it. */
  function plan() {
    const { board, lines, moved } = wanted();
    const counts = [Number(across.value), Number(down.value)];
    const half = Number(angle.value) / 2;
    return {
      target: {
        kind: kind.value,
        pitch_mm: Number(pitch.value),
        ...(lines ? { lines: counts, line_width_mm: Number(width.value) } : { size: counts }),
        ...(board ? { marker_mm: Number(marker.value), dictionary: dictionary.value } : {}),
      },
      phd_px: (1000 * Number(focal.value)) / Number(pixel.value),
      moves: moves.value,
      ...(moved
        ? {
            dz_mm: travel.value
              .split(/[\s;,]+/)
              .filter(Boolean)
              .map(Number),
            standoff_mm: Number(standoff.value),
            angle_deg: [half, -half],
          }
        : {}),
      label: name.value,
    };
  }

  const start = action(
    "Calibrate from these images",
    async () => {
      const pairs = pairsOf(one.files ?? [], two.files ?? []);
      const { board, lines, moved } = wanted();
      if (!allRight([...always, ...(board ? ruled.board : []), ...(lines ? ruled.lines : []), ...(moved ? ruled.moved : [])])) return;
      const form = new FormData();
      for (const [first, second] of pairs) {
        form.append("cam1", first);
        form.append("cam2", second);
      }
      form.append("plan", JSON.stringify(plan()));
      replace(progress, h("p.quiet", `${2 * pairs.length} images are sent …`));
      try {
        const { job, calibration_id: id } = await api.upload("/calibrations:upload", form);
        await course(job, progress, stopped.signal);
        await done(id);
      } catch (error) {
        if (!api.aborted(error)) replace(progress, problemText(error));
      }
    },
    { kind: "primary" },
  );
  return panel(
    [field("Camera 1's images", one), field("Camera 2's images", two)],
    matched,
    [
      field("Kind of target", kind),
      field("Points or lines across", across, "", "inner corners of a board"),
      field("Points or lines down", down),
      field("Distance of points or lines", pitch, "mm", "side of a square"),
      ...only.board,
      ...only.lines,
    ],
    [
      field("Focal length", focal, "mm", "as engraved"),
      field("Width of a pixel", pixel, "µm"),
      field("How they were taken", moves),
      ...only.moved,
      field("Name it", name),
    ],
    [h("div.row", start), progress],
  );
}

/** @type {(images: HTMLElement[], matched: HTMLElement, target: HTMLElement[], cameras: HTMLElement[], start: HTMLElement[]) => HTMLElement} */
const panel = (images, matched, target, cameras, start) =>
  h(
    "section.panel",
    { "aria-label": "Calibrate from images" },
    h(
      "details",
      h("summary", "Calibrate from images"),
      h("p.quiet", "Pairs of images of a target, taken with any program: choose them, or drop them on the fields."),
      h("div.fields", images),
      matched,
      h("div.fields", target),
      h("div.fields", cameras),
      start,
    ),
  );

/**
 * The button that fits a calibration again without the views that are ticked in its table.
 * @param {string} id
 * @param {HTMLElement} list where the ticks are
 * @param {HTMLElement} progress
 * @param {(id: string) => Promise<unknown>} done
 */
export const refit = (id, list, progress, done) =>
  action("Fit again without the ticked views", async () => {
    const without = [...new Set([.../** @type {NodeListOf<HTMLInputElement>} */ (list.querySelectorAll("input:checked"))].map((input) => Number(input.value)))];
    if (!without.length) throw api.problemOf({ detail: "No view is ticked.", remedy: "Tick the views to leave out; both cameras' images of that pair go." });
    const { job, calibration_id: made } = await api.post(`/calibrations/${id}:refit`, { without });
    await course(job, progress, new AbortController().signal);
    await done(made);
  });
