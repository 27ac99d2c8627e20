// A test's steps: capture with load and channels, quality of the pair, thumbnails, import of existing pairs.
import * as api from "../../lib/api.js";
import { importRecord } from "./channels.js";
import { livePanel } from "./live.js";
import { allRight, numberWithin, rule } from "../../lib/fields.js";
import { backToZero } from "../../widgets/way_back.js";
import { windowOfList } from "../../widgets/window_of_list.js";
import { h, replace, field, number, action, table, badge, num, quantity, when, notify, problemText, ask } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"TestReply">} Test */
/** @typedef {Model<"StepReply">} Step */

/** @type {Record<string, string>} */
const KIND = { ok: "good", dark: "warn", blurred: "warn", low_texture: "warn", saturated: "warn", blank: "bad", cameras_off_zero: "bad" };
/** @type {Record<string, string>} */
const WORDS = { ok: "good", dark: "too dark", blurred: "blurred", low_texture: "little texture", saturated: "saturated", blank: "blank", cameras_off_zero: "cameras off their calibrated position" };

/**
 * @param {string} id
 * @param {Test} test
 * @param {Ends} ends
 * @param {() => Promise<Test>} reread
 */
export async function stepsPanel(id, test, ends, reread) {
  const thumbs = h("div.thumbs", { "data-role": "thumbnails", style: { maxHeight: "22rem", overflow: "auto" }, tabindex: 0, role: "region", "aria-label": "Thumbnails" });
  const incomplete = h("div");
  const part = windowOfList(thumbs, thumbnail, { what: "step", name: (/** @type {Model<"StepEntry">} */ step) => step.n });
  const detail = h("div", { role: "status", "data-role": "quality" });
  /** @type {number | null} */
  let chosen = null;
  /** @type {(test: Test) => void} */
  let changed = () => {};

  async function refresh() {
    test = await reread();
    draw();
    changed(test);
  }

  function draw() {
    const steps = test.steps ?? [];
    part.lay(steps);
    if (!steps.length) replace(thumbs, h("p.quiet", "No steps yet. The first one is the reference: capture it with the specimen unloaded, or import pairs."));
    replace(incomplete, test.incomplete_steps?.length ? h("p.quiet", `Incomplete: ${test.incomplete_steps.join(", ")}.`) : null);
  }

  /** @param {Model<"StepEntry">} step */
  function thumbnail(step) {
    return h("figure", { "data-step": step.n },
      h("button.plain", { type: "button", style: { padding: 0, display: "block", width: "100%" }, "aria-pressed": String(step.n === chosen), "aria-label": `Step ${step.n}${step.label ? `, ${step.label}` : ""}`, onclick: () => show(step.n).catch(notify) },
        h("img", { loading: "lazy", alt: "", width: 132, src: api.address(`/tests/${id}/steps/${step.n}/cam1/preview`, { width_px: 132 }) })),
      h("figcaption", h("strong", `${step.n}`), ` ${step.label ?? ""} `, step.load_n !== null && step.load_n !== undefined ? `${quantity(step.load_n, "N", 4)} ` : "", step.quality && step.quality !== "ok" ? badge(WORDS[step.quality] ?? step.quality, KIND[step.quality] ?? "warn") : null));
  }

  /** @param {number} n */
  async function show(n) {
    chosen = n;
    drawDetail(await api.get(`/tests/${id}/steps/${n}`));
    for (const button of thumbs.querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.closest(`[data-step="${n}"]`) !== null));
  }

  /** @param {Step} step */
  function drawDetail(step) {
    const quality = /** @type {Partial<NonNullable<Step["quality"]>>} */ (step.quality ?? {});
    /** @type {(readonly [string, (q: Exclude<NonNullable<Step["quality"]>["cam1"], undefined | null>) => import("#dom").Part])[]} */
    const rows = [
      ["quality", (q) => badge(WORDS[q.code] ?? q.code, KIND[q.code] ?? "warn")], ["mean grey", (q) => `${num(q.mean_grey, 4)}${q.mean_share ? ` (${num(100 * q.mean_share, 3)} %)` : ""}`],
      ["saturated", (q) => quantity(100 * q.saturated_share, "%", 3)], ["contrast", (q) => quantity(q.contrast_grey, "grey", 3)],
      ["texture", (q) => quantity(q.texture_grey_per_px, "grey/px", 3)], ["focus figure", (q) => num(q.focus, 3)], ["exposure", (q) => quantity(q.exposure_ms, "ms")], ["gain", (q) => quantity(q.gain_db, "dB")],
    ];
    const channels = Object.entries(step.channels ?? {}).map(([name, value]) => `${name} ${num(value, 6)}`).join(", ");
    replace(detail,
      h("div.spread", h("h3", `Step ${step.n}${step.label ? `: ${step.label}` : ""}`), h("span.row", badge(WORDS[quality.code ?? ""] ?? quality.code ?? "not rated", KIND[quality.code ?? ""] ?? ""),
        action("Delete …", async () => {
          if (await ask(`Delete step ${step.n}?`, h("p", "It is moved to the trash; its number is not used again, and analyses that used it become out of date."), [["Cancel", null], ["Delete", "yes"]])) {
            await api.remove(`/tests/${id}/steps/${step.n}`);
            replace(detail);
            await refresh();
          }
        }))),
      (step.warnings ?? []).map((warning) => h(`div.caution${KIND[quality.code ?? ""] === "bad" ? ".bad" : ""}`, { role: "alert", "data-role": "step-warning" }, h("p", warning.replace(/ POST .*$/, "")), step.quality?.code === "cameras_off_zero" ? backToZero(() => live.look()) : null)),
      fieldOf(step),
      h("p.quiet", [when(step.captured_utc), step.load_n !== null && step.load_n !== undefined ? `load ${quantity(step.load_n, "N", 6)}` : null, channels || null, step.skew_ms !== null && step.skew_ms !== undefined ? `skew ${quantity(step.skew_ms, "ms", 3)}${quality.max_skew_ms ? ` of ${quantity(quality.max_skew_ms, "ms", 3)} allowed` : ""}` : null, (step.frames ?? 1) > 1 ? `${step.frames} frames averaged` : null].filter(Boolean).join(" · ")),
      table([["Figure", (row) => row[0], { unseen: true }], ["cam1", (row) => (quality.cam1 ? row[1](quality.cam1) : "–"), { numeric: true }], ["cam2", (row) => (quality.cam2 ? row[1](quality.cam2) : "–"), { numeric: true }]], rows, { caption: "Quality of the pair" }));
  }

  /**
   * The step's field, or what has to be done to have it.
   * @param {Step} step
   */
  function fieldOf(step) {
    if (!test.calibration_id) return null;
    const newest = (test.analyses ?? []).at(-1);
    if (newest) return h("p", h("a.button", { href: `#/results/${id}/${newest.id}?step=${step.n}` }, "Show its field"));
    return (test.steps ?? []).length ? h("p", h("a.button", { href: `#/test/${id}?at=region` }, "Draw the region and measure")) : null;
  }

  async function refreshed() {
    await refresh();
    if (chosen !== null) await show(chosen); // its channels are others now
  }

  const live = await livePanel(ends); // before anything is shown: it would push the region away from under a drawing hand
  const root = h("section.panel", { "aria-label": "Steps" }, h("h2", "Steps"),
    h("div.grid.side", h("div", live.root, part.bar, thumbs, incomplete, detail, importPairs(id, refresh, ends), importRecord(id, () => test, refreshed)), capture(id, async (step) => { chosen = step.n; drawDetail(step); await refresh(); }, ends, refresh)));
  draw();
  return { root, refresh, onchange: (/** @type {typeof changed} */ listener) => { changed = listener; } };
}

