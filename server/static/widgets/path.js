// The way through the page: seven steps in its bar, each a link to its screen, with a tick once it is done.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { h } from "../lib/dom.js";
import { SAVED } from "../lib/workspace.js";

/** @import { Here } from "../main.js" */
/** @typedef {"rig" | "calibrate" | "test" | "capture" | "region" | "measure" | "results"} Name */
/** @typedef {{ rig: boolean, calibrated: boolean, test: string | null, steps: number, region: boolean, measured: boolean, seen: boolean }} Done */

const KEPT = "test.open";
const SEEN = "results.seen";
const PAUSE_MS = 400; // events come in bursts

/** @type {readonly [Name, string, string][]} name, text, and the meaning of its tick */
const STEPS = [
  ["rig", "Rig", "cameras and stage are ready"],
  ["calibrate", "Calibrate", "a calibration is accepted"],
  ["test", "Test", "a test is open"],
  ["capture", "Capture", "the reference and a step are captured"],
  ["region", "Region", "a region is drawn"],
  ["measure", "Measure", "the test is measured"],
  ["results", "Results", "results were looked at"],
];
/** The test that was open last, in this browser. */
export const lastTest = () => localStorage.getItem(KEPT);

/**
 * Remember the test that is open, and that its results were seen.
 * @param {string} screen
 * @param {string | undefined} id
 */
function remember(screen, id) {
  if (!id || (screen !== "test" && screen !== "results")) return;
  localStorage.setItem(KEPT, id);
  if (screen === "results") localStorage.setItem(SEEN, id);
}

/** @returns {Promise<Done>} */
async function look() {
  const [rig, { calibrations }, { tests }] = await Promise.all([api.get("/rig"), api.get("/calibrations", { accepted: true }), api.get("/tests")]);
  const id = lastTest();
  const known = id && tests.some((one) => one.id === id) ? id : null;
  if (id && !known) localStorage.removeItem(KEPT);
  const [test, drawn] = known ? await Promise.all([api.get(`/tests/${known}`), api.get(`/tests/${known}/workspace`)]) : [null, null];
  const measured = Boolean(test?.analyses?.length);
  return {
    rig: rig.connected && !rig.fault && !Object.values(rig.cameras).some((one) => one.fault),
    calibrated: calibrations.length > 0,
    test: known,
    steps: test?.n_steps ?? 0,
    region: Boolean(drawn?.region) || measured,
    measured, // a measured test had a region, stored or not
    seen: measured && localStorage.getItem(SEEN) === known,
  };
}

/** Parts of a test that are screens beside the path. @type {readonly [string, string][]} */
const BESIDE = [
  ["live", "Live"],
  ["verify", "Verify"],
];

/** Show one part of a test as a screen of its own, such as capture or region; its own facts, steps and analyses without one. */
export function goTo(at = "") {
  const screen = /** @type {HTMLElement | null} */ (document.querySelector('main > [data-screen="test"]'));
  if (screen) screen.dataset.at = at;
  const plan = /** @type {HTMLDetailsElement | null | undefined} */ (screen?.querySelector('[data-role="procedure"]'));
  if (plan) plan.open = at === "verify";
  window.scrollTo({ top: 0 });
}

/** @param {HTMLElement} link @param {boolean} current */
function mark(link, current) {
  if (current) link.setAttribute("aria-current", "page");
  else link.removeAttribute("aria-current");
}

/** @param {HTMLElement} others links that follow the steps */
export function path(others) {
  /** @type {Map<Name, HTMLAnchorElement>} */
  const links = new Map(
    STEPS.map(([name, text], index) => [
      name,
      h("a", { href: `#/${name}`, "data-screen": name }, h("span.tick", { "aria-hidden": "true" }, String(index + 1)), h("span.word", text)),
    ]),
  );
  const beside = BESIDE.map(([name, text]) => h("a", { "data-screen": name }, text));
  /** @type {Here | null} */
  let here = null;
  /** @type {Done | null} */
  let done = null;

  function draw() {
    const current = here?.screen === "test" && here.path.length ? (here.query.get("at") ?? "test") : here?.screen;
    const test = done?.test ?? lastTest();
    const ticks = {
      rig: done?.rig,
      calibrate: done?.calibrated,
      test: Boolean(done?.test),
      capture: (done?.steps ?? 0) > 1,
      region: done?.region,
      measure: done?.measured,
      results: done?.seen,
    };
    const within = test ? `#/test/${encodeURIComponent(test)}` : "#/test";
    const to = {
      rig: "#/rig",
      calibrate: "#/calibrate",
      test: within,
      results: test && done?.measured ? `#/results/${encodeURIComponent(test)}` : "#/results",
    };
    STEPS.forEach(([name, , why], index) => {
      const link = /** @type {HTMLAnchorElement} */ (links.get(name));
      link.href = name in to ? to[/** @type {keyof typeof to} */ (name)] : test ? `${within}?at=${name}` : "#/test";
      link.classList.toggle("done", Boolean(ticks[name]));
      link.title = `${ticks[name] ? "Done" : "Not yet"}: ${why}`;
      /** @type {HTMLElement} */ (link.firstElementChild).textContent = ticks[name] ? "✓" : String(index + 1);
      mark(link, name === current);
    });
    BESIDE.forEach(([name], index) => {
      beside[index].hidden = !test;
      beside[index].href = `${within}?at=${name}`;
      mark(beside[index], name === current);
    });
  }

  /** @type {number | undefined} */
  let later;
  function refresh() {
    clearTimeout(later);
    later = setTimeout(async () => {
      try {
        done = await look();
        draw();
      } catch {
        // the shell shows that the service is silent; the ticks stay
      }
    }, PAUSE_MS);
  }
  for (const name of /** @type {const} */ (["calibration", "test", "step", "camera"])) events.on(name, refresh);
  window.addEventListener(SAVED, refresh);
  events.on("job", (job) => !["queued", "running", "cancelling"].includes(job.state) && refresh());

  const root = h(
    "nav",
    { "aria-label": "Screens" },
    h(
      "ol.path",
      [...links.values()].map((link) => h("li", link)),
    ),
    beside,
    others,
  );
  // a part of the test that is open is only shown: nothing drawn on it is lost
  root.addEventListener("click", (event) => {
    const link = /** @type {Element} */ (event.target).closest("a");
    if (!link || here?.screen !== "test") return;
    const [address, query] = link.hash.split("?");
    if (!here.path.length || address !== location.hash.split("?")[0]) return;
    event.preventDefault();
    history.replaceState(null, "", link.hash);
    here = { ...here, query: new URLSearchParams(query ?? "") };
    draw();
    goTo(here.query.get("at") ?? "");
  });
  /** @param {Here} now */
  const moved = (now) => {
    here = now;
    remember(now.screen, now.path[0]);
    draw();
    refresh();
  };
  return { root, moved };
}
