// A guided acquisition: both cameras live with the target drawn over, the cover by the views, and the next view.
import * as api from "../../lib/api.js";
import { View, stroke } from "../../widgets/view.js";
import { allRight, limited, numberWithin, rule } from "../../lib/fields.js";
import { h, svg, replace, field, number, select, action, badge, num, notify, problemText } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"GuideReply">} Guide */
/** @typedef {NonNullable<Guide["guidance"]>} Guidance */

const CAMERAS = /** @type {const} */ (["cam1", "cam2"]);
const ASK_MS = 250;
const SEEN = "#35d07f";
const MOVING = "#ffb020";
const WANTED = "#5ab0ff";
const TILTS = [
  ["upper left", "up", "upper right"],
  ["left", "facing", "right"],
  ["lower left", "down", "lower right"],
];

const um = (/** @type {number | null | undefined} */ value) => (value === null || value === undefined ? "not known" : `${num(value, 2)} µm`);

/**
 * The panel: a form, and the acquisition that runs.
 * @param {Model<"RigReply">} rig
 * @param {Ends} ends
 * @param {(id: string) => Promise<unknown>} done
 */
export function guidePanel(rig, ends, done) {
  const quantity = select(
    [
      ["z", "Z at the specimen"],
      ["shape", "shape at the specimen"],
    ],
    "z",
  );
  const goal = h("input", { type: "text", inputmode: "decimal", autocomplete: "off", placeholder: "none" });
  const frames = number(1, { min: 1, max: 64, step: 1 });
  const automatic = h("input", { type: "checkbox", checked: true });
  const label = h("input", { type: "text", maxlength: 300, placeholder: "purpose" });
  const live = h("div", { "data-role": "guide" });
  const rules = /** @type {[HTMLInputElement, import("../../lib/fields.js").Rule][]} */ ([
    [goal, rule(goal, numberWithin({ above: 0, unit: "µm", required: false }))],
    limited(frames, "A number of frames"),
  ]);
  const begin = action(
    "Begin guided acquisition",
    async () => {
      if (!allRight(rules)) return;
      const wanted = goal.value.trim() ? Number(goal.value) : null;
      const { job, calibration_id: id } = await api.post("/calibrations:guide", {
        quantity: /** @type {"z" | "shape"} */ (quantity.value),
        goal_um: wanted,
        frames: Number(frames.value),
        automatic: automatic.checked,
        label: label.value,
      });
      follow(id, job.id);
    },
    { kind: "primary" },
  );
  /** @type {(() => void) | null} */
  let close = null;
  ends.push(() => close?.());

  /**
   * @param {string} id of the calibration
   * @param {string} job
   */
  function follow(id, job) {
    close?.();
    begin.setAttribute("aria-disabled", "true");
    const shown = acquisition(rig, id, job, async (ended) => {
      begin.removeAttribute("aria-disabled");
      close?.();
      close = null;
      replace(live, ended ? h("p", { role: "status" }, ended) : null);
      await done(id);
    });
    close = shown.close;
    replace(live, shown.root);
  }

  // a running one is followed, also if another client began it
  api
    .get("/rig")
    .then(async ({ holder }) => {
      const job = holder?.job_id && (await api.get(`/jobs/${holder.job_id}`));
      const id = job && /** @type {string | undefined} */ (job.subject.calibration_id);
      if (job && id && holder?.purpose === "a guided calibration") follow(id, job.id);
    })
    .catch((error) => {
      if (!api.aborted(error)) notify(error);
    });

  return h(
    "section.panel",
    { "aria-label": "Guided acquisition" },
    h("h2", "Guided acquisition"),
    h("p.quiet", "Nothing moves: hold the target in your hand, first where the specimen will be. A view is taken whenever it is at rest in a new pose."),
    h(
      "div.fields",
      field("Uncertainty of", quantity),
      field("Goal", goal, "µm", "ends the acquisition by itself"),
      field("Frames per view", frames),
      field("Purpose", label),
      h("label.row", automatic, " Take views by itself"),
    ),
    h("div.row", begin),
    live,
  );
}

