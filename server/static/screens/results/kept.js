// Gauges, field, limits and colours: kept with the test as they are drawn, and there again when its results are opened.
import { Workspace } from "../../lib/workspace.js";

/** @import { Model } from "#routes" */
/** @import { Scale } from "../../widgets/scale.js" */
/** @typedef {[x: number, y: number]} Spot */
/** @typedef {{ name?: string | null, a_px?: number[] | null, b_px?: number[] | null, ends_mm?: unknown }} Extensometer */
/** @typedef {{ lines?: { name?: string | null, vertices_px: number[][] }[], areas?: { name?: string | null, rectangle_px?: number[] | null }[], extensometers?: Extensometer[], points?: unknown[], remove_rigid?: object | null }} Gauges of a request */
/** @typedef {{ line: [Spot, Spot] | null, area: [number, number, number, number] | null, extensometers: { name: string, a: Spot, b: Spot }[], serial: number, kept: { name: string, ends: [Spot, Spot] }[] }} Drawn */

/**
 * @param {Workspace} workspace
 * @param {Drawn} state of the gauges' panel; the stored gauges are put into it
 * @param {HTMLInputElement} rigid
 * @returns {() => void} stores the present drawing
 */
export function keptGauges(workspace, state, rigid) {
  const before = /** @type {Gauges} */ (workspace.value.gauges ?? {});
  const spot = (/** @type {readonly number[]} */ [x, y]) => /** @type {Spot} */ ([x, y]);
  const [line, ...others] = before.lines ?? [];
  const area = before.areas?.[0]?.rectangle_px;
  const ends = (/** @type {number[][]} */ of) => /** @type {[Spot, Spot]} */ ([spot(of[0]), spot(/** @type {number[]} */ (of.at(-1)))]);
  if (line) state.line = ends(line.vertices_px);
  others.forEach((one, k) => state.kept.push({ name: one.name ?? `L${k + 1}`, ends: ends(one.vertices_px) }));
  if (area) state.area = /** @type {[number, number, number, number]} */ ([...area]);
  for (const one of before.extensometers ?? [])
    if (one.a_px && one.b_px) state.extensometers.push({ name: one.name ?? `E${state.extensometers.length + 1}`, a: spot(one.a_px), b: spot(one.b_px) });
  state.serial = Math.max(state.serial, ...state.extensometers.map((one) => Number(/\d+$/.exec(one.name)?.[0] ?? 0)));
  rigid.checked = Boolean(before.remove_rigid);
  let last = "";
  function keep() {
    const found = {
      lines: [
        ...(state.line ? [{ name: line?.name ?? "l1", vertices_px: state.line }] : []),
        ...state.kept.map((one) => ({ name: one.name, vertices_px: one.ends })),
      ],
      areas: [...(state.area ? [{ name: before.areas?.[0]?.name ?? "a1", rectangle_px: state.area }] : []), ...(before.areas ?? []).slice(1)],
      extensometers: [
        ...state.extensometers.map((one) => ({ name: one.name, a_px: one.a, b_px: one.b })),
        ...(before.extensometers ?? []).filter((one) => one.ends_mm),
      ],
    };
    const any = found.lines.length || found.areas.length || found.extensometers.length || before.points?.length;
    const { remove_rigid: _, ...others } = before;
    const now = any ? { ...others, ...found, ...(rigid.checked ? { remove_rigid: before.remove_rigid ?? {} } : {}) } : null;
    const said = JSON.stringify(now);
    if (last && said !== last) workspace.change({ gauges: /** @type {Model<"GaugeRequest"> | null} */ (JSON.parse(said)) });
    last = said;
  }
  keep(); // the first state is no change
  rigid.addEventListener("change", keep);
  return keep;
}

/**
 * @param {Workspace} workspace
 * @param {Scale} scale
 * @param {{ field: string | null, chosen: boolean }} state of the screen
 * @returns {{ keep: () => void, chosen: () => void }} to be called when something was drawn, and when another field is chosen
 */
export function keptDisplay(workspace, scale, state) {
  const before = /** @type {Partial<Model<"Display">>} */ (workspace.value.display ?? {});
  /** @type {{ [field: string]: number[] }} */
  const limits = { ...(before.limits ?? {}) };
  if (!state.chosen && before.field) [state.field, state.chosen] = [before.field, true];
  scale.restore(before);
  const chosen = () => {
    scale.forget();
    const own = limits[state.field ?? ""];
    if (own) scale.give(own[0], own[1]);
  };
  chosen();
  let last = "";
  function keep() {
    if (!state.field) return;
    const given = scale.given;
    if (given) limits[state.field] = given;
    else delete limits[state.field];
    const now = JSON.stringify({ field: state.chosen ? state.field : null, ...scale.state(), limits });
    if (last && now !== last) workspace.change({ display: JSON.parse(now) });
    last = now;
  }
  return { keep, chosen };
}
