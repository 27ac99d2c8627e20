// Calibrations: plan with its expected uncertainty, run, review (accept or discard), import, compare.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { comparedInSpace, distanceCheck } from "./calibrate/checks.js";
import { correlations } from "./calibrate/correlations.js";
import { guidePanel } from "./calibrate/guide.js";
import { geometryOf, statusBadge } from "./calibrate/summary.js";
import { calibrationViews } from "./calibrate/views.js";
import { allRight, numberWithin, numbersWithin, rule } from "../lib/fields.js";
import { wayBackNote } from "../widgets/way_back.js";
import { h, numeric, replace, field, number, select, action, table, definitions, badge, num, count, quantity, when, notify, problemText, ask } from "../lib/dom.js";

/** @import { Here } from "../main.js" */
/** @import { Ends, Part } from "#dom" */
/** @import { Model, Reply } from "#routes" */
/** @typedef {Model<"CalibrationReply">} Calibration */
/** @typedef {Reply<"get", "/calibrations">["calibrations"]} Entries */
/** @typedef {Model<"ExpectReply">} Expected */
/** @typedef {{ nodes: Part, close: () => void }} Panels */

const NAMES = ["phd_px", "cx_px", "cy_px", "kappa_per_px2", "alpha_rad", "beta_rad", "gamma_rad", "x0_mm", "y0_mm", "z0_mm"];
/** @type {Record<string, string>} */
const PHASES = { target: "looking for the target", views: "taking views", grid: "finding the target", calibration: "adjusting" };
const CAMERAS = /** @type {const} */ (["cam1", "cam2"]);
/** @type {Record<string, string>} */
const MOVES = { cameras: "Each camera moves along its own axis.", both_cameras: "One stage moves both cameras.", target: "One stage moves the target.", free: "" };
/** @type {Record<string, string>} */
const UNIT = { phd_px: "px", cx_px: "px", cy_px: "px", kappa_per_px2: "px⁻²", alpha_rad: "rad", beta_rad: "rad", gamma_rad: "rad", x0_mm: "mm", y0_mm: "mm", z0_mm: "mm" };
const symbol = (/** @type {string} */ name) => name.replace(/_(px|rad|mm|per_px2)$/, "");
const um = (/** @type {number | null | undefined} */ mm, digits = 3) => quantity(mm === null || mm === undefined ? null : 1000 * mm, "µm", digits);

/** @param {Model<"JobReply">} job of a calibration */
function verdictOf(job) {
  const verdict = /** @type {Calibration["verdict"]} */ (job.result?.verdict);
  return verdict ? `Verdict: ${verdict.level}.` : "";
}

/**
 * Identifiers of the calibrations that are ticked.
 * @param {HTMLElement} list
 */
const ticked = (list) => [.../** @type {NodeListOf<HTMLInputElement>} */ (list.querySelectorAll("input:checked"))].map((input) => input.value);

/**
 * @param {HTMLElement} root
 * @param {Here} here
 */