/**
 * @param {string} id
 * @param {(step: Step) => unknown} done
 * @param {Ends} ends
 * @param {() => unknown} refresh
 */
function capture(id, done, ends, refresh) {
  const label = h("input", { type: "text", maxlength: 300, placeholder: "1.25 kN" });
  const load = number(null);
  const channels = h("input", { type: "text", placeholder: "stroke_mm = 0.42, temperature_c = 21.3" });
  const frames = number(1, { min: 1, max: 256, step: 1 });
  const count = number(1, { min: 1, max: 10000, step: 1 });
  const interval = number(0, { min: 0 });
  const progress = h("div", { role: "status" });
  const stopped = new AbortController();
  ends.push(() => stopped.abort());

  const rules = /** @type {[HTMLInputElement, import("../../lib/fields.js").Rule][]} */ ([
    [load, rule(load, numberWithin({ required: false, what: "A load" }))], [frames, rule(frames, numberWithin({ low: 1, high: 256, whole: true, what: "A number of frames" }))],
    [channels, rule(channels, channelsWrong)], [count, rule(count, numberWithin({ low: 1, high: 10000, whole: true, what: "A number of steps" }))], [interval, rule(interval, numberWithin({ low: 0, unit: "ms", what: "An interval" }))],
  ]);
  const take = action("Capture", async () => {
    if (!allRight(rules)) return undefined;
    /** @type {Model<"StepRequest">} */
    const body = { label: label.value, channels: parseChannels(channels.value), frames: Number(frames.value) };
    if (load.value !== "") body.load_n = Number(load.value);
    if (Number(count.value) > 1) Object.assign(body, { count: Number(count.value), interval_ms: Number(interval.value) });
    const made = await api.post(`/tests/${id}/steps`, body);
    if (!("job" in made)) return done(made);
    const bar = h("progress", { max: 1, "aria-label": "Progress of the burst" });
    replace(progress, bar, action("Cancel", () => api.post(`/jobs/${made.job.id}:cancel`), { kind: "danger" }));
    const ended = await api.finished(made.job.id, { signal: stopped.signal, onprogress: (job) => { if (job.progress?.total) bar.value = job.progress.done / job.progress.total; } });
    replace(progress, ["succeeded", "cancelled"].includes(ended.state) ? h("p", `${count.value} steps were requested; see above.`) : problemText(api.jobProblem(ended)));
    return refresh();
  }, { kind: "primary" });
  for (const input of [label, load, channels]) input.addEventListener("keydown", (event) => event.key === "Enter" && take.click());
  return h("div", { role: "group", "aria-label": "Capture" }, h("h3", "Capture a step"),
    h("div.fields", field("Label", label), field("Load", load, "N"), field("Frames averaged", frames)), field("Channels", channels, "", "name = number, between commas"),
    h("details", h("summary", "A burst"), h("div.fields", field("Steps", count), field("Interval", interval, "ms"))), h("div.row", take), progress);
}

