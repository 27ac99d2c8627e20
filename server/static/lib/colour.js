// Colour maps and scales: numbers to colours, the same for the map, the surface and the bar.

// every eighth entry of matplotlib's maps of these names (CC0; turbo: A. Mikhailov, Apache 2.0)
const VIRIDIS =
  "440154470d6048186a482374472d7b4537814240863e49893b528b375b8d33638d2f6b8e2c728e297a8e26828e23898e21918c1f978b1f9f8821a68527ad8131b57b3dbc744cc26c5cc8636ece5881d34d95d840aadc32c0df25d5e21aeae51afde725";
const CIVIDIS =
  "00224e00285b002e6a0533711a386f273e6e32436d3b496c434e6c4b546c535a6d5a5f6e61656f686a716f70737676767d7c788381798b8778928d789a9376a29975aaa073b3a670bbad6dc3b369ccba64d4c15fddc858e6d051efd748f8df3cfee838";

const TURBO =
  "30123b392a734040a24456c7466be34680f64294ff37a8fa28bceb1ccdd818ddc21fe9af32f2984ef97d6dfe628bff4ba4fc3cb9f635cdec34dfdf37eecf3af8be39fdac34fe962bfb7e21f46617eb500edf3f08d02f05be2102a91601920b017a0403";

/** @typedef {"viridis" | "cividis" | "turbo" | "diverging" | "grey"} MapName */

/** @param {string} hex */
const points = (hex) => (hex.match(/.{6}/g) ?? []).map((one) => [0, 2, 4].map((k) => parseInt(one.slice(k, k + 2), 16)));

/**
 * sRGB bytes of an OKLab colour (Ottosson 2020).
 * @param {number} lightness
 * @param {number} a
 * @param {number} b
 */
function okLab(lightness, a, b) {
  const [l, m, s] = [
    lightness + 0.3963377774 * a + 0.2158037573 * b,
    lightness - 0.1055613458 * a - 0.0638541728 * b,
    lightness - 0.0894841775 * a - 1.291485548 * b,
  ].map((v) => v ** 3);
  const linear = [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ];
  return linear.map((v) => 255 * Math.min(1, Math.max(0, v <= 0.0031308 ? 12.92 * v : 1.055 * Math.max(v, 0) ** (1 / 2.4) - 0.055)));
}

/** Blue over light grey to brown: lightness and chroma change evenly from the middle, distinguished with any colour vision. */
function diverging() {
  const made = [];
  for (let k = 0; k <= 32; k += 1) {
    const t = k / 16 - 1;
    const hue = ((t < 0 ? 258 : 45) * Math.PI) / 180;
    const size = Math.abs(t);
    made.push(okLab(0.95 - 0.55 * size, 0.135 * size * Math.cos(hue), 0.135 * size * Math.sin(hue)));
  }
  return made;
}

const grey = () => Array.from({ length: 33 }, (_, k) => okLab(0.12 + (0.86 * k) / 32, 0, 0));

/** @type {Record<MapName, number[][]>} */
const CONTROL = { viridis: points(VIRIDIS), cividis: points(CIVIDIS), turbo: points(TURBO), diverging: diverging(), grey: grey() };
export const MAPS = [
  ["auto", "Automatic"],
  ["viridis", "Viridis"],
  ["cividis", "Cividis"],
  ["turbo", "Turbo"],
  ["diverging", "Blue to brown"],
  ["grey", "Grey"],
];

/**
 * @param {MapName} name
 * @param {number} t
 */
function colourAt(name, t) {
  const control = CONTROL[name];
  const at = Math.min(Math.max(t, 0), 1) * (control.length - 1);
  const low = Math.min(Math.floor(at), control.length - 2);
  return control[low].map((v, k) => Math.round(v + (control[low + 1][k] - v) * (at - low)));
}

export const ENTRIES = 256;

/**
 * 256 colours as [r, g, b] bytes; with `levels` above 1 so many bands.
 * @param {MapName} name
 */
export function colours(name, levels = 0, reverse = false) {
  const out = new Uint8ClampedArray(3 * ENTRIES);
  for (let i = 0; i < ENTRIES; i += 1) {
    let t = i / (ENTRIES - 1);
    if (levels > 1) t = Math.min(Math.floor((i * levels) / ENTRIES), levels - 1) / (levels - 1);
    out.set(colourAt(name, reverse ? 1 - t : t), 3 * i);
  }
  return out;
}

/**
 * Index of a value's colour among the 256.
 * @param {number} value
 * @param {number} low
 * @param {number} high
 */
export function entry(value, low, high) {
  if (!(high > low)) return ENTRIES / 2;
  const i = Math.floor(((value - low) / (high - low)) * ENTRIES);
  return i < 0 ? 0 : i >= ENTRIES ? ENTRIES - 1 : i;
}

/**
 * Low and high percentile of the finite numbers; null if there are none.
 * @param {ArrayLike<number>} values
 * @param {number} low
 * @param {number} high
 * @returns {[number, number] | null}
 */
export function percentiles(values, low, high) {
  let finite = new Float64Array(values.length);
  let count = 0;
  for (let i = 0; i < values.length; i += 1) if (Number.isFinite(values[i])) finite[count++] = values[i];
  finite = finite.subarray(0, count).sort();
  if (!finite.length) return null;
  const at = (/** @type {number} */ share) => {
    const index = (share / 100) * (finite.length - 1);
    const k = Math.min(Math.floor(index), Math.max(finite.length - 2, 0));
    return finite.length === 1 ? finite[0] : finite[k] + (finite[k + 1] - finite[k]) * (index - k);
  };
  return [at(low), at(high)];
}

/**
 * The map that suits: about zero where both signs matter.
 * @param {number} low
 * @param {number} high
 * @returns {MapName}
 */
export function suited(low, high) {
  const [less, more] = [Math.min(-low, high), Math.max(Math.abs(low), Math.abs(high))];
  return low < 0 && high > 0 && less > 0.2 * more ? "diverging" : "viridis";
}

// a colour for each status: valid ones calm, each failure another
const STATUS = ["#7fb8a4", "#9aa3a8", "#4b5156", "#6a5acd", "#e0b100", "#d9480f", "#c2255c", "#1c7ed6", "#862e9c", "#000000", "#c0ca33"];
/** @param {number} value */
export const statusColour = (value) => STATUS[value] ?? "#ffffff";
/** @param {string} hex */
export function bytes(hex) {
  return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
}
