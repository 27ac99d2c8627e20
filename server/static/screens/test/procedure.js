// A verification procedure in a test: its plan, ticks of the steps taken, the next step and its actor, the certificate.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { h, replace, field, action, table, notify, problemText } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */
/** @import { Model } from "#routes" */
/** @typedef {Model<"ProcedureReply">} Procedure */
/** @typedef {Procedure["steps"][number]} Step */

const BY = { rest: "nothing moves", stage: "the stage", hand: "by hand" };
const MARK = { taken: "✓", missing: "✗", to_come: "" };
const SAID = { taken: "taken", missing: "missing", to_come: "to come" };
const EXAMPLE = {
  title: "Bench",
  static_steps: [1, 2, 3],
  translations: [
    { n: 4, translation_mm: [0, 0, 0.5], u_mm: 0.0005 },
    { n: 5, translation_mm: [0, 0, -0.5], u_mm: 0.0005 },
    { n: 6, translation_mm: [0, 0, 1], u_mm: 0.0005 },
  ],
  rotations: [{ n: 7 }],
};

/**
 * @param {string} id of the test
 * @param {Ends} ends
 */
export function procedurePanel(id, ends) {
  const body = h("div");
  const root = h("details.panel", { "data-role": "procedure" }, h("summary", "Verify this bench: a guided procedure"), body);
  root.addEventListener("toggle", () => {
    if (root.open) load();
  });

  async function load() {
    try {
      draw(await api.get(`/tests/${id}/certificate-plan`));
    } catch (error) {
      replace(body, problemText(error));
    }
  }

  /**
   * Ask for the plan.
   * @param {object} plan
   * @param {number} frames
   */
  function ask(plan, frames) {
    const text = h("textarea", { rows: 12, spellcheck: false, value: JSON.stringify(plan, null, 1) });
    const average = h("input", { type: "number", min: 1, max: 256, value: String(frames) });
    const said = h("div", { role: "status" });
    replace(
      body,
      h(
        "p",
        "State the known values of each step, by the number that the test will give it; step 0 is the reference. The stage makes ways along Z alone if it moves the target or both cameras; all others are made by hand.",
      ),
      field("Plan", text),
      field("Frames averaged", average),
      said,
      action(
        "Plan the procedure",
        async () => {
          try {
            draw(await api.put(`/tests/${id}/certificate-plan`, { plan: JSON.parse(text.value), frames: Number(average.value) }));
          } catch (error) {
            replace(said, error instanceof SyntaxError ? h("p.problem", `The plan is no JSON: ${error.message}`) : problemText(error));
          }
        },
        { kind: "primary" },
      ),
    );
  }

  /** @param {Procedure} now */
  function draw(now) {
    const { plan } = now;
    if (!plan) return ask(EXAMPLE, 1);
    const next = now.steps.find((one) => one.n === now.next);
    const taken = now.steps.filter((one) => one.state === "taken").length;
    replace(
      body,
      h(
        "p",
        { role: "status", "data-role": "procedure-next" },
        next ? h("strong", `Step ${next.n}: ${next.what}`) : "All steps are taken.",
        ` ${taken} of ${now.steps.length} taken.`,
      ),
      next ? takeButton(id, next, load) : certify(id, plan, body),
      table(
        [
          ["", (/** @type {Step} */ one) => h("span", { title: SAID[one.state], "aria-label": SAID[one.state] }, one.n === now.next ? "▸" : MARK[one.state])],
          ["Step", (one) => one.n],
          ["For", (one) => one.kind],
          ["Who", (one) => BY[one.by]],
          ["What", (one) => one.what],
        ],
        now.steps,
        { caption: "Steps of the procedure" },
      ),
      taken
        ? null
        : h(
            "p",
            action("Change the plan", async () => ask(plan, now.frames)),
          ),
    );
  }

  ends.push(
    events.on("step", (event) => {
      if (event.test_id === id && root.open) load();
    }),
  );
  return root;
}

/**
 * @param {string} id of the test
 * @param {Step} step
 * @param {() => Promise<void>} load
 */
function takeButton(id, step, load) {
  const text = step.by === "hand" ? "It is done: take the step" : step.by === "stage" ? "Move and take the step" : "Take the step";
  return h(
    "p",
    action(
      text,
      async () => {
        const { job } = await api.post(`/tests/${id}/certificate-plan:next`, { confirmed: step.by === "hand" });
        const ended = await api.finished(job.id);
        if (ended.state !== "succeeded") throw api.jobProblem(ended);
        await load();
      },
      { kind: "primary" },
    ),
  );
}

/**
 * @param {string} id of the test
 * @param {NonNullable<Procedure["plan"]>} plan
 * @param {HTMLElement} body
 */
function certify(id, plan, body) {
  return h(
    "div",
    h("p", "Measure all steps with strain (below), then make the certificate from the newest analysis."),
    action(
      "Make the certificate",
      async () => {
        const { analyses } = await api.get(`/tests/${id}`);
        const newest = (analyses ?? []).at(-1);
        if (!newest) return void notify("There is no analysis yet: measure the steps first.", "warn");
        const { job } = await api.post("/certificates", { test_id: id, analysis_id: newest.id, plan });
        const ended = await api.finished(job.id);
        if (ended.state !== "succeeded") throw api.jobProblem(ended);
        const made = String(ended.result?.certificate_id);
        body.append(
          h(
            "p",
            `The verdict is ${ended.result?.outcome}. `,
            h("a", { href: `${api.BASE}/certificates/${made}/report`, target: "_blank", rel: "noopener" }, "Show the certificate"),
          ),
        );
      },
      { kind: "primary" },
    ),
  );
}
