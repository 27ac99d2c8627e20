// Both cameras live next to the capture, with the faults that a pair taken now would have, and the way back.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { wayBackNote } from "../../widgets/way_back.js";
import { h, badge, replace, num, number, field, action, STATE_KIND } from "../../lib/dom.js";
import { allRight, numberWithin, rule } from "../../lib/fields.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */

const CAMERAS = ["cam1", "cam2"];
const ASK_MS = 1500;
const RATE_HZ = 5;
const LOADED = ["plate", "panel", "strip", "block"]; // scenes that have a load

/**
 * @param {Ends} ends
 * @returns {Promise<{ root: HTMLElement, look: () => Promise<void> }>}
 */
export async function livePanel(ends) {
  const rig = await api.get("/rig");
  const note = wayBackNote();
  const views = CAMERAS.map((cam) => {
    const [width, height] = rig.cameras[cam].nominal.image_size_px;
    const image = h("img", { alt: `Live view of ${cam}`, width, height, draggable: "false", style: { aspectRatio: `${width} / ${height}` } });
    image.style.setProperty("--aspect", String(width / height));
    const trouble = h("p.quiet", { hidden: true }, "No picture: the cameras do not answer, or are in use.");
    const state = h("span.quiet", { "data-role": `live-${cam}` });
    const start = () => {
      trouble.hidden = true;
      image.src = api.address(`/cameras/${cam}/stream.mjpg`, { rate_hz: RATE_HZ, t: Date.now() });
    };
    const end = () => image.removeAttribute("src"); // ends the stream
    image.addEventListener("error", () => {
      if (!image.getAttribute("src")) return;
      trouble.hidden = false;
      setTimeout(() => document.contains(image) && box.open && start(), 3000);
    });
    return { cam, state, start, end, root: h("div", h("div.spread", h("h3", cam), state), image, trouble) };
  });
  const box = h(
    "details",
    { open: true, "data-role": "live" },
    h("summary", "Live view"),
    h(
      "div.grid.two.live",
      views.map((one) => one.root),
    ),
  );

  /** @type {number | undefined} */
  let timer;
  let closed = false;
  async function ask() {
    if (!document.hidden && box.open) {
      await Promise.all(
        views.map(async ({ cam, state }) => {
          try {
            const { quality } = await api.get(`/cameras/${cam}/stats`);
            if (!closed) replace(state, badge(quality.code, STATE_KIND[quality.code] ?? "warn"), ` focus ${num(quality.focus, 3)}`);
          } catch {
            if (!closed) replace(state, "no figures");
          }
        }),
      );
    }
    if (!closed) timer = setTimeout(ask, ASK_MS);
  }
  const begin = () => views.forEach((one) => (box.open ? one.start() : one.end()));
  box.addEventListener("toggle", begin);
  ask();
  note.update();
  ends.push(
    () => {
      closed = true;
      clearTimeout(timer);
      views.forEach((one) => one.end());
    },
    events.on("job", (job) => !["queued", "running", "cancelling"].includes(job.state) && note.update()),
    events.on("stage", () => {
      note.update();
    }),
    events.on("scene", begin),
  );
  const load = h("div");
  const drawLoad = (/** @type {Model<"RigReply">} */ now) => {
    if (!load.contains(document.activeElement)) replace(load, now.sim && now.scene ? loadOf(now.scene) : null);
  };
  drawLoad(rig);
  ends.push(
    events.on("scene", async () => {
      const now = await api.get("/rig").catch(() => null);
      if (now && !closed) drawLoad(now);
    }),
  );
  return { root: h("div", note.root, box, load), look: note.update };
}

/** @param {Model<"SceneReply">} scene of a simulated rig */
function loadOf({ scene, load: now }) {
  if (!LOADED.includes(scene))
    return h("p.quiet", "The simulated scene has no load. Choose another one on the ", h("a", { href: "#/rig" }, "rig's screen"), ".");
  const load = number(now, { "aria-label": "Simulated load" });
  const right = rule(load, numberWithin({ what: "A load" }));
  const put = action("Apply", async () => {
    if (allRight([[load, right]])) await api.put("/sim/scene", { scene: /** @type {Model<"SceneRequest">["scene"]} */ (scene), load: Number(load.value) });
  });
  load.addEventListener("keydown", (event) => event.key === "Enter" && put.click());
  return h("div.row", field(`Simulated load of ${scene}`, load), put);
}
