// Running and ended jobs, and the state of the system.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { certificates } from "./certificates.js";
import { stateBadge, warningsBox } from "./results/warnings.js";
import { continueButton } from "../widgets/analyses_table.js";
import { duration, times } from "../lib/units.js";
import { h, replace, action, badge, count, definitions, num, quantity, table, when, problemText, STATE_KIND } from "../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"JobReply">} Job */
/** @typedef {Map<string, { key: string, line: string }[]>} Log lines of each job */

/** @param {HTMLElement} root */
export async function open(root) {
  const list = h("div");
  const detail = h("section.panel", { "aria-live": "polite" }, h("p.quiet", "Choose a job to see its log."));
  const health = h("section.panel");
  /** @type {Map<string, Job>} */
  const jobs = new Map();
  let chosen = "";
  /** @type {Map<string, string>} names of the tests that jobs are for */
  const names = new Map();
  async function nameTests() {
    const wanted = [...new Set([...jobs.values()].map((job) => job.subject?.test_id).filter((id) => typeof id === "string"))].filter((id) => !names.has(id));
    for (const id of wanted) names.set(id, ""); // asked once
    await Promise.all(
      wanted.map((id) =>
        api.get(`/tests/${id}`).then(
          (test) => {
            names.set(id, test.name);
          },
          () => {},
        ),
      ),
    );
    if (wanted.length) draw();
  }
  /** @type {Log} */
  const log = new Map();

  function draw() {
    const rows = [...jobs.values()].sort((a, b) => b.id.localeCompare(a.id));
    replace(
      list,
      table(
        [
          ["Job", (job) => h("button.plain", { type: "button", onclick: () => choose(job) }, h("code", job.id))],
          ["Kind", (job) => job.kind],
          ["For", (job) => subject(job, names)],
          ["State", state],
          ["Progress", progress],
          ["Begun", (job) => when(job.started_utc ?? job.created_utc)],
          ["Cancel or continue", (job) => (["queued", "running"].includes(job.state) ? cancel(job) : goOn(job)), { unseen: true }],
        ],
        rows,
        { caption: "Jobs, newest first", onrow: choose, empty: "No job has run yet." },
      ),
    );
  }

  /** @param {Job} job */
  function choose(job) {
    chosen = job.id;
    show();
  }
  function show() {
    const job = jobs.get(chosen);
    if (job) replace(detail, about(job, log.get(job.id) ?? []));
  }

  /** @param {Job} job */
  const cancel = (job) =>
    action(
      "Cancel",
      async () => {
        take(await api.post(`/jobs/${job.id}:cancel`));
      },
      { kind: "danger", "aria-label": `Cancel ${job.kind} ${job.id}` },
    );

  /** An analysis that stopped, unless a later job works on it. @param {Job} job */
  function goOn(job) {
    const { test_id: testId, analysis_id: analysisId } = job.subject ?? {};
    if (job.kind !== "analysis" || !testId || !analysisId) return null;
    if ([...jobs.values()].some((other) => other.subject?.analysis_id === analysisId && other.id > job.id)) return null;
    const failed = Object.keys(job.result?.steps_failed ?? {}).length;
    return continueButton({ testId: String(testId), analysisId: String(analysisId), state: job.state, failed, label: `analysis ${analysisId}` });
  }

  /** @param {Job} job */
  function take(job) {
    jobs.set(job.id, { ...jobs.get(job.id), ...job });
    note(log, job);
    draw();
    nameTests();
    if (job.id === chosen) show();
  }

  async function refresh() {
    for (const job of (await api.get("/jobs", { limit: 100 })).jobs) {
      jobs.set(job.id, job);
      if (!log.has(job.id)) note(log, job);
    }
    draw();
    nameTests();
  }

  const kept = certificates();
  const ended = events.on("job", take);
  await refresh();
  system(health);
  const timer = setInterval(() => system(health), 3000);
  replace(root, h("h1", "Jobs and system"), h("div.grid.side", h("div", h("section.panel", list), detail), h("div", health, kept.element)));
  return () => {
    ended();
    kept.close();
    clearInterval(timer);
  };
}

/**
 * @param {Log} log
 * @param {Job} job
 */
function note(log, job) {
  const { phase: stage, done, total } = job.progress ?? {};
  const line = `${new Date().toLocaleTimeString()}  ${job.state}  ${stage ?? ""} ${total ? `${done}/${total}` : ""}`.trim();
  const lines = log.get(job.id) ?? [];
  const key = `${job.state} ${stage}`;
  if (lines.length && lines[lines.length - 1].key === key) lines[lines.length - 1] = { key, line };
  else lines.push({ key, line });
  log.set(job.id, lines.slice(-200));
}

