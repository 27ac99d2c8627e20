// A load frame's record, imported onto the steps by time: the file and its recognised parts, the relation of its clock to the
// steps', the result.
import * as api from "../../lib/api.js";
import { allRight, numberWithin, rule } from "../../lib/fields.js";
import { h, replace, field, number, select, action, table, num, count, problemText } from "../../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"ChannelsImported">} Imported */
/** @typedef {Model<"ChannelsPreview">} Preview */

const ANSWERS = /** @type {const} */ ({
  time_column: "Column of the times",
  decimal: "Decimal mark",
  segment: "Part of the record",
  date_order: "Order of the dates",
});

const CLOCKS = [
  ["step", "seconds; a step was taken at"],
  ["start", "seconds; its clock was zero on"],
  ["dates", "dates and times"],
];

/**
 * @param {string} id of the test
 * @param {() => Model<"TestReply">} test as it is now
 * @param {() => unknown} refresh
 */
export function importRecord(id, test, refresh) {
  const file = h("input", { type: "file", accept: ".csv,.txt,.tsv" });
  const clock = select(CLOCKS, "step");
  const step = number(0, { min: 0, max: 9999, step: 1 });
  const at = number(0);
  const start = h("input", { type: "datetime-local", step: "any" });
  const load = h("input", { type: "text", maxlength: 100, placeholder: "force_kn" });
  const over = h("input", { type: "checkbox" });
  const said = h("div", { role: "status", "data-role": "record" });
  const seen = h("div", { role: "status", "data-role": "preview" });
  const open = h("div.fields");
  /** @type {Map<string, HTMLSelectElement>} answers to the file's open questions */
  const answers = new Map();
  const byStep = h("div.fields", field("At step", step), field("Time of the record", at, "s"));
  const byStart = h("div.fields", field("Begin of the record", start, "", "local time"));
  const show = () => {
    byStep.hidden = clock.value !== "step";
    byStart.hidden = clock.value !== "start";
  };
  clock.addEventListener("change", show);
  show();

  const there = (/** @type {string} */ text) =>
    numberWithin({ low: 0, high: 9999, whole: true, what: "A step" })(text) ||
    ((test().steps ?? []).some((one) => one.n === Number(text)) ? "" : `The test has no step ${text}.`);
  const rules = /** @type {[HTMLInputElement, import("../../lib/fields.js").Rule][]} */ ([
    [file, rule(file, () => (file.files?.length ? "" : "Choose the record's file."))],
    [step, rule(step, (text) => (clock.value === "step" ? there(text) : ""))],
    [at, rule(at, (text) => (clock.value === "step" ? numberWithin({ what: "A time", unit: "s" })(text) : ""))],
    [start, rule(start, (text) => (clock.value === "start" && !text ? "Say when the record's clock was zero." : ""))],
  ]);

  function filled() {
    const form = new FormData();
    if (file.files?.length) form.append("file", file.files[0]);
    if (clock.value === "step")
      for (const [name, control] of /** @type {const} */ ([
        ["at_step", step],
        ["at_s", at],
      ]))
        form.append(name, control.value);
    if (clock.value === "start" && start.value) form.append("starts_utc", new Date(start.value).toISOString());
    if (load.value.trim()) form.append("load", load.value.trim());
    if (over.checked) form.append("replace", "true");
    for (const [name, control] of answers) if (control.value) form.append(name, control.value);
    return form;
  }

  async function look() {
    if (!file.files?.length) return;
    try {
      drawRead(await api.upload(`/tests/${id}/channels:preview`, filled()));
    } catch (error) {
      replace(seen, problemText(error));
    }
  }
  file.addEventListener("change", () => {
    answers.clear();
    replace(open);
    replace(said);
    void look();
  });

  /** @param {Preview} found */
  function drawRead({ read, refused }) {
    for (const { option, choices } of read.questions) {
      if (answers.has(option)) continue;
      const control = select([["", "choose"], ...choices.map((one) => /** @type {[string, string]} */ ([one, one]))], "");
      control.addEventListener("change", look);
      answers.set(option, control);
      open.append(field(ANSWERS[option], control));
    }
    replace(seen, readText(read, refused));
  }

  const send = action(
    "Import the record",
    async () => {
      if (!allRight(rules) || !file.files) return;
      try {
        replace(said, importedText(await api.upload(`/tests/${id}/channels:import`, filled())));
      } catch (error) {
        replace(said, problemText(error));
        return;
      }
      await refresh();
    },
    { kind: "primary" },
  );

  return h(
    "details",
    { "data-role": "import-record" },
    h("summary", "Import a load frame's record"),
    h(
      "p.hint",
      "A CSV file with a row of titles: times, then channels with their units, as in Force (kN). Each step gets the values at the time at which it was taken.",
    ),
    h("div.fields", field("File of the record", file)),
    seen,
    open,
    h("div.fields", field("Its times are", clock)),
    byStep,
    byStart,
    h("div.fields", field("Channel of the load", load, "", "in a unit of force; empty: none")),
    h("label.check", over, "write over channels that are there"),
    h("div.row", { style: { marginTop: "0.5rem" } }, send),
    said,
  );
}

