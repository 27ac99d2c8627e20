// Settings, step summaries and files of an analysis.
import * as api from "../../lib/api.js";
import { h, replace, table, badge, definitions, num, tick, count, quantity, action, field, select, number, notify, when, STATE_KIND } from "../../lib/dom.js";

import { REMEDY, camerasBadge } from "./cameras.js";
import { NOT_INCLUDED } from "./uncertainty.js";

/** @import { Viewer } from "../results.js" */
/** @import { StepSummary } from "#routes" */

/**
 * Settings, software, inputs; each step's figures, checks and warnings.
 * @param {Viewer} screen
 */
export function about(screen) {
  const { result } = screen;
  const root = h("details.panel", { "data-role": "about" }, h("summary", "Settings, checks and warnings"));
  const body = h("div");
  root.append(body);

  /**
   * @param {unknown} value
   * @returns {string}
   */
  const text = (value) => {
    if (value === null || value === undefined) return "none";
    if (Array.isArray(value)) return value.length > 12 ? `${value.length} entries` : value.map(text).join(", ") || "none";
    if (typeof value === "object") return Object.entries(value).filter(([, v]) => v !== null && !(Array.isArray(v) && !v.length)).map(([k, v]) => `${k} ${text(v)}`).join("; ") || "none";
    return typeof value === "number" ? tick(value) : String(value);
  };

  function draw() {
    const { analysis } = result;
    const steps = analysis.summary?.steps ?? [];
    const failed = Object.entries(analysis.steps_failed ?? {});
    const verdict = (/** @type {StepSummary["epipolar_check"]} */ check) => (check ? h("span", { title: check.reason }, badge(check.level, STATE_KIND[check.level] ?? "warn")) : "–");
    const warned = steps.flatMap((one) => [
      ...(one.epipolar_check && one.epipolar_check.level !== "ok" ? [`Step ${one.n}: ${one.epipolar_check.reason}`] : []),
      ...(one.camera_motion?.camera_moved ? [`Step ${one.n}: ${one.camera_motion.text}. ${REMEDY}`] : []),
    ]);
    replace(body,
      analysis.stale ? h("p", badge("out of date", "warn"), " ", (analysis.stale_reasons ?? []).join("; ")) : null,
      warned.length ? h("div", h("h3", "Warnings"), h("ul", warned.map((one) => h("li", one)))) : null,
      failed.length ? h("div", h("h3", "Steps that failed"), h("ul", failed.map(([n, one]) => h("li", `Step ${n}: ${one.code}: ${one.cause} ${one.remedy}`)))) : null,
      h("h3", "Settings"),
      definitions([["kind", analysis.kind], ...Object.entries(analysis.settings ?? {}).map(([name, value]) => /** @type {const} */ ([name.replace(/_/g, " "), text(value)])),
        ["software", analysis.software ?? "–"], ["begun", when(analysis.created_utc)], ["calibration", analysis.inputs?.calibration_sha256 ? [analysis.calibration_id ? h("a", { href: `#/calibrate/${analysis.calibration_id}` }, analysis.calibration_id) : null, " ", h("code", analysis.inputs.calibration_sha256.slice(0, 16))] : "–"]]),
      h("h3", "Steps"),
      table([
        ["Step", (one) => one.n, { numeric: true }],
        ["Valid", (one) => `${count(one.valid)} of ${count(one.points)}`, { numeric: true }],
        ["Epipolar check", (one) => verdict(one.epipolar_check)],
        ["Cameras", (one) => camerasBadge(one.camera_motion)],
        ["Epipolar offset", (one) => quantity(one.epipolar_offset_rms_px, "px", 3), { numeric: true }],
        ["Correlation", (one) => num(Math.min(...Object.values(one.zncc_median ?? { none: NaN })), 4), { numeric: true }],
        ["σ Z", (one) => quantity(one.sigma_median_mm?.z_mm, "mm", 2), { numeric: true }],
        ["σ W", (one) => quantity(one.sigma_median_mm?.w_mm, "mm", 2), { numeric: true }],
        ["Strain noise floor", (one) => quantity(one.strain?.noise_floor_microstrain?.exx, "µm/m", 3), { numeric: true }],
        ["Patch", (one) => h("span", { title: one.patch?.reason ?? "" }, one.patch?.patch ?? "–")],
        ["Time", (one) => quantity(one.wall_s, "s", 3), { numeric: true }],
      ], steps, { caption: `Summary of each step; σ are medians of the reported standard uncertainties (k = 1)${steps.some((one) => !one.sigma_calibration_median_mm) ? `, ${NOT_INCLUDED}` : ""}`, empty: "No step is finished yet." }),
      definitions(steps.length ? [["epipolar check of the last step", steps.at(-1)?.epipolar_check?.reason ?? "–"], ["cameras at the last step", steps.at(-1)?.camera_motion?.text ?? "–"], ["patch of the last step", steps.at(-1)?.patch?.reason ?? "–"]] : []));
  }
  draw();
  return { root, draw };
}

/** @typedef {any} Schema of a parameter, in JSON Schema; not checked at run time */
/** @typedef {{ name: string, in: string, required?: boolean, description?: string, schema: Schema }} Parameter */
/** @type {any} */
let description = null;
/** The API's own description: it lists the formats of a result. */
async function operations() {
  description ??= await (await api.raw("/openapi.json")).json();
  return description;
}

