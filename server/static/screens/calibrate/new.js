// A new calibration: its plan with the expected uncertainty, and its run.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { allRight, numberWithin, numbersWithin, rule } from "../../lib/fields.js";
import { wayBackNote } from "../../widgets/way_back.js";
import { h, numeric, replace, field, number, select, action, table, definitions, num, quantity, notify, problemText } from "../../lib/dom.js";
import { course } from "./course.js";
import { CAMERAS, NAMES, named, um } from "./tables.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"RigReply">} Rig */
/** @typedef {Model<"ExpectReply">} Expected */
/** @typedef {[HTMLInputElement, import("../../lib/fields.js").Rule]} Ruled */

/** @type {Record<string, string>} */
const MOVES = {
  cameras: "Each camera moves along its own axis.",
  both_cameras: "One stage moves both cameras.",
  target: "One stage moves the target.",
  free: "",
};
const LOCALISERS = [
  ["profile", "profile (finest)"],
  ["paper", "paper (1996)"],
];

/**
 * The plan, its expected uncertainty, and its run.
 * @param {Rig} rig
 * @param {Ends} ends
 * @param {(id: string) => Promise<unknown>} done
 * @param {boolean} first without a calibration that is shown below: all of the prediction is shown
 */
export function newCalibration(rig, ends, done, first) {
  const plan = planOf(rig);
  const { positions, held, frames, localiser, rules } = plan;
  const label = h("input", { type: "text", maxlength: 300, placeholder: "purpose" });
  const progress = h("div", { role: "status", "data-role": "progress" });
  const start = action("Calibrate", begin, { kind: "primary" });
  const note = wayBackNote();
  note.update();
  ends.push(
    events.on("stage", () => {
      note.update();
    }),
    events.on("job", (job) => !["queued", "running", "cancelling"].includes(job.state) && note.update()),
  );
  const prediction = predictionOf(plan, ends, first);

  async function begin() {
    if (!allRight(rules)) return;
    const { job, calibration_id: id } = await api.post("/calibrations", { ...plan.value(), frames: Number(frames.value), label: label.value });
    await follow(job, id);
  }

  const stopped = new AbortController();
  ends.push(() => stopped.abort());
  /**
   * @param {Model<"JobReply">} job
   * @param {string | undefined} id
   */
  async function follow(job, id) {
    start.setAttribute("aria-disabled", "true");
    try {
      const ended = await course(job, progress, stopped.signal);
      if (id) await done(id);
      if (ended.state === "succeeded") document.querySelector('[aria-label="Verdict"]')?.scrollIntoView({ block: "start" });
    } catch (error) {
      if (!api.aborted(error)) throw error;
    } finally {
      start.removeAttribute("aria-disabled");
    }
  }
  // a running one is followed, also if another client began it
  api
    .get("/jobs", { limit: 20 })
    .then(({ jobs }) => {
      const job = jobs.find((one) => one.kind === "calibration" && ["queued", "running", "cancelling"].includes(one.state));
      return job && follow(job, /** @type {string | undefined} */ (job.subject.calibration_id));
    })
    .catch((error) => {
      if (!api.aborted(error)) notify(error);
    });

  const { target } = rig;
  return h(
    "section.panel",
    { "aria-label": "New calibration" },
    h("h2", "New calibration"),
    h(
      "p.quiet",
      `Target of the rig file: ${targetText(target)}, pitch ${quantity(target.pitch_mm, "mm")}, positions known to ±${um(target.node_tolerance_mm)}. ${MOVES[rig.calibration_plan?.moves ?? "cameras"]}`,
    ),
    h(
      "div.fields",
      field("Fitted positions", positions, "mm", "dZ, away from the target"),
      field("Held-out positions", held, "mm", "for an independent check"),
      field("Frames averaged", frames),
      field("Line detection", localiser),
      field("Label", label),
    ),
    prediction,
    h("div.row", start),
    progress,
    note.root,
  );
}