/**
 * The subject of a job, with the name that people gave it.
 * @param {Job} job
 * @param {Map<string, string>} names
 */
function subject(job, names) {
  const { test_id: test, analysis_id: analysis, calibration_id: calibration } = /** @type {Record<string, string | undefined>} */ (job.subject ?? {});
  if (test) return h("a", { href: analysis ? `#/results/${test}/${analysis}` : `#/test/${test}` }, names.get(test) || test);
  return calibration ? h("a", { href: `#/calibrate/${calibration}` }, "calibration") : "–";
}

/** @param {Job} job */
const state = (job) => stateBadge(job.state, warningsOf(job));
const warningsOf = (/** @type {Job} */ job) => /** @type {import("./results/warnings.js").Warning[] | undefined} */ (job.result?.warnings);

/** @param {Job} job */
function progress(job) {
  const { phase: stage, done, total, eta_s: eta } = job.progress ?? {};
  if (["succeeded", "failed", "cancelled", "interrupted"].includes(job.state))
    return job.finished_utc && job.started_utc ? duration((Date.parse(job.finished_utc) - Date.parse(job.started_utc)) / 1000) : "";
  return h(
    "div",
    h("progress", { value: total ? done : null, max: total || 1, "aria-label": `Progress of ${job.kind}` }),
    h("small", `${stage ?? ""} ${total ? `${num((100 * done) / total, 3)} %` : ""}${eta ? `, ${duration(eta)} left` : ""}`),
  );
}

/**
 * @param {Job} job
 * @param {{ line: string }[]} log
 */
const about = (job, log) => [
  h("div.spread", h("h2", `${job.kind} `, h("code", job.id)), state(job)),
  warningsBox(warningsOf(job)),
  definitions([
    ["created", when(job.created_utc)],
    ["started", when(job.started_utc)],
    ["finished", when(job.finished_utc)],
    ...Object.entries(job.subject ?? {}).map(([name, value]) => /** @type {const} */ ([name, link(name, value, job.subject)])),
  ]),
  job.problem ? problemText(api.problemOf(job.problem)) : null,
  h("h3", "Log"),
  h(
    "pre.scroll",
    { tabindex: 0, role: "region", "aria-label": "Log of the job" },
    log.map((one) => `${one.line}\n`),
  ),
  job.result
    ? h(
        "details",
        h("summary", "Result as returned by the API"),
        h("pre.scroll", { tabindex: 0, role: "region", "aria-label": "Result of the job" }, JSON.stringify(job.result, null, 1)),
      )
    : null,
];

/**
 * @param {string} name
 * @param {unknown} value
 * @param {Job["subject"]} subject
 */
function link(name, value, subject) {
  if (name === "test_id") return h("a", { href: `#/test/${value}` }, String(value));
  if (name === "analysis_id" && subject.test_id) return h("a", { href: `#/results/${subject.test_id}/${value}` }, String(value));
  if (name === "calibration_id") return h("a", { href: `#/calibrate/${value}` }, String(value));
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** State of the service. @param {HTMLElement} health */
async function system(health) {
  if (document.hidden) return;
  try {
    const [well, metrics] = await Promise.all([api.get("/healthz"), api.raw("/metrics").then((r) => r.text())]);
    const value = (/** @type {string} */ name) => {
      const found = new RegExp(`^${name}(?:\\{[^}]*\\})? ([-+0-9.eE]+)$`, "m").exec(metrics);
      return found ? Number(found[1]) : null;
    };
    const free = value("stereorig_disk_free_bytes");
    const ready = value("stereorig_ready") === 1;
    replace(
      health,
      h("div.spread", h("h2", "System"), badge(ready ? "ready" : "not ready", ready ? "good" : "warn")),
      ready ? null : action("Show the cause", () => api.get("/readyz")),
      definitions([
        ["version", well.version],
        ["uptime", duration(well.uptime_s)],
        ["rig", badge(well.rig, STATE_KIND[well.rig])],
        ["compute worker", badge(well.worker, STATE_KIND[well.worker])],
        ["free on the disk", free === null ? "–" : quantity(free / 2 ** 30, "GiB", 4)],
        ["jobs running or waiting", count(value("stereorig_jobs_active"))],
        ["analyses waiting", count(value("stereorig_compute_queue"))],
        ["compute worker started", times(value("stereorig_worker_starts_total"))],
      ]),
      h("p", h("a", { href: `${api.BASE}/metrics` }, "All figures"), " · ", h("a", { href: "/docs" }, "HTTP API")),
    );
  } catch (error) {
    replace(health, h("h2", "System"), problemText(error));
  }
}
