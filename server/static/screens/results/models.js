// The step that is shown against finite element results that are stored with its test: verdict and refuted regions.
import * as api from "../../lib/api.js";
import { h, replace, svg, table, action, field, notify, num, problemText, badge } from "../../lib/dom.js";

/** @import { Viewer } from "../results.js" */
/** @import { Reply } from "#routes" */
/** @typedef {Reply<"post", "/tests/{test_id}/analyses/{analysis_id}/comparison">} Comparison */
/** @typedef {Comparison["regions"][number]} Region */

const UNITS = ["", "mm", "m", "um", "cm", "in"];
const MAX_Z = 4;

/** The largest difference of a region over its uncertainty. @param {Region} region */
function worst(region) {
  const each = Object.entries(region.difference).flatMap(([name, one]) =>
    one.value === null || !one.sigma ? [] : [{ name, z: one.value / one.sigma, ...one }],
  );
  return each.toSorted((a, b) => Math.abs(b.z) - Math.abs(a.z))[0] ?? null;
}

/** @param {number} z */
const colour = (z) => {
  const share = Math.min(Math.abs(z) / MAX_Z, 1);
  const pale = Math.round(245 - 190 * share);
  return z < 0 ? `rgb(${pale}, ${pale}, 245)` : `rgb(245, ${pale}, ${pale})`;
};

/** Regions over the image, coloured by their largest z. @param {Comparison} found */
function picture(found) {
  const all = found.regions.map((one) => one.rectangle_px);
  const [x0, y0, x1, y1] = [
    Math.min(...all.map((r) => r[0])),
    Math.min(...all.map((r) => r[1])),
    Math.max(...all.map((r) => r[2])),
    Math.max(...all.map((r) => r[3])),
  ];
  return svg(
    "svg",
    {
      viewBox: `${x0} ${y0} ${x1 - x0} ${y1 - y0}`,
      role: "img",
      "data-role": "model-map",
      style: { width: "100%", maxHeight: "22rem" },
      "aria-label": `Largest difference of each of ${all.length} regions over its uncertainty; ${found.refuted.length} refuted`,
    },
    found.regions.map((region) => {
      const [a, b, c, d] = region.rectangle_px;
      const most = worst(region);
      const z = most?.z ?? 0;
      const refuted = region.refuted.length > 0;
      return svg(
        "rect",
        {
          x: a,
          y: b,
          width: c - a,
          height: d - b,
          fill: colour(z),
          stroke: refuted ? "#b00020" : "#888",
          "stroke-width": refuted ? 3 : 0.7,
          "data-region": region.number,
        },
        svg("title", `region ${region.number}: ${most ? `${most.name} ${num(z, 3)} of its uncertainty` : "no value"}${refuted ? ", refuted" : ""}`),
      );
    }),
  );
}

/** @param {Comparison} found */
function verdict(found) {
  /** @type {[string, Comparison["displacement"] | null | undefined][]} */
  const quantities = [
    ["displacement", found.displacement],
    ["strain", found.strain],
  ];
  const rows = quantities.flatMap(([name, one]) => (one ? [{ name, one }] : []));
  const bad = found.regions.filter((one) => one.refuted.length);
  return [
    h(
      "p",
      { role: "status", "data-role": "model-verdict" },
      badge(found.accepted ? "accepted" : "refuted", found.accepted ? "good" : "bad"),
      ` Step ${found.step}: ${found.points.compared} of ${found.points.measured} points compared; measured displacement over the model's ${found.factor.value === null ? "not known" : `${num(found.factor.value, 5)} ± ${num(found.factor.sigma, 2)}`}${found.left_out ? `; plane model, ${found.left_out.replace("_mm", "")} is left out` : ""}${found.not_included ? `; ${found.not_included}` : ""}.`,
    ),
    table(
      [
        ["Quantity", (row) => row.name],
        ["Verdict", (row) => (row.one.accepted ? "accepted" : "refuted")],
        ["Probability", (row) => num(row.one.overall.probability, 3)],
        [
          "Difference over its uncertainty, rms",
          (row) =>
            Object.entries(row.one.rms_z)
              .map(([name, z]) => `${name.replace("_mm", "")} ${num(z, 3)}`)
              .join(", "),
        ],
      ],
      rows,
      { caption: "Verdict over the whole field" },
    ),
    picture(found),
    bad.length
      ? table(
          [
            ["Region, px", (one) => one.rectangle_px.map((/** @type {number} */ v) => num(v, 4)).join(", ")],
            ["By", (one) => one.refuted.join(", ")],
            [
              "Most",
              (one) => {
                const most = worst(one);
                return most ? `${most.name} ${num(most.value, 3)} ± ${num(most.sigma, 2)} ${most.units === "1" ? "" : most.units}` : "–";
              },
            ],
          ],
          bad,
          { caption: "Where the model is refuted" },
        )
      : h("p.quiet", "No region refutes the model by itself."),
  ];
}

