// Calibrations: a new one, review (accept or discard), import, compare.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { distanceCheck } from "./calibrate/checks.js";
import { correlations } from "./calibrate/correlations.js";
import { fromImages } from "./calibrate/from_images.js";
import { guidePanel } from "./calibrate/guide.js";
import { newCalibration } from "./calibrate/new.js";
import { printer } from "./calibrate/print.js";
import { figures, geometryOf, statusBadge } from "./calibrate/summary.js";
import { comparison, measures, parameters, um, viewTable } from "./calibrate/tables.js";
import { calibrationViews } from "./calibrate/views.js";
import { h, replace, field, action, table, definitions, badge, quantity, when, notify, problemText, ask, confirmed } from "../lib/dom.js";

/** @import { Here } from "../main.js" */
/** @import { Ends, Part } from "#dom" */
/** @import { Reply } from "#routes" */
/** @import { Calibration } from "./calibrate/tables.js" */
/** @typedef {Reply<"get", "/calibrations">["calibrations"]} Entries */
/** @typedef {{ nodes: Part, close: () => void }} Panels */

/**
 * Identifiers of the calibrations that are ticked.
 * @param {HTMLElement} list
 */
const ticked = (list) => [.../** @type {NodeListOf<HTMLInputElement>} */ (list.querySelectorAll("input:checked"))].map((input) => input.value);

/**
 * @param {Entries} entries
 * @param {string | undefined} chosen
 * @param {Set<string>} compared
 */
const listed = (entries, chosen, compared) =>
  table(
    [
      [
        "Compare",
        (one) =>
          h("input", {
            type: "checkbox",
            value: one.id,
            checked: compared.has(one.id),
            disabled: one.state !== "complete",
            "aria-label": `Compare ${one.id}`,
          }),
        { unseen: true },
      ],
      ["Calibration", (one) => h("a", { href: `#/calibrate/${one.id}`, "aria-current": one.id === chosen ? "true" : null }, one.label || one.id)],
      ["Made", (one) => when(one.created_utc, { dateStyle: "short", timeStyle: "short" })],
      ["State", (one) => statusBadge({ state: one.state, decision: one.decision, level: /** @type {string | undefined} */ (one.verdict?.level) })],
    ],
    entries,
    { caption: "Calibrations, newest first", empty: "No calibration yet: run one, or import one." },
  );

/**
 * @param {HTMLElement} root
 * @param {Here} here
 */
export async function open(root, { path }) {
  /** @type {Ends} */
  const ends = [];
  const rig = await api.get("/rig");
  const shown = h("div", { "aria-live": "polite" });
  const list = h("div");
  /** @type {string | undefined} */
  let chosen = path[0];
  /** @type {Entries} */
  let entries = [];
  let drawn = ""; // which calibration, in which state, is shown
  /** @type {(() => void) | null} */
  let closeShown = null;

  async function refresh() {
    entries = (await api.get("/calibrations")).calibrations.toReversed();
    replace(list, listed(entries, chosen, new Set(ticked(list))));
  }

  async function show(again = false) {
    const id = chosen ?? entries.find((one) => one.state === "complete")?.id;
    if (!id) {
      replace(shown, h("section.panel", h("p.quiet", "The result of a calibration is shown here.")));
      return;
    }
    try {
      const document_ = await api.get(`/calibrations/${id}`);
      const state = JSON.stringify([id, document_.state, document_.review, Boolean(document_.taken)]);
      if (!again && state === drawn) return;
      drawn = state;
      closeShown?.();
      closeShown = null;
      const decide = h(
        "div.row",
        decisions(
          document_,
          async () => {
            await refresh();
            await show(true);
          },
          async () => {
            chosen = undefined;
            await refresh();
            if (location.hash === "#/calibrate") await show(true);
            else location.hash = "#/calibrate";
          },
        ),
      );
      const parts = await one(document_, decide, chosenNow);
      closeShown = parts.close;
      replace(shown, parts.nodes);
    } catch (error) {
      drawn = "";
      replace(shown, h("section.panel", h("h2", id), problemText(error)));
    }
  }

  ends.push(
    events.on("calibration", () => {
      refresh()
        .then(() => show())
        .catch(notify);
    }),
  );
  await refresh();
  const chosenNow = async (/** @type {string} */ id) => {
    chosen = id;
    await refresh();
    await show(true);
  };
  const running = newCalibration(
    rig,
    ends,
    async (id) => {
      chosen = id;
      await refresh();
      await show();
    },
    !chosen && !entries.some((one) => one.state === "complete"),
  );
  const guided = guidePanel(rig, ends, chosenNow);
  const compare = action("Compare the two chosen", () => comparison(ticked(list)));
  await show();
  replace(
    root,
    h("h1", "Calibrate"),
    h(
      "div.grid.side",
      h("div.grid", rig.calibration_plan?.moves === "free" ? null : running, guided, fromImages(ends, chosenNow), shown),
      h(
        "section.panel",
        list,
        h("div.row", { style: { marginTop: "0.5rem" } }, compare),
        importer(async (id) => {
          chosen = id;
          await refresh();
          await show();
        }),
        printer(),
      ),
    ),
  );
  return () => {
    closeShown?.();
    ends.forEach((end) => end());
  };
}

