// How the parameters of a calibration hang together: a map of their correlations, the strongest, and files of them.
import { h, num, svg, pen, table } from "../../lib/dom.js";
import { cell, saveButtons, svgText } from "../../widgets/saving.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"CalibrationReply">} Calibration */

const [NEGATIVE, POSITIVE] = ["rgb(40, 120, 220)", "rgb(230, 120, 0)"];
const EDGE = 12;

/** @type {(what: string, more: Record<string, string | number>) => SVGElement} */
const text = (what, more) => Object.assign(svg("text", { fill: "#222", ...more }), { textContent: what });

/**
 * @param {readonly string[]} names
 * @param {readonly number[][]} values
 */
const matrixTable = (names, values) =>
  [["correlation", ...names], ...values.map((row, i) => [names[i], ...row.map(String)])].map((row) => `${row.map(cell).join(",")}\n`).join("");

/**
 * The matrix as a plot with its names: orange positive, blue negative.
 * @param {readonly string[]} names
 * @param {readonly number[][]} values
 * @param {string} title
 */
function matrixPicture(names, values, title) {
  const [each, side] = [24, 150]; // of a square, of the names
  const width = side + names.length * each + EDGE;
  const height = 40 + names.length * each + side + 3 * EDGE;
  const parts = values.flatMap((row, i) =>
    row.map((v, k) =>
      svg("rect", {
        x: side + k * each,
        y: 40 + i * each,
        width: each - 1,
        height: each - 1,
        fill: v < 0 ? NEGATIVE : POSITIVE,
        "fill-opacity": Math.abs(v).toFixed(4),
      }),
    ),
  );
  const under = 40 + names.length * each;
  const words = names.flatMap((name, k) => [
    text(name, { x: side - 6, y: 40 + k * each + 16, "text-anchor": "end", "font-size": 12 }),
    text(name, { transform: `translate(${side + k * each + 16} ${under + 6}) rotate(-90)`, "text-anchor": "end", "font-size": 12 }),
  ]);
  const key = [
    ["−1", NEGATIVE],
    ["1", POSITIVE],
  ].flatMap(([v, ink], k) => [
    svg("rect", { x: side + 70 * k, y: height - 22, width: 14, height: 14, fill: ink }),
    text(String(v), { x: side + 70 * k + 20, y: height - 10, "font-size": 12 }),
  ]);
  return svgText(width, height, [text(title, { x: EDGE, y: 24, "font-size": 15, fill: "#111" }), ...parts, ...words, ...key]);
}

/**
 * Correlation of all parameters as a map whose squares can be read, and the strongest as a table.
 * @param {Calibration} document_
 */
export function correlations(document_) {
  const { covariance } = document_;
  if (!covariance?.matrix) return null;
  const { names, matrix } = covariance;
  const r = matrix.map((row, i) => row.map((value, k) => value / Math.sqrt(matrix[i][i] * matrix[k][k])));
  /** @type {[one: string, other: string, correlation: number][]} */
  const strongest = [];
  names.forEach((a, i) =>
    names.forEach((b, k) => {
      if (k > i && Math.abs(r[i][k]) > 0.9) strongest.push([a, b, r[i][k]]);
    }),
  );
  strongest.sort((a, b) => Math.abs(b[2]) - Math.abs(a[2]));
  const SIZE = 14;
  const canvas = h("canvas", {
    width: names.length * SIZE,
    height: names.length * SIZE,
    role: "img",
    "aria-label": "Correlation of all parameters: blue negative, orange positive",
    style: { maxWidth: "100%", display: "block" },
  });
  const context = pen(canvas);
  r.forEach((row, i) =>
    row.forEach((value, k) => {
      context.fillStyle = value < 0 ? `rgba(40, 120, 220, ${Math.abs(value)})` : `rgba(230, 120, 0, ${Math.abs(value)})`;
      context.fillRect(k * SIZE, i * SIZE, SIZE - 1, SIZE - 1);
    }),
  );
  const under = h("p.quiet", { role: "status" }, "Point at a square to read its value.");
  canvas.addEventListener("pointermove", (event) => {
    const box = canvas.getBoundingClientRect();
    const [k, i] = [Math.floor(((event.clientX - box.left) / box.width) * names.length), Math.floor(((event.clientY - box.top) / box.height) * names.length)];
    if (r[i]?.[k] !== undefined) under.textContent = `${names[i]} and ${names[k]}: ${num(r[i][k], 4)}`;
  });
  return h(
    "details",
    h("summary", "Correlation of the parameters"),
    h("p.quiet", "The effects of strongly correlated parameters nearly cancel; assess a calibration by the uncertainty of points."),
    canvas,
    under,
    saveButtons("Save the correlations", () => `${document_.id} correlations`, {
      csv: () => matrixTable(names, r),
      svg: () => matrixPicture(names, r, `Correlation of the parameters, calibration ${document_.id}`),
    }),
    table(
      [
        ["One", (row) => row[0]],
        ["Other", (row) => row[1]],
        ["Correlation", (row) => row[2].toFixed(5).replace("-", "−"), { numeric: true }],
      ],
      strongest.slice(0, 12),
      { caption: "Strongest, above 0.9", empty: "None above 0.9." },
    ),
  );
}
