// The views of a calibration with the lines and intersections found in them, and residual arrows.
import * as api from "../../lib/api.js";
import { View, stroke } from "../../widgets/view.js";
import { cell, saveButtons } from "../../widgets/saving.js";
import { seenPicture } from "../../widgets/seen_picture.js";
import { h, replace, svg, field, select, num, quantity } from "../../lib/dom.js";

const COLOUR = { lines: "#33c6ff", node: "#ffd23e", arrow: "#ff4d3d" };
const MAX_ARROW = 0.15; // of the picture's width
/** @import { Model, TakenView } from "#routes" */
/** @typedef {readonly (number | null)[]} Spot */
/** @typedef {{ name: string, found_px: Spot[][], residual_px?: Spot[][] | null, rbe_px?: number | null, raz_mm?: number | null }} Found lines' intersections of a view, with residuals */

/** @type {Record<string, string>} */
const ROLE = { fitted: "fitted", held_out: "held out", zero: "zero", zero_again: "zero, again" };

/** @param {TakenView} view */
const fileOf = (view) => view.file.split("/").pop() ?? "";

/**
 * Both cameras' views of one position side by side; {root, close}, or null if none were taken.
 * @param {Model<"CalibrationReply">} calibration
 * @param {Found[] | null} residuals
 */
export function calibrationViews(calibration, residuals) {
  const taken = calibration.taken ?? [];
  if (!taken.length) return null;
  const indices = [...new Set(taken.map((view) => view.index))].sort((a, b) => a - b);
  const at = (/** @type {number} */ index, /** @type {string} */ cam) => taken.find((view) => view.index === index && view.camera === cam);
  const text = (/** @type {number} */ index) => {
    const view = /** @type {TakenView} */ (at(index, "cam1") ?? at(index, "cam2"));
    return `${quantity(view.dz_commanded_mm ?? view.dz_mm, "mm", 4)} · ${ROLE[view.role] ?? view.role}`;
  };
  const position = select(
    indices.map((index) => [index, text(index)]),
    indices[0],
  );
  const magnification = h("input", {
    type: "range",
    min: 0,
    max: 4,
    step: 0.05,
    value: Math.log10(exaggeration(residuals, calibration.image_size_px?.cam1?.[0] ?? 640)).toFixed(2),
  });
  const timesText = h("output");
  const lines = h("input", { type: "checkbox", checked: true });
  const arrows = h("input", { type: "checkbox", checked: true });
  const views = ["cam1", "cam2"].map((cam) => {
    const view = new View({ label: `Calibration view of ${cam}` });
    const caption = h("p.quiet", { style: { margin: "0.25rem 0 0" } });
    view.image.addEventListener("error", () => view.image.getAttribute("src") && view.blank("This view cannot be read."));
    return { cam, view, caption, layer: svg("g", { "data-role": "found" }), root: h("div", h("h3", cam), view.root, caption) };
  });
  for (const one of views) one.view.svg.append(one.layer);

  function draw() {
    const times = 10 ** Number(magnification.value);
    timesText.textContent = `${num(times, 3)} ×`;
    for (const { cam, view, caption, layer } of views) {
      const index = Number(position.value);
      const taken_ = at(index, cam);
      const name = taken_ && fileOf(taken_);
      // the repeated view at zero is compared, not fitted: it has no residuals
      const found = residuals?.find((one) => one.name === name);
      caption.textContent = taken_
        ? `${ROLE[taken_.role] ?? taken_.role}, dZ ${quantity(taken_.dz_mm, "mm", 6)} as read back, ${taken_.frames} frames averaged${found ? `; RBE ${quantity(found.rbe_px, "px", 3)}, RAZ ${quantity(found.raz_mm && 1000 * found.raz_mm, "µm", 3)}` : ""}`
        : "no view";
      replace(layer, ...(found ? drawing(found, times, lines.checked, arrows.checked) : []));
      view.content.append(view.svg);
    }
  }

  function load() {
    for (const { cam, view } of views) view.show(api.address(`/calibrations/${calibration.id}/views/${position.value}/${cam}/preview`));
    draw();
  }
  position.addEventListener("change", load);
  for (const input of [magnification, lines, arrows]) input.addEventListener("input", draw);
  load();
  const shownText = () => text(Number(position.value));
  const files = saveButtons("Save these views", () => `${calibration.id} views ${shownText()}`, {
    csv: residuals
      ? () =>
          residualTable(
            taken.filter((view) => view.index === Number(position.value)),
            residuals,
          )
      : undefined,
    svg: () =>
      seenPicture(
        views.map(({ cam, view }) => ({ frame: view.frame, within: view.image, title: cam })),
        {
          title: `Calibration ${calibration.id}, ${shownText()}`,
          width: 1600,
          notes: [
            ...views.map(({ cam, caption }) => `${cam}: ${caption.textContent}`),
            ...(residuals && arrows.checked ? [`residual arrows ${timesText.textContent}`] : []),
          ],
        },
      ),
  });
  const root = h(
    "div",
    h(
      "div.fields",
      field("Position", position),
      residuals
        ? [
            field("Magnification of arrows", h("span.control", Object.assign(magnification, { id: "magnification" }), timesText)),
            h("label.check", { style: { alignSelf: "center" } }, lines, "lines and intersections"),
            h("label.check", { style: { alignSelf: "center" } }, arrows, "residual arrows"),
          ]
        : null,
    ),
    h(
      "div.grid.two.views",
      views.map((one) => one.root),
    ),
    files,
  );
  magnification.setAttribute("aria-label", "Magnification of the residual arrows");
  return { root, close: () => views.forEach((one) => one.view.close()) };
}

