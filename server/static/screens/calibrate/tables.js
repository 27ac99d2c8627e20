// Numbers of a calibration in tables: its checks, its views, its parameters, two of them compared.
import * as api from "../../lib/api.js";
import { h, numeric, table, num, count, quantity, when, problemText, ask } from "../../lib/dom.js";
import { comparedInSpace } from "./checks.js";
import { refit } from "./from_images.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"CalibrationReply">} Calibration */

/** Symbol and unit of each parameter of a camera. @type {Record<string, [symbol: string, unit: string]>} */
const PARAMETERS = {
  phd_px: ["phd", "px"],
  cx_px: ["cx", "px"],
  cy_px: ["cy", "px"],
  kappa_per_px2: ["kappa", "px⁻²"],
  alpha_rad: ["alpha", "rad"],
  beta_rad: ["beta", "rad"],
  gamma_rad: ["gamma", "rad"],
  x0_mm: ["x0", "mm"],
  y0_mm: ["y0", "mm"],
  z0_mm: ["z0", "mm"],
};
export const NAMES = Object.keys(PARAMETERS);
export const CAMERAS = /** @type {const} */ (["cam1", "cam2"]);
/** Symbol of a parameter, and its unit. @param {string} name */
export function named(name) {
  const [, plain, ending] = /^(.*?)(?:_(px|mm|rad|deg))?$/.exec(name) ?? [];
  const [symbol, unit] = PARAMETERS[name] ?? [plain, ending ?? ""];
  return [symbol, " ", h("span.quiet", unit)];
}
export const um = (/** @type {number | null | undefined} */ mm, digits = 3) => quantity(mm === null || mm === undefined ? null : 1000 * mm, "µm", digits);

/** @param {Calibration} document_ */
export function measures(document_) {
  const { checks } = document_;
  if (!checks) return h("p.quiet", "It has no checks.");
  /** @type {[text: string, camera: string, check: import("#routes").PositionsCheck, positions: { [cam: string]: number[] } | null][]} */
  const rows = [];
  for (const [name, text] of /** @type {const} */ ([
    ["fitted", "fitted"],
    ["held_out", "held out"],
  ])) {
    const check = checks[name];
    if (!check) continue;
    rows.push([text, "both", check, check.positions_mm ?? null]);
    for (const cam of CAMERAS) {
      const own = check.per_camera?.[cam];
      if (own) rows.push([text, cam, own, null]);
    }
  }
  return [
    table(
      [
        [
          "Positions",
          (row) => [row[0], row[3] ? h("small.quiet", ` ${[...new Set(Object.values(row[3]).flat())].map((mm) => num(mm, 3)).join(", ")} mm`) : null],
        ],
        ["Camera", (row) => row[1]],
        ["RBE", (row) => quantity(row[2].rbe_px, "px", 3), { numeric: true }],
        ["RAZ", (row) => um(row[2].raz_mm), { numeric: true }],
        ["NSCE", (row) => num(row[2].nsce, 3), { numeric: true }],
        ["Points", (row) => count(row[2].points), { numeric: true }],
      ],
      rows,
      { caption: "Reprojection error (RBE), its size on the target (RAZ), normalised (NSCE)" },
    ),
    checks.drift_px
      ? h(
          "p.quiet",
          `After the return to zero the grid was ${num(checks.drift_px.cam1, 2)} px (cam1) and ${num(checks.drift_px.cam2, 2)} px (cam2) from its first position.`,
        )
      : null,
  ];
}

/**
 * Each view's residuals, the largest first, with a tick to leave it out of another fit.
 * @param {Calibration} document_
 * @param {(id: string) => Promise<unknown>} done shows the other fit
 */
export function viewTable(document_, done) {
  if (!Array.isArray(document_.views)) return null;
  const progress = h("div", { role: "status" });
  const indexOf = (/** @type {{ name: string }} */ view) => Number(/^\d+(?=_cam)/.exec(view.name)?.[0] ?? NaN);
  const again = Boolean(document_.taken?.length);
  const list = h(
    "div",
    table(
      [
        ...(again ? [leaveOut(indexOf)] : []),
        ["View", (v) => v.name.replace(/\.tif$/, "")],
        ["dZ", (v) => quantity(v.dz_mm, "mm", 4), { numeric: true }],
        ["Role", (v) => (v.held_out ? "held out" : "fitted")],
        ["RBE", (v) => quantity(v.rbe_px, "px", 3), { numeric: true }],
        ["RAZ", (v) => um(v.raz_mm), { numeric: true }],
        ["NSCE", (v) => num(v.nsce, 3), { numeric: true }],
      ],
      document_.views.toSorted((a, b) => (b.rbe_px ?? 0) - (a.rbe_px ?? 0)),
      { caption: "Measures of each view, the largest error first" },
    ),
  );
  return h("details", h("summary", "Each view"), list, again ? h("div.row", refit(document_.id, list, progress, done)) : null, progress);
}

/**
 * @param {(view: { name: string }) => number} indexOf
 * @returns {import("#dom").Column<any>}
 */
const leaveOut = (indexOf) => [
  "Leave out",
  (view) => (Number.isFinite(indexOf(view)) ? h("input", { type: "checkbox", value: indexOf(view), "aria-label": `Leave out ${view.name}` }) : null),
];