/** @param {Viewer} screen */
export function models(screen) {
  const { result } = screen;
  const file = h("input", { type: "file", multiple: true, accept: ".vtu,.xdmf,.xmf,.csv,.txt,.h5,.hdf5" });
  const unit = h(
    "select",
    UNITS.map((name) => h("option", { value: name }, name || "as the file states")),
  );
  const fit = h("input", { type: "checkbox" });
  const rigid = h("input", { type: "checkbox" });
  const choice = h("select", { "data-role": "model" });
  const answer = h("div");

  async function list() {
    const { models: held } = await api.get(`/tests/${result.testId}/models`);
    replace(
      choice,
      held.length ? null : h("option", { value: "" }, "none yet"),
      held.toReversed().map((one) => h("option", { value: one.id }, `${one.name} (${one.unit})`)),
    );
  }

  const keep = action("Keep with the test", async () => {
    const chosen = [...(file.files ?? [])];
    const light = chosen.find((one) => !/\.(h5|hdf5)$/i.test(one.name));
    if (!light) throw new Error("Choose the model's file: VTU, XDMF with its HDF5, or CSV.");
    const form = new FormData();
    form.append("file", light);
    const heavy = chosen.find((one) => one !== light);
    if (heavy) form.append("heavy", heavy);
    if (unit.value) form.append("unit", unit.value);
    if (fit.checked) form.append("align", JSON.stringify({ kind: "best-fit" }));
    await api.upload(`/tests/${result.testId}/models`, form);
    await list();
  });
  const compare = action(
    "Compare this step",
    async () => {
      if (!choice.value) throw new Error("Keep a model with the test first.");
      replace(answer, h("p.quiet", { role: "status" }, "Comparing …"));
      try {
        const found = await api.post(
          `/tests/${result.testId}/analyses/${result.analysisId}/comparison`,
          /** @type {any} */ ({ model_id: choice.value, step: screen.step, remove_rigid: rigid.checked }),
        );
        replace(answer, verdict(found));
      } catch (error) {
        replace(answer, problemText(error));
      }
    },
    { kind: "primary" },
  );
  const drop = action("Delete the model", async () => {
    if (!choice.value) return;
    await api.remove(`/tests/${result.testId}/models/${choice.value}`);
    replace(answer);
    await list();
  });
  const root = h(
    "details.panel",
    { "data-role": "models" },
    h("summary", "Model"),
    h(
      "p.quiet",
      "A finite element result with displacements at its nodes, in the calibration's axes or laid onto the measured shape. Its unit must be stated.",
    ),
    h("div.row", field("File", file), field("Unit", unit), field("Best fit of the shapes", fit), keep),
    h("div.row", field("Model", choice), field("Take out rigid motion", rigid), compare, drop),
    answer,
  );
  let read = false;
  root.addEventListener("toggle", () => {
    if (root.open && !read) {
      read = true;
      list().catch(notify);
    }
  });
  return root;
}
