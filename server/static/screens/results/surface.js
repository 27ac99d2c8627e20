// The measured surface in space with the field on it: rotated by mouse, finger or keys; its displacement magnified.
import { h, replace, field, number, action, tick } from "../../lib/dom.js";
import { ENTRIES } from "../../lib/colour.js";
import { marks, round125 } from "../../lib/even.js";
import { trianglesOf } from "../../lib/isolines.js";
import { pngOf, saveAs } from "../../widgets/saving.js";
import { drawTriad3 } from "../../widgets/triad.js";
import { spaceOverlay } from "./surface_overlay.js";

/** @import { Viewer } from "../results.js" */
/** @import { Grid } from "../../lib/point_grid.js" */
/** @typedef {[number, number, number]} Triple */
/** @typedef {ArrayLike<number>[]} Each of three coordinates, a number a point */

/** @type {Promise<[typeof import("../../vendor/three/three.module.js"), typeof import("../../vendor/three/OrbitControls.js")]> | null} */
let library = null;
async function three() {
  library ??= Promise.all([import("../../vendor/three/three.module.js"), import("../../vendor/three/OrbitControls.js")]);
  const [THREE, { OrbitControls }] = await library;
  return { THREE, OrbitControls };
}

/** Radians about the vertical and the horizontal. @type {Record<string, [number, number]>} */
const TURNS = { ArrowLeft: [0.12, 0], ArrowRight: [-0.12, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] };

const MAX_TIMES = 1000;

