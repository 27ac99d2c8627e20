// Evaluations that are installed, over the steps of the analysis: a form from the settings' schema, the document as it comes.
import * as api from "../../lib/api.js";
import { action, badge, count, definitions, field, h, notify, num, problemText, replace, svg } from "../../lib/dom.js";

/** @import { Viewer } from "../results.js" */
/** @import { Reply } from "#routes" */
/** @typedef {Reply<"get", "/evaluations">["evaluations"][number]} Entry */
/** @typedef {{ type?: string, enum?: unknown[], anyOf?: Schema[], default?: unknown, description?: string }} Schema */
/** @typedef {Record<string, unknown>} Document */

/** The part of a schema that is not null. @param {Schema} schema @returns {Schema} */
const given = (schema) => ({ ...schema, ...schema.anyOf?.find((one) => one.type !== "null") });

/**
 * A control for a setting, and the function that reads it: undefined if it is left empty.
 * @param {Schema} schema
 * @returns {{ control: HTMLElement, read: () => unknown }}
 */
function setting(schema) {
  const { type, enum: choices, default: first } = given(schema);
  if (type === "boolean") {
    const control = h("input", { type: "checkbox", checked: first === true });
    return { control, read: () => control.checked };
  }
  if (choices) {
    const control = h(
      "select",
      choices.map((one) => h("option", { value: String(one), selected: one === first }, String(one))),
    );
    return { control, read: () => choices.find((one) => String(one) === control.value) };
  }
  const shown = first === undefined || first === null ? "" : type === "string" ? String(first) : JSON.stringify(first);
  const isNumber = type === "number" || type === "integer";
  const control = h("input", { type: isNumber ? "number" : "text", step: "any", value: shown });
  return {
    control,
    read: () => {
      if (control.value === "") return undefined;
      return type === "string" ? control.value : JSON.parse(control.value);
    },
  };
}

/** Bars of a histogram. @param {number[]} edges @param {number[]} counts */
function bars(edges, counts) {
  const most = Math.max(...counts, 1);
  const label = `Histogram of ${counts.length} bins from ${num(edges[0], 4)} to ${num(edges[counts.length], 4)}, at most ${most} points in one`;
  return svg(
    "svg",
    { viewBox: `0 0 ${counts.length} 40`, preserveAspectRatio: "none", role: "img", "aria-label": label, style: { width: "100%", height: "8rem" } },
    counts.map((points, k) =>
      svg(
        "rect",
        { x: k + 0.05, y: 40 - (40 * points) / most, width: 0.9, height: (40 * points) / most, fill: "currentColor" },
        svg("title", `${num(edges[k], 4)} to ${num(edges[k + 1], 4)}: ${points}`),
      ),
    ),
  );
}

/** @param {unknown} value @returns {import("#dom").Part} */
function shown(value) {
  if (typeof value === "number") return Number.isInteger(value) ? count(value) : num(value, 5);
  if (value === null || value === undefined) return "–";
  if (Array.isArray(value) && value.some((one) => typeof one === "object" && one !== null))
    return definitions(value.map((one, k) => [String(k + 1), shown(one)]));
  if (Array.isArray(value))
    return value.length > 12 ? `${value.length} values` : value.map((one) => (typeof one === "number" ? num(one, 5) : String(one))).join(", ");
  if (typeof value !== "object") return String(value);
  const { edges, counts } = /** @type {{ edges?: number[], counts?: number[] }} */ (value);
  if (edges && counts) return bars(edges, counts);
  return definitions(Object.entries(value).map(([name, one]) => [name.replaceAll("_", " "), shown(one)]));
}

/** @param {Document} document */
function answered(document) {
  const { verdict, accepted, ...others } = document;
  const known = verdict ?? (typeof accepted === "boolean" ? (accepted ? "accepted" : "not accepted") : null);
  const kind = accepted === true ? "good" : accepted === false ? "bad" : "";
  return [
    known === null ? null : h("p", { role: "status", "data-role": "evaluation-verdict" }, badge(String(known), kind)),
    definitions(Object.entries(others).map(([name, value]) => [name.replaceAll("_", " "), shown(value)])),
  ];
}

/** @param {Viewer} screen */
export function evaluations(screen) {
  const { result } = screen;
  const choice = h("select", { "data-role": "evaluation" });
  const form = h("div.row");
  const answer = h("div");
  /** @type {Entry[]} */
  let entries = [];
  /** @type {Record<string, () => unknown>} */
  let readers = {};

  function ask() {
    const entry = entries.find((one) => one.name === choice.value);
    replace(answer, entry?.problem ? h("p", entry.problem) : null);
    readers = {};
    const properties = /** @type {Record<string, Schema>} */ (entry?.settings.properties ?? {});
    replace(
      form,
      Object.entries(properties).map(([name, schema]) => {
        const { control, read } = setting(schema);
        control.dataset.setting = name;
        readers[name] = read;
        return field(name.replaceAll("_", " "), control, "", schema.description);
      }),
    );
  }

  const run = action(
    "Evaluate",
    async () => {
      const values = Object.entries(readers).map(([name, read]) => [name, read()]);
      const settings = Object.fromEntries(values.filter(([, value]) => value !== undefined));
      replace(answer, h("p.quiet", { role: "status" }, "Evaluating …"));
      try {
        const found = await api.post(`/tests/${result.testId}/analyses/${result.analysisId}/evaluations/${choice.value}`, { settings });
        replace(answer, answered(found.document));
      } catch (error) {
        replace(answer, problemText(error));
      }
    },
    { kind: "primary" },
  );
  choice.addEventListener("change", ask);
  const about = h("p.quiet", "Numbers and a verdict over the finished steps, from this program or from packages that are installed beside it.");
  const root = h(
    "details.panel",
    { "data-role": "evaluations" },
    h("summary", "Evaluations"),
    about,
    h("div.row", field("Evaluation", choice)),
    form,
    run,
    answer,
  );
  let read = false;
  root.addEventListener("toggle", () => {
    if (!root.open || read) return;
    read = true;
    api
      .get("/evaluations")
      .then((found) => {
        entries = found.evaluations;
        replace(
          choice,
          entries.map((one) => h("option", { value: one.name }, one.title || one.name)),
        );
        ask();
      })
      .catch(notify);
  });
  return root;
}
