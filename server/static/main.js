// The shell: bar with the stop button, screens by address, messages about connection and key.
import * as api from "./lib/api.js";
import * as events from "./lib/events.js";
import { goTo, path as guidedPath } from "./widgets/path.js";
import { h, replace, notify, badge, num, field, part, problemText, ask, modal } from "./lib/dom.js";

/** @typedef {() => void} Leave */
/** @typedef {{ screen: string, path: string[], query: URLSearchParams }} Here parts of the address */
/** @typedef {{ open: (root: HTMLElement, here: Here) => Promise<Leave> }} Screen */

/** @type {Record<string, [text: string, load: () => Promise<Screen>]>} */
const SCREENS = {
  rig: ["Rig", () => import("./screens/rig.js")],
  calibrate: ["Calibrate", () => import("./screens/calibrate.js")],
  test: ["Test", () => import("./screens/test.js")],
  results: ["Results", () => import("./screens/results.js")],
  jobs: ["Jobs & system", () => import("./screens/jobs.js")],
};

const main = part("main");
const bar = part("bar");
/** @type {Leave | null} */
let leave = null;
let visit = 0;
let shown = ""; // the screen

/** "#/test/t000001-52d4a7?step=3" -> {screen, path, query} */
function route() {
  const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
  const [screen, ...rest] = path.split("/").filter(Boolean).map(decodeURIComponent);
  return { screen: SCREENS[screen] ? screen : "rig", path: rest, query: new URLSearchParams(query ?? "") };
}

async function open() {
  const here = route();
  visit += 1;
  const mine = visit;
  guide.moved(here);
  if (here.screen === "jobs") jobsLink.setAttribute("aria-current", "page");
  else jobsLink.removeAttribute("aria-current");
  document.title = `${SCREENS[here.screen][0]} · stereorig`;
  // notes and questions of another screen do not belong to this one
  if (here.screen !== shown) for (const old of part("notices").querySelectorAll(".notice.bad")) old.remove();
  for (const dialog of /** @type {NodeListOf<HTMLDialogElement>} */ (document.querySelectorAll("dialog[open]:not([data-stays])"))) {
    dialog.dispatchEvent(new Event("cancel", { cancelable: true }));
  }
  shown = here.screen;
  leave?.();
  leave = null;
  replace(main, h("p.quiet", "Loading …"));
  try {
    const screen = await SCREENS[here.screen][1]();
    if (mine !== visit) return;
    const root = h("div", { "data-screen": here.screen });
    const ended = await screen.open(root, here);
    if (mine !== visit) {
      ended?.();
      return;
    }
    leave = ended;
    replace(main, root);
    root.dispatchEvent(new Event("shown"));
    if (here.screen === "test") goTo(route().query.get("at") ?? ""); // another part may have been chosen while it loaded
  } catch (error) {
    if (mine === visit) replace(main, h("div.panel", h("h1", SCREENS[here.screen][0]), problemText(error)));
  }
}

async function stop() {
  stopButton.textContent = "STOPPING …";
  try {
    const answer = await api.post("/stage:stop");
    notify(
      `The stop command was sent after ${num(answer.elapsed_ms, 3)} ms.${answer.cancelled_job ? " The job that moved the axis was cancelled." : ""}`,
      "good",
    );
  } catch (error) {
    notify(error);
  } finally {
    stopButton.textContent = "STOP";
  }
}

const jobsLink = h("a", { href: "#/jobs", "data-screen": "jobs" }, SCREENS.jobs[0]);
const guide = guidedPath(jobsLink);
const stopButton = h("button.stop", { type: "button", id: "stop", onclick: stop, title: "Stop every axis at once (Esc, twice)" }, "STOP");
const stageText = h("span", { id: "bar-stage", title: "Stage position" });
const jobText = h("a", { href: "#/jobs", id: "bar-job", hidden: true });
const person = h("span");
const lost = h("div.banner", { hidden: true, role: "alert" });

