// Pages for a printer: the rig's target, speckle for its images, and a print's measured rulers.
import * as api from "../../lib/api.js";
import { h, replace, field, number, select, action, num } from "../../lib/dom.js";
import { saveAs } from "../../widgets/saving.js";

/** @param {HTMLInputElement} input */
const value = (input) => (input.value === "" ? undefined : Number(input.value));

/** The panel: target and speckle are drawn by the service, in true millimetres. */
export function printer() {
  const paper = h("input", { type: "text", value: "A4", maxlength: 20 });
  const form = select(
    [
      ["pdf", "PDF"],
      ["svg", "SVG"],
    ],
    "pdf",
  );
  const diameter = number(null, { min: 0, placeholder: "4 px of the rig" });
  const seed = number(1, { min: 0, step: 1 });
  const file = h("input", { type: "file", accept: ".toml" });
  const [acrossNumbers, across, downNumbers, down, u] = Array.from({ length: 5 }, () => number(null, { min: 0 }));
  const found = h("p", { "aria-live": "polite", "data-role": "print-scale" });
  const shape = () => /** @type {"pdf" | "svg"} */ (form.value);

  async function target() {
    saveAs(await api.fileOf("/prints/target", { paper: paper.value, form: shape() }), `target.${form.value}`);
    saveAs(await api.fileOf("/prints/target", { paper: paper.value, form: "toml" }), "target.toml");
  }

  async function speckle() {
    const asked = { diameter_mm: value(diameter), seed: value(seed), paper: paper.value, form: form.value };
    saveAs(await (await api.raw("/prints/speckle", asked)).blob(), `speckle.${form.value}`);
  }

  async function measured() {
    const [chosen] = file.files ?? [];
    if (!chosen) throw api.problemOf({ detail: "No file is chosen.", remedy: "Choose the target.toml that was saved with the print." });
    const pairs = [
      [acrossNumbers, across],
      [downNumbers, down],
    ].filter((pair) => pair.some((one) => one.value !== ""));
    const body = {
      target_file: await chosen.text(),
      printed_mm: pairs.map(([one]) => Number(one.value)),
      measured_mm: pairs.map(([, one]) => Number(one.value)),
      u_mm: Number(u.value),
    };
    const made = await api.post("/prints/measured", body);
    replace(found, `${made.title}: scale ${num(made.scale, 6)} ± ${num(made.sigma, 2)}. Calibrate with the saved target.toml.`);
    saveAs(new Blob([made.target_file], { type: "application/toml" }), "target.toml");
  }

  return h(
    "details",
    { style: { marginTop: "0.75rem" } },
    h("summary", "Print a target or speckle"),
    field("Paper", paper, "", "A4, A3, letter, or 600x400 in mm"),
    field("Format", form),
    h("div.row", action("Save the rig's target", target)),
    field("Speckle, diameter", diameter, "mm"),
    field("Pattern number", seed),
    h("div.row", action("Save speckle", speckle)),
    h("h3", "A print's rulers"),
    h("p.quiet", "Print at 100 %, measure both rulers from mark to mark; the pitch becomes the measured one, with its uncertainty."),
    field("target.toml of the print", file),
    field("Ruler across, by its numbers", acrossNumbers, "mm"),
    field("Ruler across, measured", across, "mm"),
    field("Ruler down, by its numbers", downNumbers, "mm"),
    field("Ruler down, measured", down, "mm"),
    field("u of a measured length", u, "mm"),
    h("div.row", action("Save the measured target", measured)),
    found,
  );
}
