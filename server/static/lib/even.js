// Round numbers: 1, 2 or 5 times a power of ten, even marks of such steps; and even parts of a list.

/**
 * 1, 2 or 5 times a power of ten, not above `value`; 1 if there is none.
 * @param {number} value
 */
export function round125(value) {
  if (!(value > 0) || !Number.isFinite(value)) return 1;
  const power = 10 ** Math.floor(Math.log10(value) + 1e-12);
  return Number((([5, 2, 1].find((one) => one * power <= value * (1 + 1e-12)) ?? 1) * power).toPrecision(12));
}

/**
 * Even marks between two numbers.
 * @param {number} low
 * @param {number} high
 * @param {number} max about so many
 */
export function marks(low, high, max = 5) {
  const rough = (high - low) / max;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = ([1, 2, 5, 10].find((one) => one * power >= rough) ?? 10) * power;
  const out = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(Math.abs(v) < 1e-9 * step ? 0 : Number(v.toPrecision(12)));
  return out;
}

/**
 * So many entries of a list, evenly spread, its first and last among them; all if there are no more.
 * @param {readonly number[]} all
 * @param {number} most
 */
export const spread = (all, most) =>
  all.length <= most ? [...all] : Array.from({ length: most }, (_, k) => all[Math.round((k * (all.length - 1)) / (most - 1))]);
