// The list of the tests: a picture, the number of steps and the newest analysis' state of each; found by a word, deleted.
import * as api from "../../lib/api.js";
import * as events from "../../lib/events.js";
import { continueButton } from "../../widgets/analyses_table.js";
import { allTests } from "../results/analysis.js";
import { tryIt } from "./sample.js";
import { stateBadge } from "../results/warnings.js";
import { h, replace, action, confirmed, count, numeric, table, when, notify } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"TestEntry">} Entry */
/** @typedef {Model<"TestReply">} Test */

const PART = 30; // tests shown at first, and with each press of More: each asks for its steps and analyses

export async function testsList() {
  const list = h("div");
  const wanted = h("input", { type: "search", "aria-label": "Find a test", placeholder: "Find a test", oninput: () => draw() });
  /** @type {Entry[]} */
  let tests = [];
  let most = PART;
  /** @type {Map<string, Promise<Test>>} */
  const known = new Map();

  /** @param {string} id */
  function whole(id) {
    const test = known.get(id) ?? api.get(`/tests/${id}`);
    known.set(id, test);
    return test;
  }

  /**
   * A cell that is filled once the test's steps and analyses are known.
   * @param {(test: Test) => import("#dom").Part} fill
   */
  const later =
    (fill) =>
    (/** @type {Entry} */ { id }) => {
      const cell = h("span.row");
      whole(id).then(
        (test) => replace(cell, fill(test)),
        () => known.delete(id), // deleted meanwhile, or no answer: asked again at the next drawing
      );
      return cell;
    };

  /** @param {Test} test */
  function picture(test) {
    const first = test.steps?.[0];
    return first
      ? h("img.thumb", { loading: "lazy", alt: "", width: 66, src: api.address(`/tests/${test.id}/steps/${first.n}/cam1/preview`, { width_px: 132 }) })
      : null;
  }

  /** @param {Test} test */
  function state(test) {
    const newest = test.analyses?.at(-1);
    if (!newest?.state) return h("span.quiet", test.n_steps ? "not measured" : "no steps");
    const of = { testId: test.id, analysisId: newest.id, state: newest.state, failed: newest.steps_failed?.length, label: test.name };
    return [h("a", { href: `#/results/${test.id}/${newest.id}` }, stateBadge(newest.state, newest.warnings)), continueButton(of)];
  }

  /** @param {Entry} test */
  async function remove(test) {
    const text = `${test.name}, with its images and results, is moved to the trash. An administrator can restore it.`;
    if (!(await confirmed("Delete this test?", h("p", text), "Delete"))) return;
    await api.remove(`/tests/${test.id}`);
    await refresh();
  }

  const offer = tryIt();
  function draw() {
    if (!tests.length || offer.dataset.going) {
      replace(list, offer); // it stays until its results are shown
      return;
    }
    const word = wanted.value.trim().toLowerCase();
    const found = tests.filter((test) => `${test.name} ${test.specimen ?? ""} ${test.id}`.toLowerCase().includes(word));
    replace(
      list,
      table(
        [
          ["Picture", later(picture), { unseen: true }],
          ["Test", (test) => h("a", { href: `#/test/${test.id}` }, test.name)],
          ["Specimen", (test) => test.specimen || "–"],
          numeric(
            "Steps",
            later((test) => count(test.n_steps)),
          ),
          ["State", later(state)],
          ["Made", (test) => when(test.created_utc)],
          ["Delete", (test) => action("Delete", () => remove(test), { kind: "plain", "aria-label": `Delete ${test.name}` }), { unseen: true }],
        ],
        found.slice(0, most),
        {
          caption: "Tests, newest first",
          onrow: (test) => {
            location.hash = `#/test/${test.id}`;
          },
          empty: "No test has this in its name, specimen or id.",
        },
      ),
      found.length > most ? h("button", { type: "button", onclick: more }, `Show more of ${found.length}`) : null,
    );
  }
  function more() {
    most += PART;
    draw();
  }
  async function refresh() {
    tests = await allTests();
    draw();
  }
  await refresh();
  const ends = [
    events.on("test", () => refresh().catch(notify)),
    events.on("job", ({ kind, state: now, subject, progress }) => {
      const id = String(subject?.test_id ?? "");
      if (kind !== "analysis" || (now === "running" && progress?.done)) return; // its beginning and its end are shown
      known.delete(id);
      if (tests.slice(0, most).some((test) => test.id === id)) draw();
    }),
  ];
  return { root: h("section.panel", h("div.spread", h("h2", "All tests"), wanted), list), close: () => ends.forEach((end) => end()) };
}
