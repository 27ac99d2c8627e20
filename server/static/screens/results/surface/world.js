// The surface in WebGL: mesh, grid lines and box, their colours, light and camera.
import { ENTRIES } from "../../../lib/colour.js";

/** @import { Scale } from "../../../widgets/scale.js" */
/** @import { FieldMap } from "../../../widgets/field_map.js" */
/** @import { Shape } from "./shape.js" */
/** @typedef {ReturnType<typeof worldOf>} World */

/** Radians about the vertical and the horizontal. @type {Record<string, [number, number]>} */
const TURNS = { ArrowLeft: [0.12, 0], ArrowRight: [-0.12, 0], ArrowUp: [0, 0.12], ArrowDown: [0, -0.12] };
/** @type {Record<string, number>} */
const ZOOMS = { "+": 1 / 1.2, "=": 1 / 1.2, "-": 1.2 };

/** @type {Promise<[typeof import("../../../vendor/three/three.module.js"), typeof import("../../../vendor/three/OrbitControls.js")]> | null} */
let library = null;
export async function three() {
  library ??= Promise.all([import("../../../vendor/three/three.module.js"), import("../../../vendor/three/OrbitControls.js")]);
  const [THREE, { OrbitControls }] = await library;
  return { THREE, OrbitControls };
}

/**
 * An empty world; an error if the browser has no WebGL.
 * @param {Awaited<ReturnType<typeof three>>} libraries
 */
export function worldOf({ THREE, OrbitControls }) {
  const renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(30, 1, 0.01, 1e6);
  const controls = new OrbitControls(camera, renderer.domElement);
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
  return { THREE, renderer, scene, camera, controls, texture, mesh, wire, box };
}

/**
 * @param {World} world
 * @param {Shape} shape
 * @param {number[]} edges of its box
 */
export function lay({ THREE, mesh, wire, box }, { at, triangles, lines }, edges) {
  const attribute = new THREE.BufferAttribute(at, 3);
  for (const one of [mesh, wire, box]) {
    one.geometry.dispose();
    one.geometry = new THREE.BufferGeometry();
    one.geometry.setAttribute("position", one === box ? new THREE.Float32BufferAttribute(edges, 3) : attribute);
  }
  mesh.geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array((2 * at.length) / 3).fill(0.5), 2));
  mesh.geometry.setIndex(triangles);
  mesh.geometry.computeVertexNormals();
  wire.geometry.setIndex(lines);
}

/**
 * The field's colours on the points.
 * @param {World} world
 * @param {number[]} triangles
 * @param {FieldMap["now"]} now
 * @param {Scale} scale
 */
export function paint({ mesh, texture }, triangles, now, scale) {
  if (!now) return;
  const { values, grid, info } = now;
  const uv = mesh.geometry.attributes.uv;
  if (values.length !== grid.x.length || !uv || uv.count !== grid.x.length) return;
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

/**
 * View from the side of camera 1: X to the right, Y down, a little from above.
 * @param {World} world
 * @param {Shape} shape
 */
export function look({ THREE, camera, controls }, { span, origin, size }) {
  camera.up.set(0, -1, 0);
  controls.target.set(0, 0, 0);
  for (let k = 0; k < 3; k += 1) controls.target.setComponent(k, (span[k][0] + span[k][1]) / 2 - origin[k]);
  camera.position.copy(controls.target).add(new THREE.Vector3(-0.35, -0.62, -0.75).normalize().multiplyScalar(size * 1.75));
  camera.near = size / 100;
  camera.far = size * 100;
  camera.updateProjectionMatrix();
  controls.update();
}

/**
 * Rotate or zoom by a key; false if the key does neither.
 * @param {World} world
 * @param {string} key
 */
export function turn({ THREE, camera, controls }, key) {
  const off = camera.position.clone().sub(controls.target);
  if (TURNS[key]) {
    const upright = new THREE.Quaternion().setFromUnitVectors(camera.up, new THREE.Vector3(0, 1, 0));
    const polar = new THREE.Spherical().setFromVector3(off.clone().applyQuaternion(upright));
    polar.theta += TURNS[key][0];
    polar.phi = Math.min(Math.max(polar.phi - TURNS[key][1], 0.05), Math.PI - 0.05);
    off.setFromSpherical(polar).applyQuaternion(upright.invert());
  } else if (ZOOMS[key]) off.multiplyScalar(ZOOMS[key]);
  else return false;
  camera.position.copy(controls.target).add(off);
  controls.update();
  return true;
}

/**
 * Draw the world as large as its frame.
 * @param {World} world
 * @param {number} width
 * @param {number} height
 */
export function render({ THREE, renderer, scene, camera }, width, height) {
  const size = renderer.getSize(new THREE.Vector2());
  if (size.x !== width || size.y !== height) {
    renderer.setSize(width, height);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
  }
  renderer.render(scene, camera);
}

/**
 * Put the texts of the axes on their places in the picture.
 * @param {World} world
 * @param {HTMLElement} labels
 * @param {{ at: number[] }[]} ticks
 * @param {number} width
 * @param {number} height
 */
export function place({ THREE, camera }, labels, ticks, width, height) {
  const v = new THREE.Vector3();
  for (const [k, one] of ticks.entries()) {
    v.fromArray(one.at).project(camera);
    const span = /** @type {HTMLElement | undefined} */ (labels.children[k]);
    if (!span) return;
    span.style.transform = `translate(${((v.x + 1) / 2) * width}px, ${((1 - v.y) / 2) * height}px) translate(-50%, -50%)`;
    span.hidden = v.z > 1;
  }
}

/** Directions of X, Y and Z in the picture. @param {World} world */
export function axesSeen({ THREE, camera }) {
  const turned = new THREE.Quaternion().copy(camera.quaternion).invert();
  return [0, 1, 2].map((k) => {
    const a = new THREE.Vector3().setComponent(k, 1).applyQuaternion(turned);
    return [a.x, -a.y, a.z];
  });
}

/** @param {World} world */
export function dispose({ renderer, controls, texture, mesh, wire, box }) {
  controls.dispose();
  for (const one of [mesh, wire, box]) one.geometry.dispose();
  for (const one of [...mesh.material, wire.material, box.material]) one.dispose();
  texture.dispose();
  renderer.dispose();
  renderer.forceContextLoss();
}