export async function open(root, { path }) {
  /** @type {Ends} */
  const ends = [];
  const rig = await api.get("/rig");
  const shown = h("div", { "aria-live": "polite" });
  const list = h("div");
  /** @type {string | undefined} */
  let chosen = path[0];
  /** @type {Entries} */
  let entries = [];
  let drawn = ""; // which calibration, in which state, is shown
  /** @type {(() => void) | null} */
  let closeShown = null;

  async function refresh() {
    entries = (await api.get("/calibrations")).calibrations.toReversed();
    drawList();
  }

  function drawList() {
    const compared = new Set(ticked(list));
    replace(list, table([
      ["Compare", (one) => h("input", { type: "checkbox", value: one.id, checked: compared.has(one.id), disabled: one.state !== "complete", "aria-label": `Compare ${one.id}` }), { unseen: true }],
      ["Calibration", (one) => h("a", { href: `#/calibrate/${one.id}`, "aria-current": one.id === chosen ? "true" : null }, one.label || one.id)],
      ["Made", (one) => when(one.created_utc, { dateStyle: "short", timeStyle: "short" })],
      ["State", (one) => statusBadge({ state: one.state, decision: one.decision, level: /** @type {string | undefined} */ (one.verdict?.level) })],
    ], entries, { caption: "Calibrations, newest first", empty: "No calibration yet: run one, or import one." }));
  }

  async function show(again = false) {
    const id = chosen ?? entries.find((one) => one.state === "complete")?.id;
    if (!id) {
      replace(shown, h("section.panel", h("p.quiet", "The result of a calibration is shown here.")));
      return;
    }
    try {
      const document_ = await api.get(`/calibrations/${id}`);
      const state = JSON.stringify([id, document_.state, document_.review, Boolean(document_.taken)]);
      if (!again && state === drawn) return;
      drawn = state;
      closeShown?.();
      closeShown = null;
      const parts = await one(document_);
      closeShown = parts.close;
      replace(shown, parts.nodes);
    } catch (error) {
      drawn = "";
      replace(shown, h("section.panel", h("h2", id), problemText(error)));
    }
  }

  /**
   * @param {Calibration} document_
   * @returns {Promise<Panels>}
   */
  async function one(document_) {
    const { id, plan } = document_;
    const heading = h("div.spread", h("h2", plan.label || "Calibration", " ", h("code", id)),
      statusBadge({ state: document_.state, decision: document_.review?.decision, level: document_.verdict?.level }));
    const decide = h("div.row", decisions(document_, async () => { await refresh(); await show(true); }, async () => {
      chosen = undefined;
      await refresh();
      if (location.hash === "#/calibrate") await show(true);
      else location.hash = "#/calibrate";
    }));
    const { problem } = document_;
    // one with the verdict failed is shown like any other: its residuals show the cause
    if (document_.state !== "complete" && !document_.verdict) {
      return { nodes: h("section.panel", heading,
        problem ? problemText(api.problemOf(problem)) : h("p.quiet", "Not complete yet; the progress is shown above, or under Jobs."),
        document_.state === "unfinished" ? null : decide, viewsOf(document_)), close: () => {} };
    }
    /** @type {Reply<"get", "/calibrations/{calibration_id}/residuals">["views"] | null} */
    let residuals = null;
    try {
      if (document_.taken) residuals = (await api.get(`/calibrations/${id}/residuals`)).views;
    } catch (error) {
      if (!(error instanceof api.Problem && error.status === 404)) notify(error);
    }
    const made = calibrationViews(document_, /** @type {import("./calibrate/views.js").Found[] | null} */ (residuals));
    return {
      nodes: [
        h("section.panel", { "aria-label": "Verdict" }, heading, verdict(document_), await geometryOf(document_), decide),
        made ? h("section.panel", { "aria-label": "Views" }, h("h2", "Views"), made.root) : null,
        h("div.grid.tables", { style: { marginTop: "var(--gap)" } },
          h("section.panel", h("h2", "Checks"), measures(document_), viewTable(document_), document_.state === "complete" ? distanceCheck(document_) : null),
          h("section.panel", h("h2", "Parameters"), parameters(document_), correlations(document_))),
      ],
      close: () => made?.close(),
    };
  }

  /** @param {Calibration} document_ */
  function viewsOf(document_) {
    const made = calibrationViews(document_, null);
    if (!made) return null;
    ends.push(made.close);
    return h("div", h("h3", "Views that were taken"), made.root);
  }

  ends.push(events.on("calibration", () => { refresh().then(() => show()).catch(notify); }));
  await refresh();
  const running = run(rig, ends, async (id) => { chosen = id; await refresh(); await show(); }, !chosen && !entries.some((one) => one.state === "complete"));
  const guided = guidePanel(rig, ends, async (id) => { chosen = id; await refresh(); await show(true); });
  const compare = action("Compare the two chosen", () => comparison(list));
  await show();
  replace(root, h("h1", "Calibrate"),
    h("div.grid.side", h("div.grid", rig.calibration_plan?.moves === "free" ? null : running, guided, shown),
      h("section.panel", list, h("div.row", { style: { marginTop: "0.5rem" } }, compare), importer(async (id) => { chosen = id; await refresh(); await show(); }))));
  return () => { closeShown?.(); ends.forEach((end) => end()); };
}

