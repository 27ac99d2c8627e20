// One camera live: its picture, settings and figures.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { View } from "../../widgets/view.js";
import { chart } from "../../widgets/plots.js";
import { allRight, numberWithin, rule, tell } from "../../lib/fields.js";
import { focusCourse } from "./focus.js";
import {
  h,
  replace,
  field,
  number,
  select,
  action,
  describe,
  badge,
  num,
  tick,
  count,
  quantity,
  notify,
  problemText,
  when,
  STATE_KIND,
} from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model, Reply } from "#routes" */
/** @typedef {Reply<"get", "/cameras/{cam}/stats">} Stats */

const OVERLAYS = [
  ["", "no overlay"],
  ["saturation", "saturated pixels"],
  ["texture", "texture quality"],
];
const RATE_OVER_MS = 4000; // a rate over less jumps with the moment of its reading

/** Rate of a count over the last seconds; null until there are two, and after a new start. */
export function rateOf() {
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

/**
 * @param {string} cam
 * @param {Model<"CameraReply">} first
 * @param {Ends} ends
 */
export function camera(cam, first, ends) {
  const quality = h("span");
  const trouble = h("div", { role: "alert" });
  const name = h("span.quiet");
  const focus = focusCourse(cam);
  const picture = livePicture(cam, first.nominal?.image_size_px ?? [0, 0], ends, focus.forget);
  const settings = settingsOf(cam, first, focus.forget);
  const figures = figuresOf(cam);
  ends.push(figures.close, focus.close);
  /** @type {number | null} */
  let began = null;

  // figures of a frame long past must not pass for the present ones
  function unseen() {
    figures.histogram.hidden = true;
    if (began !== null) focus.add((performance.now() - began) / 1000, null).catch(notify);
  }
  /** @param {Model<"CameraReply">["device"] | undefined} device */
  function called(device) {
    name.textContent = [device?.model, device?.serial].filter(Boolean).join(" · ");
  }
  called(first.device);

  /** @param {Model<"CameraReply"> | undefined} now */
  async function update(now) {
    const fault = JSON.stringify(now?.fault ?? null);
    if (fault !== trouble.dataset.fault) {
      // announced once, not every second
      trouble.dataset.fault = fault;
      replace(trouble, now?.fault ? problemText(api.problemOf(now.fault)) : null);
    }
    if (now?.fault) {
      picture.lose(now.fault.detail);
      replace(quality, badge(connection(now), "bad"));
      replace(figures.list);
      unseen();
      return null;
    }
    called(now?.device); // it may have been found just now
    let stats;
    try {
      stats = await api.get(`/cameras/${cam}/stats`);
      picture.regain();
    } catch (error) {
      if (!(error instanceof Error)) throw error;
      if (error instanceof api.Problem && error.status >= 500) {
        picture.lose(error.message);
        replace(quality);
        unseen();
      }
      describe(figures.list, [["unknown", error.message]]);
      return null;
    }
    began ??= performance.now();
    if (picture.fresh(stats.sequence)) focus.add((performance.now() - began) / 1000, stats.quality.focus ?? null).catch(notify);
    replace(quality, badge(stats.quality.code, STATE_KIND[stats.quality.code] ?? "warn"));
    await figures.draw(stats);
    picture.later();
    return stats;
  }

  const root = h(
    "section.panel",
    { "aria-label": cam },
    h("div.spread", h("h2", cam, " ", name), quality),
    trouble,
    h("div.shot", picture.root, h("div", figures.list, settings)),
    h("h3", "Grey levels"),
    figures.histogram,
    h("h3", "Focus"),
    focus.root,
  );
  return { cam, root, update };
}

/**
 * The live picture with its overlay.
 * @param {string} cam
 * @param {readonly number[]} size
 * @param {Ends} ends
 * @param {() => void} forget drops the figures of an old scene
 */
function livePicture(cam, size, ends, forget) {
  const view = new View({
    label: `Live view of ${cam}`,
    grey: async (x, y) => {
      const pixel = await api.get(`/cameras/${cam}/pixel`, { x_px: x, y_px: y });
      return `grey ${pixel.value} of ${2 ** pixel.bit_depth - 1}`;
    },
  });
  view.size(size[0], size[1]);
  view.root.style.setProperty("--aspect", String(size[0] && size[1] ? size[0] / size[1] : 4 / 3));
  const overlay = overlayOf(cam, view);
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
  /** Whether a frame is of the present scene. @param {number | null} sequence */
  function fresh(sequence) {
    if (!waiting) return true;
    if (seen === null || sequence === seen) seen ??= sequence;
    else {
      waiting = false;
      regain(true);
    }
    return false;
  }
  ends.push(
    // both are exposed together: without one there are no pictures of the other
    events.on("camera", (event) => (event.state === "lost" ? lose(event.problem?.detail ?? `${event.camera} is lost.`) : regain(true))),
    events.on("job", (job) => job.kind === "reconnect" && job.state === "succeeded" && regain(true)),
    events.on("scene", () => {
      waiting = true;
      seen = null;
      forget();
      view.blank("Waiting for the first picture of the new scene …");
    }),
    events.on("lost", () => {
      severed = true;
    }),
    events.on("open", () => {
      regain(severed);
      severed = false;
    }),
    () => {
      view.close();
      overlay.close();
    },
  );
  return { root: view.root, lose, regain, fresh, later: overlay.later };
}

/**
 * The choice of a map over the picture.
 * @param {string} cam
 * @param {View} view
 */
function overlayOf(cam, view) {
  const image = h("img", { alt: "", hidden: true });
  view.content.insertBefore(image, view.svg);
  const choice = select(OVERLAYS, "", { "aria-label": `Overlay of ${cam}` });
  const legend = h("span.legend", { hidden: true }); // over the picture: both pictures keep the same height
  let shown = "";
  let rounds = 0;
  async function lay() {
    const kind = choice.value;
    image.hidden = !kind;
    legend.hidden = !kind;
    if (!kind) return;
    const answer = await api.raw(`/cameras/${cam}/maps/${kind}`);
    legend.textContent = answer.headers.get("X-Legend") ?? "";
    const next = URL.createObjectURL(await answer.blob());
    image.src = next;
    if (shown) URL.revokeObjectURL(shown);
    shown = next;
  }
  choice.addEventListener("change", () => lay().catch(notify));
  view.tools.append(choice);
  view.frame.append(legend);
  return {
    /** Another one at each second call. */
    later() {
      rounds += 1;
      if (choice.value && rounds % 2 === 0) lay().catch(() => {});
    },
    close() {
      if (shown) URL.revokeObjectURL(shown);
    },
  };
}

/**
 * Exposure and gain.
 * @param {string} cam
 * @param {Model<"CameraReply">} first
 * @param {() => void} forget drops the figures under other settings
 */
function settingsOf(cam, first, forget) {
  const { exposure_range_ms: ofExposure, gain_range_db: ofGain } = first.device ?? {};
  const exposure = number(first.settings?.exposure_ms, { min: 0, ...limits(ofExposure) });
  const gain = number(first.settings?.gain_db, limits(ofGain));
  const rules = [withinOf(exposure, ofExposure, "ms"), withinOf(gain, ofGain, "dB")];
  const taken = h("p.quiet.taken", { role: "status" });
  /** @param {{ exposure_ms?: number | null, gain_db?: number | null }} settings */
  function applied(settings, more = "") {
    exposure.value = settings.exposure_ms === null || settings.exposure_ms === undefined ? "" : String(Number(settings.exposure_ms.toPrecision(5)));
    gain.value = String(settings.gain_db ?? "");
    taken.textContent = `The camera applied ${quantity(settings.exposure_ms, "ms")} and ${quantity(settings.gain_db, "dB")}${more}.`;
    forget();
  }
  const set = action(
    "Set",
    async () => {
      if (!allRight(rules)) return;
      /** @type {Model<"SettingsPatch">} */
      const changes = {};
      if (exposure.value !== "") changes.exposure_ms = Number(exposure.value);
      if (gain.value !== "") changes.gain_db = Number(gain.value);
      applied((await api.patch(`/cameras/${cam}`, changes)).settings);
    },
    { kind: "primary" },
  );
  const search = action(
    "Auto exposure",
    async () => {
      tell(exposure, "");
      try {
        const found = await api.post(`/cameras/${cam}:expose`, {});
        applied(
          found.settings,
          `: the brightest parts are at ${num(100 * found.level, 3)} % of full scale, ${found.saturated_share ? `${num(100 * found.saturated_share, 2)} %` : "none"} saturated`,
        );
      } catch (error) {
        if (!(error instanceof api.Problem && (error.code?.startsWith("light_") || error.code === "exposure_not_settable"))) throw error;
        tell(exposure, `${error.message} ${error.remedy ?? ""}`);
      }
    },
    { title: "Search for the exposure that brings the brightest parts of the picture to 80 % of full scale" },
  );
  for (const input of [exposure, gain]) input.addEventListener("keydown", (event) => event.key === "Enter" && set.click());
  return [
    h(
      "div.fields",
      { style: { marginTop: "0.5rem" } },
      field("Exposure", exposure, "ms", range(ofExposure, "ms")),
      field("Gain", gain, "dB", range(ofGain, "dB")),
    ),
    h("div.row", set, search),
    taken,
  ];
}

/** Figures and histogram of the newest frame. @param {string} cam */
function figuresOf(cam) {
  const list = h("dl.definitions");
  const histogram = h("div");
  const frameRate = rateOf();
  /** @type {Awaited<ReturnType<typeof chart>> | null} */
  let plot = null;
  /** @param {Stats} stats */
  async function draw(stats) {
    const q = stats.quality;
    describe(list, [
      ["frame rate", quantity(frameRate(stats.frames.delivered), "Hz", 3)],
      ["mean grey", num(q.mean_grey, 4)],
      ["saturated", quantity(100 * q.saturated_share, "%", 3)],
      ["texture", quantity(q.texture_grey_per_px, "grey/px", 3)],
      ["focus figure", q.focus === null || q.focus === undefined ? "– (noise only)" : num(q.focus, 3)],
      ["dropped", count(stats.frames.dropped)],
      ["incomplete", count(stats.frames.incomplete)],
    ]);
    histogram.hidden = false;
    const bins = stats.histogram.map((_, i) => i);
    if (!plot && histogram.clientWidth) {
      plot = await chart(histogram, {
        x: "grey level (8 bit)",
        y: "pixels",
        height: 190,
        bars: true,
        files: false,
        series: [{ label: "pixels" }],
        data: [bins, stats.histogram],
        label: `Histogram of ${cam}`,
      });
    } else plot?.set([bins, stats.histogram]);
  }
  return { list, histogram, draw, close: () => plot?.close() };
}

/** @typedef {readonly number[] | null | undefined} Span low and high */
const limits = (/** @type {Span} */ pair) => (pair ? { min: pair[0], max: pair[1] } : {});
const range = (/** @type {Span} */ pair, /** @type {string} */ name) => (pair ? `${tick(pair[0])} to ${tick(pair[1])} ${name}` : "");

/**
 * Rule of a number within a range of the device.
 * @param {HTMLInputElement} input
 * @param {Span} pair
 * @param {string} unit
 * @returns {[HTMLInputElement, import("../../lib/fields.js").Rule]}
 */
const withinOf = (input, pair, unit) => [input, rule(input, numberWithin({ low: pair?.[0], high: pair?.[1], unit, required: false }))];

/** @param {{ state?: string | null, since_utc?: string | null }} device */
export const connection = (device) =>
  device.state === "looked_for" ? "looked for" : device.state === "lost" ? `lost since ${when(device.since_utc)}` : "connected";