/** The fields of the plan with their rules. @param {Rig} rig */
function planOf(rig) {
  const usual = rig.calibration_plan ?? {};
  const list_ = (/** @type {number[] | null | undefined} */ values) => (values ?? []).map((value) => String(value)).join(", ");
  const positions = h("input", { type: "text", value: list_(usual.positions_mm), inputmode: "decimal", autocomplete: "off" });
  const held = h("input", { type: "text", value: list_(usual.held_out_mm), inputmode: "decimal", autocomplete: "off" });
  const frames = number(usual.frames ?? 4, { min: 1, max: 256, step: 1 });
  const localiser = select(LOCALISERS, usual.localiser ?? "profile");
  const zero = Object.fromEntries((rig.stage.axes ?? []).map((axis) => [axis.axis, axis]));
  // dZ of a camera is its axis' way from zero, forward or backward
  const reach = CAMERAS.map((cam) => {
    const { stage_axis: axisOf, stage_sign: sign } = rig.cameras[cam].nominal;
    const axis = axisOf === undefined ? undefined : zero[axisOf];
    return axis?.limits
      ? [axis.limits.low_mm, axis.limits.high_mm].map((mm) => (mm - axis.zero_mm) * (sign ?? 1)).toSorted((a, b) => a - b)
      : [-Infinity, Infinity];
  });
  const span = { low: Math.max(...reach.map(([low]) => low)), high: Math.min(...reach.map(([, high]) => high)), unit: "mm" };
  const rules = /** @type {Ruled[]} */ ([
    [positions, rule(positions, numbersWithin({ ...span, least: 2 }))],
    [held, rule(held, (text) => numbersWithin(span)(text) || shared(text))],
    [frames, rule(frames, numberWithin({ low: 1, high: 256, whole: true, what: "A number of frames" }))],
  ]);
  const list = (/** @type {string} */ text) =>
    text
      .split(/[\s;,]+/)
      .filter(Boolean)
      .map(Number);
  /** @param {string} text of the held-out positions */
  function shared(text) {
    const both = list(text).find((mm) => list(positions.value).includes(mm));
    return both === undefined ? "" : `${both}\u00a0mm is a fitted position too: a position that checks the fit must not be part of it.`;
  }

  /**
   * @param {HTMLInputElement} input
   * @param {string} name
   */
  function numbers(input, name) {
    const parts = input.value.split(/[\s;,]+/).filter(Boolean);
    const values = parts.map(Number);
    if (values.some((value) => !Number.isFinite(value)))
      throw api.problemOf({
        detail: `${name}: “${input.value}” is not a list of numbers.`,
        remedy: "Write millimetres with a point, between commas: 0, 2.5, 5.",
      });
    return values;
  }
  const value = () => ({
    positions_mm: numbers(positions, "Fitted positions"),
    held_out_mm: numbers(held, "Held-out positions"),
    localiser: /** @type {"profile" | "paper"} */ (localiser.value),
  });
  return { positions, held, frames, localiser, rules, value };
}

/**
 * The expected uncertainty of a plan, computed again once its fields rest.
 * @param {ReturnType<typeof planOf>} plan
 * @param {Ends} ends
 * @param {boolean} open
 */
function predictionOf(plan, ends, open) {
  const roll = number(0, { min: -180, max: 180 });
  const noise = number(0.005, { min: 0.0001, max: 10 });
  const expected = h("div", { role: "status", "data-role": "expected" });
  const assumed = /** @type {Ruled[]} */ ([
    [noise, rule(noise, numberWithin({ low: 0.0001, high: 10, unit: "px", what: "A noise" }))],
    [roll, rule(roll, numberWithin({ low: -180, high: 180, unit: "°", what: "An angle" }))],
  ]);
  let asked = 0;
  // until somebody states it, the grid lies as the rig's newest calibration found it
  let stated = false;
  roll.addEventListener("input", () => (stated = true));
  async function estimate() {
    asked += 1;
    const mine = asked;
    if (![...plan.rules, ...assumed].map(([, check]) => check()).every(Boolean)) return replace(expected, h("p.quiet", "Correct the fields that are marked."));
    try {
      const estimated = await api.post("/calibrations:expect", {
        ...plan.value(),
        roll_deg: stated ? Number(roll.value) : null,
        noise_px: Number(noise.value),
      });
      if (mine !== asked) return undefined;
      if (!stated) roll.value = estimated.assumed.roll_deg.toFixed(1);
      replace(expected, expectedUncertainty(estimated));
    } catch (error) {
      if (mine === asked) replace(expected, problemText(error));
    }
    return undefined;
  }
  /** @type {number | undefined} */
  let timer;
  for (const input of [plan.positions, plan.held, plan.localiser, roll, noise])
    input.addEventListener("input", () => {
      clearTimeout(timer);
      timer = setTimeout(estimate, 350);
    });
  ends.push(() => clearTimeout(timer));
  estimate();
  return h(
    "details",
    { open },
    h("summary", "Expected uncertainty"),
    h(
      "div.fields",
      field("Assumed noise of an intersection", noise, "px"),
      field("Rotation of the grid", roll, "°", "in the images; 45 for a grid on its corner"),
    ),
    expected,
  );
}

