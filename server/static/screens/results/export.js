// Export: the picture as it is shown, a film of it, the numbers for other programs.
import * as api from "../../lib/api.js";
import { h, replace, action, badge, field, number, select, notify, problemText, tick } from "../../lib/dom.js";
import { pngOf, saveAs, svgFile } from "../../widgets/saving.js";
import { shownUnit } from "./analysis.js";

/** @import { Viewer } from "../results.js" */
/** @import { Result } from "./analysis.js" */
/** @import { Model } from "#routes" */
/** @typedef {Record<string, string | number | boolean>} Asked parameters of the API's export */

/** @type {[form: string, text: string][]} */
const NUMBERS = [
  ["nc", "NetCDF, as measured"],
  ["csv", "table (CSV)"],
  ["vtu", "ParaView (VTU, PVD)"],
  ["mat", "MATLAB"],
  ["h5", "HDF5, all steps stacked"],
];
const FILMS = [
  ["mp4", "MP4"],
  ["gif", "GIF"],
];
const WHICH = [
  ["one", "the step shown"],
  ["all", "all steps"],
];
const FIELDS = [
  ["all", "all"],
  ["seen", "the one shown"],
];
const ACTIVE = ["queued", "running", "cancelling"];
/** @type {Record<string, string>} */
const PHASES = { waiting: "waiting", reading: "reading the steps", drawing: "drawing", writing: "writing" };
const MAPS = /** @type {const} */ ({ viridis: "viridis", cividis: "cividis", turbo: "turbo", diverging: "blue to brown", grey: "grey" });

/**
 * The export's parameters for the same picture as the view: field, colours, limits, image and axes.
 * @param {Viewer} screen
 * @param {boolean} over over the reference image
 * @returns {Asked | null} null where the view shows no single field
 */
export function seen(screen, over) {
  const { info, scale, map, result } = screen;
  if (!info || info.component !== null) return null;
  /** @type {Asked} */
  const asked = { variables: info.name, frame: result.frame, over_image: over };
  if (scale.flags) return asked;
  const factor = /** @type {{ factor?: number }} */ (info).factor ?? shownUnit(info.name, "").factor;
  const opacity = Number(map.view.canvas.style.opacity || 1);
  return {
    ...asked,
    limits: `${scale.low / factor},${scale.high / factor}`,
    colours: scale.name,
    levels: Math.min(Math.max(Math.round(Number(scale.levels.value) || 0), 0), 64),
    reverse: scale.reverse.checked,
    opacity: Math.min(Math.max(opacity, 0.05), 1),
  };
}

/**
 * Pictures, films and files of an analysis.
 * @param {Viewer} screen
 */
export function files(screen) {
  const { result } = screen;
  const course = h("div", { "data-role": "export-course", role: "status" });
  const picture = pictureOf(screen);
  const { over, width, dense, densePx } = picture;
  const film = select(FILMS, "mp4");
  const pace = number(2, { min: 0.1, max: 60 });
  async function makeFilm() {
    const asked = seen(screen, over.checked);
    if (!asked) throw new Error("Choose a field with one number a point: a film shows it over the steps.");
    const fps = Number(pace.value);
    if (!(fps >= 0.1 && fps <= 60)) throw new Error("A film shows 0.1 to 60 steps a second; correct Steps a second.");
    await slowly(result, course, { ...asked, format: film.value, fps, width_px: picture.size(), ...(dense.checked ? { dense: true } : {}) });
  }
  const denseMap = denseMapOf(screen, picture);
  const root = h(
    "details.panel",
    { "data-role": "files" },
    h("summary", "Export"),
    h("h3", "The picture that is shown"),
    picture.text,
    h(
      "div.row",
      field("Width", width, "px"),
      h("label.check", over, "over the reference image"),
      densePx ? h("label.check", dense, "the dense field") : null,
      action("Save as PNG", () => picture.save("png"), { "data-role": "save-png" }),
      action("Save as SVG", () => picture.save("svg")),
    ),
    denseMap.root,
    h("h3", "A film of it over the steps"),
    h("div.row", field("Film as", film), field("Steps a second", pace), action("Make the film", makeFilm)),
    course,
    h("h3", "Numbers for other programs"),
    numbers(screen, course, densePx),
    densePx
      ? h(
          "p.hint",
          "The dense field's files are in the folder ",
          h("code", "dense"),
          ` of the analysis, ${result.analysisId}, in the layout of the ordinary ones; strain, normals and rotation are the ordinary field's alone.`,
        )
      : "",
  );
  function tell() {
    const asked = seen(screen, over.checked);
    denseMap.show(asked, root.open);
    picture.tell(asked);
  }
  for (const choice of [over, dense]) choice.addEventListener("change", tell);
  for (const name of ["toggle", "seen"]) root.addEventListener(name, tell);
  screen.overlay.changed.add(tell);
  screen.drawn.add(tell);
  return root;
}

