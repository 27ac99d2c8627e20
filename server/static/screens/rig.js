// Both cameras live, their settings and figures, and the stage.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { allRight, numberWithin, rule } from "../lib/fields.js";
import { camera, connection, rateOf } from "./rig/camera.js";
import { liveCheck } from "./rig/live_check.js";
import { h, replace, field, number, select, action, describe, badge, num, count, quantity, notify, problemText, STATE_KIND } from "../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"RigReply">} Rig */
/** @typedef {Model<"StageReply">["axes"]} Axes */

const CAMERAS = ["cam1", "cam2"];
/** @param {HTMLElement} root */
export async function open(root) {
  const rig = await api.get("/rig");
  /** @type {Ends} */
  const ends = [];
  const cameras = CAMERAS.map((cam) => camera(cam, rig.cameras[cam], ends));
  const pair = h("dl.definitions");
  const state = h("div");
  const again = reconnect(); // one button: it must not be drawn again while it is pressed
  replace(
    root,
    h("div.spread", h("h1", rig.name || "Rig"), state),
    liveCheck(ends),
    h(
      "div.grid.two.views",
      cameras.map((one) => one.root),
    ),
    h("div.grid.side", { style: { marginTop: "var(--gap)" } }, stage(ends), h("section.panel", h("h2", "Pairs"), pair, rig.sim ? scene(rig) : null)),
  );

  const pairRate = rateOf();
  let closed = false;
  async function update() {
    if (document.hidden) return;
    try {
      const now = await api.get("/rig");
      if (!closed && CAMERAS.some((cam) => !rig.cameras[cam].device && now.cameras[cam].device)) {
        // its settings and their ranges are known now
        ends.splice(0).forEach((end) => end());
        const leave = await open(root);
        if (closed) leave();
        else ends.push(leave);
        return;
      }
      const gone = [...CAMERAS.filter((cam) => now.cameras[cam].fault), ...(now.stage.fault ? ["the stage"] : [])];
      replace(
        state,
        now.fault
          ? badge("fault", "bad")
          : gone.length
            ? badge(`without ${gone.join(" and ")}`, "bad")
            : badge(now.holder ? `in use: ${now.holder}` : "ready", now.holder ? "busy" : "good"),
        now.fault ? [problemText(api.problemOf(now.fault)), again] : gone.length ? again : null,
      );
      const stats = await Promise.all(cameras.map((one) => one.update(now.cameras[one.cam])));
      const figures = stats.find(Boolean)?.pairs;
      if (figures) {
        const rate = pairRate(figures.paired);
        describe(pair, [
          ["paired", count(figures.paired)],
          ["pairs per second", num(rate, 3)],
          ["max. skew", quantity(now.max_skew_ms, "ms", 3)],
          ["unpaired", count(figures.unpaired)],
          ["dropped", count(figures.dropped)],
          ["incomplete", count(figures.incomplete)],
          ["refused", count(figures.refused)],
          ["missed pulses", count(figures.slips)],
        ]);
      }
    } catch (error) {
      replace(state, badge("unknown", "warn"));
      if (error instanceof api.Problem && error.status >= 500) replace(state, problemText(error), again);
    }
  }
  update();
  const timer = setInterval(update, 1000);
  ends.push(() => clearInterval(timer));
  return () => {
    closed = true;
    ends.forEach((end) => end());
  };
}

function reconnect() {
  return action("Reconnect", async () => {
    const { job } = await api.post("/rig:reconnect");
    const ended = await api.finished(job.id);
    if (ended.state !== "succeeded") throw api.jobProblem(ended);
    notify("Cameras and stage are open again.", "good");
  });
}

