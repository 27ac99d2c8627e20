// Capture of a step, a burst or a recording, with load and channels.
import * as api from "../../lib/api.js";
import { allRight, numberWithin, rule } from "../../lib/fields.js";
import { h, replace, field, number, action, problemText } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"StepReply">} Step */
/** @typedef {[HTMLInputElement, import("../../lib/fields.js").Rule]} Ruled */

/** @type {Record<string, string>} */
const TRIGGERS = {
  call: "a call",
  level: "a level of a channel",
  slope: "a slope of a channel",
  peak: "peaks",
  valley: "valleys",
  phase: "phases of its cycles",
};

/**
 * @param {string} id
 * @param {(step: Step) => unknown} done
 * @param {Ends} ends
 * @param {() => unknown} refresh
 */
export function capture(id, done, ends, refresh) {
  const label = h("input", { type: "text", maxlength: 300, placeholder: "1.25 kN" });
  const load = number(null);
  const channels = h("input", { type: "text", placeholder: "stroke_mm = 0.42, temperature_c = 21.3" });
  const frames = number(1, { min: 1, max: 256, step: 1 });
  const count = number(1, { min: 1, max: 10000, step: 1 });
  const interval = number(0, { min: 0 });
  const progress = h("div", { role: "status" });
  const follow = follower(progress, ends, refresh);
  const rules = /** @type {Ruled[]} */ ([
    [load, rule(load, numberWithin({ required: false, what: "A load" }))],
    [frames, rule(frames, numberWithin({ low: 1, high: 256, whole: true, what: "A number of frames" }))],
    [channels, rule(channels, channelsWrong)],
    [count, rule(count, numberWithin({ low: 1, high: 10000, whole: true, what: "A number of steps" }))],
    [interval, rule(interval, numberWithin({ low: 0, unit: "ms", what: "An interval" }))],
  ]);
  const take = action(
    "Capture",
    async () => {
      if (!allRight(rules)) return undefined;
      /** @type {Model<"StepRequest">} */
      const body = { label: label.value, channels: parseChannels(channels.value), frames: Number(frames.value) };
      if (load.value !== "") body.load_n = Number(load.value);
      if (Number(count.value) > 1) Object.assign(body, { count: Number(count.value), interval_ms: Number(interval.value) });
      const made = await api.post(`/tests/${id}/steps`, body);
      if (!("job" in made)) return done(made);
      return follow(made.job.id, "Progress of the burst", () => `${count.value} steps were requested; see above.`);
    },
    { kind: "primary" },
  );
  for (const input of [label, load, channels]) input.addEventListener("keydown", (event) => event.key === "Enter" && take.click());
  return h(
    "div",
    { role: "group", "aria-label": "Capture" },
    h("h3", "Capture a step"),
    h("div.fields", field("Label", label), field("Load", load, "N"), field("Frames averaged", frames)),
    field("Channels", channels, "", "name = number, between commas"),
    h("details", h("summary", "A burst"), h("div.fields", field("Steps", count), field("Interval", interval, "ms"))),
    recording(id, label, follow),
    h("div.row", take),
    progress,
  );
}

/**
 * Makes a function that follows a job with its progress.
 * @param {HTMLElement} progress
 * @param {Ends} ends
 * @param {() => unknown} refresh
 */
function follower(progress, ends, refresh) {
  const stopped = new AbortController();
  ends.push(() => stopped.abort());
  /**
   * @param {string} job
   * @param {string} of
   * @param {(ended: Model<"JobReply">) => string} text
   * @param {import("#dom").Part} [more]
   */
  return async function follow(job, of, text, more = null) {
    const bar = h("progress", { max: 1, "aria-label": of });
    replace(
      progress,
      bar,
      more,
      action("Cancel", () => api.post(`/jobs/${job}:cancel`), { kind: "danger" }),
    );
    const ended = await api.finished(job, {
      signal: stopped.signal,
      onprogress: (one) => {
        if (one.progress?.total) bar.value = one.progress.done / one.progress.total;
      },
    });
    replace(progress, ["succeeded", "cancelled"].includes(ended.state) ? h("p", text(ended)) : problemText(api.jobProblem(ended)));
    return refresh();
  };
}

/** How many pairs of a recording were kept. @param {Model<"JobReply">} ended */
function account(ended) {
  const { kept = 0, pairs = 0, dropped } = /** @type {{ kept?: number, pairs?: number, dropped?: Record<string, number> }} */ (ended.result?.account ?? {});
  const lost = Object.entries(dropped ?? {})
    .map(([why, n]) => `${n} ${why}`)
    .join(", ");
  return `${kept} of ${pairs} pairs were kept as steps${lost ? `; dropped: ${lost}` : ""}.`;
}

/**
 * A recording: pairs are kept at a trigger.
 * @param {string} id of the test
 * @param {HTMLInputElement} label
 * @param {ReturnType<typeof follower>} follow
 */
function recording(id, label, follow) {
  const kind = h(
    "select",
    Object.entries(TRIGGERS).map(([value, text]) => h("option", { value }, text)),
  );
  const watched = h("input", { type: "text", maxlength: 100, placeholder: "force" });
  const value = number(null),
    every = number(1, { min: 1, step: 1 }),
    phases = h("input", { type: "text", value: "0" });
  const before = number(1, { min: 0 }),
    after = number(10, { min: 0 });
  const record = action("Record", async () => {
    const trigger = { kind: kind.value, every: Number(every.value), ...(kind.value === "call" ? {} : { channel: watched.value }) };
    if (kind.value === "level") Object.assign(trigger, { level: Number(value.value) });
    if (kind.value === "slope") Object.assign(trigger, { slope_per_s: Number(value.value) });
    if (kind.value === "phase")
      Object.assign(trigger, {
        phases_deg: phases.value
          .split(/[,;\s]+/)
          .filter(Boolean)
          .map(Number),
      });
    const body = /** @type {Model<"RecordRequest">} */ ({ label: label.value, trigger, before_s: Number(before.value), after_s: Number(after.value) });
    const made = await api.post(`/tests/${id}/record`, body);
    return follow(
      made.job.id,
      "Progress of the recording",
      account,
      action("Trigger now", () => api.post(`/tests/${id}/record:trigger`)),
    );
  });
  return h(
    "details",
    h("summary", "A recording"),
    h(
      "div.fields",
      field("Trigger", kind),
      field("Channel", watched),
      field("Level, or slope a second", value),
      field("Every N-th", every),
      field("Phases", phases, "deg"),
      field("Before", before, "s"),
      field("After", after, "s"),
    ),
    h("div.row", record),
  );
}

/**
 * The error in a text of channels; empty: none.
 * @param {string} text
 */
function channelsWrong(text) {
  try {
    parseChannels(text);
    return "";
  } catch (error) {
    return error instanceof api.Problem ? `${error.message} ${error.remedy}` : String(error);
  }
}

/**
 * "stroke_mm = 0.42, temperature_c = 21.3" -> {stroke_mm: 0.42, ...}
 * @param {string} text
 */
export function parseChannels(text) {
  /** @type {Record<string, number>} */
  const out = {};
  for (const part of text
    .split(/[,;\n]+/)
    .map((one) => one.trim())
    .filter(Boolean)) {
    const [name, value, ...more] = part.split("=").map((one) => one.trim());
    if (!name || more.length || !value || !Number.isFinite(Number(value)))
      throw api.problemOf({ detail: `“${part}” is not a channel.`, remedy: "Write name = number, with a point, between commas." });
    out[name] = Number(value);
  }
  return out;
}