/**
 * The plan, its expected uncertainty, and its run.
 * @param {Model<"RigReply">} rig
 * @param {Ends} ends
 * @param {(id: string) => Promise<unknown>} done
 * @param {boolean} first without a calibration that is shown below: all is shown of what this one would bring
 */
function run(rig, ends, done, first) {
  const usual = rig.calibration_plan ?? {};
  const list_ = (/** @type {number[] | null | undefined} */ values) => (values ?? []).map((value) => String(value)).join(", ");
  const positions = h("input", { type: "text", value: list_(usual.positions_mm), inputmode: "decimal", autocomplete: "off" });
  const held = h("input", { type: "text", value: list_(usual.held_out_mm), inputmode: "decimal", autocomplete: "off" });
  const frames = number(usual.frames ?? 4, { min: 1, max: 256, step: 1 });
  const localiser = select([["profile", "profile (finest)"], ["paper", "paper (1996)"]], usual.localiser ?? "profile");
  const label = h("input", { type: "text", maxlength: 300, placeholder: "purpose" });
  const roll = number(0, { min: -180, max: 180 });
  const noise = number(0.005, { min: 0.0001, max: 10 });
  const expected = h("div", { role: "status", "data-role": "expected" });
  const progress = h("div", { role: "status", "data-role": "progress" });
  const start = action("Calibrate", begin, { kind: "primary" });
  const note = wayBackNote();
  note.update();
  ends.push(events.on("stage", () => { note.update(); }), events.on("job", (job) => !["queued", "running", "cancelling"].includes(job.state) && note.update()));
  const zero = Object.fromEntries((rig.stage.axes ?? []).map((axis) => [axis.axis, axis]));
  // dZ of a camera is its axis' way from zero, forward or backward
  const reach = CAMERAS.map((cam) => {
    const { stage_axis: axisOf, stage_sign: sign } = rig.cameras[cam].nominal;
    const axis = axisOf === undefined ? undefined : zero[axisOf];
    return axis?.limits ? [axis.limits.low_mm, axis.limits.high_mm].map((mm) => (mm - axis.zero_mm) * (sign ?? 1)).toSorted((a, b) => a - b) : [-Infinity, Infinity];
  });
  const span = { low: Math.max(...reach.map(([low]) => low)), high: Math.min(...reach.map(([, high]) => high)), unit: "mm" };
  const rules = /** @type {[HTMLInputElement, import("../lib/fields.js").Rule][]} */ ([
    [positions, rule(positions, numbersWithin({ ...span, least: 2 }))],
    [held, rule(held, (text) => numbersWithin(span)(text) || shared(text))],
    [frames, rule(frames, numberWithin({ low: 1, high: 256, whole: true, what: "A number of frames" }))],
  ]);
  const assumed = /** @type {[HTMLInputElement, import("../lib/fields.js").Rule][]} */ ([
    [noise, rule(noise, numberWithin({ low: 0.0001, high: 10, unit: "px", what: "A noise" }))], [roll, rule(roll, numberWithin({ low: -180, high: 180, unit: "°", what: "An angle" }))],
  ]);
  const list = (/** @type {string} */ text) => text.split(/[\s;,]+/).filter(Boolean).map(Number);
  /** @param {string} text of the held-out positions */
  function shared(text) {
    const both = list(text).find((mm) => list(positions.value).includes(mm));
    return both === undefined ? "" : `${both}\u00a0mm is a fitted position too: what checks the fit must not be in it.`;
  }

  /**
   * @param {HTMLInputElement} input
   * @param {string} name
   */
  function numbers(input, name) {
    const parts = input.value.split(/[\s;,]+/).filter(Boolean);
    const values = parts.map(Number);
    if (values.some((value) => !Number.isFinite(value))) throw api.problemOf({ cause: `${name}: “${input.value}” is not a list of numbers.`, remedy: "Write millimetres with a point, between commas: 0, 2.5, 5." });
    return values;
  }
  const plan = () => ({ positions_mm: numbers(positions, "Fitted positions"), held_out_mm: numbers(held, "Held-out positions"), localiser: /** @type {"profile" | "paper"} */ (localiser.value) });

  let asked = 0;
  async function estimate() {
    asked += 1;
    const mine = asked;
    if (![...rules, ...assumed].map(([, check]) => check()).every(Boolean)) return replace(expected, h("p.quiet", "Correct the fields that are marked."));
    try {
      const estimated = await api.post("/calibrations:expect", { ...plan(), roll_deg: Number(roll.value), noise_px: Number(noise.value) });
      if (mine === asked) replace(expected, expectedUncertainty(estimated));
    } catch (error) {
      if (mine === asked) replace(expected, problemText(error));
    }
    return undefined;
  }
  /** @type {number | undefined} */
  let timer;
  for (const input of [positions, held, localiser, roll, noise]) input.addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(estimate, 350); });
  ends.push(() => clearTimeout(timer));
  estimate();

  async function begin() {
    if (!allRight(rules)) return;
    const { job, calibration_id: id } = await api.post("/calibrations", { ...plan(), frames: Number(frames.value), label: label.value });
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
    const bar = h("progress", { max: 1, "aria-label": "Progress of the calibration" });
    const text = h("span");
    replace(progress, h("div.row", h("span", { style: { flex: 1, minWidth: "10rem" } }, bar), text, action("Cancel", () => api.post(`/jobs/${job.id}:cancel`), { kind: "danger" })));
    try {
      const ended = await api.finished(job.id, { signal: stopped.signal, onprogress: (now) => {
        const { phase: stage, done: ready, total } = now.progress ?? {};
        if (total) bar.value = ready / total;
        text.textContent = now.state === "queued" ? "waiting" : `${PHASES[stage ?? ""] ?? stage ?? ""} ${total ? `${ready} of ${total}` : ""}`;
      } });
      replace(progress, ended.state === "succeeded"
        ? h("p", verdictOf(ended), " It is shown below.")
        : ended.state === "cancelled" ? h("p", badge("cancelled", "warn"), " The axes were stopped; no calibration was computed from the views.") : problemText(api.jobProblem(ended)));
      if (id) await done(id);
      if (ended.state === "succeeded") document.querySelector('[aria-label="Verdict"]')?.scrollIntoView({ block: "start" });
    } catch (error) {
      if (!api.aborted(error)) throw error;
    } finally {
      start.removeAttribute("aria-disabled");
    }
  }
  // a running one is followed, whichever client began it
  api.get("/jobs", { limit: 20 }).then(({ jobs }) => {
    const job = jobs.find((one) => one.kind === "calibration" && ["queued", "running", "cancelling"].includes(one.state));
    return job && follow(job, /** @type {string | undefined} */ (job.subject.calibration_id));
  }).catch((error) => { if (!api.aborted(error)) notify(error); });

  const { target } = rig;
  return h("section.panel", { "aria-label": "New calibration" }, h("h2", "New calibration"),
    h("p.quiet", `Target of the rig file: ${targetText(target)}, pitch ${quantity(target.pitch_mm, "mm")}, positions known to ±${um(target.node_tolerance_mm)}. ${MOVES[usual.moves ?? "cameras"]}`),
    h("div.fields",
      field("Fitted positions", positions, "mm", "dZ, away from the target"), field("Held-out positions", held, "mm", "for an independent check"),
      field("Frames averaged", frames), field("Line detection", localiser), field("Label", label)),
    h("details", { open: first }, h("summary", "Expected uncertainty"),
      h("div.fields", field("Assumed noise of an intersection", noise, "px"), field("Rotation of the grid", roll, "°", "in the images; 45 for a grid on its corner")), expected),
    h("div.row", start), progress, note.root);
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
    estimated.refused ? h("div.problem", h("p", h("strong", "Such views would be refused.")), h("ul", estimated.reasons.map((text) => h("li", text))), h("p", "Increase the distance between the positions.")) : null,
    table([["Point", (row) => row[0]], ...["X", "Y", "Z"].map((axis, k) => numeric(`σ ${axis}`, (/** @type {[string, number[]]} */ row) => um(row[1][k])))],
      /** @type {[string, number[]][]} */ ([["middle of the volume", middle.sigma_mm], ["worst corner", worst]]), { caption: `Standard uncertainty of a point from that of the parameters; the corners are at ±${num(Math.abs(corners[0].xyz_mm[0]), 3)}, ±${num(Math.abs(corners[0].xyz_mm[1]), 3)}, ±${num(Math.abs(corners[0].xyz_mm[2]), 3)} mm` }),
    table([["Measurement", (row) => row[0]], numeric("u", (/** @type {[string, number | null]} */ row) => um(row[1]))], foreseen(estimated), { caption: "Standard uncertainty (k = 1) of what a measurement will report, image noise included" }),
    h("details", h("summary", "Parameters and assumptions"),
      table([["Parameter", (name) => [symbol(name), " ", h("span.quiet", UNIT[name])]], ...CAMERAS.map((cam) => numeric(`σ ${cam}`, (/** @type {string} */ name) => num(sigma(cam, name), 3)))], NAMES, { caption: "Expected standard uncertainties" }),
      definitions([["shape", `${um(estimated.shape_rms_mm)} rms over the volume`], ["scale", quantity(100 * estimated.scale, "%", 2)], ["visible intersections", `cam1 ${num(100 * estimated.seen_share.cam1, 3)} %, cam2 ${num(100 * estimated.seen_share.cam2, 3)} %`]]),
      h("p.quiet", String(estimated.assumed.text)), h("p.quiet", estimated.measurement.text)),
  ];
}