/**
 * Files in every format of the service, and the report.
 * @param {Viewer} screen
 */
export function files(screen) {
  const { result } = screen;
  const root = h("details.panel", { "data-role": "files" }, h("summary", "Export and report"));
  const form = h("div");
  root.append(form);
  /** @type {Map<string, HTMLInputElement | HTMLSelectElement>} */
  const inputs = new Map();

  /** @param {Parameter} parameter */
  function control(parameter) {
    const schema = (parameter.schema.anyOf ?? [parameter.schema]).find((/** @type {Schema} */ one) => one.type !== "null") ?? {};
    const of = schema.enum ?? (schema.const !== undefined ? [schema.const] : null);
    const usual = parameter.schema.default ?? schema.default;
    if (of) return select([...(parameter.required || usual !== undefined ? [] : [["", "–"]]), ...of.map((/** @type {string} */ one) => [one, String(one)])], usual ?? of[0]);
    if (schema.type === "boolean") return h("input", { type: "checkbox", checked: Boolean(usual) });
    if (schema.type === "integer" || schema.type === "number") return number(usual ?? null, { min: schema.minimum, max: schema.maximum });
    return h("input", { type: "text", value: usual ?? "" });
  }

  /** @param {HTMLInputElement | HTMLSelectElement} input */
  function value(input) {
    if (input instanceof HTMLInputElement && input.type === "checkbox") return input.checked ? "true" : null;
    return input.value === "" ? null : input.value;
  }

  async function save() {
    const address = new URL(api.address(`${result.path}/export`), location.origin);
    for (const [name, input] of inputs) {
      const v = value(input);
      if (v !== null) for (const one of input.dataset.many ? v.split(/[\s,]+/) : [v]) address.searchParams.append(name, one);
    }
    const answer = await api.raw(address.href);
    const named = /filename\*?=(?:UTF-8'')?"?([^";]+)"?/.exec(answer.headers.get("Content-Disposition") ?? "");
    const stale = answer.headers.get("X-Stale");
    const link = h("a", { href: URL.createObjectURL(await answer.blob()), download: named ? decodeURIComponent(named[1]) : `${result.testId}_${result.analysisId}.${address.searchParams.get("format") ?? "nc"}` });
    document.body.append(link);
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
    if (stale) notify(`The file is saved, but out of date: ${stale}`, "warn");
  }

  /** Take step and variable from the screen where the format allows: figures show one variable, films all steps. */
  function propose() {
    const form_ = inputs.get("format")?.value;
    const film = ["gif", "mp4"].includes(form_ ?? "");
    const step = inputs.get("step");
    const variables = inputs.get("variables");
    const frame = inputs.get("frame");
    if (frame) frame.value = result.frame;
    if (step) step.value = film || screen.step === null ? "" : String(screen.step);
    if (variables) variables.value = (film || ["png", "svg"].includes(form_ ?? "")) && screen.info ? screen.info.name : "";
  }

  /** The report in a tab of its own. It is computed on request, which takes a while: a message states so. */
  function report() {
    const address = api.address(`${result.path}/report`, { frame: result.frame });
    const note = h("p.quiet", { role: "status" }, "One HTML page with all results, to file or print.");
    const announce = () => { note.textContent = "The report is computed from the steps' files: some seconds, longer for many steps. It is shown when it is complete."; };
    return h("div", h("div.row", h("a.button", { href: address, target: "_blank", rel: "noopener", onclick: announce }, "Open the report"),
      h("a.button", { href: address, download: `${result.testId}_${result.analysisId}_report.html`, onclick: announce }, "Save the report")), note);
  }

  async function draw() {
    const { paths, components } = await operations();
    const resolved = (/** @type {Schema} */ schema) => (schema.$ref ? { ...components.schemas[schema.$ref.split("/").at(-1)], default: schema.default } : schema);
    const at = (/** @type {string} */ end) => paths[`${api.BASE}/tests/{test_id}/analyses/{analysis_id}/${end}`]?.get;
    const found = at("export");
    inputs.clear();
    const rows = /** @type {Parameter[]} */ (found?.parameters ?? []).filter((one) => one.in === "query").map((given) => {
      const whole = given.schema.allOf?.length === 1 ? { ...resolved(given.schema.allOf[0]), default: given.schema.default } : resolved(given.schema);
      const parameter = { ...given, schema: { ...whole, anyOf: whole.anyOf?.map(resolved) } };
      const input = control(parameter);
      const schema = (parameter.schema.anyOf ?? [parameter.schema]).find((/** @type {Schema} */ one) => one.type !== "null") ?? {};
      if (schema.type === "array") input.dataset.many = "1";
      inputs.set(parameter.name, input);
      return field(parameter.name.replace(/_/g, " "), input, "", parameter.description ?? "");
    });
    inputs.get("format")?.addEventListener("change", propose);
    propose();
    replace(form,
      found ? h("div", h("p.quiet", found.summary), h("div.fields", rows), action("Save the file", save, { kind: "primary" })) : h("p.quiet", "This service offers no export."),
      at("report") ? report() : null);
  }
  root.addEventListener("toggle", () => root.open && !inputs.size && draw().catch(notify));
  screen.drawn.add(() => inputs.size && propose());
  return root;
}