const dark = matchMedia("(prefers-color-scheme: dark)");
function theme() {
  // the first press always changes the colours; the third goes back to the system's colours
  const order = dark.matches ? ["", "light", "dark"] : ["", "dark", "light"];
  const now = document.documentElement.dataset.theme ?? "";
  const next = order[(order.indexOf(now) + 1) % 3];
  if (next) document.documentElement.dataset.theme = next;
  else delete document.documentElement.dataset.theme;
  localStorage.setItem("theme", next);
  themeButton.title = `Colours: ${next || "as the system"}`;
  window.dispatchEvent(new Event("themechange"));
}
const themeButton = h("button.plain", { type: "button", onclick: theme, "aria-label": "Light or dark colours" }, "◐");

function drawBar() {
  replace(
    bar,
    h("a.brand", { href: "#/rig" }, h("img", { src: "/static/icon.svg", alt: "", width: 24, height: 24 }), "stereorig"),
    guide.root,
    h("div.status", jobText, stageText, person, h("a", { href: "/docs", title: "The HTTP API" }, "API"), keysButton, themeButton),
    stopButton,
    lost,
  );
}

let escaped = -Infinity;
// in the capture phase: the stop works wherever the focus is, in a drawing or a dialog too
const twice = (/** @type {KeyboardEvent} */ event) => {
  if (event.key !== "Escape") return;
  if (event.timeStamp - escaped < 1500) stop();
  escaped = event.timeStamp;
};
window.addEventListener("keydown", twice, true);
window.addEventListener("stopstage", stop);

const KEYS = [
  ["Esc, twice", "Stops every axis at once, from anywhere"],
  ["On a picture", ""],
  ["arrow keys", "Move the picture; with Shift farther"],
  ["+, −, 0, 1", "Zoom in, zoom out, fit, one picture pixel on one screen pixel"],
  ["c", "Cross-hair on or off"],
  ["Enter", "Begin to point: the values under the cross-hair are shown below the picture"],
  ["While pointing or drawing", ""],
  ["arrow keys", "Move the cross-hair by 1 px; with Shift by 10 px, with Alt by 0.1 px"],
  ["Enter", "Set a point, or read it; at the last point once more ends a polygon, hole or crack"],
  ["Backspace", "Take one point back"],
  ["Escape", "Leave"],
  ["Ctrl+Z, Ctrl+Y", "Undo, redo"],
  ["Corners and ends of a drawing", ""],
  ["Tab", "Moves the focus to them"],
  ["arrow keys", "Move one by 1 px; with Shift by 10 px, with Alt by 0.1 px"],
  ["Delete", "Remove one"],
  ["On the 3-D surface", ""],
  ["arrow keys, +, −, 0", "Rotate, zoom, reset the view"],
];
function showKeys() {
  const rows = KEYS.map(([keys, what]) => (what ? h("tr", h("td", h("kbd", keys)), h("td", what)) : h("tr", h("th", { colspan: 2, scope: "rowgroup" }, keys))));
  return ask("Keys", h("div.scroll", { tabindex: 0, role: "region", "aria-label": "Keys and their actions" }, h("table.keys", h("tbody", rows))), [
    ["Close", null],
  ]);
}
const keysButton = h("button.plain", { type: "button", onclick: showKeys, "aria-label": "Keys", title: "Keys" }, "⌨");

const ACTIVE = ["queued", "running", "cancelling"];
/** @type {Map<string, import("#routes").Model<"JobReply">>} */
const active = new Map();
function showJobs() {
  const jobs = [...active.values()];
  const job = jobs.find((one) => one.state === "running") ?? jobs[0];
  if (!job) {
    jobText.hidden = true; // a link without a text is none
    return;
  }
  const { phase: stage, done, total } = job.progress ?? {};
  const share = total ? ` ${Math.floor((100 * done) / total)} %` : "";
  jobText.hidden = false;
  const text = `${job.kind}: ${stage ?? job.state}${share}${jobs.length > 1 ? ` (+${jobs.length - 1})` : ""}`;
  jobText.title = text; // its end is cut off if there is little room
  replace(jobText, badge(text, "busy"));
}