/**
 * @param {Expected} estimated
 * @returns {[string, number | null][]}
 */
function foreseen({ quantities }) {
  const shown = quantities.filter((one) => one.name === "length along X" || (one.name === "w" && one.of === "point"));
  return shown.map((one) => [one.of === "length" ? `a length of ${num(one.size_mm, 3)} mm` : `w after ${num(one.translation_mm?.[2], 3)} mm along Z`, one.sigma]);
}

/** @param {Calibration} document_ */
function verdict(document_) {
  const { verdict: v, uncertainty: u, checks } = document_;
  if (!v) return h("p.quiet", `Imported${document_.plan.source_name ? ` from ${document_.plan.source_name}` : ""}: it has no verdict.`);
  return [
    h("ul", (v.reasons ?? []).map((text) => h("li", text))),
    document_.problem ? h("p", document_.problem.remedy, " ", h("code.quiet", document_.problem.code)) : null,
    u ? definitions([["shape", `${um(u.shape_rms_mm)} rms, expected from this calibration alone`], ["Z at the middle, at the corners", `${um(u.centre_z_mm)}, ${um(u.corner_z_mm)}`], ["common scale", quantity(100 * u.scale, "%", 2)]]) : null,
    checks?.made ? h("details", h("summary", "Checks made and not made"), h("ul", checks.made.map((check) => h("li", badge(check.made ? "checked" : "not checked", check.made ? "good" : "warn"), " ", check.text)))) : null,
    document_.review?.note ? h("p.quiet", `${document_.review.decision} by ${document_.review.by}: ${document_.review.note}`) : null,
  ];
}