/**
 * Initial magnification of the arrows: 1000, or less if the longest would leave the picture.
 * @param {Found[] | null} residuals
 * @param {number} width
 */
function exaggeration(residuals, width) {
  let largest = 1e-9;
  for (const view of residuals ?? []) for (const r of view.residual_px?.flat() ?? []) if (isFound(r)) largest = Math.max(largest, Math.hypot(...r));
  return Math.min(1000, Math.max(1, (MAX_ARROW * width) / largest));
}

/**
 * Return true if a point was found.
 * @param {Spot | undefined} xy
 * @returns {xy is [number, number]}
 */
const isFound = (xy) => xy !== undefined && xy[0] !== null && xy[1] !== null && Number.isFinite(xy[0]);

/**
 * @param {Found} view
 * @param {number} times
 * @param {boolean} lines
 * @param {boolean} arrows
 */
function drawing({ found_px: found, residual_px: residual }, times, lines, arrows) {
  const parts = [];
  if (lines) {
    /** @type {string[]} */
    const path = [];
    const course = (/** @type {Spot[]} */ points) => {
      let open = false;
      for (const xy of points) {
        if (isFound(xy)) {
          path.push(`${open ? "L" : "M"}${xy[0]} ${xy[1]}`);
          open = true;
        } else open = false;
      }
    };
    found.forEach(course);
    found[0]?.forEach((_, k) => course(found.map((row) => row[k])));
    parts.push(svg("path", { ...stroke(COLOUR.lines, 1), d: path.join(""), "data-role": "lines" }));
    // a line of no length is a dot that keeps its size on the screen at any zoom
    parts.push(
      svg("path", {
        ...stroke(COLOUR.node, 5),
        "stroke-linecap": "round",
        "data-role": "nodes",
        d: found
          .flat()
          .filter(isFound)
          .map(([x, y]) => `M${x} ${y}h0.001`)
          .join(""),
      }),
    );
  }
  if (arrows && residual) {
    /** @type {string[]} */
    const path = [];
    found.forEach((row, i) =>
      row.forEach((xy, k) => {
        const r = residual[i]?.[k];
        if (!isFound(xy) || !isFound(r)) return;
        const [dx, dy] = [r[0] * times, r[1] * times];
        const head = 0.25;
        path.push(
          `M${xy[0]} ${xy[1]}l${dx} ${dy}`,
          `m${-head * (dx - 0.5 * dy)} ${-head * (dy + 0.5 * dx)}L${xy[0] + dx} ${xy[1] + dy}l${-head * (dx + 0.5 * dy)} ${-head * (dy - 0.5 * dx)}`,
        );
      }),
    );
    parts.push(svg("path", { ...stroke(COLOUR.arrow, 1.5), d: path.join(""), "data-role": "arrows" }));
  }
  return parts;
}

/**
 * Found intersections and residuals of the views of a position; nothing for one that was not found.
 * @param {readonly TakenView[]} taken
 * @param {readonly Found[]} residuals
 */
function residualTable(taken, residuals) {
  const lines = ["camera,view,row,column,x (px),y (px),residual x (px),residual y (px)"];
  for (const view of taken) {
    const found = residuals.find((one) => one.name === fileOf(view));
    found?.found_px.forEach((row, i) =>
      row.forEach((xy, k) => {
        const numbers = [...xy, ...(found.residual_px?.[i]?.[k] ?? [null, null])].map((v) => (v === null || !Number.isFinite(v) ? "" : String(v)));
        lines.push([view.camera, cell(found.name), i, k, ...numbers].join(","));
      }),
    );
  }
  return `${lines.join("\n")}\n`;
}
