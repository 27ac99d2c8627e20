// Statistics of the shown field, and its principal strains.
import { h, num, count, quantity, describe, definitions } from "../../lib/dom.js";
import { amount, shown } from "../../lib/units.js";
import { measured } from "../../widgets/field_map.js";

/** @import { Viewer } from "../results.js" */

/** @param {Viewer} screen */
export function statistics(screen) {
  const { result, map, state } = screen;
  const root = h("dl.definitions", { "data-role": "statistics" });
  function draw() {
    if (!map.now) return;
    const { statistics: s, info } = map.now;
    const { unit, factor } = shown(info.unit, Math.max(Math.abs(s.min ?? 0), Math.abs(s.max ?? 0))); // one unit for all
    const text = (/** @type {number | null} */ v, digits = 4) => quantity(v === null ? null : factor * v, unit, digits);
    const valid = `${count(s.count)} of ${count(s.within)} (${num(s.within ? (100 * s.count) / s.within : null, 3)} %)`;
    describe(root, [
      ["min", text(s.min)],
      ["max", text(s.max)],
      ["mean", text(s.mean)],
      ["sd", text(s.sd, 3)],
      ["valid", h("span.whole", { title: "points with a value, of those in the region" }, valid)],
    ]);
  }

  /** Principal strains with a component of strain: they do not depend on the axes. */
  let asked = 0;
  async function principal() {
    asked += 1;
    const mine = asked;
    const { step, info } = state;
    if (step === null || info?.group !== "Strain" || !map.now) return;
    const { all } = await result.fields(step);
    if (!all.has("e1") || !all.has("e2")) return;
    const [e1, e2, exx, eyy, exy] = await Promise.all(["e1", "e2", "exx", "eyy", "exy"].map((name) => result.values(step, name)));
    if (mine !== asked || state.step !== step || state.info !== info || !map.now) return; // another drawing adds them
    const { grid } = map.now;
    const mean = (/** @type {ArrayLike<number>} */ of) => {
      const known = measured(grid, of);
      return known.length ? known.reduce((sum, v) => sum + v, 0) / known.length : null;
    };
    const title = "of the mean strain, from X towards Y: a specimen that is tilted in the picture has shear in axes along the image's rows";
    const axis = axisText(measured(grid, exx), measured(grid, eyy), measured(grid, exy));
    root.append(
      ...definitions([
        ["principal strains, mean", h("span.whole", `${amount(mean(e1), "µm/m")}, ${amount(mean(e2), "µm/m")}`)],
        ["axis of the larger", h("span.whole", { "data-role": "principal-axis", title }, axis)],
      ]).children,
    );
  }
  return { root, draw, principal };
}

/**
 * Direction of the larger principal strain of the mean; none where the points scatter more than the two strains differ.
 * @param {Float64Array} exx of the points with a value
 * @param {Float64Array} eyy
 * @param {Float64Array} exy
 */
function axisText(exx, eyy, exy) {
  const mean = (/** @type {Float64Array} */ of) => of.reduce((sum, v) => sum + v, 0) / of.length;
  const [x, y, shear] = [exx, eyy, exy].map(mean);
  const differences = exx.map((v, i) => v - eyy[i] - (x - y));
  const scatter = Math.sqrt(mean(differences.map((v) => v * v)));
  if (!(Math.hypot(x - y, 2 * shear) > scatter)) return "none is significant";
  return `${num((90 / Math.PI) * Math.atan2(2 * shear, x - y), 3)}° from X`;
}