/**
 * @param {number | null | undefined} value
 * @param {number | null | undefined} sigma
 */
function withSigma(value, sigma) {
  if (value === undefined || value === null) return "–";
  if (!sigma || !(sigma > 0)) return num(value, 6);
  const decimals = Math.min(Math.max(1 - Math.floor(Math.log10(sigma)), 0), 12);
  return Math.abs(value) < 1e-4 ? `${num(value, 4)} ± ${num(sigma, 2)}` : `${value.toFixed(Math.min(decimals, 8)).replace("-", "−")} ± ${num(sigma, 2)}`;
}

/**
 * The parameters of both cameras, whatever their lens model is.
 * @param {Calibration} document_
 * @param {{ [cam: string]: { [name: string]: number } } | undefined} values of a complete one
 */
export function parameters(document_, values) {
  const sigma = document_.sigma ?? {};
  const of = (/** @type {"cam1" | "cam2"} */ cam) => values?.[cam] ?? document_[cam] ?? {};
  const names = [...new Set(CAMERAS.flatMap((cam) => Object.keys(of(cam))))];
  return table(
    [
      ["Parameter", named],
      ...CAMERAS.map((cam) => numeric(`${cam} ± σ`, (/** @type {string} */ name) => withSigma(of(cam)[name], sigma[`${cam}.${name}`]))),
      ...(document_.nominal ? [numeric("nominal", (/** @type {string} */ name) => nominal(document_, name))] : []),
    ],
    names.length ? names : NAMES,
    {
      caption: Object.keys(sigma).length
        ? "Parameters of each camera, with their standard uncertainties"
        : "Parameters of each camera; their uncertainty is not known",
    },
  );
}

/**
 * @param {Calibration} document_
 * @param {string} name
 */
function nominal(document_, name) {
  const of = (/** @type {string} */ cam) => {
    const n = document_.nominal?.[cam];
    if (!n) return null;
    /** @type {Record<string, number>} */
    const known = {
      phd_px: n.phd_px,
      z0_mm: n.standoff_mm,
      gamma_rad: (n.angle_deg * Math.PI) / 180,
      cx_px: (n.image_size_px[0] - 1) / 2,
      cy_px: (n.image_size_px[1] - 1) / 2,
    };
    return known[name] ?? null;
  };
  const [a, b] = [of("cam1"), of("cam2")];
  if (a === null && b === null) return "";
  return a === b ? num(a, 5) : `${num(a, 4)}; ${num(b, 4)}`;
}

/** Two calibrations in a dialog. @param {string[]} ids */
export async function comparison(ids) {
  if (ids.length !== 2) throw api.problemOf({ detail: `${ids.length} calibrations are chosen.`, remedy: "Tick two complete calibrations in the list." });
  const [a, b] = await Promise.all(ids.map((id) => api.get(`/calibrations/${id}`)));
  /** @type {[name: string, unit: string, a: string, b: string, difference: number, sigmas: number | null][]} */
  const rows = [];
  for (const cam of CAMERAS)
    for (const [name, [symbol, unit]] of Object.entries(PARAMETERS)) {
      const key = `${cam}.${name}`;
      const [sa, sb] = [a.sigma?.[key], b.sigma?.[key]];
      const difference = (b[cam]?.[name] ?? NaN) - (a[cam]?.[name] ?? NaN);
      const both = sa && sb ? Math.hypot(sa, sb) : null;
      rows.push([`${cam} ${symbol}`, unit, withSigma(a[cam]?.[name], sa), withSigma(b[cam]?.[name], sb), difference, both ? difference / both : null]);
    }
  const checks = /** @type {const} */ ([
    ["fitted", "RBE fitted"],
    ["held_out", "RBE held out"],
  ]).map(([name, text]) => [String(text), quantity(a.checks?.[name]?.rbe_px, "px", 3), quantity(b.checks?.[name]?.rbe_px, "px", 3)]);
  checks.push(
    ["verdict", a.verdict?.level ?? "–", b.verdict?.level ?? "–"],
    ["made", when(a.plan.created_utc), when(b.plan.created_utc)],
    ["shape", um(a.uncertainty?.shape_rms_mm), um(b.uncertainty?.shape_rms_mm)],
  );
  const inSpace = await comparedInSpace(ids[0], ids[1]).catch(problemText);
  await ask(
    "Two calibrations",
    h(
      "div",
      { "data-role": "comparison" },
      inSpace,
      table(
        [
          ["Check", (row) => row[0]],
          [a.plan.label || a.id, (row) => row[1], { numeric: true }],
          [b.plan.label || b.id, (row) => row[2], { numeric: true }],
        ],
        checks,
        { caption: "Checks" },
      ),
      table(
        [
          ["Parameter", (row) => [row[0], " ", h("span.quiet", row[1])]],
          [a.id, (row) => row[2], { numeric: true }],
          [b.id, (row) => row[3], { numeric: true }],
          ["difference", (row) => num(row[4], 3), { numeric: true }],
          ["in σ", (row) => (row[5] === null ? "–" : h(Math.abs(row[5]) > 3 ? "strong" : "span", num(row[5], 2))), { numeric: true }],
        ],
        rows,
        { caption: "Parameters; a difference beyond 3 σ of both together is bold" },
      ),
    ),
    [["Close", null]],
  );
}
