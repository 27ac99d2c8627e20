// Positions along a line, and values of several lines on common positions.

/** @typedef {(number | null)[]} Numbers null for missing ones */

/**
 * Distance along the surface from the first position, mm; null where a point is missing on the way.
 * @param {readonly Numbers[]} xyz three coordinates, a number a position
 * @returns {number[] | null}
 */
export function distanceMm(xyz) {
  const out = [];
  let length = 0;
  for (let k = 0; k < xyz[0].length; k += 1) {
    const at = xyz.map((one) => one[k] ?? NaN);
    if (!at.every(Number.isFinite)) return null;
    if (k) length += Math.hypot(...at.map((v, axis) => v - Number(xyz[axis][k - 1])));
    out.push(length);
  }
  return out;
}

/**
 * Values on other positions, straight between neighbours; null beyond the ends and next to a missing value.
 * @param {readonly number[]} x in rising order
 * @param {Numbers} values
 * @param {readonly number[]} at in rising order
 * @returns {Numbers}
 */
export function resampled(x, values, at) {
  let k = 0;
  return at.map((v) => {
    while (k < x.length - 2 && x[k + 1] < v) k += 1;
    const [a, b] = [values[k], values[k + 1]];
    if (v === x[k]) return a ?? null;
    if (v < x[k] || v > (x[k + 1] ?? NaN) || a === null || b === null || a === undefined || b === undefined) return v === x[k + 1] ? (b ?? null) : null;
    return a + ((b - a) * (v - x[k])) / (x[k + 1] - x[k]);
  });
}
