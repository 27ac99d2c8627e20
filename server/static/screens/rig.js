// Both cameras live, their settings and figures, and the stage.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { View } from "../widgets/view.js";
import { chart } from "../widgets/plots.js";
import { allRight, numberWithin, rule, tell } from "../lib/fields.js";
import { focusCourse } from "./rig/focus.js";
import { liveCheck } from "./rig/live_check.js";
import { h, replace, field, number, select, action, definitions, badge, num, tick, count, quantity, notify, problemText, STATE_KIND } from "../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"RigReply">} Rig */
/** @typedef {Model<"StageReply">["axes"]} Axes */
/** @typedef {Awaited<ReturnType<typeof chart>>} Chart */

const CAMERAS = ["cam1", "cam2"];
const RATE_OVER_MS = 4000; // a rate over less jumps with the moment of its reading

/** Rate of a count over the last seconds; null until there are two, and after it began anew. */
function rateOf() {
  /** @type {{ at: number, counted: number }[]} */
  let past = [];
  return (/** @type {number} */ counted) => {
    const at = performance.now();
    const last = past.at(-1);
    if (last && counted < last.counted) past = [];
    past.push({ at, counted });
    while (past.length > 2 && at - past[1].at > RATE_OVER_MS) past.shift();
    return at - past[0].at < 0.4 * RATE_OVER_MS ? null : (1000 * (counted - past[0].counted)) / (at - past[0].at);
  };
}

/** @param {HTMLElement} root */
export async function open(root) {
  const rig = await api.get("/rig");
  /** @type {Ends} */
  const ends = [];
  const cameras = CAMERAS.map((cam) => camera(cam, rig.cameras[cam], ends));
  const pair = h("dl.definitions");
  const state = h("div");
  const again = reconnect(); // one button: it must not be drawn again while it is pressed
  replace(root,
    h("div.spread", h("h1", rig.name || "Rig"), state),
    liveCheck(ends),
    h("div.grid.two.views", cameras.map((one) => one.root)),
    h("div.grid.side", { style: { marginTop: "var(--gap)" } }, stage(ends), h("section.panel", h("h2", "Pairs"), pair, rig.sim ? scene(rig) : null)),
  );

  const pairRate = rateOf();
  async function update() {
    if (document.hidden) return;
    try {
      const now = await api.get("/rig");
      const gone = CAMERAS.filter((cam) => now.cameras[cam].fault);
      replace(state, now.fault ? badge("fault", "bad") : gone.length ? badge(`without ${gone.join(" and ")}`, "bad") : badge(now.holder ? `in use: ${now.holder}` : "ready", now.holder ? "busy" : "good"),
        now.fault ? [problemText(api.problemOf(now.fault)), again] : gone.length ? again : null);
      const stats = await Promise.all(cameras.map((one) => one.update(now.cameras[one.cam])));
      const figures = stats.find(Boolean)?.pairs;
      if (figures) {
        const rate = pairRate(figures.paired);
        replace(pair, [...definitions([
          ["paired", count(figures.paired)],
          ["pairs per second", num(rate, 3)],
          ["max. skew", quantity(now.max_skew_ms, "ms", 3)],
          ["unpaired", count(figures.unpaired)], ["dropped", count(figures.dropped)], ["incomplete", count(figures.incomplete)], ["refused", count(figures.refused)],
        ]).children]);
      }
    } catch (error) {
      replace(state, badge("unknown", "warn"));
      if (error instanceof api.Problem && error.status >= 500) replace(state, problemText(error), again);
    }
  }
  update();
  const timer = setInterval(update, 1000);
  ends.push(() => clearInterval(timer));
  return () => ends.forEach((end) => end());
}

function reconnect() {
  return action("Reconnect", async () => {
    const { job } = await api.post("/rig:reconnect");
    const ended = await api.finished(job.id);
    if (ended.state !== "succeeded") throw api.jobProblem(ended);
    notify("Cameras and stage are open again.", "good");
  });
}

/**
 * @param {string} cam
 * @param {Model<"CameraReply">} first
 * @param {Ends} ends
 */