/**
 * How a record was read: its lines, its columns, and doubts.
 * @param {Preview["read"]} read
 * @param {Preview["refused"]} refused
 */
function readText(read, refused) {
  const left = [
    [read.left_above, "above the table"],
    [read.left_between, "in it"],
    [read.left_below, "below it"],
  ].filter(([n]) => n);
  const lines = left.length
    ? `left out: ${left.map(([n, where]) => `${count(Number(n))} ${Number(n) === 1 ? "line" : "lines"} ${where}`).join(", ")}`
    : "no line left out";
  return [
    h("p", `${read.encoding}, cells separated by ${read.separator}, titles in line ${read.titles_line}; ${lines}.`),
    read.left_lines.length
      ? h(
          "ul.hint",
          read.left_lines.map((one) => h("li", `Line ${one.line}: ${one.text}`)),
        )
      : null,
    [...read.questions.map((one) => one.cause), ...read.doubts].map((text) => h("p.problem", text)),
    table(
      [
        ["Column", (row) => row.title],
        ["Channel", (row) => row.name ?? row.kind],
        ["Unit", (row) => row.unit],
        ["First cell", (row) => row.example],
        ["Numbers", (row) => count(row.numbers ?? 0), { numeric: true }],
        ["Empty", (row) => count(row.empty ?? 0), { numeric: true }],
        ["Not read", (row) => count(row.unread ?? 0), { numeric: true }],
      ],
      read.columns,
      { caption: "Columns of the record" },
    ),
    refused && !read.questions.length ? h("p.hint", `With these entries the import is refused: ${refused}`) : null,
  ];
}

/** The steps' values by a record. @param {Imported} found */
function importedText(found) {
  const names = Object.keys(found.channels);
  const reasons = Object.entries(found.reasons ?? {});
  return [
    h(
      "p",
      `${count(found.n_aligned)} of ${count(found.n_steps)} steps have values of ${names.map((name) => (found.channels[name] === "1" ? name : `${name} (${found.channels[name]})`)).join(", ")} now, between readings ${num(found.interval_s, 3)}\u00a0s apart.`,
    ),
    found.read.doubts.map((text) => h("p.problem", text)),
    reasons.map(([why, n]) => h("p.problem", `${count(n)} ${n === 1 ? "step" : "steps"}: ${why}`)),
    table(
      [
        ["Step", (row) => row.n, { numeric: true }],
        ["Record's time (s)", (row) => (row.time_s === null || row.time_s === undefined ? "–" : num(row.time_s, 6)), { numeric: true }],
        ...names.map((name) => /** @type {import("#dom").Column<Model<"StepAligned">>} */ ([name, (row) => num(row.channels?.[name], 6), { numeric: true }])),
      ],
      found.steps,
      { caption: (found.n_steps ?? 0) > found.steps.length ? `The first ${found.steps.length} steps` : "Channels of the steps" },
    ),
  ];
}