/** @param {Model<"RigReply">["target"]} target */
function targetText(target) {
  if ((target.kind ?? "line_grid") !== "line_grid") return `${target.kind}, ${target.size?.join(" × ")} points`;
  return `${target.lines?.join(" × ")} lines, ${target.dark_lines ? "dark" : "bright"}, line width ${quantity(target.line_width_mm, "mm")}`;
}

/** @param {Expected} estimated */
function expectedUncertainty(estimated) {
  const middle = estimated.points[0];
  const corners = estimated.points.slice(1);
  const worst = [0, 1, 2].map((axis) => Math.max(...corners.map((point) => point.sigma_mm[axis])));
  const sigma = (/** @type {string} */ cam, /** @type {string} */ name) => estimated.parameters[`${cam}.${name}`].sigma;
  return [
    estimated.refused
      ? h(
          "div.problem",
          h("p", h("strong", "Such views would be refused.")),
          h(
            "ul",
            estimated.reasons.map((text) => h("li", text)),
          ),
          h("p", "Increase the distance between the positions."),
        )
      : null,
    table(
      [["Point", (row) => row[0]], ...["X", "Y", "Z"].map((axis, k) => numeric(`σ ${axis}`, (/** @type {[string, number[]]} */ row) => um(row[1][k])))],
      /** @type {[string, number[]][]} */ ([
        ["middle of the volume", middle.sigma_mm],
        ["worst corner", worst],
      ]),
      {
        caption: `Standard uncertainty of a point from that of the parameters; the corners are at ±${num(Math.abs(corners[0].xyz_mm[0]), 3)}, ±${num(Math.abs(corners[0].xyz_mm[1]), 3)}, ±${num(Math.abs(corners[0].xyz_mm[2]), 3)} mm`,
      },
    ),
    table([["Measurement", (row) => row[0]], numeric("u", (/** @type {[string, number | null]} */ row) => um(row[1]))], foreseen(estimated), {
      caption: "Standard uncertainty (k = 1) of what a measurement will report, image noise included",
    }),
    h(
      "details",
      h("summary", "Parameters and assumptions"),
      table([["Parameter", named], ...CAMERAS.map((cam) => numeric(`σ ${cam}`, (/** @type {string} */ name) => num(sigma(cam, name), 3)))], NAMES, {
        caption: "Expected standard uncertainties",
      }),
      definitions([
        ["shape", `${um(estimated.shape_rms_mm)} rms over the volume`],
        ["scale", quantity(100 * estimated.scale, "%", 2)],
        ["visible intersections", `cam1 ${num(100 * estimated.seen_share.cam1, 3)} %, cam2 ${num(100 * estimated.seen_share.cam2, 3)} %`],
      ]),
      h("p.quiet", String(estimated.assumed.text)),
      h("p.quiet", estimated.measurement.text),
    ),
  ];
}

/**
 * @param {Expected} estimated
 * @returns {[string, number | null][]}
 */
function foreseen({ quantities }) {
  const shown = quantities.filter((one) => one.name === "length along X" || (one.name === "w" && one.of === "point"));
  return shown.map((one) => [
    one.of === "length" ? `a length of ${num(one.size_mm, 3)} mm` : `w after ${num(one.translation_mm?.[2], 3)} mm along Z`,
    one.sigma,
  ]);
}