/**
 * What is wrong with a text of channels; empty: nothing.
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
  for (const part of text.split(/[,;\n]+/).map((one) => one.trim()).filter(Boolean)) {
    const [name, value, ...more] = part.split("=").map((one) => one.trim());
    if (!name || more.length || !value || !Number.isFinite(Number(value))) throw api.problemOf({ cause: `“${part}” is not a channel.`, remedy: "Write name = number, with a point, between commas." });
    out[name] = Number(value);
  }
  return out;
}

/**
 * Pairs of files in the order of their names, numbers in them counted as numbers.
 * @param {ArrayLike<File>} one
 * @param {ArrayLike<File>} two
 * @returns {[File, File][]}
 */
export function pairsOf(one, two) {
  const order = new Intl.Collator("en", { numeric: true });
  const sorted = (/** @type {ArrayLike<File>} */ files) => Array.from(files).sort((a, b) => order.compare(a.name, b.name));
  const [first, second] = [sorted(one), sorted(two)];
  if (first.length !== second.length || !first.length) throw api.problemOf({ cause: `Camera 1 has ${first.length} images, camera 2 has ${second.length}.`, remedy: "Choose as many images of each camera; they are matched in the order of their names." });
  return first.map((file, index) => [file, second[index]]);
}

/**
 * @param {string} id
 * @param {() => unknown} refresh
 * @param {Ends} ends
 */
function importPairs(id, refresh, ends) {
  const accept = ".tif,.tiff,.png,.bmp,.jpg,.jpeg";
  const one = h("input", { type: "file", multiple: true, accept });
  const two = h("input", { type: "file", multiple: true, accept });
  const matched = h("div", { role: "status" });
  const progress = h("div", { role: "status" });
  const byName = h("input", { type: "checkbox", checked: true });
  /** @type {AbortController | null} */
  let going = null;
  const files = (/** @type {HTMLInputElement} */ input) => input.files ?? [];
  ends.push(() => going?.abort());

  function match() {
    if (!files(one).length || !files(two).length) return replace(matched);
    try {
      const pairs = pairsOf(files(one), files(two));
      return replace(matched, table([["Number", (row) => String(row[2] + 1), { unseen: true }], ["Camera 1", (row) => row[0].name], ["Camera 2", (row) => row[1].name]], pairs.map(([a, b], k) => /** @type {const} */ ([a, b, k])).slice(0, 200), { caption: `${pairs.length} pairs, in the order of their names` }));
    } catch (error) {
      return replace(matched, problemText(error));
    }
  }
  one.addEventListener("change", match);
  two.addEventListener("change", match);
  const start = action("Import", async () => {
    const pairs = pairsOf(files(one), files(two));
    const stopping = new AbortController();
    going = stopping;
    const bar = h("progress", { max: pairs.length, value: 0, "aria-label": "Progress of the import" });
    const text = h("span");
    replace(progress, h("div.row", h("span", { style: { flex: 1 } }, bar), text, h("button.danger", { type: "button", onclick: () => stopping.abort() }, "Stop")));
    let ready = 0;
    try {
      for (const [first, second] of pairs) {
        if (stopping.signal.aborted) break;
        text.textContent = `${ready} of ${pairs.length}: ${first.name}`;
        const form = new FormData();
        form.append("cam1", first);
        form.append("cam2", second);
        form.append("label", byName.checked ? first.name.replace(/\.[^.]*$/, "").slice(0, 300) : "");
        try {
          await api.upload(`/tests/${id}/steps:import`, form);
        } catch (error) {
          if (error instanceof Error) error.message = `${first.name} and ${second.name}: ${error.message}`;
          throw error;
        }
        ready += 1;
        bar.value = ready;
      }
    } finally {
      replace(progress, h("p", badge(ready === pairs.length ? "imported" : "stopped", ready === pairs.length ? "good" : "warn"), ` ${ready} of ${pairs.length} pairs imported as steps.`));
      await refresh();
    }
  }, { kind: "primary" });
  return h("details", { style: { marginTop: "0.75rem" } }, h("summary", "Import existing pairs"), h("div.fields", field("Images of camera 1", one), field("Images of camera 2", two)),
    h("label.check", byName, "label each step by its file's name"), matched, h("div.row", { style: { marginTop: "0.5rem" } }, start), progress);
}
