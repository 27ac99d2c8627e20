// Parts that every kind of gauge has: its type, its four numbers by keyboard, the button that removes it.
import { h, number, action } from "../../../lib/dom.js";

/** @import { Body } from "#routes" */
/** @import { Known } from "../../../widgets/plots.js" */
/** @import { Viewer } from "../../results.js" */
/** @typedef {[x: number, y: number]} Spot */
/** @typedef {[x0: number, y0: number, x1: number, y1: number]} Four */
/** @typedef {"line" | "extensometer" | "area"} Kind of a gauge */
/** @typedef {Kind | "probe"} Tool */
/** @typedef {Body<"post", "/tests/{test_id}/analyses/{analysis_id}/gauges">} Request */
/** @typedef {{ name: string, ends: [Spot, Spot] }} Line */
/** @typedef {{ tool: Tool, line: [Spot, Spot] | null, area: Four | null, extensometers: { name: string, a: Spot, b: Spot }[], serial: number, first: Spot | null, kept: Line[] }} State
 *   `first`: the first of two clicks; `kept`: lines beside the one that is drawn now */
/** @typedef {{ screen: Viewer, state: State, body: (more: Partial<Request>) => Request, draw: (mouse?: Spot | null) => void, changed: (tool: Kind) => unknown }} Gauges
 *   `body`: of a request for readings; `draw` puts the gauges on the picture; `changed`: a gauge is new or moved */
/** @typedef {{ root: HTMLDetailsElement, fill: () => void, read: () => Promise<unknown>, draw: () => unknown, close: () => void }} Panel of a kind of gauge:
 *   `fill` shows its numbers, `read` asks for its readings, `draw` shows the last ones again */

/**
 * Four numbers and a button that uses them.
 * @param {string[]} names
 * @param {(v: Four) => unknown} set
 */
export function four(names, set) {
  const inputs = names.map((name) => number(null, { "aria-label": name, style: "width:5em" }));
  const use = action("Use", async () => {
    const v = inputs.map((one) => Number(one.value));
    if (inputs.some((one) => one.value === "") || !v.every(Number.isFinite)) throw new Error("Give all four numbers, in pixels of camera 1's reference image.");
    await set(/** @type {Four} */ (v));
  });
  const hints = names.map((name) => name.split(" ").slice(1).join(" "));
  const labelled = inputs.map((one, k) => h("label.field", h("small.hint", hints[k]), one));
  return {
    row: h("div.row", labelled, h("span.unit", "px"), use),
    fill: (/** @type {number[]} */ values) => {
      for (const [k, v] of values.entries()) inputs[k].value = String(v);
    },
  };
}

/**
 * E1, E2 ...: e1 and e2 are the principal strains. Gauges that were saved under other names keep them.
 * @param {State} state
 */
export function nextName(state) {
  do state.serial += 1;
  while (state.extensometers.some((one) => one.name === `E${state.serial}`));
  return `E${state.serial}`;
}

/**
 * A button that removes a gauge.
 * @param {Gauges} my
 * @param {"line" | "area"} tool
 * @param {() => unknown} close closes its chart
 * @param {HTMLElement[]} boxes of its readings
 */
export function clear(my, tool, close, boxes) {
  const onclick = () => {
    my.state[tool] = null;
    close();
    for (const box of boxes) box.replaceChildren();
    my.draw();
  };
  return h("button", { type: "button", onclick }, "Clear");
}

/** @type {(values: Known, factor: number) => Known} */
export const times = (values, factor) => values.map((v) => (v === null ? null : v * factor));
