// A test's steps: thumbnails, and the quality of a pair.
import * as api from "../../lib/api.js";
import { capture } from "./capture.js";
import { importRecord } from "./channels.js";
import { importPairs } from "./import_pairs.js";
import { livePanel } from "./live.js";
import { backToZero } from "../../widgets/way_back.js";
import { windowOfList } from "../../widgets/window_of_list.js";
import { h, replace, action, table, badge, num, quantity, when, notify, confirmed } from "../../lib/dom.js";

/** @import { Ends, Part } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"TestReply">} Test */
/** @typedef {Model<"StepReply">} Step */

/** @type {Record<string, string>} */
const KIND = { ok: "good", dark: "warn", blurred: "warn", low_texture: "warn", saturated: "warn", blank: "bad", cameras_off_zero: "bad" };
/** @type {Record<string, string>} */
const WORDS = {
  ok: "good",
  dark: "too dark",
  blurred: "blurred",
  low_texture: "little texture",
  saturated: "saturated",
  blank: "blank",
  cameras_off_zero: "cameras off their calibrated position",
};

/**
 * @param {string} id
 * @param {Test} test
 * @param {Ends} ends
 * @param {() => Promise<Test>} reread
 */
export async function stepsPanel(id, test, ends, reread) {
  const thumbs = h("div.thumbs", {
    "data-role": "thumbnails",
    tabindex: 0,
    role: "region",
    "aria-label": "Thumbnails",
  });
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
    thumbs.scrollLeft = thumbs.scrollWidth; // where they stand in a row, the newest is seen
    replace(incomplete, test.incomplete_steps?.length ? h("p.quiet", `Incomplete: ${test.incomplete_steps.join(", ")}.`) : null);
  }

  /** @param {Model<"StepEntry">} step */
  function thumbnail(step) {
    return h(
      "figure",
      { "data-step": step.n },
      h(
        "button.plain",
        {
          type: "button",
          style: { padding: 0, display: "block", width: "100%" },
          "aria-pressed": String(step.n === chosen),
          "aria-label": `Step ${step.n}${step.label ? `, ${step.label}` : ""}`,
          onclick: () => show(step.n).catch(notify),
        },
        h("img", { loading: "lazy", alt: "", width: 132, src: api.address(`/tests/${id}/steps/${step.n}/cam1/preview`, { width_px: 132 }) }),
      ),
      h(
        "figcaption",
        h("strong", `${step.n}`),
        ` ${step.label ?? ""} `,
        step.load_n !== null && step.load_n !== undefined ? `${quantity(step.load_n, "N", 4)} ` : "",
        step.quality && step.quality !== "ok" ? badge(WORDS[step.quality] ?? step.quality, KIND[step.quality] ?? "warn") : null,
      ),
    );
  }

  /** @param {number} n */
  async function show(n) {
    chosen = n;
    drawDetail(await api.get(`/tests/${id}/steps/${n}`));
    for (const button of thumbs.querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.closest(`[data-step="${n}"]`) !== null));
  }

  const drawDetail = (/** @type {Step} */ step) => replace(detail, detailOf(step, fieldOf(test, step), remove, live.look));
  /** @param {Step} step */
  async function remove(step) {
    const text = "It is moved to the trash; its number is not used again, and analyses that used it become out of date.";
    if (!(await confirmed(`Delete step ${step.n}?`, h("p", text), "Delete"))) return;
    await api.remove(`/tests/${id}/steps/${step.n}`);
    replace(detail);
    await refresh();
  }

  async function refreshed() {
    await refresh();
    if (chosen !== null) await show(chosen); // its channels are others now
  }

  const live = await livePanel(ends); // before anything is shown: it would push the region away from under a drawing hand
  const taking = capture(
    id,
    async (step) => {
      chosen = step.n;
      drawDetail(step);
      await refresh();
    },
    ends,
    refresh,
  );
  live.root.dataset.on = taking.dataset.on = "capture";
  const root = h(
    "section.panel",
    { "aria-label": "Steps" },
    h("h2", "Steps"),
    h(
      "div.grid.side",
      h("div", live.root, part.bar, thumbs, incomplete),
      h(
        "div",
        taking,
        detail,
        importPairs(id, refresh, ends),
        importRecord(id, () => test, refreshed),
      ),
    ),
  );
  draw();
  return {
    root,
    refresh,
    onchange: (/** @type {typeof changed} */ listener) => {
      changed = listener;
    },
  };
}

