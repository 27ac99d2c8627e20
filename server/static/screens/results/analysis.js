// One analysis' results: answers are cached, so that stepping and playing request each once.
import * as api from "../../lib/api.js";
import { figuresOf, readAnalysis, readTest } from "../../lib/steps.js";
import { Grid } from "../../lib/point_grid.js";
import { axesOf } from "../../widgets/triad.js";

/** @import { Model, Reply } from "#routes" */
/** @typedef {{ key: string, name: string, component: number | null, group: string, text: string, unit: string, about: string,
 *   flags: Record<string, string> | null, signed?: boolean }} Shown a field of a step */

const MAX_BYTES = 300e6;
/** @type {{ [kind: string]: { unit: string, factor: number } }} */
const UNITS = { strain: { unit: "µm/m", factor: 1e6 }, angle: { unit: "°", factor: 180 / Math.PI } };
export const INTERNALS = "Internals";
const UNCERTAINTY = "Standard uncertainty";
const GROUPS = ["Displacement", "Strain", "Shape", "Quality", UNCERTAINTY, INTERNALS];
/** @type {Map<string, Model<"FieldVariable">>} variables of the steps that were read, by name */
const known = new Map();

/**
 * Display unit of a variable, and the factor from its stored numbers.
 * @param {string} name
 * @param {string} units
 */
export function shownUnit(name, units) {
  return UNITS[known.get(name)?.kind ?? ""] ?? { unit: units === "pixel" ? "px" : units === "1" ? "" : units === "count" ? "grey" : units, factor: 1 };
}

/**
 * Name of a variable as it is shown.
 * @param {string} name
 */
export const pretty = (name) => known.get(name)?.label ?? name.replace(/_/g, " ");

/**
 * True if a variable is zero at the reference by definition.
 * @param {string} name
 */
export const isRelative = (name) => known.get(name)?.relative ?? false;

/**
 * True if a variable has a row of its own in a list of values: it is neither a status nor the uncertainty of another one.
 * @param {string} name
 */
export const isListed = (name) => known.get(name)?.group !== UNCERTAINTY && !known.get(name)?.flags;

/**
 * Group of a variable, and the group's place.
 * @param {string} name
 */
export function groupOf(name) {
  const group = known.get(name)?.group ?? INTERNALS;
  return { at: GROUPS.indexOf(group), group };
}

/**
 * Meaning of a field, its axes named as they are drawn.
 * @param {Shown} info
 */
export const aboutText = (info) =>
  info.about
    .replace(/([XYZ])_(frame|sys)/, "$1")
    .replace("axis 1", "X")
    .replace("axis 2", "Y");

export class Result {
  /** @type {Model<"AnalysisReply"> | null} */
  #sortedOf = null;
  /** @type {number[]} */
  #sorted = [];
  /** @type {Model<"TestReply"> | null} */
  #entriesOf = null;
  /** @type {Map<number, Model<"StepEntry">>} */
  #entries = new Map();

  /**
   * @param {Model<"TestReply">} test
   * @param {Model<"AnalysisReply">} analysis
   */
  constructor(test, analysis) {
    this.testId = test.id;
    this.analysisId = analysis.id;
    this.test = test;
    this.analysis = analysis;
    /** @type {Map<string, { bytes: number, promise: Promise<any> }>} by key */
    this.kept = new Map();
    this.bytes = 0;
    /** Axes that the numbers are read in: "specimen", "system", or written out. */
    this.frame = "specimen";
    /** @type {string | null} axes of another result that these are the same as */
    this.follows = null;
  }

  /**
   * Read everything in other axes from now on; also if the same axes were defined again.
   * @param {string} frame
   */
  use(frame) {
    this.frame = frame;
    this.kept.clear();
    this.bytes = 0;
  }

