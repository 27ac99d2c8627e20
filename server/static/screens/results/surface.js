// The measured surface in space with the field on it: rotated by mouse, finger or keys; its displacement magnified.
import { h, replace, field, number, action, tick } from "../../lib/dom.js";
import { pngOf, saveAs } from "../../widgets/saving.js";
import { drawTriad3 } from "../../widgets/triad.js";
import { spaceOverlay } from "./surface/overlay.js";
import { MAX_TIMES, axesOf, extentOf, shapeOf } from "./surface/shape.js";
import { axesSeen, dispose, lay, look, paint, place, render, three, turn, worldOf } from "./surface/world.js";

/** @import { Viewer } from "../results.js" */
/** @import { Result } from "./analysis.js" */
/** @import { Grid } from "../../lib/point_grid.js" */
/** @import { Measured, Shape } from "./surface/shape.js" */
/** @import { World } from "./surface/world.js" */

/**
 * What the surface is asked for, and its frame.
 * @param {Viewer} screen
 */
function controlsOf(screen) {
  const { result, map } = screen;
  const space = h("div.space", { tabindex: 0, role: "application", "aria-label": "Surface in space: arrow keys rotate, + and − zoom, 0 resets the view" });
  const magnification = number(null, { min: 0, max: MAX_TIMES, "data-role": "magnification" });
  const depth = number(1, { min: 0 });
  const grid = h("input", { type: "checkbox" });
  const note = h("span.quiet", { role: "status" });
  const reset = h("button", { type: "button" }, "Reset view");
  const wrong = h("small.problem", { role: "alert", hidden: true }, `Give a factor from 0 to ${MAX_TIMES}.`);
  const trueScale = h("button", { type: "button", title: "Displacements as large as they are" }, "True scale");
  const usualScale = h("button", { type: "button", title: "Displacements as large as can be seen well" }, "Usual");
  const save = action("Save picture", async () => {
    if (map.now) saveAs(await pngOf(screen.picture(1200)), `${result.testId}_${result.analysisId}_step${map.now.n}_surface.png`);
  });
  const root = h(
    "div.panel",
    { "data-role": "surface" },
    h("div.row", field("Displacement ×", magnification), trueScale, usualScale, field("Depth ×", depth), h("label.check", grid, "grid lines"), reset, save),
    h("p.row.surface-note", note, wrong),
    space,
  );
  return { root, space, magnification, depth, grid, note, wrong, reset, trueScale, usualScale };
}

const factor = (/** @type {HTMLInputElement} */ input, /** @type {number} */ usual) =>
  input.value === "" || !Number.isFinite(Number(input.value)) ? usual : Number(input.value);

/**
 * The shape as the controls ask for it; null if no point is valid.
 * @param {ReturnType<typeof controlsOf>} controls
 * @param {Measured} measured
 */
function asked(controls, measured) {
  const extent = extentOf(measured);
  if (!extent) return null;
  const { motion } = measured;
  controls.magnification.placeholder = String(extent.usual);
  controls.magnification.disabled = !motion;
  const wanted = factor(controls.magnification, extent.usual);
  controls.wrong.hidden = wanted >= 0 && wanted <= MAX_TIMES;
  const times = motion ? Math.min(Math.max(wanted, 0), MAX_TIMES) : 0;
  const deep = factor(controls.depth, 1);
  const shape = shapeOf(measured, extent, times, deep);
  controls.space.dataset.triangles = String(shape.triangles.length / 3);
  controls.space.dataset.magnification = String(times);
  const moved = motion ? `displacement × ${tick(times)}${times === 1 ? " (as it is)" : ""}` : "shape; this step has no displacement";
  controls.note.textContent = `${moved}${deep === 1 ? "" : `, depth × ${tick(deep)}`}; axes in mm`;
  return shape;
}

/**
 * A step's points in space.
 * @param {Result} result
 * @param {{ n: number, grid: Grid }} of
 * @returns {Promise<Measured>}
 */
async function read(result, { n, grid }) {
  const { all } = await result.fields(n);
  const of = (/** @type {string[]} */ names) => Promise.all(names.map((name) => result.array(n, name).then((one) => one.data)));
  const [position, motion] = await Promise.all([of(["x_mm", "y_mm", "z_mm"]), all.has("u_mm") ? of(["u_mm", "v_mm", "w_mm"]) : null]);
  return { n, grid, position, motion };
}