/** @param {Ends} ends */
function stage(ends) {
  const rows = h("div");
  const lines = h("div", { "data-role": "controllers" });
  const step = number(1, { min: 0.001, "aria-label": "Step of the jog buttons" });
  const stepRight = rule(step, numberWithin({ above: 0, unit: "mm", what: "A step" }));
  /** @type {Axes} */
  let axes = [];

  /** @param {Promise<Model<"Accepted">>} asked */
  async function run(asked) {
    const { job } = await asked;
    const ended = await api.finished(job.id);
    await update();
    if (ended.state !== "succeeded") throw api.jobProblem(ended);
  }

  function draw() {
    replace(
      rows,
      axes.map((axis) => {
        const target = number(null, { min: axis.limits?.low_mm, max: axis.limits?.high_mm, placeholder: num(axis.position_mm, 5) });
        const within = rule(target, numberWithin({ low: axis.limits?.low_mm, high: axis.limits?.high_mm, unit: "mm", what: "A position" }));
        const go = action("Go", async () => {
          if (allRight([[target, within]])) await run(api.post("/stage/moves", { positions_mm: { [axis.axis]: Number(target.value) } }));
        });
        target.addEventListener("keydown", (event) => event.key === "Enter" && go.click());
        const jog = (/** @type {1 | -1} */ sign) =>
          action(
            sign < 0 ? "◂ −" : "+ ▸",
            async () => {
              if (allRight([[step, stepRight]])) await run(api.post("/stage/moves", { by_mm: { [axis.axis]: sign * Number(step.value) } }));
            },
            { "aria-label": `Jog axis ${axis.axis} ${sign < 0 ? "backward" : "forward"}` },
          );
        return h(
          "fieldset",
          { "data-axis": axis.axis },
          h("legend", `Axis ${axis.axis}${axis.cameras?.length ? ` · ${axis.cameras.join(", ")}` : ""}`),
          h(
            "div.row",
            h("strong", { "data-role": "position" }, quantity(axis.position_mm, "mm", 6)),
            h("span", { "data-role": "state" }, stateBadge(axis)),
            h("span.quiet", axis.limits ? `${num(axis.limits.low_mm, 4)} to ${num(axis.limits.high_mm, 4)} mm` : ""),
          ),
          h(
            "div.row",
            jog(-1),
            jog(1),
            h("label", { for: `target${axis.axis}` }, "to"),
            Object.assign(target, { id: `target${axis.axis}` }),
            h("span.unit", "mm"),
            go,
            action("Home", () => run(api.post("/stage:home", { axes: [axis.axis] }))),
          ),
        );
      }),
    );
  }

  const stateBadge = (/** @type {Axes[number]} */ axis) =>
    badge(
      axis.moving ? "moving" : axis.homed === false ? "not homed" : axis.state,
      axis.moving ? "busy" : axis.homed === false ? "warn" : (STATE_KIND[axis.state] ?? ""),
    );

  async function update() {
    if (document.hidden) return;
    try {
      const now = (await api.get("/rig")).stage; // it names its controllers when none answers too
      const fresh = now.axes ?? [];
      if (fresh.length !== axes.length) {
        axes = fresh;
        draw();
      } else {
        axes = fresh;
        for (const axis of axes) {
          // an unfinished input stays
          const shown = (/** @type {string} */ role) => /** @type {HTMLElement} */ (rows.querySelector(`[data-axis="${axis.axis}"] [data-role="${role}"]`));
          shown("position").textContent = quantity(axis.position_mm, "mm", 6);
          replace(shown("state"), stateBadge(axis));
        }
      }
      if (!axes.length) replace(rows, now.fault ? problemText(api.problemOf(now.fault)) : h("p.quiet", "This rig has no stage."));
      replace(
        lines,
        now.controllers.map((one) =>
          h(
            "p.quiet",
            badge(connection(one), one.fault ? "bad" : "good"),
            ` ${one.driver}, axes ${one.axes.join(", ")}, ${one.url}`,
            one.fault && axes.length ? `: ${one.fault.detail}` : null,
          ),
        ),
      );
    } catch (error) {
      replace(lines);
      replace(rows, problemText(error));
      axes = [];
    }
  }
  update();
  const timer = setInterval(update, 700);
  ends.push(() => clearInterval(timer), events.on("stage", update));
  return h(
    "section.panel",
    h("h2", "Stage"),
    h("div.fields", field("Jog step", step, "mm")),
    rows,
    lines,
    h(
      "div.row",
      action("Home all", () => run(api.post("/stage:home", {}))),
      h("span.quiet", "The red button stops every axis at once; so does Esc, pressed twice."),
    ),
  );
}

/** @param {Rig} rig */
function scene(rig) {
  const which = select(
    ["grid", "steel", "plate", "panel", "block", "strip", "sphere", "line_grid", "checkerboard", "charuco", "circles", "circles_asymmetric"].map((s) => [s, s]),
    rig.scene?.scene,
  );
  const load = number(rig.scene?.load ?? 0);
  const loadRight = rule(load, numberWithin({ what: "A load" }));
  return h(
    "details",
    h("summary", "Simulated scene"),
    field("Scene", which),
    field("Load", load, "", "kPa for plate, kN for panel, per cent for strip, share of the motion for block"),
    action(
      "Show the scene",
      async () =>
        allRight([[load, loadRight]]) &&
        api.put("/sim/scene", { scene: /** @type {Model<"SceneRequest">["scene"]} */ (which.value), load: Number(load.value) }),
    ),
  );
}