/** @param {Viewer} screen */
export async function surface(screen) {
  const { THREE, OrbitControls } = await three();
  const { result, map, scale } = screen;
  const space = h("div.space", { tabindex: 0, role: "application", "aria-label": "Surface in space: arrow keys rotate, + and − zoom, 0 resets the view" });
  const labels = h("div.labels", { "aria-hidden": "true" });
  const magnification = number(null, { min: 0, max: MAX_TIMES, "data-role": "magnification" });
  const depth = number(1, { min: 0 });
  const grid = h("input", { type: "checkbox" });
  const note = h("span.quiet", { role: "status" });
  const reset = h("button", { type: "button", onclick: () => resetView() }, "Reset view");
  const wrong = h("small.problem", { role: "alert", hidden: true }, `Give a factor from 0 to ${MAX_TIMES}.`);
  const trueScale = h("button", { type: "button", title: "Displacements as large as they are", onclick: () => { magnification.value = "1"; depth.value = "1"; again(); } }, "True scale");
  const usualScale = h("button", { type: "button", title: "Displacements as large as can be seen well", onclick: () => { magnification.value = ""; again(); } }, "Usual");
  const root = h("div.panel", { "data-role": "surface" },
    h("div.row", field("Displacement ×", magnification), trueScale, usualScale, field("Depth ×", depth), h("label.check", grid, "grid lines"), reset, action("Save picture", save)),
    h("p.row.surface-note", note, wrong), space);

  /** @type {import("three").WebGLRenderer} */
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  } catch {
    replace(space, h("p", "This browser cannot draw in space (no WebGL). The map over the image shows the same field."));
    return { root, close: () => {}, update: async () => {} };
  }
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  space.append(renderer.domElement, labels);
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(30, 1, 0.01, 1e6);
  const controls = new OrbitControls(camera, renderer.domElement);
  controls.addEventListener("change", () => draw());
  scene.add(new THREE.AmbientLight(0xffffff, 1.6));
  const lamp = new THREE.DirectionalLight(0xffffff, 1.6);
  scene.add(camera);
  camera.add(lamp);
  lamp.position.set(-0.6, 0.8, 0.6);
  const texture = new THREE.DataTexture(new Uint8Array(4 * ENTRIES), ENTRIES, 1, THREE.RGBAFormat);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.minFilter = THREE.NearestFilter;
  texture.magFilter = THREE.NearestFilter;
  const material = new THREE.MeshLambertMaterial({ map: texture, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
  const plain = new THREE.MeshLambertMaterial({ color: 0x9aa3a8, side: THREE.DoubleSide }); // measured, but without a value of this field
  const mesh = new THREE.Mesh(new THREE.BufferGeometry(), [material, plain]);
  const wire = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0x000000, transparent: true, opacity: 0.35 }));
  const box = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0x808a90 }));
  scene.add(mesh, wire, box);
  const over = spaceOverlay(THREE, scene, space);
  screen.overlay.changed.add(update);

  /** @type {{ n: number, grid: Grid, position: Each, motion: Each | null } | null} */
  let held = null;
  /** @type {{ span: [number, number][], origin: number[], size: number, times: number, deep: number } | null} */
  let bounds = null;
  let shownAt = new Float32Array();
  /** @type {{ at: number[], text: string }[]} */
  let ticks = [];
  /** @type {number[]} */
  let triangles = [];
  let asked = 0;

  /** @param {{ n: number, grid: Grid }} of */
  async function read({ n, grid }) {
    const { all } = await result.fields(n);
    const of = (/** @type {string[]} */ names) => Promise.all(names.map((name) => result.array(n, name).then((one) => one.data)));
    const [position, motion] = await Promise.all([of(["x_mm", "y_mm", "z_mm"]), all.has("u_mm") ? of(["u_mm", "v_mm", "w_mm"]) : null]);
    return { n, grid, position, motion };
  }

  const factor = (/** @type {HTMLInputElement} */ input, /** @type {number} */ usual) => (input.value === "" || !Number.isFinite(Number(input.value)) ? usual : Number(input.value));

  /** Triangles over cells whose corners all have a position: never over a missing point or a cut. */
  function build() {
    if (!held) return false;
    const { grid: g, position, motion } = held;
    const count = g.x.length;
    let largest = 0;
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < count; i += 1) {
      if (!g.valid[i]) continue;
      for (let k = 0; k < 3; k += 1) {
        if (position[k][i] < low[k]) low[k] = position[k][i];
        if (position[k][i] > high[k]) high[k] = position[k][i];
      }
      if (motion) largest = Math.max(largest, Math.hypot(motion[0][i], motion[1][i], motion[2][i]));
    }
    if (!(high[0] >= low[0])) return false;
    const size = Math.hypot(...[0, 1, 2].map((k) => high[k] - low[k])) || 1;
    const usual = largest > 0 ? Math.min(Math.max(round125((0.12 * size) / largest), 1), MAX_TIMES) : 1;
    magnification.placeholder = String(usual);
    magnification.disabled = !motion;
    const asked_ = factor(magnification, usual);
    wrong.hidden = asked_ >= 0 && asked_ <= MAX_TIMES;
    const times = motion ? Math.min(Math.max(asked_, 0), MAX_TIMES) : 0;
    const deep = factor(depth, 1);
    const middle = (low[2] + high[2]) / 2;
    const at = new Float32Array(3 * count);
    const uv = new Float32Array(2 * count).fill(0.5);
    /** @type {[number, number][]} */
    const span = [[Infinity, -Infinity], [Infinity, -Infinity], [Infinity, -Infinity]];
    const origin = [0, 1, 2].map((k) => (low[k] + high[k]) / 2);
    for (let i = 0; i < count; i += 1) {
      if (!g.valid[i]) continue;
      for (let k = 0; k < 3; k += 1) {
        let v = position[k][i];
        if (k === 2) v = middle + deep * (v - middle);
        if (motion) v += times * motion[k][i];
        if (Number.isFinite(v)) { span[k][0] = Math.min(span[k][0], v); span[k][1] = Math.max(span[k][1], v); }
        at[3 * i + k] = v - origin[k];
      }
    }
    /** @type {number[]} */
    const lines = [];
    const whole = (/** @type {number} */ i) => g.valid[i] && Number.isFinite(at[3 * i]) && (!motion || Number.isFinite(motion[0][i]));
    triangles = trianglesOf(g, whole, (cell, [p, q, s], good) => {
      if (good[0] && good[1] && !g.parted(cell, p, q)) lines.push(p, q);
      if (good[0] && good[2] && !g.parted(cell, p, s)) lines.push(p, s);
    });
    const attribute = new THREE.BufferAttribute(at, 3);
    mesh.geometry.dispose();
    mesh.geometry = new THREE.BufferGeometry();
    mesh.geometry.setAttribute("position", attribute);
    mesh.geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
    mesh.geometry.setIndex(triangles);
    mesh.geometry.computeVertexNormals();
    wire.geometry.dispose();
    wire.geometry = new THREE.BufferGeometry();
    wire.geometry.setAttribute("position", attribute);
    wire.geometry.setIndex(lines);
    wire.visible = grid.checked;
    // a flat surface needs a box of some depth
    for (const one of span) if (one[1] - one[0] < 0.02 * size) { const m = (one[0] + one[1]) / 2; one[0] = m - 0.01 * size; one[1] = m + 0.01 * size; }
    bounds = { span, origin, size, times, deep };
    shownAt = at;
    axes(bounds);
    space.dataset.triangles = String(triangles.length / 3);
    space.dataset.magnification = String(times);
    note.textContent = `${motion ? `displacement × ${tick(times)}${times === 1 ? " (as it is)" : ""}` : "shape; this step has no displacement"}${deep === 1 ? "" : `, depth × ${tick(deep)}`}; axes in mm`;
    return true;
  }

  /** @param {NonNullable<typeof bounds>} bounds */
  function axes({ span, origin, size, times, deep }) {
    /** @type {number[]} */
    const v = [];
    const corner = (/** @type {number} */ i, /** @type {number} */ j, /** @type {number} */ k) => [span[0][i] - origin[0], span[1][j] - origin[1], span[2][k] - origin[2]];
    const edge = (/** @type {number[]} */ a, /** @type {number[]} */ b) => v.push(...a, ...b);
    for (const j of [0, 1]) for (const k of [0, 1]) {
      edge(corner(0, j, k), corner(1, j, k));
      edge(corner(j, 0, k), corner(j, 1, k));
      edge(corner(j, k, 0), corner(j, k, 1));
    }
    ticks = [];
    const long = 0.015 * size;
    /** @type {(axis: number, value: number, from: number[], out: Triple) => number[]} */
    const put = (axis, value, from, out) => {
      const a = [...from];
      a[axis] = value - origin[axis];
      const b = a.map((x, k) => x + out[k] * long);
      edge(a, b);
      return a.map((x, k) => x + 3 * out[k] * long);
    };
    const maxMarks = (/** @type {number} */ axis) => Math.max(2, Math.min(5, Math.round((6 * (span[axis][1] - span[axis][0])) / size)));
    // X along the lower edge of the picture, Y along the left one, Z along the far left corner; Y_sys points down in it
    for (const value of marks(...span[0], maxMarks(0))) ticks.push({ at: put(0, value, corner(0, 1, 0), [0, 1, 0]), text: tick(value) });
    for (const value of marks(...span[1], maxMarks(1))) ticks.push({ at: put(1, value, corner(0, 0, 0), [-1, 0, 0]), text: tick(value) });
    for (const value of times > 1 || deep !== 1 ? [] : marks(...span[2], maxMarks(2))) ticks.push({ at: put(2, value, corner(1, 1, 0), [1, 0, 0]), text: tick(value) });
    /** @type {(axis: number, from: number[], out: Triple) => number[]} */
    const mid = (axis, from, out) => { const a = [...from]; a[axis] = (span[axis][0] + span[axis][1]) / 2 - origin[axis]; return a.map((x, k) => x + 7 * out[k] * long); };
    ticks.push({ at: mid(0, corner(0, 1, 0), [0, 1, 0]), text: "X (mm)" }, { at: mid(1, corner(0, 0, 0), [-1, 0, 0]), text: "Y (mm)" },
      { at: mid(2, corner(1, 1, 0), [0.6, 0, 0]), text: times > 1 || deep !== 1 ? "Z (magnified)" : "Z (mm)" });
    replace(labels, ticks.map((one) => h("span", one.text)));
    box.geometry.dispose();
    box.geometry = new THREE.BufferGeometry();
    box.geometry.setAttribute("position", new THREE.Float32BufferAttribute(v, 3));
  }

  /** The field's colours on the points. */
  function paint() {
    if (!map.now) return;
    const { values, grid: g, info } = map.now;
    if (values.length !== g.x.length || !mesh.geometry.attributes.uv || mesh.geometry.attributes.uv.count !== g.x.length) return;
    const uv = mesh.geometry.attributes.uv;
    const flags = Boolean(info.flags);
    for (let i = 0; i < values.length; i += 1) {
      const share = flags ? (values[i] + 0.5) / ENTRIES : (values[i] - scale.low) / (scale.high - scale.low);
      uv.array[2 * i] = Number.isFinite(share) ? Math.min(Math.max(share, 0.5 / ENTRIES), 1 - 0.5 / ENTRIES) : 0.5;
    }
    uv.needsUpdate = true;
    /** @type {number[]} */
    const coloured = [];
    /** @type {number[]} */
    const others = [];
    for (let k = 0; k < triangles.length; k += 3) {
      const three_ = [triangles[k], triangles[k + 1], triangles[k + 2]];
      const each = three_.map((i) => values[i]);
      const complete = each.every(Number.isFinite) && (!flags || (each[0] === each[1] && each[1] === each[2]));
      (complete ? coloured : others).push(...three_);
    }
    mesh.geometry.setIndex(coloured.concat(others));
    mesh.geometry.clearGroups();
    mesh.geometry.addGroup(0, coloured.length, 0);
    mesh.geometry.addGroup(coloured.length, others.length, 1);
    const data = /** @type {Uint8Array} */ (texture.image.data);
    for (let i = 0; i < ENTRIES; i += 1) {
      const rgb = flags ? scale.colour(i) : [scale.rgb[3 * i], scale.rgb[3 * i + 1], scale.rgb[3 * i + 2]];
      data.set([...rgb, 255], 4 * i);
    }
    texture.needsUpdate = true;
  }

  /** View from the side of camera 1: X to the right, Y down, a little from above. */
  function resetView() {
    if (!bounds) return;
    const far = bounds.size * 1.75;
    camera.up.set(0, -1, 0);
    controls.target.set(0, 0, 0);
    for (let k = 0; k < 3; k += 1) controls.target.setComponent(k, (bounds.span[k][0] + bounds.span[k][1]) / 2 - bounds.origin[k]);
    camera.position.copy(controls.target).add(new THREE.Vector3(-0.35, -0.62, -0.75).normalize().multiplyScalar(far));
    camera.near = bounds.size / 100;
    camera.far = bounds.size * 100;
    camera.updateProjectionMatrix();
    controls.update();
    draw();
  }

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const width = space.clientWidth;
      const height = space.clientHeight;
      if (!width || !height) return;
      const size = renderer.getSize(new THREE.Vector2());
      if (size.x !== width || size.y !== height) {
        renderer.setSize(width, height);
        camera.aspect = width / height;
        camera.updateProjectionMatrix();
      }
      renderer.render(scene, camera);
      const v = new THREE.Vector3();
      ticks.forEach((one, k) => {
        v.fromArray(one.at).project(camera);
        const span = /** @type {HTMLElement | undefined} */ (labels.children[k]);
        if (!span) return;
        span.style.transform = `translate(${((v.x + 1) / 2) * width}px, ${((1 - v.y) / 2) * height}px) translate(-50%, -50%)`;
        span.hidden = v.z > 1;
      });
      over.place(height / (2 * Math.tan((camera.fov * Math.PI) / 360) * camera.position.distanceTo(controls.target)));
      const turned = new THREE.Quaternion().copy(camera.quaternion).invert();
      drawTriad3(space, [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map(([x, y, z]) => { const a = new THREE.Vector3(x, y, z).applyQuaternion(turned); return [a.x, -a.y, a.z]; }),
        result.frame === "specimen" ? "the specimen's" : "the calibration's");
      space.dataset.drawn = `${map.now?.n} ${map.now?.info.key}`;
    });
  }

  /** What is in the frame, for a picture that is made at once: WebGL's canvas forgets what was drawn. */
  function seen() {
    renderer.render(scene, camera);
    return [{ frame: space, title: note.textContent ?? "" }];
  }

  async function save() {
    if (map.now) saveAs(await pngOf(screen.picture(1200)), `${result.testId}_${result.analysisId}_step${map.now.n}_surface.png`);
  }

  async function update() {
    asked += 1;
    const mine = asked;
    if (!map.now) return;
    const fresh = !held || held.n !== map.now.n;
    if (fresh) {
      const got = await read(map.now);
      if (mine !== asked) return;
      const first = !bounds;
      held = got;
      if (!build()) {
        note.textContent = "No point of this step is valid.";
        return;
      }
      paint();
      if (first) resetView();
    } else paint();
    await lines(mine);
    draw();
  }

  /** Contour lines and vectors on the surface as it is shown. @param {number} mine */
  async function lines(mine = asked) {
    const vectors = await screen.overlay.vectors();
    if (mine !== asked || !held || !map.now || !bounds) return;
    const { values, grid: g } = map.now;
    over.contours(shownAt, triangles, values, screen.overlay.levels()?.levels ?? []);
    over.arrows(shownAt, vectors, vectors ? (vectors.every * bounds.size) / Math.hypot(g.rows, g.cols) : 0);
  }

  const again = () => { if (held && build()) { paint(); lines().then(draw); } };
  for (const input of [magnification, depth]) input.addEventListener("change", again);
  grid.addEventListener("change", () => { wire.visible = grid.checked; draw(); });
  space.addEventListener("keydown", (event) => {
    const turn = TURNS[event.key];
    const off = camera.position.clone().sub(controls.target);
    if (turn) {
      const polar = new THREE.Spherical().setFromVector3(off.clone().applyQuaternion(new THREE.Quaternion().setFromUnitVectors(camera.up, new THREE.Vector3(0, 1, 0))));
      polar.theta += turn[0];
      polar.phi = Math.min(Math.max(polar.phi - turn[1], 0.05), Math.PI - 0.05);
      off.setFromSpherical(polar).applyQuaternion(new THREE.Quaternion().setFromUnitVectors(camera.up, new THREE.Vector3(0, 1, 0)).invert());
    } else if (event.key === "+" || event.key === "=") off.multiplyScalar(1 / 1.2);
    else if (event.key === "-") off.multiplyScalar(1.2);
    else if (event.key === "0") { resetView(); event.preventDefault(); return; }
    else return;
    event.preventDefault();
    camera.position.copy(controls.target).add(off);
    controls.update();
    draw();
  });
  const observer = new ResizeObserver(() => draw());
  observer.observe(space);
  const close = () => {
    asked += 1;
    screen.overlay.changed.delete(update);
    over.close();
    observer.disconnect();
    controls.dispose();
    for (const one of [mesh, wire, box]) one.geometry.dispose();
    for (const one of [material, plain, wire.material, box.material]) one.dispose();
    texture.dispose();
    renderer.dispose();
    renderer.forceContextLoss();
  };
  return { root, update, close, seen, about: "the surface in space" };
}