function camera(cam, first, ends) {
  const size = first.nominal?.image_size_px ?? [0, 0];
  const view = new View({
    label: `Live view of ${cam}`,
    grey: async (x, y) => {
      const pixel = await api.get(`/cameras/${cam}/pixel`, { x_px: x, y_px: y });
      return `grey ${pixel.value} of ${2 ** pixel.bit_depth - 1}`;
    },
  });
  view.size(size[0], size[1]);
  view.root.style.setProperty("--aspect", String(size[0] && size[1] ? size[0] / size[1] : 4 / 3));
  const overlay = h("img", { alt: "", hidden: true });
  view.content.insertBefore(overlay, view.svg);
  const overlayChoice = select([["", "no overlay"], ["saturation", "saturated pixels"], ["texture", "texture quality"]], "", { "aria-label": `Overlay of ${cam}` });
  const legend = h("span.legend", { hidden: true }); // over the picture: both pictures keep the same height
  let shownOverlay = "";
  async function layOver() {
    const kind = overlayChoice.value;
    overlay.hidden = !kind;
    legend.hidden = !kind;
    if (!kind) return;
    const answer = await api.raw(`/cameras/${cam}/maps/${kind}`);
    legend.textContent = answer.headers.get("X-Legend") ?? "";
    const next = URL.createObjectURL(await answer.blob());
    overlay.src = next;
    if (shownOverlay) URL.revokeObjectURL(shownOverlay);
    shownOverlay = next;
  }
  overlayChoice.addEventListener("change", () => layOver().catch(notify));
  view.tools.append(overlayChoice);
  view.frame.append(legend);

  const start = () => view.show(api.address(`/cameras/${cam}/stream.mjpg`, { rate_hz: 10, t: Date.now() }));
  view.image.addEventListener("error", () => {
    view.blank("No picture: the stream ended. Trying again.");
    setTimeout(() => !dark && document.contains(view.root) && start(), 2000);
  });
  start();
  let waiting = false; // for a picture of a new scene: an old one must not pass for it
  /** @type {number | null} */
  let seen = null; // number of a frame that may be the last of the old scene
  // the browser keeps the last picture of a stream that ended, without an event: an old picture must not pass for a live one
  let dark = false;
  let severed = false;
  /** @param {string} cause */
  function lose(cause) {
    dark = true;
    view.blank(`No picture: ${cause}`);
  }
  function regain(again = false) {
    if (dark || again) start();
    dark = false;
  }
  ends.push(
    // both are exposed together: without one there are no pictures of the other
    events.on("camera", (event) => (event.state === "lost" ? lose(event.problem?.cause ?? `${event.camera} is lost.`) : regain(true))),
    events.on("job", (job) => job.kind === "reconnect" && job.state === "succeeded" && regain(true)),
    events.on("scene", () => { waiting = true; seen = null; focus.forget(); view.blank("Waiting for the first picture of the new scene …"); }),
    events.on("lost", () => { severed = true; }),
    events.on("open", () => { regain(severed); severed = false; }),
  );

  const figures = h("dl.definitions");
  const quality = h("span");
  const trouble = h("div", { role: "alert" });
  const histogramBox = h("div");
  const focus = focusCourse(cam);
  const frameRate = rateOf();
  /** @type {Chart | null} */
  let histogram = null;
  /** @type {number | null} */
  let began = null;

  const exposure = number(first.settings?.exposure_ms, { min: 0, ...limits(first.device?.exposure_range_ms) });
  const gain = number(first.settings?.gain_db, limits(first.device?.gain_range_db));
  const rules = [withinOf(exposure, first.device?.exposure_range_ms, "ms"), withinOf(gain, first.device?.gain_range_db, "dB")];
  const taken = h("p.quiet.taken", { role: "status" });
  /** @param {{ exposure_ms?: number | null, gain_db?: number | null }} settings */
  function applied(settings, more = "") {
    exposure.value = settings.exposure_ms === null || settings.exposure_ms === undefined ? "" : String(Number(settings.exposure_ms.toPrecision(5)));
    gain.value = String(settings.gain_db ?? "");
    taken.textContent = `The camera applied ${quantity(settings.exposure_ms, "ms")} and ${quantity(settings.gain_db, "dB")}${more}.`;
    focus.forget();
  }
  const set = action("Set", async () => {
    if (!allRight(rules)) return;
    /** @type {Model<"SettingsPatch">} */
    const changes = {};
    if (exposure.value !== "") changes.exposure_ms = Number(exposure.value);
    if (gain.value !== "") changes.gain_db = Number(gain.value);
    applied((await api.patch(`/cameras/${cam}`, changes)).settings);
  }, { kind: "primary" });
  const search = action("Auto exposure", async () => {
    tell(exposure, "");
    try {
      const found = await api.post(`/cameras/${cam}:expose`, {});
      applied(found.settings, `: the brightest parts are at ${num(100 * found.level, 3)} % of full scale, ${found.saturated_share ? `${num(100 * found.saturated_share, 2)} %` : "none"} saturated`);
    } catch (error) {
      if (!(error instanceof api.Problem && (error.code?.startsWith("light_") || error.code === "exposure_not_settable"))) throw error;
      tell(exposure, `${error.message} ${error.remedy ?? ""}`);
    }
  }, { title: "Search for the exposure that brings the brightest parts of the picture to 80 % of full scale" });
  for (const input of [exposure, gain]) input.addEventListener("keydown", (event) => event.key === "Enter" && set.click());

  ends.push(() => { view.close(); histogram?.close(); focus.close(); if (shownOverlay) URL.revokeObjectURL(shownOverlay); });

  let rounds = 0;
  /** @param {Rig["cameras"][string]} now */
  async function update(now) {
    const fault = JSON.stringify(now?.fault ?? null);
    if (fault !== trouble.dataset.fault) { // announced once, not every second
      trouble.dataset.fault = fault;
      replace(trouble, now?.fault ? problemText(api.problemOf(now.fault)) : null);
    }
    if (now?.fault) {
      lose(now.fault.cause);
      replace(quality, badge("lost", "bad"));
      replace(figures);
      return null;
    }
    let stats;
    try {
      stats = await api.get(`/cameras/${cam}/stats`);
      regain();
    } catch (error) {
      if (!(error instanceof Error)) throw error;
      if (error instanceof api.Problem && error.status >= 500) lose(error.message);
      replace(figures, [...definitions([["unknown", error.message]]).children]);
      return null;
    }
    const q = stats.quality;
    began ??= performance.now();
    const at = (performance.now() - began) / 1000;
    if (waiting) {
      if (seen === null || stats.sequence === seen) seen ??= stats.sequence;
      else {
        waiting = false;
        regain(true);
      }
    } else focus.add(at, q.focus ?? null).catch(notify);
    replace(quality, badge(q.code, STATE_KIND[q.code] ?? "warn"));
    replace(figures, [...definitions([
      ["frame rate", quantity(frameRate(stats.frames.delivered), "Hz", 3)], ["mean grey", num(q.mean_grey, 4)], ["saturated", quantity(100 * q.saturated_share, "%", 3)],
      ["texture", quantity(q.texture_grey_per_px, "grey/px", 3)], ["focus figure", q.focus === null || q.focus === undefined ? "– (noise only)" : num(q.focus, 3)],
      ["dropped", count(stats.frames.dropped)], ["incomplete", count(stats.frames.incomplete)],
    ]).children]);
    const bins = stats.histogram.map((_, i) => i);
    if (!histogram && histogramBox.clientWidth) {
      histogram = await chart(histogramBox, { x: "grey level (8 bit)", y: "pixels", height: 190, bars: true, files: false, series: [{ label: "pixels" }], data: [bins, stats.histogram], label: `Histogram of ${cam}` });
    } else histogram?.set([bins, stats.histogram]);
    rounds += 1;
    if (overlayChoice.value && rounds % 2 === 0) layOver().catch(() => {});
    return stats;
  }

  /** @type {Partial<NonNullable<typeof first.device>>} */
  const device = first.device ?? {};
  const box = h("section.panel", { "aria-label": cam },
    h("div.spread", h("h2", cam, " ", h("span.quiet", [device.model, device.serial].filter(Boolean).join(" · "))), quality),
    trouble,
    h("div.shot", view.root, h("div", figures,
      h("div.fields", { style: { marginTop: "0.5rem" } },
        field("Exposure", exposure, "ms", range(device.exposure_range_ms, "ms")), field("Gain", gain, "dB", range(device.gain_range_db, "dB"))),
      h("div.row", set, search), taken)),
    h("h3", "Grey levels"), histogramBox, h("h3", "Focus"), focus.root);
  return { cam, root: box, update };
}