/**
 * @param {Model<"RigReply">} rig
 * @param {string} id
 * @param {string} job
 * @param {(text: string) => Promise<void>} ended
 */
function acquisition(rig, id, job, ended) {
  const views = CAMERAS.map((cam) => {
    const view = new View({ label: `Guided view of ${cam}`, tools: false });
    const size = rig.cameras[cam].nominal.image_size_px;
    view.size(size[0], size[1]);
    view.show(api.address(`/cameras/${cam}/stream.mjpg`, { rate_hz: 8, t: Date.now() }));
    const over = svg("g", { class: "guide" });
    view.svg.append(over);
    const state = h("p.quiet", { "data-role": `seen-${cam}` });
    return { cam, view, over, state, size };
  });
  const sentence = h("p", { role: "status", "data-role": "proposal", style: { fontSize: "1.2rem", fontWeight: 600 } }, "Looking for the target …");
  const figures = h("p", { "data-role": "uncertainty" });
  const cover = h("div.grid.two");
  const path = /** @type {const} */ (`/calibrations/${id}/guide`);
  const take = action("Take a view now", () => api.post(`${path}/views`));
  const finish = action("Finish and fit", () => api.post(`${path}:finish`), { kind: "primary" });
  const cancel = action("Cancel", () => api.post(`/jobs/${job}:cancel`), { kind: "danger" });
  const root = h(
    "div",
    { style: { marginTop: "var(--gap)" } },
    sentence,
    figures,
    h("div.row", take, finish, cancel),
    h(
      "div.grid.two.views",
      { style: { marginTop: "var(--gap)" } },
      views.map((one) => h("div", h("h3", one.cam), one.view.root, one.state)),
    ),
    cover,
  );

  let closed = false;
  /** @type {number | undefined} */
  let timer;
  let taken = -1;
  async function ask() {
    try {
      const now = await api.get(path);
      if (closed) return;
      if (now.guidance && now.guidance.taken !== taken) {
        taken = now.guidance.taken;
        replace(sentence, now.guidance.text);
        replace(figures, figuresOf(now.guidance, now));
        replace(cover, coverage(now.guidance, views));
      }
      for (const one of views) draw(one, now);
      if (now.state === "fitting") replace(sentence, "Fitting both cameras …");
      else if (now.state !== "acquiring") {
        await ended(now.state === "complete" ? "The calibration is complete." : "The acquisition has ended; its views are kept.");
        return;
      }
    } catch (error) {
      if (closed || api.aborted(error)) return;
      replace(sentence, problemText(error));
    }
    timer = setTimeout(ask, ASK_MS);
  }
  ask();
  return {
    root,
    close: () => {
      closed = true;
      clearTimeout(timer);
      views.forEach((one) => one.view.close());
    },
  };
}

/**
 * Draw the target found, and the outline of the pose proposed, over one camera's picture.
 * @param {{ cam: "cam1" | "cam2", over: Element, state: Element }} one
 * @param {Guide} now
 */
function draw({ cam, over, state }, now) {
  const look = now.live;
  const seen = look?.cameras[cam];
  const wanted = now.guidance?.proposal?.outlines_px[cam];
  const line = (/** @type {number[][]} */ points) => `M${points.map(([x, y]) => `${x} ${y}`).join("L")}Z`;
  const colour = look?.still ? SEEN : MOVING;
  over.replaceChildren(
    ...(wanted ? [svg("path", { ...stroke(WANTED, 2.5, [7, 5]), d: line(wanted), "data-role": "wanted" })] : []),
    ...(seen?.outline_px.length
      ? [
          svg("path", { ...stroke(colour, 2), d: line(seen.outline_px), "data-role": "outline" }),
          svg("path", { ...stroke(colour, 5), "stroke-linecap": "round", d: seen.points_px.map(([x, y]) => `M${x} ${y}h0`).join("") }),
        ]
      : []),
  );
  const words =
    !look || !seen
      ? "…"
      : seen.problem
        ? seen.problem.detail
        : `${seen.found} points; ${look.still ? "at rest" : "moving"}, ${look.new ? "a new pose" : look.like_view === null ? "not seen by both" : `like view ${look.like_view + 1}`}`;
  if (state.textContent !== words) state.textContent = words;
}