/**
 * The picture as it is shown: its choices, what it shows, and its file.
 * @param {Viewer} screen
 */
function pictureOf(screen) {
  const { result } = screen;
  const text = h("p", { "data-role": "seen", role: "status" });
  const over = h("input", { type: "checkbox", checked: true });
  const width = number(1200, { min: 200, max: 4000, step: 1 });
  // vectors between the points, if they were measured
  const densePx = result.analysis.settings.dense_step_px;
  const dense = h("input", { type: "checkbox" });

  /** Whether only the page has the picture: the deformed image, lines over the colours, the surface in space. */
  const here = () => screen.state.mode !== "image" || screen.state.image !== "reference" || screen.overlay.on;

  /** @param {Asked | null} asked */
  function tell(asked) {
    const { info, scale } = screen;
    if (!asked || !info || screen.step === null) {
      text.textContent = "Choose a field with one number a point to save its picture or film.";
      return;
    }
    const unit = scale.unit ? ` ${scale.unit}` : "";
    const seen_ = dense.checked ? `its dense field, a vector every ${densePx} px, ${over.checked ? "over the reference image" : "without an image"}` : "";
    text.textContent =
      `${info.text}, ${result.stepText(screen.step)}${scale.flags ? "" : `; ${MAPS[scale.name]} from ${tick(Number(scale.low.toPrecision(4)))} to ${tick(Number(scale.high.toPrecision(4)))}${unit}${Number(scale.levels.value) > 1 ? `, ${asked.levels} levels` : ""}`}; ` +
      `axes of the ${result.frame === "system" ? "calibration" : "specimen"}; ${seen_ ? seen_ : here() ? `as it is seen, ${screen.state.mode === "surface" ? "in space" : screen.state.mode === "compare" ? "both views side by side" : "its lines and its image included"}; a film of it ${over.checked ? "is over the reference image" : "has no image"}` : over.checked ? "over the reference image" : "without an image"}.`;
  }

  /** Numbers of the picture, checked before anything is sent. */
  function size() {
    const v = Number(width.value);
    if (!Number.isInteger(v) || v < 200 || v > 4000) throw new Error("A picture is 200 to 4,000 px wide; give a whole number under Width.");
    return v;
  }

  /** @param {string} format */
  async function save(format) {
    const asked = seen(screen, over.checked);
    if (!asked || screen.step === null) throw new Error("Choose a field with one number a point: its picture can be saved.");
    const width_px = size();
    if (dense.checked) return direct(result, { ...asked, format, step: screen.step, width_px, dense: true });
    if (!here()) return direct(result, { ...asked, format, step: screen.step, width_px });
    const drawn = screen.picture(width_px);
    return saveAs(
      format === "svg" ? svgFile(drawn) : await pngOf(drawn, 1),
      `${result.testId}_${result.analysisId}_step${screen.step}_${asked.variables}_as_seen.${format}`,
    );
  }

  return { text, over, width, dense, densePx, tell, size, save };
}

/**
 * The map of the dense field: the service draws it.
 * @param {Viewer} screen
 * @param {ReturnType<typeof pictureOf>} picture
 */