/** @type {(readonly [string, (q: Exclude<NonNullable<Step["quality"]>["cam1"], undefined | null>) => Part])[]} */
const FIGURES = [
  ["quality", (q) => badge(WORDS[q.code] ?? q.code, KIND[q.code] ?? "warn")],
  ["mean grey", (q) => `${num(q.mean_grey, 4)}${q.mean_share ? ` (${num(100 * q.mean_share, 3)} %)` : ""}`],
  ["saturated", (q) => quantity(100 * q.saturated_share, "%", 3)],
  ["contrast", (q) => quantity(q.contrast_grey, "grey", 3)],
  ["texture", (q) => quantity(q.texture_grey_per_px, "grey/px", 3)],
  ["focus figure", (q) => num(q.focus, 3)],
  ["exposure", (q) => quantity(q.exposure_ms, "ms")],
  ["gain", (q) => quantity(q.gain_db, "dB")],
  ["temperature", (q) => quantity(q.temperature_c, "°C", 3)],
];

/**
 * A step's quality and readings.
 * @param {Step} step
 * @param {Part} field
 * @param {(step: Step) => unknown} remove
 * @param {() => unknown} look at the live picture again
 */
function detailOf(step, field, remove, look) {
  const quality = /** @type {Partial<NonNullable<Step["quality"]>>} */ (step.quality ?? {});
  const channels = Object.entries(step.channels ?? {})
    .map(([name, value]) => `${name} ${num(value, 6)}${step.channel_u?.[name] === undefined ? "" : ` ± ${num(step.channel_u[name], 2)}`}`)
    .join(", ");
  return [
    h(
      "div.spread",
      h("h3", `Step ${step.n}${step.label ? `: ${step.label}` : ""}`),
      h(
        "span.row",
        badge(WORDS[quality.code ?? ""] ?? quality.code ?? "not rated", KIND[quality.code ?? ""] ?? ""),
        action("Delete …", () => remove(step)),
      ),
    ),
    (step.warnings ?? []).map((warning) =>
      h(
        `div.caution${KIND[quality.code ?? ""] === "bad" ? ".bad" : ""}`,
        { role: "alert", "data-role": "step-warning" },
        h("p", warning.replace(/ POST .*$/, "")),
        step.quality?.code === "cameras_off_zero" ? backToZero(look) : null,
      ),
    ),
    field,
    h(
      "p.quiet",
      [
        when(step.captured_utc),
        step.load_n !== null && step.load_n !== undefined ? `load ${quantity(step.load_n, "N", 6)}` : null,
        channels || null,
        step.skew_ms !== null && step.skew_ms !== undefined
          ? `skew ${quantity(step.skew_ms, "ms", 3)}${step.skew_uncertainty_ms ? ` ± ${quantity(step.skew_uncertainty_ms, "ms", 2)} by ${step.skew_source}` : ""}${quality.max_skew_ms ? ` of ${quantity(quality.max_skew_ms, "ms", 3)} allowed` : ""}`
          : null,
        (step.frames ?? 1) > 1 ? `${step.frames} frames averaged` : null,
      ]
        .filter(Boolean)
        .join(" · "),
    ),
    table(
      [
        ["Figure", (row) => row[0], { unseen: true }],
        ["cam1", (row) => (quality.cam1 ? row[1](quality.cam1) : "–"), { numeric: true }],
        ["cam2", (row) => (quality.cam2 ? row[1](quality.cam2) : "–"), { numeric: true }],
      ],
      FIGURES,
      { caption: "Quality of the pair" },
    ),
  ];
}

/**
 * The step's field, or the action that leads to it.
 * @param {Test} test
 * @param {Step} step
 */
function fieldOf(test, step) {
  if (!test.calibration_id) return null;
  const newest = (test.analyses ?? []).at(-1);
  if (newest) return h("p", h("a.button", { href: `#/results/${test.id}/${newest.id}?step=${step.n}` }, "Show its field"));
  return (test.steps ?? []).length ? h("p", h("a.button", { href: `#/test/${test.id}?at=region` }, "Draw the region and measure")) : null;
}