/**
 * @param {Calibration} document_
 * @param {() => Promise<unknown>} changed
 * @param {() => Promise<unknown>} gone
 */
function decisions(document_, changed, gone) {
  const { id, state } = document_;
  const now = document_.review?.decision;
  const put = (/** @type {"accepted" | "discarded" | null} */ decision, note = "") => api.put(`/calibrations/${id}/review`, { decision, note }).then(changed);
  return [
    state === "complete" && now === "accepted" ? h("a.button.primary", { href: "#/test?new" }, "Make a test") : null,
    state === "complete" && now !== "accepted" ? action("Accept", () => put("accepted"), { kind: "primary", title: "New tests measure with the newest accepted calibration" }) : null,
    now !== "discarded" ? action("Discard", async () => {
      const note = h("input", { type: "text", maxlength: 300 });
      if (await ask("Discard this calibration?", h("div", h("p", "No new test can be made with it. It stays on disk, and the decision can be withdrawn."), field("Reason", note)), [["Cancel", null], ["Discard", "yes"]])) await put("discarded", note.value);
    }, { kind: "danger" }) : null,
    now ? action("Withdraw the decision", () => put(null)) : null,
    action("Delete …", async () => {
      if (await ask("Delete this calibration?", h("p", "It is moved to the trash; tests made with it keep their own copy."), [["Cancel", null], ["Delete", "yes"]])) {
        await api.remove(`/calibrations/${id}`);
        await gone();
      }
    }),
    state === "complete" ? h("a.button", { href: api.address(`/calibrations/${id}/file`), download: `${id}.json` }, "Download") : null,
  ];
}