/**
 * @param {Guidance} guidance
 * @param {Guide} now
 */
function figuresOf(guidance, now) {
  const value = guidance.uncertainty && (now.quantity === "z" ? guidance.uncertainty.z_um : guidance.uncertainty.shape_um);
  const left = guidance.taken - guidance.used;
  return [
    badge(guidance.reached ? "goal met" : `${guidance.used} view${guidance.used === 1 ? "" : "s"}`, guidance.reached ? "good" : "busy"),
    " ",
    `Uncertainty of ${now.quantity === "z" ? "Z" : "shape"}: ${um(value)}${guidance.adjusted || value === null ? "" : " by nominal lenses"}`,
    now.goal_um === null ? "" : `; goal ${um(now.goal_um)}`,
    left > 0 ? `; ${left} left out: ${guidance.left_out.map((one) => `view ${one.view + 1}, ${one.camera}: ${one.reason}`).join("; ")}` : "",
  ];
}

/**
 * @param {Guidance} guidance
 * @param {{ cam: "cam1" | "cam2", size: number[] }[]} cameras
 */
function coverage({ coverage: cover }, cameras) {
  const cell = (/** @type {number} */ value, /** @type {number} */ most) =>
    h(
      "td",
      {
        style: {
          background: value ? `color-mix(in srgb, ${SEEN} ${25 + (60 * value) / most}%, transparent)` : "transparent",
          border: "1px solid var(--line, #8886)",
          height: "1.4rem",
          textAlign: "center",
          padding: 0,
        },
      },
      value ? String(value) : "",
    );
  const images = cameras.map(({ cam }) => {
    const most = Math.max(1, ...cover.cells[cam].flat());
    return h(
      "div",
      h("h3", `Covered of ${cam}: ${num(100 * cover.share[cam], 2)} %`),
      h(
        "table",
        { "aria-label": `Points seen in each part of ${cam}'s image`, style: { width: "100%", tableLayout: "fixed", borderCollapse: "collapse" } },
        h(
          "tbody",
          cover.cells[cam].map((row) =>
            h(
              "tr",
              row.map((value) => cell(value, most)),
            ),
          ),
        ),
      ),
    );
  });
  const tilted = Math.max(1, ...Object.values(cover.tilts));
  const tilts = h(
    "div",
    h("h3", "Tilts seen"),
    h(
      "table",
      { "aria-label": "Views by the direction of the target's tilt", style: { width: "100%", tableLayout: "fixed", borderCollapse: "collapse" } },
      h(
        "tbody",
        TILTS.map((row) =>
          h(
            "tr",
            row.map((name) => {
              const made = cell(cover.tilts[name], tilted);
              made.title = name;
              return made;
            }),
          ),
        ),
      ),
    ),
  );
  const deep = Math.max(1, ...cover.depths);
  const depths = h(
    "div",
    h("h3", "Distances seen, nearest first"),
    h(
      "table",
      { "aria-label": "Views by distance, nearest first", style: { width: "100%", tableLayout: "fixed", borderCollapse: "collapse" } },
      h(
        "tbody",
        h(
          "tr",
          cover.depths.map((value, k) => {
            const made = cell(value, deep);
            made.title = `${cover.depth_edges[k - 1] ?? 0} to ${cover.depth_edges[k] ?? "∞"} of the specimen's distance`;
            return made;
          }),
        ),
      ),
    ),
  );
  return [...images, tilts, depths];
}
