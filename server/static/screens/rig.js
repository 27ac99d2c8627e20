// Both cameras live, their settings and figures, and the stage.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { View } from "../widgets/view.js";
import { chart } from "../widgets/plots.js";
import { h, replace, field, number, select, action, definitions, badge, num, count, quantity, notify, problemText, STATE_KIND } from "../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"RigReply">} Rig */
/** @typedef {Model<"StageReply">["axes"]} Axes */
/** @typedef {Awaited<ReturnType<typeof chart>>} Chart */

const CAMERAS = ["cam1", "cam2"];
const COURSE = 120; // samples of the focus figure that are kept

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
    h("div.grid.two.views", cameras.map((one) => one.root)),
    h("div.grid.side", { style: { marginTop: "var(--gap)" } }, stage(ends), h("section.panel", h("h2", "Pairs"), pair, rig.sim ? scene(rig) : null)),
  );

  /** @type {{ at: number, paired: number } | null} */
  let last = null;
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
        const rate = last && figures.paired >= last.paired ? (1000 * (figures.paired - last.paired)) / (performance.now() - last.at) : null;
        replace(pair, [...definitions([
          ["paired", count(figures.paired)],
          ["pairs per second", num(rate, 3)],
          ["max. skew", quantity(now.max_skew_ms, "ms", 3)],
          ["unpaired", count(figures.unpaired)], ["dropped", count(figures.dropped)], ["incomplete", count(figures.incomplete)], ["refused", count(figures.refused)],
        ]).children]);
        last = { at: performance.now(), paired: figures.paired };
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
    events.on("lost", () => { severed = true; }),
    events.on("open", () => { regain(severed); severed = false; }),
  );

  const figures = h("dl.definitions");
  const quality = h("span");
  const trouble = h("div", { role: "alert" });
  const histogramBox = h("div");
  const focusBox = h("div");
  /** @type {[number, number | null][]} time and focus */
  const course = [];
  /** @type {Chart | null} */
  let histogram = null;
  /** @type {Chart | null} */
  let focus = null;
  /** @type {number | null} */
  let began = null;

  const exposure = number(first.settings?.exposure_ms, { min: 0, ...limits(first.device?.exposure_range_ms) });
  const gain = number(first.settings?.gain_db, limits(first.device?.gain_range_db));
  const taken = h("p.quiet", { role: "status" });
  const set = action("Set", async () => {
    /** @type {Model<"SettingsPatch">} */
    const changes = {};
    if (exposure.value !== "") changes.exposure_ms = Number(exposure.value);
    if (gain.value !== "") changes.gain_db = Number(gain.value);
    const answer = await api.patch(`/cameras/${cam}`, changes);
    exposure.value = String(answer.settings.exposure_ms ?? "");
    gain.value = String(answer.settings.gain_db ?? "");
    taken.textContent = `The camera applied ${quantity(answer.settings.exposure_ms, "ms")} and ${quantity(answer.settings.gain_db, "dB")}.`;
  }, { kind: "primary" });
  for (const input of [exposure, gain]) input.addEventListener("keydown", (event) => event.key === "Enter" && set.click());

  ends.push(() => { view.close(); histogram?.close(); focus?.close(); if (shownOverlay) URL.revokeObjectURL(shownOverlay); });

  /** @type {{ delivered: number, at: number } | null} */
  let counted = null;
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
      counted = null;
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
    course.push([at, q.focus ?? null]);
    if (course.length > COURSE) course.shift();
    const highest = Math.max(...course.map((p) => p[1] ?? 0));
    replace(quality, badge(q.code, STATE_KIND[q.code] ?? "warn"));
    // after a change of settings a camera counts from zero
    const rate = counted && stats.frames.delivered >= counted.delivered ? (stats.frames.delivered - counted.delivered) / ((performance.now() - counted.at) / 1000) : null;
    counted = { delivered: stats.frames.delivered, at: performance.now() };
    replace(figures, [...definitions([
      ["frame rate", quantity(rate, "Hz", 3)], ["mean grey", num(q.mean_grey, 4)], ["saturated", quantity(100 * q.saturated_share, "%", 3)],
      ["texture", quantity(q.texture_grey_per_px, "grey/px", 3)], ["focus figure", q.focus === null || q.focus === undefined ? "– (little but noise is seen)" : `${num(q.focus, 3)} (highest ${num(highest, 3)})`],
      ["dropped", count(stats.frames.dropped)], ["incomplete", count(stats.frames.incomplete)],
    ]).children]);
    const bins = stats.histogram.map((_, i) => i);
    if (!histogram && histogramBox.clientWidth) {
      histogram = await chart(histogramBox, { x: "grey level (8 bit)", y: "pixels", height: 130, bars: true, files: false, series: [{ label: "pixels" }], data: [bins, stats.histogram], label: `Histogram of ${cam}` });
    } else histogram?.set([bins, stats.histogram]);
    /** @type {[number[], (number | null)[], (number | null)[]]} */
    const courseData = [course.map((p) => p[0]), course.map((p) => p[1]), course.map((p) => (p[1] !== null && p[1] === highest ? p[1] : null))];
    if (!focus && focusBox.clientWidth && course.length > 1) {
      focus = await chart(focusBox, { x: "time (s)", y: "focus", height: 130, files: false, series: [{ label: "focus" }, { label: "highest", edge: true, dots: true }], data: courseData, label: `Recent history of the focus figure of ${cam}` });
    } else focus?.set(courseData);
    rounds += 1;
    if (overlayChoice.value && rounds % 2 === 0) layOver().catch(() => {});
    return stats;
  }

  /** @type {Partial<NonNullable<typeof first.device>>} */
  const device = first.device ?? {};
  const box = h("section.panel", { "aria-label": cam },
    h("div.spread", h("h2", cam, " ", h("span.quiet", [device.model, device.serial].filter(Boolean).join(" · "))), quality),
    trouble, view.root,
    h("div.fields", { style: { marginTop: "0.5rem" } },
      field("Exposure", exposure, "ms", range(device.exposure_range_ms, "ms")), field("Gain", gain, "dB", range(device.gain_range_db, "dB")),
      h("div.field", h("span.quiet", "\u00a0"), set)),
    taken,
    h("div.grid.two", h("div", figures), h("div", histogramBox, focusBox)));
  return { cam, root: box, update };
}