/** @param {Calibration} document_ */
function measures(document_) {
  const { checks } = document_;
  if (!checks) return h("p.quiet", "It has no checks.");
  /** @type {[text: string, camera: string, check: import("#routes").PositionsCheck, positions: { [cam: string]: number[] } | null][]} */
  const rows = [];
  for (const [name, text] of /** @type {const} */ ([["fitted", "fitted"], ["held_out", "held out"]])) {
    const check = checks[name];
    if (!check) continue;
    rows.push([text, "both", check, check.positions_mm ?? null]);
    for (const cam of CAMERAS) {
      const own = check.per_camera?.[cam];
      if (own) rows.push([text, cam, own, null]);
    }
  }
  return [
    table([["Positions", (row) => [row[0], row[3] ? h("small.quiet", ` ${[...new Set(Object.values(row[3]).flat())].map((mm) => num(mm, 3)).join(", ")} mm`) : null]], ["Camera", (row) => row[1]],
      ["RBE", (row) => quantity(row[2].rbe_px, "px", 3), { numeric: true }], ["RAZ", (row) => um(row[2].raz_mm), { numeric: true }], ["NSCE", (row) => num(row[2].nsce, 3), { numeric: true }], ["Points", (row) => count(row[2].points), { numeric: true }]],
    rows, { caption: "Reprojection error (RBE), its size on the target (RAZ), normalised (NSCE)" }),
    checks.drift_px ? h("p.quiet", `After the return to zero the grid was ${num(checks.drift_px.cam1, 2)} px (cam1) and ${num(checks.drift_px.cam2, 2)} px (cam2) from its first position.`) : null,
  ];
}

/** @param {Calibration} document_ */
function viewTable(document_) {
  if (!Array.isArray(document_.views)) return null;
  return h("details", h("summary", "Each view"), table([["View", (v) => v.name], ["dZ", (v) => quantity(v.dz_mm, "mm", 4), { numeric: true }], ["Role", (v) => (v.held_out ? "held out" : "fitted")],
    ["RBE", (v) => quantity(v.rbe_px, "px", 3), { numeric: true }], ["RAZ", (v) => um(v.raz_mm), { numeric: true }], ["NSCE", (v) => num(v.nsce, 3), { numeric: true }]], document_.views, { caption: "Measures of each view" }));
}

/**
 * @param {number | null | undefined} value
 * @param {number | null | undefined} sigma
 */
function withSigma(value, sigma) {
  if (value === undefined || value === null) return "–";
  if (!sigma || !(sigma > 0)) return num(value, 6);
  const decimals = Math.min(Math.max(1 - Math.floor(Math.log10(sigma)), 0), 12);
  return Math.abs(value) < 1e-4 ? `${num(value, 4)} ± ${num(sigma, 2)}` : `${value.toFixed(Math.min(decimals, 8)).replace("-", "−")} ± ${num(sigma, 2)}`;
}

/** @param {Calibration} document_ */
function parameters(document_) {
  const sigma = document_.sigma ?? {};
  return table([["Parameter", (name) => [symbol(name), " ", h("span.quiet", UNIT[name])]],
    ...CAMERAS.map((cam) => numeric(`${cam} ± σ`, (/** @type {string} */ name) => withSigma(document_[cam]?.[name], sigma[`${cam}.${name}`]))),
    ["nominal", (name) => nominal(document_, name), { numeric: true }]], NAMES, { caption: "Ten parameters of each camera, with their standard uncertainties" });
}

/**
 * @param {Calibration} document_
 * @param {string} name
 */
