// Tests: make one, capture or import its steps, state its metadata, draw the region, start an analysis.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { readTest } from "../lib/steps.js";
import { stepsPanel } from "./test/steps.js";
import { liveValuesPanel } from "./test/live_values.js";
import { metadataPanel } from "./test/metadata.js";
import { measurePanel } from "./test/measure.js";
import { procedurePanel } from "./test/procedure.js";
import { analysesTable } from "../widgets/analyses_table.js";
import { testsList } from "./test/list.js";
import { allRight, rule } from "../lib/fields.js";
import { h, replace, field, select, action, when, notify, problemText } from "../lib/dom.js";

/** @import { Here } from "../main.js" */
/** @import { Ends } from "#dom" */
/** @import { Model, Reply } from "#routes" */
/** @typedef {Model<"TestReply">} Test */

/**
 * @param {HTMLElement} root
 * @param {Here} here
 */
export async function open(root, { path, query }) {
  return path[0] ? one(root, path[0]) : all(root, query.get("calibration"));
}

/**
 * Calibrations to choose from: the newest accepted one first, then the newest.
 * @param {string} [chosen] of a test; left out: the one to begin with
 */
async function calibrationChoice(chosen) {
  const usable = (await api.get("/calibrations")).calibrations.filter((c) => c.state === "complete" && c.decision !== "discarded").toReversed();
  const first = usable.find((c) => c.decision === "accepted") ?? usable[0];
  const text = (/** @type {Reply<"get", "/calibrations">["calibrations"][number]} */ c) =>
    `${c.label || c.id} · ${c.verdict?.level ?? "imported"}${c.decision === "accepted" ? " · accepted" : ""} · ${when(c.created_utc)}`;
  /** @type {[string, string][]} */
  const options = usable.map((c) => [c.id, text(c)]);
  if (chosen === undefined) return select([...options, ["", "none: images only"]], first?.id ?? "");
  if (chosen && !usable.some((c) => c.id === chosen)) options.unshift([chosen, `${chosen} · gone or discarded since`]);
  return select(chosen ? options : [["", usable.length ? "choose one …" : "there is none yet"], ...options], chosen);
}

/**
 * @param {HTMLElement} root
 * @param {string | null} asked calibration that was chosen on the way here
 */
async function all(root, asked) {
  const name = h("input", { type: "text", maxlength: 300, required: true });
  const specimen = h("input", { type: "text", maxlength: 300 });
  const notes = h("textarea", { rows: 2, maxlength: 20000 });
  const calibration = await calibrationChoice();
  if (asked && [...calibration.options].some((one) => one.value === asked)) calibration.value = asked;
  const named = rule(name, (text) => (text ? "" : "The test has no name. Give it one; it can be changed later."));
  const uncalibrated = calibration.value
    ? null
    : h(
        "div.caution",
        { role: "status" },
        h("p", "No calibration can be used yet: images can be taken, and measured once there is one."),
        h("a.button", { href: "#/calibrate" }, "Calibrate first"),
      );
  const make = action(
    "Make the test",
    async () => {
      if (!allRight([[name, named]])) return;
      const made = await api.post("/tests", {
        name: name.value.trim(),
        specimen: specimen.value,
        notes: notes.value,
        calibration_id: calibration.value || null,
      });
      location.hash = `#/test/${made.id}?at=capture`;
    },
    { kind: "primary" },
  );
  const list = await testsList();
  replace(
    root,
    h("h1", "Tests"),
    h(
      "div.grid.side",
      list.root,
      h(
        "section.panel",
        { "aria-label": "New test" },
        h("h2", "New test"),
        field("Name", name),
        field("Specimen", specimen),
        field("Calibration", calibration, "", "The test keeps its own copy."),
        field("Notes", notes),
        uncalibrated,
        make,
      ),
    ),
  );
  return list.close;
}

/**
 * @param {HTMLElement} root
 * @param {string} id
 */
