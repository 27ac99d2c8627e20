// The sample of an empty service: a notched sheet in tension, imported and measured as anybody's own images are.
import * as api from "../../lib/api.js";
import { analysisJob } from "../../widgets/analysis_job.js";
import { h, replace, action } from "../../lib/dom.js";

/** @import { Body } from "#routes" */
/** @typedef {{ cam1: string, cam2: string, label: string, channels: { [name: string]: number } }} Step */
/** @typedef {{ name: string, specimen: string, notes: string, steps: Step[], recipe: Body<"put", "/tests/{test_id}/workspace"> }} Sample */

/** @param {string} name of a file that the page brings along */
const file = async (name) => api.raw(/** @type {`/jobs`} */ (new URL(`../../sample/${name}`, import.meta.url).href));

/** @param {{ [name: string]: string | [Blob, string] }} fields */
function form(fields) {
  const filled = new FormData();
  for (const [name, value] of Object.entries(fields)) {
    if (typeof value === "string") filled.append(name, value);
    else filled.append(name, ...value);
  }
  return filled;
}

/**
 * Import the sample and begin its analysis.
 * @param {(text: string) => void} tell
 */
async function make(tell) {
  tell("Importing the sample's calibration ...");
  /** @type {Sample} */
  const { steps, recipe, ...about } = await (await file("sample.json")).json();
  const calibration = await (await file("calibration.json")).blob();
  const label = `${about.name}: its cameras`;
  const { id: calibration_id } = await api.upload("/calibrations:import", form({ file: [calibration, "calibration.json"], label }));
  const { id } = await api.post("/tests", { ...about, calibration_id });
  for (const [n, { cam1, cam2, label, channels }] of steps.entries()) {
    tell(`Importing pair ${n + 1} of ${steps.length} ...`);
    const pair = await Promise.all([cam1, cam2].map(async (name) => (await file(name)).blob()));
    const fields = { cam1: /** @type {[Blob, string]} */ ([pair[0], cam1]), cam2: /** @type {[Blob, string]} */ ([pair[1], cam2]) };
    await api.upload(`/tests/${id}/steps:import`, form({ ...fields, label, channels: JSON.stringify(channels) }));
  }
  await api.put(`/tests/${id}/workspace`, recipe);
  const { job, analysis_id } = await api.post(`/tests/${id}/analyses`, { ...recipe.settings, region: recipe.region ?? undefined, label: "sample" });
  return { id, job, analysis: analysis_id };
}

/** The offer, with its progress; `data-going` while it is taken. */
export function tryIt() {
  const progress = h("div", { role: "status" });
  async function run() {
    const { id, job, analysis } = await make((text) => replace(progress, h("p", text)));
    const { root: row, draw } = analysisJob({ testId: id, analysisId: analysis, jobId: job.id, follow: false });
    replace(progress, row);
    const ended = await api.finished(job.id, { onprogress: draw });
    if (ended.state !== "succeeded") throw api.jobProblem(ended);
    if (root.isConnected) location.hash = `#/results/${id}/${analysis}?step=3&field=eyy`;
  }
  const start = action(
    "Try it",
    async () => {
      root.dataset.going = "yes";
      try {
        await run();
      } finally {
        delete root.dataset.going;
      }
    },
    { kind: "primary" },
  );
  const text = "No test yet. A sample is at hand: a sheet with a notch in tension, at three loads. It is imported and measured in a minute.";
  const root = h("div", h("p", text), start, progress);
  return root;
}