/**
 * @param {Calibration} document_
 * @param {HTMLElement} decide buttons of its review
 * @param {(id: string) => Promise<unknown>} other shows another calibration
 * @returns {Promise<Panels>}
 */
async function one(document_, decide, other) {
  const { id, plan } = document_;
  const heading = h(
    "div.spread",
    h("h2", plan.label || "Calibration", " ", h("code", id)),
    statusBadge({ state: document_.state, decision: document_.review?.decision, level: document_.verdict?.level }),
  );
  const { problem } = document_;
  // one with the verdict failed is shown like any other: its residuals show the cause
  if (document_.state !== "complete" && !document_.verdict) {
    const views = calibrationViews(document_, null);
    return {
      nodes: h(
        "section.panel",
        heading,
        problem ? problemText(api.problemOf(problem)) : h("p.quiet", "Not complete yet; the progress is shown above, or under Jobs."),
        document_.state === "unfinished" ? null : decide,
        views ? h("div", h("h3", "Views that were taken"), views.root) : null,
      ),
      close: () => views?.close(),
    };
  }
  /** @type {Reply<"get", "/calibrations/{calibration_id}/residuals">["views"] | null} */
  let residuals = null;
  try {
    if (document_.taken) residuals = (await api.get(`/calibrations/${id}/residuals`)).views;
  } catch (error) {
    if (!(error instanceof api.Problem && error.status === 404)) notify(error);
  }
  const geometry = await geometryOf(document_);
  const made = calibrationViews(document_, /** @type {import("./calibrate/views.js").Found[] | null} */ (residuals));
  return {
    nodes: [
      h("section.panel", { "aria-label": "Verdict" }, heading, verdict(document_), figures(geometry), decide),
      made ? h("section.panel", { "aria-label": "Views" }, h("h2", "Views"), made.root) : null,
      h(
        "div.grid.tables",
        { style: { marginTop: "var(--gap)" } },
        h(
          "section.panel",
          h("h2", "Checks"),
          measures(document_),
          viewTable(document_, other),
          document_.state === "complete" ? distanceCheck(document_) : null,
        ),
        h("section.panel", h("h2", "Parameters"), parameters(document_, geometry?.parameters), correlations(document_)),
      ),
    ],
    close: () => made?.close(),
  };
}

/** @param {Calibration} document_ */
function verdict(document_) {
  const { verdict: v, uncertainty: u, checks } = document_;
  if (!v) return h("p.quiet", "Imported: it has no verdict.");
  return [
    h(
      "ul",
      (v.reasons ?? []).map((text) => h("li", text)),
    ),
    document_.problem ? h("p", document_.problem.remedy, " ", h("code.quiet", document_.problem.code)) : null,
    u
      ? definitions([
          ["shape", `${um(u.shape_rms_mm)} rms, expected from this calibration alone`],
          ["Z at the middle, at the corners", `${um(u.centre_z_mm)}, ${um(u.corner_z_mm)}`],
          ["common scale", quantity(100 * u.scale, "%", 2)],
        ])
      : null,
    checks?.made
      ? h(
          "details",
          h("summary", "Checks made and not made"),
          h(
            "ul",
            checks.made.map((check) => h("li", badge(check.made ? "checked" : "not checked", check.made ? "good" : "warn"), " ", check.text)),
          ),
        )
      : null,
    document_.review?.note ? h("p.quiet", `${document_.review.decision} by ${document_.review.by}: ${document_.review.note}`) : null,
  ];
}