/** @typedef {readonly number[] | null | undefined} Span low and high */
const limits = (/** @type {Span} */ pair) => (pair ? { min: pair[0], max: pair[1] } : {});
const range = (/** @type {Span} */ pair, /** @type {string} */ name) => (pair ? `${num(pair[0], 3)} to ${num(pair[1], 4)} ${name}` : "");

/** @param {Ends} ends */
function stage(ends) {
  const rows = h("div");
  const step = number(1, { min: 0.001, "aria-label": "Step of the jog buttons" });
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
      const go = action("Go", () => run(api.post("/stage/moves", { positions_mm: { [axis.axis]: Number(target.value) } })));
      target.addEventListener("keydown", (event) => event.key === "Enter" && go.click());
      const jog = (/** @type {1 | -1} */ sign) => action(sign < 0 ? "◂ −" : "+ ▸", () => run(api.post("/stage/moves", { by_mm: { [axis.axis]: sign * Number(step.value) } })), { "aria-label": `Jog axis ${axis.axis} ${sign < 0 ? "backward" : "forward"}` });
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
  return h("details", h("summary", "Simulated scene"),
    field("Scene", which), field("Load", load, "", "kPa for plate, kN for panel, per cent for strip, share of the motion for block"),
    action("Show the scene", () => api.put("/sim/scene", { scene: /** @type {Model<"SceneRequest">["scene"]} */ (which.value), load: Number(load.value) })));
}