function nominal(document_, name) {
  const of = (/** @type {string} */ cam) => {
    const n = document_.nominal?.[cam];
    if (!n) return null;
    /** @type {Record<string, number>} */
    const known = { phd_px: n.phd_px, z0_mm: n.standoff_mm, gamma_rad: (n.angle_deg * Math.PI) / 180, cx_px: (n.image_size_px[0] - 1) / 2, cy_px: (n.image_size_px[1] - 1) / 2 };
    return known[name] ?? null;
  };
  const [a, b] = [of("cam1"), of("cam2")];
  if (a === null && b === null) return "";
  return a === b ? num(a, 5) : `${num(a, 4)}; ${num(b, 4)}`;
}

/** @param {HTMLElement} list */
async function comparison(list) {
  const ids = ticked(list);
  if (ids.length !== 2) throw api.problemOf({ cause: `${ids.length} calibrations are chosen.`, remedy: "Tick two complete calibrations in the list." });
  const [a, b] = await Promise.all(ids.map((id) => api.get(`/calibrations/${id}`)));
  /** @type {[name: string, unit: string, a: string, b: string, difference: number, sigmas: number | null][]} */
  const rows = [];
  for (const cam of CAMERAS) for (const name of NAMES) {
    const key = `${cam}.${name}`;
    const [sa, sb] = [a.sigma?.[key], b.sigma?.[key]];
    const difference = (b[cam]?.[name] ?? NaN) - (a[cam]?.[name] ?? NaN);
    const both = sa && sb ? Math.hypot(sa, sb) : null;
    rows.push([`${cam} ${symbol(name)}`, UNIT[name], withSigma(a[cam]?.[name], sa), withSigma(b[cam]?.[name], sb), difference, both ? difference / both : null]);
  }
  const checks = /** @type {const} */ ([["fitted", "RBE fitted"], ["held_out", "RBE held out"]]).map(([name, text]) => [String(text), quantity(a.checks?.[name]?.rbe_px, "px", 3), quantity(b.checks?.[name]?.rbe_px, "px", 3)]);
  checks.push(["verdict", a.verdict?.level ?? "–", b.verdict?.level ?? "–"], ["made", when(a.plan.created_utc), when(b.plan.created_utc)], ["shape", um(a.uncertainty?.shape_rms_mm), um(b.uncertainty?.shape_rms_mm)]);
  const inSpace = await comparedInSpace(ids[0], ids[1]).catch(problemText);
  await ask("Two calibrations", h("div", { "data-role": "comparison" }, inSpace,
    table([["Check", (row) => row[0]], [a.plan.label || a.id, (row) => row[1], { numeric: true }], [b.plan.label || b.id, (row) => row[2], { numeric: true }]], checks, { caption: "Checks" }),
    table([["Parameter", (row) => [row[0], " ", h("span.quiet", row[1])]], [a.id, (row) => row[2], { numeric: true }], [b.id, (row) => row[3], { numeric: true }], ["difference", (row) => num(row[4], 3), { numeric: true }],
      ["in σ", (row) => (row[5] === null ? "–" : h(Math.abs(row[5]) > 3 ? "strong" : "span", num(row[5], 2))), { numeric: true }]], rows, { caption: "Parameters; a difference beyond 3 σ of both together is bold" })), [["Close", null]]);
}

/** @param {(id: string) => Promise<unknown>} done */
function importer(done) {
  const file = h("input", { type: "file", accept: ".json,.xml,.yml,.yaml,.caldat,.z3d" });
  const label = h("input", { type: "text", maxlength: 300 });
  return h("details", { style: { marginTop: "0.75rem" } }, h("summary", "Import a calibration"), field("File", file, "", "calibration.json, or DICe, OpenCV, MatchID, VIC-3D, pyvale file of a stereo pair"), field("Label", label),
    action("Import", async () => {
      const [chosen] = file.files ?? [];
      if (!chosen) throw api.problemOf({ cause: "No file is chosen.", remedy: "Choose the file of a stereo calibration." });
      const form = new FormData();
      form.append("file", chosen);
      form.append("label", label.value || chosen.name);
      const made = await api.upload("/calibrations:import", form);
      notify(`${made.id} is imported.`, "good");
      await done(made.id);
    }));
}