  /** Directions of the axes in the reference image. */
  axes() {
    return this.#keep("axes", async () => {
      const n = this.steps.includes(this.reference) ? this.reference : this.steps[0];
      const [px, py, x, y] = await Promise.all(["x_px", "y_px", "x_mm", "y_mm"].map((name) => this.array(n, name)));
      return { axes: axesOf(px.data, py.data, x.data, y.data) };
    }).then((found) => found.axes);
  }

  /**
   * @param {string} testId
   * @param {string} analysisId
   */
  static async open(testId, analysisId) {
    return new Result(...(await Result.#read(testId, analysisId)));
  }

  /**
   * @param {string} testId
   * @param {string} analysisId
   */
  static #read(testId, analysisId) {
    return Promise.all([readTest(testId), readAnalysis(testId, analysisId)]);
  }

  async refresh() {
    [this.test, this.analysis] = await Result.#read(this.testId, this.analysisId);
  }

  get path() {
    return /** @type {const} */ (`/tests/${this.testId}/analyses/${this.analysisId}`);
  }

  /** Steps that are finished, in their order. */
  get steps() {
    if (this.#sortedOf !== this.analysis) {
      this.#sortedOf = this.analysis;
      this.#sorted = this.analysis.steps_finished.toSorted((a, b) => a - b);
    }
    return this.#sorted;
  }

  /**
   * A step's entry in its test's list.
   * @param {number} n
   */
  entry(n) {
    if (this.#entriesOf !== this.test) {
      this.#entriesOf = this.test;
      this.#entries = new Map((this.test.steps ?? []).map((one) => [one.n, one]));
    }
    return this.#entries.get(n);
  }

  /**
   * Figures of a step's field, if it is finished.
   * @param {number} n
   */
  async figures(n) {
    const known = this.analysis.summary?.steps?.find((one) => one.n === n);
    if (known || (this.analysis.n_finished ?? 0) <= (this.analysis.summary?.steps?.length ?? 0)) return known;
    return this.#keep(`${n} figures`, async () => /** @type {object} */ ((await figuresOf(this.testId, this.analysisId, n)) ?? {}));
  }

  get reference() {
    return this.analysis.settings.reference ?? this.analysis.steps?.[0] ?? 0;
  }

  /**
   * Short text of a step: its number and label.
   * @param {number} n
   */
  stepText(n) {
    const step = this.entry(n);
    return `step ${n}${step?.label ? `: ${step.label}` : ""}${n === this.reference ? " (reference)" : ""}`;
  }

  /**
   * @template {object} T `bytes` are counted if it has them
   * @param {string} key
   * @param {() => Promise<T>} make
   * @returns {Promise<T>}
   */
  #keep(key, make) {
    const held = this.kept.get(key);
    if (held) {
      this.kept.delete(key); // dropped least recently used first
      this.kept.set(key, held);
      return held.promise;
    }
    const entry = { bytes: 0, promise: make() };
    entry.promise = entry.promise.then((value) => {
      entry.bytes = "bytes" in value ? Number(value.bytes) : 0;
      this.bytes += entry.bytes;
      for (const [old, one] of this.kept) {
        if (this.bytes <= MAX_BYTES || old === key) break;
        this.kept.delete(old);
        this.bytes -= one.bytes;
      }
      return value;
    });
    entry.promise.catch(() => this.kept.delete(key));
    this.kept.set(key, entry);
    return entry.promise;
  }

  /**
   * The fields of a step.
   * @param {number} n
   */
  fields(n) {
    return this.#keep(`${n}`, async () => {
      const { fields, cuts_px: cuts, frame, uncertainty } = await api.get(`${this.path}/steps/${n}/fields`, { frame: this.frame });
      /** @type {Shown[]} */
      const shown = [];
      for (const one of fields) {
        known.set(one.name, one);
        const { group } = groupOf(one.name);
        const { unit } = shownUnit(one.name, one.units);
        const common = { name: one.name, group, unit, about: one.long_name, flags: one.flags ?? null };
        if (one.dimensions.join() === "row,col" && !["x_px", "y_px"].includes(one.name))
          shown.push({ ...common, key: one.name, component: null, text: pretty(one.name) });
        for (const [k, pair] of (one.comparisons ?? []).entries()) {
          const text = `correlation ${pair.replace("__", " with ").replace(/_/g, " ")}`;
          shown.push({ ...common, key: `${one.name}:${k}`, component: k, text });
        }
      }
      shown.sort((a, b) => GROUPS.indexOf(a.group) - GROUPS.indexOf(b.group));
      return { shown, cuts, frame, uncertainty, all: new Set(fields.map((one) => one.name)) };
    });
  }

  /**
   * @param {number} n
   * @param {string} name
   */
  array(n, name) {
    return this.#keep(`${n}/${name}`, async () => {
      const got = await api.npy(`${this.path}/steps/${n}/fields/${name}`, { format: "npy", frame: this.frame });
      return { ...got, bytes: got.data.byteLength };
    });
  }

  /**
   * Positions of the points in a step's image of a camera.
   * @param {number} n
   * @param {string} cam
   */
  positions(n, cam) {
    return this.#keep(`${n}/${cam}`, async () => {
      const got = await api.npy(`${this.path}/steps/${n}/positions/${cam}`, { format: "npy" });
      return { ...got, bytes: got.data.byteLength };
    });
  }

  /** @param {number} n */
  grid(n) {
    return this.#keep(`${n} grid`, async () => {
      const { cuts } = await this.fields(n);
      const [x, y, status] = await Promise.all(["x_px", "y_px", "status"].map((name) => this.array(n, name)));
      const [rows, cols] = status.shape;
      return new Grid({ rows, cols, x: x.data, y: y.data, status: status.data, cuts });
    });
  }

  /**
   * Values of one entry of `fields`, in the unit it is shown in.
   * @param {number} n
   * @param {string} key
   * @returns {Promise<ArrayLike<number>>}
   */
  async values(n, key) {
    const [name, component] = key.split(":");
    const { data, shape } = await this.array(n, name);
    const { factor } = shownUnit(name, "");
    if (component === undefined && factor === 1) return data;
    return this.#keep(`${n}/${key} shown`, async () => {
      const each = component === undefined ? 1 : shape[2];
      const out = new Float32Array(data.length / each);
      for (let i = 0; i < out.length; i += 1) out[i] = factor * data[i * each + Number(component ?? 0)];
      return Object.assign(out, { bytes: out.byteLength });
    });
  }

  /**
   * Standard uncertainties of an entry of `fields`, null where the file has none.
   * @param {number} n
   * @param {string} key
   */
  async sigma(n, key) {
    const { all } = await this.fields(n);
    return all.has(`sigma_${key}`) ? this.values(n, `sigma_${key}`) : null;
  }
}

/** Every test, newest first. */
export async function allTests() {
  const out = [];
  /** @type {string | null | undefined} */
  let cursor;
  do {
    /** @type {Reply<"get", "/tests">} */
    const page = await api.get("/tests", { cursor });
    out.push(...page.tests);
    cursor = page.next_cursor;
  } while (cursor);
  return out.reverse();
}