async function one(root, id) {
  /** @type {Ends} */
  const ends = [];
  let test = await readTest(id);
  const head = h("section.panel", { "aria-label": "About the test" });
  const analyses = h("section.panel", { "aria-label": "Analyses" });

  /** @param {import("#routes").Body<"patch", "/tests/{test_id}">} changes */
  async function change(changes) {
    const { etag } = await api.getTagged(`/tests/${id}`);
    return api.patch(`/tests/${id}`, changes, etag === null ? {} : { "If-Match": etag });
  }
  /** @param {string} calibration */
  async function calibrate(calibration) {
    test = await change({ calibration_id: calibration });
    drawHead();
    await measure.steps(test);
    notify("New analyses are measured with this calibration.", "good");
  }
  let drawn = 0;
  function drawHead() {
    drawn += 1;
    const mine = drawn;
    const calibration = h("div", { "data-role": "calibration" });
    calibrationRow(test, calibrate).then(
      (row) => {
        if (mine === drawn) replace(calibration, row);
      },
      (error) => replace(calibration, problemText(error)),
    );
    const name = h("input", { type: "text", maxlength: 300, value: test.name });
    const specimen = h("input", { type: "text", maxlength: 300, value: test.specimen });
    const notes = h("textarea", { rows: 3, maxlength: 20000, value: test.notes });
    replace(
      head,
      h("p", test.specimen ? `${test.specimen} · ` : "", `made ${when(test.created_utc)} · `, h("code", test.id)),
      test.notes ? h("p.quiet", test.notes) : null,
      calibration,
      h(
        "details",
        h("summary", "Name, specimen and notes"),
        h("div.fields", field("Name", name), field("Specimen", specimen)),
        field("Notes", notes),
        action("Save", async () => {
          test = await change({ name: name.value, specimen: specimen.value, notes: notes.value });
          title.textContent = test.name;
          drawHead();
          notify("Saved.", "good");
        }),
      ),
      metadataPanel(id),
    );
  }
  const again = async () => {
    test = await readTest(id);
    drawAnalyses();
  };
  const drawAnalyses = () => replace(analyses, h("h2", "Analyses"), analysesTable(test, again));
  const title = h("h1", test.name);
  const steps = await stepsPanel(id, test, ends, async () => {
    test = await readTest(id);
    return test;
  });
  const liveValues = await liveValuesPanel(id, ends);
  const measure = await measurePanel(id, test, ends, again);
  steps.onchange((/** @type {typeof test} */ fresh) => {
    test = fresh;
    measure.steps(fresh);
  });
  drawHead();
  drawAnalyses();
  // at most five times a second, and once more after the last one: a burst's steps come faster than they rest
  let later = 0;
  let more = false;
  function soon() {
    more = true;
    if (later) return;
    later = window.setTimeout(async () => {
      more = false;
      await steps.refresh().catch(notify);
      later = 0;
      if (more) soon();
    }, 200);
  }
  ends.push(
    events.on("step", (event) => {
      if (event.test_id === id) soon();
    }),
    () => {
      clearTimeout(later);
      more = false;
    },
  );
  replace(
    root,
    h("div.spread", title, measure.head, h("a", { href: "#/test" }, "All tests")),
    h("div.grid.parts", head, steps.root, procedurePanel(id, ends), measure.root, liveValues, analyses),
  );
  return () => ends.forEach((end) => end());
}

/**
 * The calibration that new analyses are measured with; a test without one shows the way to one.
 * @param {Test} test
 * @param {(calibration: string) => Promise<void>} calibrate
 */
async function calibrationRow(test, calibrate) {
  const choice = Object.assign(await calibrationChoice(test.calibration_id ?? ""), { id: "test-calibration" });
  choice.style.maxWidth = "100%";
  const said = h("small.hint", { role: "status" }, "Analyses that are there keep theirs.");
  choice.addEventListener("change", async () => {
    if (!choice.value) return;
    try {
      await calibrate(choice.value);
    } catch (error) {
      choice.value = test.calibration_id ?? "";
      replace(said, problemText(error));
    }
  });
  const row = h(
    "div.row",
    h("label", { for: "test-calibration" }, "Calibration"),
    choice,
    h("a", { href: test.calibration_id ? `#/calibrate/${test.calibration_id}` : "#/calibrate" }, test.calibration_id ? "look at it" : "make or import one"),
    said,
  );
  return test.calibration_id
    ? row
    : h(
        "div.caution",
        { "data-role": "uncalibrated" },
        h("p", "This test names no calibration: choose one, and its images can be measured. It can be changed at any time."),
        row,
      );
}
