// The list of the tests with their analyses.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { h, replace, table, when, count, definitions, problemText } from "../../lib/dom.js";
import { ENDED } from "../../widgets/analysis_job.js";
import { allTests } from "./analysis.js";
import { analysesTable } from "../../widgets/analyses_table.js";

/**
 * @param {HTMLElement} root
 * @param {string | undefined} testId
 */
export async function list(root, testId) {
  const tests = await allTests();
  const detail = h("section.panel", { "aria-live": "polite" });
  /** @type {{ id: string } | undefined} */
  let chosen = tests.find((one) => one.id === testId) ?? tests[0];
  /** @param {{ id: string }} test */
  async function choose(test) {
    if (test.id !== chosen?.id) replace(detail, h("p.quiet", "Loading …"));
    chosen = test;
    try {
      const whole = await api.get(`/tests/${test.id}`);
      if (chosen !== test) return;
      replace(
        detail,
        h("div.spread", h("h2", whole.name), h("a", { href: `#/test/${whole.id}` }, "the test")),
        definitions([
          ["specimen", whole.specimen || "–"],
          ["made", when(whole.created_utc)],
          ["steps", count(whole.n_steps)],
          ["calibration", whole.calibration_id ?? "–"],
        ]),
        h("h3", "Analyses"),
        analysesTable(whole, () => choose(test)),
        whole.analyses?.length ? null : h("a.button", { href: `#/test/${test.id}?at=region` }, "Measure it"),
      );
    } catch (error) {
      replace(detail, problemText(error));
    }
  }
  replace(
    root,
    h("h1", "Results"),
    h(
      "div.grid.two",
      h(
        "section.panel",
        table(
          [
            ["Test", (one) => h("button.plain", { type: "button", onclick: () => choose(one) }, one.name || one.id)],
            ["Specimen", (one) => one.specimen],
            ["Made", (one) => when(one.created_utc)],
          ],
          tests,
          { caption: "Tests, newest first", onrow: choose, empty: "There is no test yet." },
        ),
      ),
      detail,
    ),
  );
  if (chosen) choose(chosen);
  else replace(detail, h("p.quiet", "Results appear here once a test was measured."), h("a.button.primary", { href: "#/test" }, "Make a test"));
  const again = (/** @type {unknown} */ id) => (chosen && id === chosen.id ? choose(chosen) : null);
  const ends = [
    events.on("result", (event) => again(event.test_id)),
    events.on("job", (job) => (ENDED.includes(job.state) ? again(job.subject?.test_id) : null)),
  ];
  return () => ends.forEach((end) => end());
}
