// Units and digits of the numbers that are shown: µm below 0.1 mm, strain in µm/m, or % from 1 % on, digits by the standard uncertainty.
import { apart, count, num, tick } from "./dom.js";

const MINUS = "−";
const SMALL_MM = 0.1;
const LARGE_STRAIN = 1e4; // µm/m: 1 %
const KEPT = "strainUnit";

/** @typedef {"µm/m" | "%"} StrainUnit */
/** @type {StrainUnit} */
let strain = "µm/m";
try {
  if (globalThis.localStorage?.getItem(KEPT) === "%") strain = "%";
} catch {
  // a browser that keeps nothing: the usual unit
}

export const strainUnit = () => strain;

/** @param {StrainUnit} unit */
export function useStrainUnit(unit) {
  strain = unit;
  try {
    globalThis.localStorage?.setItem(KEPT, unit);
  } catch {
    // not kept
  }
}

/**
 * Unit to show numbers of a unit in, and the factor to it.
 * @param {string} unit
 * @param {number | null} [size] of the largest of the numbers
 */
export function shown(unit, size = null) {
  if (unit === "mm" && size !== null && Math.abs(size) < SMALL_MM) return { unit: "µm", factor: 1000 };
  if (unit === "µm/m" && (strain === "%" || (size !== null && Math.abs(size) >= LARGE_STRAIN))) return { unit: "%", factor: 1e-4 };
  return { unit, factor: 1 };
}

/**
 * A number to a decimal place: 1 is tenths, -1 tens.
 * @param {number} value
 * @param {number} decimals
 */
function fixed(value, decimals) {
  const rounded = decimals < 0 ? Math.round(value * 10 ** decimals) / 10 ** decimals : value;
  const text = rounded.toFixed(Math.max(Math.min(decimals, 12), 0));
  return apart(Number(text) === 0 ? text.replace("-", "") : text.replace("-", MINUS));
}

/**
 * A value and its standard uncertainty with two digits of it, in the unit that suits.
 * @param {number | null | undefined} value
 * @param {number | null | undefined} u in the same unit
 * @param {string} unit
 * @param {number} [size] of the largest number in its column: a column has one unit
 * @returns {string} a value without an uncertainty with four digits; an unknown value is a dash
 */
export function uncertain(value, u, unit, size = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (u === null || u === undefined || !(u > 0) || !Number.isFinite(u)) return amount(value, unit, 4, size);
  const to = shown(unit, Math.max(Math.abs(value), u, size));
  const two = Number((u * to.factor).toPrecision(2));
  const decimals = 1 - Math.floor(Math.log10(two) + 1e-12);
  const after = to.unit ? `\u00a0${to.unit}` : "";
  if (decimals > 8) return `${num(value * to.factor, 5)} ± ${num(two, 2)}${after}`;
  return `${fixed(value * to.factor, decimals)} ± ${fixed(two, decimals)}${after}`;
}

/**
 * A number in the unit that suits.
 * @param {number | null | undefined} value
 * @param {string} unit
 * @param {number} [size] of the largest number in its column: a column has one unit
 */
export function amount(value, unit, digits = 4, size = 0) {
  const to = shown(unit, value === null || value === undefined ? null : Math.max(Math.abs(value), size));
  const text = num(value === null || value === undefined ? value : value * to.factor, digits);
  return text === "–" || !to.unit ? text : `${text}\u00a0${to.unit}`;
}

/**
 * Marks of a scale, all with the same decimals, as few as distinguish neighbours.
 * @param {readonly number[]} values
 */
export function evenMarks(values) {
  const step = Math.min(
    ...values
      .slice(1)
      .map((v, k) => Math.abs(v - values[k]))
      .filter((v) => v > 0),
  );
  const largest = Math.max(...values.map(Math.abs));
  if (!Number.isFinite(step) || largest >= 1e5 || largest < 1e-3) return values.map((v) => tick(Number(v.toPrecision(3))));
  const decimals = Math.max(0, 1 - Math.floor(Math.log10(step) + 1e-9));
  return values.map((v) => fixed(v, Math.min(decimals, 6)));
}

/**
 * The service's words as the page writes units: µm, ±, µm/m.
 * @param {string | null | undefined} text
 */
export const inUnits = (text) =>
  (text ?? "")
    .replaceAll("+-", "±")
    .replace(/(?<=\d )um\b/g, "µm")
    .replace(/(?<=\d )microstrain\b/g, "µm/m")
    .replace(/(?<=\d )sigma\b/g, "σ");

/**
 * A duration in the units that people use: 0.4 s, 12 s, 29 min 31 s, 3 h 5 min, 2 d 4 h.
 * @param {number | null | undefined} seconds
 */
export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "–";
  if (seconds < 9.95) return `${Number(seconds.toFixed(1))}\u00a0s`;
  const whole = Math.round(seconds);
  const parts = /** @type {[number, string][]} */ ([
    [Math.floor(whole / 86400), "d"],
    [Math.floor(whole / 3600) % 24, "h"],
    [Math.floor(whole / 60) % 60, "min"],
    [whole % 60, "s"],
  ]);
  const first = parts.findIndex(([n]) => n > 0);
  return parts
    .slice(first, first + 2)
    .filter(([n]) => n > 0)
    .map(([n, unit]) => `${n}\u00a0${unit}`)
    .join(" ");
}

/**
 * How often something was: once, twice, 12 times.
 * @param {number | null} n
 */
export const times = (n) => (n === null ? "–" : n === 1 ? "once" : n === 2 ? "twice" : `${count(n)} times`);
