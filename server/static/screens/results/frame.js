// The axes that the numbers are shown in: the specimen's, kept with its test, or the calibration's.
import * as api from "../../lib/api.js";
import { h, replace, svg, action, notify, problemText } from "../../lib/dom.js";
import { drawTriad } from "../../widgets/triad.js";

/** @import { Body } from "#routes" */
/** @import { Viewer } from "../results.js" */
/** @typedef {Body<"put", "/tests/{test_id}/frame">["frame"]} Frame */
/** @typedef {[x: number, y: number]} Spot */

/** @type {{ name: string, text: string, points: string[], frame: (at: Spot[]) => Frame }[]} */
const WAYS = [
  {
    name: "line",
    text: "X along a line (2 clicks)",
    points: ["where X begins", "where X points to"],
    frame: ([a, b]) => /** @type {Frame} */ ({ kind: "plane", x_line_px: [a, b] }),
  },
  {
    name: "points",
    text: "Three points (3 clicks)",
    points: ["the origin", "a point on X", "a third point of the plane"],
    frame: ([o, x, p]) => /** @type {Frame} */ ({ kind: "3-2-1", positions_px: [o, x, p, o, x, o] }),
  },
  {
    name: "321",
    text: "3-2-1 (6 clicks)",
    points: [
      "a first point of the plane",
      "a second point of the plane",
      "a third point of the plane",
      "where X begins",
      "where X points to",
      "the origin along X",
    ],
    frame: (at) => /** @type {Frame} */ ({ kind: "3-2-1", positions_px: at }),
  },
];

/**
 * @param {Viewer} screen
 * @param {() => Promise<void>} reread draws everything again in other axes
 */
export function frames(screen, reread) {
  const { result, map } = screen;
  const { view } = map;
  const choice = h(
    "select",
    { id: "resultframe", "data-role": "axes", "aria-describedby": "frame-hint" },
    h("option", { value: "specimen" }, "of the specimen"),
    h("option", { value: "system" }, "of the calibration"),
  );
  choice.value = result.frame;
  const marks = svg("g", { class: "axes-points" });
  view.svg.append(marks);
  const state = h("p.quiet", { role: "status", "data-role": "frame-state" });
  const buttons = WAYS.map((way) => h("button", { type: "button", "data-frame": way.name, onclick: () => begin(way) }, way.text));
  const usual = action("Best plane, X along the image's rows", async () => {
    end();
    await api.remove(`/tests/${result.testId}/frame`);
    await changed();
  });
  const root = h(
    "details.panel",
    { "data-role": "frame" },
    h("summary", "Axes"),
    h(
      "p.quiet",
      { id: "frame-hint" },
      "The page's fields, gauges, exports and report are in these axes; they are kept with the test. Stored results stay in the calibration's axes.",
    ),
    h("div.row", usual, buttons),
    state,
  );
  /** @type {{ way: typeof WAYS[number], at: Spot[] } | null} */
  let picking = null;

  function draw() {
    const px = 1 / (view.scale || 1);
    marks.replaceChildren(
      ...(picking?.at ?? []).flatMap(([x, y], k) => [
        svg("circle", { cx: x, cy: y, r: 6 * px, fill: "#ff9d1e", stroke: "#000", "stroke-width": px }),
        svg(
          "text",
          { x: x + 9 * px, y, fill: "#ff9d1e", "font-size": 14 * px, "dominant-baseline": "central", stroke: "#000", "stroke-width": 0.5 * px },
          String(k + 1),
        ),
      ]),
    );
    if (picking)
      state.textContent = `Click ${picking.way.points[picking.at.length]} (${picking.at.length + 1} of ${picking.way.points.length}) on the reference image; Escape ends it.`;
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.frame === picking?.way.name));
  }
  function end() {
    picking = null;
    draw();
  }
  /** @param {typeof WAYS[number]} way */
  function begin(way) {
    if (screen.state.image !== "reference" || screen.state.mode !== "image") {
      state.textContent = "The points are clicked on the reference image: choose View Image, and Image reference, camera 1.";
      return;
    }
    /** @type {HTMLElement | null} */ (view.tools.querySelector('[data-tool="probe"]'))?.click();
    picking = { way, at: [] };
    draw();
    view.frame.focus();
    view.frame.scrollIntoView({ block: "nearest" });
  }
  const before = screen.onpick;
  screen.onpick = async (x, y, event) => {
    if (!picking) {
      await before(x, y, event);
      return;
    }
    picking.at.push([Math.round(10 * x) / 10, Math.round(10 * y) / 10]);
    const { way, at } = picking;
    if (at.length < way.points.length) {
      draw();
      return;
    }
    end();
    try {
      await api.put(`/tests/${result.testId}/frame`, { frame: way.frame(at) });
      await changed();
    } catch (error) {
      replace(state, problemText(error));
    }
  };
  view.frame.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && picking && !view.aim) {
      end();
      tell().catch(notify);
    }
  });

  async function changed() {
    choice.value = "specimen";
    await choose();
  }
  async function choose() {
    result.use(choice.value === "system" ? "system" : "specimen");
    await tell();
    await reread();
  }
  async function tell() {
    const { text, chosen } = await api.get(`/tests/${result.testId}/frame`);
    if (picking) return; // begun while this was on its way: the next click is named here
    state.textContent = `${chosen ? "Kept with the test" : "Usual axes"}: ${text.replace(/^aligned by plane/, "best plane of the reference shape").replace(/^aligned by/, "laid by")}.`;
  }
  choice.addEventListener("change", () => choose().catch(notify));
  root.addEventListener("toggle", () => root.open && !picking && tell().catch(notify));

  screen.drawn.add(async () => {
    const n = screen.step;
    if (n === null) return;
    const axes = await result.axes().catch(() => null);
    drawTriad(view.frame, axes, result.frame === "specimen" ? "the specimen's" : "the calibration's");
  });
  return { root, choice };
}