/** @type {Set<string>} */
let toldSince = new Set(); // jobs of which an event came after the list was asked for: it is the newer word
events.on("job", (job) => {
  toldSince.add(job.id);
  if (ACTIVE.includes(job.state)) active.set(job.id, job);
  else active.delete(job.id);
  showJobs();
});
// one that waits sends no event, and one may have ended while the service did not answer
events.on("open", async () => {
  lost.hidden = true;
  const told = new Set();
  toldSince = told;
  const { jobs } = await api.get("/jobs").catch(() => ({ jobs: null }));
  if (!jobs || told !== toldSince) return;
  for (const id of active.keys()) if (!told.has(id)) active.delete(id);
  for (const job of jobs) if (ACTIVE.includes(job.state) && !told.has(job.id)) active.set(job.id, job);
  showJobs();
});

async function showStage() {
  if (document.hidden) return;
  try {
    const stage = await api.get("/stage");
    stageText.textContent = (stage.axes ?? [])
      .map((axis) => `${axis.cameras?.join("+") || `axis ${axis.axis}`} ${num(axis.position_mm, 5)} mm${axis.moving ? " ▸" : ""}`)
      .join("  ");
    stageText.title = stage.fault ? stage.fault.detail : "Stage position";
  } catch {
    stageText.textContent = "stage: unknown";
  }
}

let asking = false;
async function askForKey() {
  if (asking) return;
  asking = true;
  const input = h("input", { type: "password", autocomplete: "current-password", required: true });
  const problem = h("div");
  const dialog = h(
    "dialog",
    { "aria-label": "Log in", "data-stays": true },
    h(
      "form",
      {
        method: "dialog",
        onsubmit: async (event) => {
          event.preventDefault();
          try {
            await api.login(input.value.trim());
            dialog.close();
            asking = false;
            begin();
          } catch (error) {
            replace(problem, problemText(error));
          }
        },
      },
      h("h2", "This service requires a key"),
      h("p.quiet", "An administrator makes one with ", h("code", "stereorig keys add NAME --role operator"), "."),
      field("Key", input),
      problem,
      h("div.row.end", h("button.primary", { type: "submit" }, "Log in")),
    ),
  );
  dialog.addEventListener("cancel", (event) => event.preventDefault());
  modal(dialog, input);
}

api.onConnection((state) => {
  if (state === "login") askForKey();
  lost.hidden = state !== "down";
  if (state === "down")
    lost.textContent = "The service does not answer. The values shown may be out of date; the page continues by itself once the service answers.";
});

async function logOut() {
  await api.remove("/session");
  location.reload();
}

/** @type {number | undefined} */
let ticking;
async function begin() {
  let who;
  try {
    who = await api.get("/session");
  } catch (error) {
    if (!(error instanceof api.Problem && error.status === 401)) {
      lost.hidden = false;
      setTimeout(begin, 2000);
    }
    return;
  }
  if (who.name === "local") person.replaceChildren();
  else replace(person, `${who.name} (${who.role}) `, h("button.plain", { type: "button", title: "Log out", onclick: logOut }, "⏏"));
  events.start();
  clearInterval(ticking);
  ticking = setInterval(showStage, 1000);
  showStage();
  open();
}

const kept = localStorage.getItem("theme");
if (kept) document.documentElement.dataset.theme = kept;
drawBar();
SCREENS[route().screen][1]().catch(() => {}); // its script loads during the session request
window.addEventListener("hashchange", open);
document.querySelector(".skip")?.addEventListener("click", (event) => {
  event.preventDefault(); // the address names the screen
  main.focus();
});
// the bar does not cover the control in focus
new ResizeObserver(() => document.documentElement.style.setProperty("scroll-padding-top", `${bar.offsetHeight + 8}px`)).observe(bar);
begin();