/**
 * @param {Calibration} document_
 * @param {() => Promise<unknown>} changed
 * @param {() => Promise<unknown>} gone
 */
function decisions(document_, changed, gone) {
  const { id, state } = document_;
  const now = document_.review?.decision;
  const put = (/** @type {"accepted" | "discarded" | null} */ decision, note = "") => api.put(`/calibrations/${id}/review`, { decision, note }).then(changed);
  async function discard() {
    const note = h("input", { type: "text", maxlength: 300 });
    const text = "No new test can be made with it. It stays on disk, and the decision can be withdrawn.";
    if (await confirmed("Discard this calibration?", h("div", h("p", text), field("Reason", note)), "Discard")) await put("discarded", note.value);
  }
  async function accept() {
    if (document_.plan.source !== "import") {
      await put("accepted");
      return;
    }
    const text = "For this rig, the live cameras are checked against it, and new tests measure with it. For imported images only, you choose it for a test.";
    const answer = await ask("What is this calibration for?", h("p", text), [
      ["Imported images only", "images"],
      ["This rig", "rig"],
    ]);
    if (answer === "rig") await put("accepted");
    if (answer === "images") location.hash = `#/test?calibration=${id}`;
  }
  return [
    state === "complete" && now === "accepted" ? h("a.button.primary", { href: "#/test?new" }, "Make a test") : null,
    state === "complete" && now !== "accepted"
      ? action("Accept", accept, { kind: "primary", title: "New tests measure with the newest accepted calibration" })
      : null,
    now !== "discarded" ? action("Discard", discard, { kind: "danger" }) : null,
    now ? action("Withdraw the decision", () => put(null)) : null,
    action("Delete …", async () => {
      const text = "It is moved to the trash; tests made with it keep their own copy.";
      if (!(await confirmed("Delete this calibration?", h("p", text), "Delete"))) return;
      await api.remove(`/calibrations/${id}`);
      await gone();
    }),
    state === "complete" ? h("a.button", { href: api.address(`/calibrations/${id}/file`), download: `${id}.json` }, "Download") : null,
  ];
}

/** @param {(id: string) => Promise<unknown>} done */
function importer(done) {
  const file = h("input", { type: "file", accept: ".json,.xml,.yml,.yaml,.caldat,.z3d" });
  const label = h("input", { type: "text", maxlength: 300 });
  const unit = h("input", { type: "text", maxlength: 40, placeholder: "mm" });
  return h(
    "details",
    { style: { marginTop: "0.75rem" } },
    h("summary", "Import a calibration"),
    field("File", file, "", "calibration.json, or DICe, OpenCV, MatchID, VIC-3D, pyvale file of a stereo pair"),
    field("Label", label),
    field("Unit of length", unit, "", "of another program's file: mm, m, cm, in, um, or a size as 25 mm if it counts a board's squares"),
    action("Import", async () => {
      const [chosen] = file.files ?? [];
      if (!chosen) throw api.problemOf({ detail: "No file is chosen.", remedy: "Choose the file of a stereo calibration." });
      const form = new FormData();
      form.append("file", chosen);
      form.append("label", label.value || chosen.name);
      if (unit.value.trim()) form.append("unit", unit.value.trim());
      const made = await api.upload("/calibrations:import", form);
      notify(`${made.id} is imported.`, "good");
      const { check } = /** @type {{ check?: { warnings: string[] } }} */ (made.plan);
      for (const warning of check?.warnings ?? []) notify(`${made.id}: ${warning}.`, "warn");
      await done(made.id);
    }),
  );
}