/** @param {Viewer} screen */
export async function surface(screen) {
  const libraries = await three();
  const { result, map, scale } = screen;
  const controls = controlsOf(screen);
  const { root, space, note, grid } = controls;
  /** @type {World} */
  let world;
  try {
    world = worldOf(libraries);
  } catch {
    replace(space, h("p", "This browser cannot draw in space (no WebGL). The map over the image shows the same field."));
    return { root, close: () => {}, update: async () => {} };
  }
  const labels = h("div.labels", { "aria-hidden": "true" });
  space.append(world.renderer.domElement, labels);
  const over = spaceOverlay(world.THREE, world.scene, space);
  screen.overlay.changed.add(update);

  /** @type {Measured | null} */
  let held = null;
  /** @type {Shape | null} */
  let shape = null;
  /** @type {ReturnType<typeof axesOf>["ticks"]} */
  let ticks = [];
  let round = 0;

  function build() {
    const made = held && asked(controls, held);
    if (!made) return false;
    shape = made;
    const axes = axesOf(made);
    ticks = axes.ticks;
    lay(world, made, axes.edges);
    world.wire.visible = grid.checked;
    replace(
      labels,
      ticks.map((one) => h("span", one.text)),
    );
    return true;
  }

  function resetView() {
    if (!shape) return;
    look(world, shape);
    draw();
  }

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const [width, height] = [space.clientWidth, space.clientHeight];
      if (!width || !height) return;
      render(world, width, height);
      place(world, labels, ticks, width, height);
      over.place(height / (2 * Math.tan((world.camera.fov * Math.PI) / 360) * world.camera.position.distanceTo(world.controls.target)));
      drawTriad3(space, axesSeen(world), result.frame === "specimen" ? "the specimen's" : "the calibration's");
      space.dataset.drawn = `${map.now?.n} ${map.now?.info.key}`;
    });
  }

  /** Content of the frame, for a picture that is made at once: WebGL's canvas does not keep its drawing. */
  function seen() {
    world.renderer.render(world.scene, world.camera);
    return [{ frame: space, title: note.textContent ?? "" }];
  }

  async function update() {
    round += 1;
    const mine = round;
    if (!map.now) return;
    const fresh = !held || held.n !== map.now.n;
    const first = !shape;
    if (fresh) {
      const got = await read(result, map.now);
      if (mine !== round) return;
      held = got;
      if (!build()) {
        note.textContent = "No point of this step is valid.";
        return;
      }
    }
    colour();
    if (fresh && first) resetView();
    await lines(mine);
    draw();
  }

  const colour = () => paint(world, shape?.triangles ?? [], map.now, scale);

  /** Contour lines and vectors on the surface as it is shown. @param {number} mine */
  async function lines(mine = round) {
    const vectors = await screen.overlay.vectors();
    if (mine !== round || !held || !map.now || !shape) return;
    const { values, grid: g } = map.now;
    over.contours(shape.at, shape.triangles, values, screen.overlay.levels()?.levels ?? []);
    over.arrows(shape.at, vectors, vectors ? (vectors.every * shape.size) / Math.hypot(g.rows, g.cols) : 0);
  }

  const again = () => {
    if (!build()) return;
    colour();
    lines().then(draw);
  };
  listen(controls, world, { again, resetView, draw });
  const observer = new ResizeObserver(draw);
  observer.observe(space);
  const close = () => {
    round += 1;
    screen.overlay.changed.delete(update);
    over.close();
    observer.disconnect();
    dispose(world);
  };
  return { root, update, close, seen, about: "the surface in space" };
}

/**
 * @param {ReturnType<typeof controlsOf>} controls
 * @param {World} world
 * @param {{ again: () => void, resetView: () => void, draw: () => void }} to `again`: other magnifications are asked for
 */
function listen({ space, reset, trueScale, usualScale, magnification, depth, grid }, world, { again, resetView, draw }) {
  world.controls.addEventListener("change", draw);
  reset.addEventListener("click", resetView);
  trueScale.addEventListener("click", () => {
    magnification.value = "1";
    depth.value = "1";
    again();
  });
  usualScale.addEventListener("click", () => {
    magnification.value = "";
    again();
  });
  for (const input of [magnification, depth]) input.addEventListener("change", again);
  grid.addEventListener("change", () => {
    world.wire.visible = grid.checked;
    draw();
  });
  space.addEventListener("keydown", (event) => {
    if (event.key === "0") resetView();
    else if (turn(world, event.key)) draw();
    else return;
    event.preventDefault();
  });
}
