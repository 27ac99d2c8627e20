// A load frame's record, imported onto the steps by time: the file, how its clock goes with the steps', what came of it.
import * as api from "../../lib/api.js";
import { allRight, numberWithin, rule } from "../../lib/fields.js";
import { h, replace, field, number, select, action, table, num, count, problemText } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"ChannelsImported">} Imported */

/**
 * @param {string} id of the test
 * @param {() => Model<"TestReply">} test as it is now
 * @param {() => unknown} refresh
 */
export function importRecord(id, test, refresh) {
  const file = h("input", { type: "file", accept: ".csv,.txt,.tsv" });
  const clock = select([["step", "seconds; a step was taken at"], ["start", "seconds; its clock was zero on"], ["dates", "dates and times"]], "step");
  const step = number(0, { min: 0, max: 9999, step: 1 });
  const at = number(0);
  const start = h("input", { type: "datetime-local", step: "any" });
  const load = h("input", { type: "text", maxlength: 100, placeholder: "force_kn" });
  const over = h("input", { type: "checkbox" });
  const said = h("div", { role: "status", "data-role": "record" });
  const byStep = h("div.fields", field("At step", step), field("Time of the record", at, "s"));
  const byStart = h("div.fields", field("Begin of the record", start, "", "local time"));
  const show = () => { byStep.hidden = clock.value !== "step"; byStart.hidden = clock.value !== "start"; };
  clock.addEventListener("change", show);
  show();

  const there = (/** @type {string} */ text) => numberWithin({ low: 0, high: 9999, whole: true, what: "A step" })(text)
    || ((test().steps ?? []).some((one) => one.n === Number(text)) ? "" : `The test has no step ${text}.`);
  const rules = /** @type {[HTMLInputElement, import("../../lib/fields.js").Rule][]} */ ([
    [file, rule(file, () => (file.files?.length ? "" : "Choose the record's file."))],
    [step, rule(step, (text) => (clock.value === "step" ? there(text) : ""))], [at, rule(at, (text) => (clock.value === "step" ? numberWithin({ what: "A time", unit: "s" })(text) : ""))],
    [start, rule(start, (text) => (clock.value === "start" && !text ? "Say when the record's clock was zero." : ""))],
  ]);

  const send = action("Import the record", async () => {
    if (!allRight(rules) || !file.files) return;
    const form = new FormData();
    form.append("file", file.files[0]);
    if (clock.value === "step") for (const [name, control] of /** @type {const} */ ([["at_step", step], ["at_s", at]])) form.append(name, control.value);
    if (clock.value === "start") form.append("starts_utc", new Date(start.value).toISOString());
    if (load.value.trim()) form.append("load", load.value.trim());
    if (over.checked) form.append("replace", "true");
    try {
      draw(await api.upload(`/tests/${id}/channels:import`, form));
    } catch (error) {
      replace(said, problemText(error));
      return;
    }
    await refresh();
  }, { kind: "primary" });

  /** @param {Imported} found */
  function draw(found) {
    const names = Object.keys(found.channels);
    const reasons = Object.entries(found.reasons ?? {});
    replace(said,
      h("p", `${count(found.n_aligned)} of ${count(found.n_steps)} steps have values of ${names.map((name) => (found.channels[name] === "1" ? name : `${name} (${found.channels[name]})`)).join(", ")} now, between readings ${num(found.interval_s, 3)}\u00a0s apart.`),
      reasons.map(([why, n]) => h("p.problem", `${count(n)} ${n === 1 ? "step" : "steps"}: ${why}`)),
      table([["Step", (row) => row.n, { numeric: true }], ["Record's time (s)", (row) => (row.time_s === null || row.time_s === undefined ? "–" : num(row.time_s, 6)), { numeric: true }],
        ...names.map((name) => /** @type {import("#dom").Column<Model<"StepAligned">>} */ ([name, (row) => num(row.channels?.[name], 6), { numeric: true }]))],
      found.steps, { caption: (found.n_steps ?? 0) > found.steps.length ? `The first ${found.steps.length} steps` : "Channels of the steps" }));
  }

  return h("details", { "data-role": "import-record" }, h("summary", "Import a load frame's record"),
    h("p.hint", "A CSV file with a row of titles: times, then channels with their units in brackets, as in Force (kN). Each step gets the values at the time at which it was taken."),
    h("div.fields", field("File of the record", file), field("Its times are", clock)), byStep, byStart,
    h("div.fields", field("Channel of the load", load, "", "in N or kN; empty: none")),
    h("label.check", over, "write over channels that are there"), h("div.row", { style: { marginTop: "0.5rem" } }, send), said);
}
