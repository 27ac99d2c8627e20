// The list of the tests with their analyses.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { h, replace, table, when, count, definitions, problemText } from "../../lib/dom.js";
import { allTests } from "./analysis.js";
import { warningsCell } from "./warnings.js";

/**
 * @param {HTMLElement} root
 * @param {string | undefined} testId
 */
export async function list(root, testId) {
  const tests = await allTests();
  const detail = h("section.panel", { "aria-live": "polite" });
  const chosen = tests.find((one) => one.id === testId) ?? tests[0];
  /** @param {{ id: string }} test */
  async function choose(test) {
    replace(detail, h("p.quiet", "Loading …"));
    try {
      const whole = await api.get(`/tests/${test.id}`);
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
        table(
          [
            ["Analysis", (one) => h("a", { href: `#/results/${test.id}/${one.id}` }, one.label || one.id)],
            ["Kind", (one) => one.kind],
            ["Checks", warningsCell],
            ["Begun", (one) => when(one.created_utc)],
          ],
          (whole.analyses ?? []).toReversed(),
          {
            caption: "Analyses of this test, newest first",
            empty: "This test has not been measured yet.",
            onrow: (one) => {
              location.hash = `#/results/${test.id}/${one.id}`;
            },
          },
        ),
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
  return events.on("result", (event) => {
    if (event.test_id === chosen?.id) choose(chosen);
  });
}