function denseMapOf(screen, { text, dense }) {
  const picture = h("img", { alt: "" });
  const root = h("div.dense", { hidden: true, role: "status", "data-role": "dense-map" });
  /** @type {number | undefined} */
  let drawing;
  let last = "";
  /** Show it once its choice rests. @param {Asked | null} asked @param {boolean} open true: the panel is open */
  function show(asked, open) {
    root.hidden = !(asked && dense.checked);
    const wanted = { ...asked, format: "png", step: screen.step, width_px: 900, dense: true };
    const mine = root.hidden || !open ? "" : JSON.stringify(wanted);
    if (mine === last) return;
    last = mine;
    clearTimeout(drawing);
    if (!mine) return;
    drawing = setTimeout(async () => {
      try {
        const drawn = await (await api.raw(`${screen.result.path}/export`, wanted)).blob();
        if (mine !== last) return;
        URL.revokeObjectURL(picture.src);
        replace(root, Object.assign(picture, { src: URL.createObjectURL(drawn), alt: `Dense field: ${text.textContent}` }));
      } catch (error) {
        if (mine === last) replace(root, problemText(error));
      }
    }, 400);
  }
  return { root, show };
}

/**
 * The row that saves numbers.
 * @param {Viewer} screen
 * @param {HTMLElement} course
 * @param {number | null | undefined} densePx
 */
function numbers(screen, course, densePx) {
  const { result } = screen;
  const form = select(NUMBERS, "nc");
  const which = select(WHICH, "one");
  const fields = select(FIELDS, "all");
  const points = select(
    [
      ["field", "the points of the maps"],
      ["dense", `the dense field, a vector every ${densePx} px`],
    ],
    "field",
  );
  async function save() {
    const { factor } = screen.interval;
    /** @type {Asked} */
    const asked = { format: form.value, frame: result.frame, ...(points.value === "dense" ? { dense: true } : {}) };
    if (fields.value === "seen" && screen.info && form.value !== "nc") asked.variables = screen.info.name;
    if (factor !== 1 && form.value !== "nc") asked.coverage = 0.95;
    if (which.value === "one" && screen.step !== null) await direct(result, { ...asked, step: screen.step });
    else await slowly(result, course, asked);
  }

  const asStored = () => {
    const stored = form.value === "nc";
    fields.disabled = stored;
    fields.title = stored ? "NetCDF files hold all fields" : "";
  };
  form.addEventListener("change", asStored);
  asStored();
  return h(
    "div.row",
    field("Form", form),
    field("Steps", which),
    field("Fields", fields),
    densePx ? field("Points", points) : null,
    action("Save the file", save, { kind: "primary" }),
  );
}

/**
 * A file that the service makes at once.
 * @param {Result} result
 * @param {Asked} asked
 */
async function direct(result, asked) {
  const answer = await api.raw(`${result.path}/export`, asked);
  const named = /filename\*?=(?:UTF-8'')?"?([^";]+)"?/.exec(answer.headers.get("Content-Disposition") ?? "");
  const stale = answer.headers.get("X-Stale");
  saveAs(await answer.blob(), named ? decodeURIComponent(named[1]) : `${result.testId}_${result.analysisId}.${asked.format}`);
  if (stale) notify(`The file is saved, but out of date: ${stale}`, "warn");
}

/**
 * A file that takes a while: a job with its course, its file fetched at the end.
 * @param {Result} result
 * @param {HTMLElement} course
 * @param {Asked} asked
 */
async function slowly(result, course, asked) {
  const begun = await api.post(`${result.path}/exports`, undefined, /** @type {any} */ (asked));
  const { id } = begun.job;
  const bar = h("progress", { "aria-label": "Progress of the export" });
  const text = h("span");
  const stop = action("Cancel", () => api.post(`/jobs/${id}:cancel`), { kind: "danger" });
  replace(course, h("div.row", badge("exporting", "busy"), text, stop), bar);
  const job = await api.finished(id, {
    onprogress: (/** @type {Model<"JobReply">} */ now) => {
      const { phase, done, total } = now.progress ?? {};
      if (total) Object.assign(bar, { max: total, value: done ?? 0 });
      else bar.removeAttribute("value");
      text.textContent = ACTIVE.includes(now.state) ? `${PHASES[phase ?? ""] ?? phase ?? ""}${total ? ` ${done} of ${total}` : ""}` : "";
    },
  });
  if (job.state === "cancelled") return void replace(course, h("p.quiet", "The export was cancelled; nothing was saved."));
  if (job.state !== "succeeded") {
    course.replaceChildren();
    throw api.jobProblem(job);
  }
  const name = String(job.result?.file ?? "export");
  saveAs(api.address(`/jobs/${id}/file`), name);
  replace(course, h("p.quiet", "Saved as ", h("a", { href: api.address(`/jobs/${id}/file`), download: name }, name), "."));
}