/** @typedef {readonly number[] | null | undefined} Span low and high */
const limits = (/** @type {Span} */ pair) => (pair ? { min: pair[0], max: pair[1] } : {});
const range = (/** @type {Span} */ pair, /** @type {string} */ name) => (pair ? `${tick(pair[0])} to ${tick(pair[1])} ${name}` : "");

/**
 * Rule of a number within a range of the device.
 * @param {HTMLInputElement} input
 * @param {Span} pair
 * @param {string} unit
 * @returns {[HTMLInputElement, import("../lib/fields.js").Rule]}
 */
const withinOf = (input, pair, unit) => [input, rule(input, numberWithin({ low: pair?.[0], high: pair?.[1], unit, required: false }))];

/** @param {Ends} ends */
function stage(ends) {
  const rows = h("div");
  const step = number(1, { min: 0.001, "aria-label": "Step of the jog buttons" });
  const stepRight = rule(step, numberWithin({ above: 0, unit: "mm", what: "A step" }));
  /** @type {Axes} */
  let axes = [];

  /** @param {Promise<Model<"Accepted">>} asked */
  async function run(asked) {
    const { job } = await asked;
    const ended = await api.finished(job.id);
    await update();
    if (ended.state !== "succeeded") throw api.jobProblem(ended);
  }

  function draw() {
    replace(rows, axes.map((axis) => {
      const target = number(null, { min: axis.limits?.low_mm, max: axis.limits?.high_mm, placeholder: num(axis.position_mm, 5) });
      const within = rule(target, numberWithin({ low: axis.limits?.low_mm, high: axis.limits?.high_mm, unit: "mm", what: "A position" }));
      const go = action("Go", async () => { if (allRight([[target, within]])) await run(api.post("/stage/moves", { positions_mm: { [axis.axis]: Number(target.value) } })); });
      target.addEventListener("keydown", (event) => event.key === "Enter" && go.click());
      const jog = (/** @type {1 | -1} */ sign) => action(sign < 0 ? "◂ −" : "+ ▸", async () => { if (allRight([[step, stepRight]])) await run(api.post("/stage/moves", { by_mm: { [axis.axis]: sign * Number(step.value) } })); }, { "aria-label": `Jog axis ${axis.axis} ${sign < 0 ? "backward" : "forward"}` });
      return h("fieldset", { "data-axis": axis.axis },
        h("legend", `Axis ${axis.axis}${axis.cameras?.length ? ` · ${axis.cameras.join(", ")}` : ""}`),
        h("div.row", h("strong", { "data-role": "position" }, quantity(axis.position_mm, "mm", 6)), h("span", { "data-role": "state" }, stateBadge(axis)),
          h("span.quiet", axis.limits ? `${num(axis.limits.low_mm, 4)} to ${num(axis.limits.high_mm, 4)} mm` : "")),
        h("div.row", jog(-1), jog(1), h("label", { for: `target${axis.axis}` }, "to"), Object.assign(target, { id: `target${axis.axis}` }), h("span.unit", "mm"), go,
          action("Home", () => run(api.post("/stage:home", { axes: [axis.axis] })))));
    }));
  }

  const stateBadge = (/** @type {Axes[number]} */ axis) => badge(axis.moving ? "moving" : axis.homed === false ? "not homed" : axis.state, axis.moving ? "busy" : axis.homed === false ? "warn" : (STATE_KIND[axis.state] ?? ""));

  async function update() {
    if (document.hidden) return;
    try {
      const now = await api.get("/stage");
      const fresh = now.axes ?? [];
      if (fresh.length !== axes.length) {
        axes = fresh;
        draw();
      } else {
        axes = fresh;
        for (const axis of axes) { // an unfinished input stays
          const shown = (/** @type {string} */ role) => /** @type {HTMLElement} */ (rows.querySelector(`[data-axis="${axis.axis}"] [data-role="${role}"]`));
          shown("position").textContent = quantity(axis.position_mm, "mm", 6);
          replace(shown("state"), stateBadge(axis));
        }
      }
      if (!axes.length) replace(rows, h("p.quiet", now.fault?.cause ?? "This rig has no stage."));
    } catch (error) {
      replace(rows, problemText(error));
      axes = [];
    }
  }
  update();
  const timer = setInterval(update, 700);
  ends.push(() => clearInterval(timer), events.on("stage", update));
  return h("section.panel", h("h2", "Stage"), h("div.fields", field("Jog step", step, "mm")), rows,
    h("div.row", action("Home all", () => run(api.post("/stage:home", {}))), h("span.quiet", "The red button stops every axis at once; so does Esc, pressed twice.")));
}

/** @param {Rig} rig */
function scene(rig) {
  const which = select(["grid", "steel", "plate", "panel", "block", "strip", "sphere", "line_grid", "checkerboard", "charuco", "circles", "circles_asymmetric"].map((s) => [s, s]), rig.scene?.scene);
  const load = number(rig.scene?.load ?? 0);
  const loadRight = rule(load, numberWithin({ what: "A load" }));
  return h("details", h("summary", "Simulated scene"),
    field("Scene", which), field("Load", load, "", "kPa for plate, kN for panel, per cent for strip, share of the motion for block"),
    action("Show the scene", async () => allRight([[load, loadRight]]) && api.put("/sim/scene", { scene: /** @type {Model<"SceneRequest">["scene"]} */ (which.value), load: Number(load.value) })));
}
