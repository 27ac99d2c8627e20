// The colour scale: its controls, its bar, and the colouring of values with it.
import { MAPS, ENTRIES, colours, entry, percentiles, suited, statusColour, bytes } from "../lib/colour.js";
import { h, replace, field, number, pen, select } from "../lib/dom.js";
import { amount, evenMarks, shown } from "../lib/units.js";

/** @import { MapName } from "../lib/colour.js" */
/** @import { Raster } from "../lib/point_grid.js" */

export class Scale {
  /**
   * @param {() => void} changed called after each change by the user
   * @param {boolean} steps true: it can be laid over several steps
   */
  constructor(changed, steps = true) {
    /** @type {Record<string, string> | null} meanings of a status' values */
    this.flags = null;
    this.unit = "";
    this.low = 0;
    this.high = 1;
    /** @type {MapName} */
    this.name = "viridis";
    this.rgb = colours(this.name);
    /** numbers at the bar: where, from 0 to 1, and their texts */
    this.marked = { shares: /** @type {number[]} */ ([]), texts: /** @type {string[]} */ ([]), unit: "" };
    this.map = select(MAPS, "auto");
    this.limits = select(
      [
        ["auto", "by percentiles"],
        ["given", "given limits"],
      ],
      "auto",
    );
    this.span = select(
      [
        ["step", "each step"],
        ["all", "all steps"],
      ],
      "step",
    );
    this.lowest = number(1, { min: 0, max: 50, "aria-label": "Lower percentile" });
    this.highest = number(99, { min: 50, max: 100, "aria-label": "Upper percentile" });
    this.lowGiven = number(null, { "aria-label": "Lower limit" });
    this.highGiven = number(null, { "aria-label": "Upper limit" });
    this.levels = number(0, { min: 0, max: 64, step: 1 });
    this.reverse = h("input", { type: "checkbox" });
    for (const input of [this.lowest, this.highest, this.levels]) input.style.width = "4.3em";
    for (const input of [this.lowGiven, this.highGiven]) input.style.width = "7.5em";
    this.bar = h("canvas", { width: ENTRIES, height: 1, "aria-hidden": "true" });
    this.marks = h("div.marks");
    this.legend = h("div.colourbar", { role: "img", "aria-label": "Colour bar", "data-role": "colourbar" }, this.bar, this.marks);
    this.flagList = h("ul.flags", { hidden: true });
    this.byPercentiles = h("div.fields", field("From", this.lowest, "%"), field("to", this.highest, "%"), steps ? field("Over", this.span) : null);
    this.limitUnits = [h("span.unit"), h("span.unit")];
    this.byLimits = h("div.fields", { hidden: true }, field("From", this.lowGiven), this.limitUnits[0], field("to", this.highGiven), this.limitUnits[1]);
    this.levels.title = "0: smooth";
    this.controls = h(
      "div.tight",
      h("div.fields", field("Colours", this.map), field("Levels", this.levels), h("label.check", this.reverse, "reversed")),
      field("Limits", this.limits),
      this.byPercentiles,
      this.byLimits,
    );
    this.root = h("div", this.legend, this.flagList, this.controls);
    for (const control of [this.map, this.limits, this.span, this.lowest, this.highest, this.lowGiven, this.highGiven, this.levels, this.reverse]) {
      control.addEventListener("change", () => {
        const given = this.limits.value === "given";
        if (control === this.limits && given && this.lowGiven.value === "") {
          this.lowGiven.value = String(Number(this.low.toPrecision(4)));
          this.highGiven.value = String(Number(this.high.toPrecision(4)));
        }
        this.byLimits.hidden = !given;
        this.byPercentiles.hidden = given;
        changed();
      });
    }
  }

  get overAll() {
    return this.limits.value === "auto" && this.span.value === "all";
  }

  /**
   * Percentiles of the limits.
   * @returns {[number, number]}
   */
  get percentiles() {
    const of = (/** @type {HTMLInputElement} */ input, /** @type {number} */ usual) =>
      input.value === "" || !Number.isFinite(Number(input.value)) ? usual : Math.min(Math.max(Number(input.value), 0), 100);
    return [of(this.lowest, 1), of(this.highest, 99)];
  }

  /** The choices, without given limits. */
  state() {
    return {
      colours: this.map.value,
      levels: Math.round(Number(this.levels.value) || 0),
      reversed: this.reverse.checked,
      over: this.span.value,
      percentiles: this.percentiles,
    };
  }

  /** @param {{ colours?: string, levels?: number, reversed?: boolean, over?: string, percentiles?: readonly number[] }} state */
  restore(state) {
    if (state.colours && [...this.map.options].some((one) => one.value === state.colours)) this.map.value = state.colours;
    if (state.levels !== undefined) this.levels.value = String(state.levels);
    if (state.reversed !== undefined) this.reverse.checked = state.reversed;
    if (state.over) this.span.value = state.over;
    if (state.percentiles) [this.lowest.value, this.highest.value] = state.percentiles.map(String);
  }

  /**
   * Limits that were given; null: none.
   * @returns {[number, number] | null}
   */
  get given() {
    const [low, high] = [Number(this.lowGiven.value), Number(this.highGiven.value)];
    return this.limits.value === "given" && this.lowGiven.value !== "" && high > low ? [low, high] : null;
  }

  /**
   * Give limits.
   * @param {number} low
   * @param {number} high
   */
  give(low, high) {
    this.limits.value = "given";
    this.lowGiven.value = String(low);
    this.highGiven.value = String(high);
    this.byLimits.hidden = false;
    this.byPercentiles.hidden = true;
  }

  /** Drop given limits: another field's do not apply. */
  forget() {
    this.lowGiven.value = "";
    this.highGiven.value = "";
    this.limits.value = "auto";
    this.byLimits.hidden = true;
    this.byPercentiles.hidden = false;
  }

  /**
   * Lay the scale.
   * @param {ArrayLike<number>[]} values of one step, or of all
   * @param {string} unit
   * @param {Record<string, string> | null} flags meanings of a status' values
   * @param {boolean} signed true: zero is the middle for all limits (a difference)
   */
  lay(values, unit, flags = null, signed = false) {
    this.unit = unit;
    this.flags = flags;
    if (this.limits.value === "given" && Number(this.highGiven.value) > Number(this.lowGiven.value)) {
      this.low = Number(this.lowGiven.value);
      this.high = Number(this.highGiven.value);
    } else {
      const found = values.map((one) => percentiles(one, ...this.percentiles)).filter((one) => one !== null);
      this.low = found.length ? Math.min(...found.map((one) => one[0])) : 0;
      this.high = found.length ? Math.max(...found.map((one) => one[1])) : 1;
      if (!(this.high - this.low > 1e-9 * Math.abs(this.low))) {
        // all the same but for rounding
        const pad = Math.abs(this.low) * 0.01 || 0.5;
        this.low -= pad;
        this.high += pad;
      }
    }
    this.name = this.map.value === "auto" ? (signed ? "diverging" : suited(this.low, this.high)) : /** @type {MapName} */ (this.map.value);
    if (this.name === "diverging" && this.limits.value !== "given") {
      const max = Math.max(Math.abs(this.low), Math.abs(this.high));
      if (this.low < 0 && this.high > 0) [this.low, this.high] = [-max, max];
    }
    this.rgb = colours(this.name, Math.round(Number(this.levels.value) || 0), this.reverse.checked);
    this.#draw();
  }

  #draw() {
    this.legend.hidden = Boolean(this.flags);
    this.flagList.hidden = !this.flags;
    if (this.flags) {
      replace(
        this.flagList,
        Object.entries(this.flags).map(([value, word]) =>
          h("li", { "data-flag": value }, h("span.swatch", { style: { background: statusColour(Number(value)) } }), word.replace(/_/g, " ")),
        ),
      );
      return;
    }
    const image = new ImageData(ENTRIES, 1);
    for (let i = 0; i < ENTRIES; i += 1) image.data.set([this.rgb[3 * i], this.rgb[3 * i + 1], this.rgb[3 * i + 2], 255], 4 * i);
    pen(this.bar).putImageData(image, 0, 0);
    const { unit, factor } = shown(this.unit, Math.max(Math.abs(this.low), Math.abs(this.high)));
    const at = (/** @type {number[]} */ shares) => ({ shares, texts: evenMarks(shares.map((share) => factor * (this.low + share * (this.high - this.low)))) });
    let { shares, texts } = at([0, 0.25, 0.5, 0.75, 1]);
    if (texts.some((text) => text.length > 6)) ({ shares, texts } = at([0, 0.5, 1])); // long numbers need room
    this.marked = { shares, texts, unit };
    replace(
      this.marks,
      shares.map((share, k) => h("span", { style: { left: `${100 * share}%` } }, texts[k])),
      h("span.of", unit),
    );
    for (const one of this.limitUnits) one.textContent = this.unit;
    this.legend.setAttribute("aria-label", `Colour bar from ${amount(this.low, this.unit)} to ${amount(this.high, this.unit)}`);
    this.legend.dataset.low = String(this.low);
    this.legend.dataset.high = String(this.high);
    this.legend.dataset.map = this.name;
  }

  /**
   * [r, g, b] of a value.
   * @param {number} value
   */
  colour(value) {
    if (this.flags) return bytes(statusColour(value));
    const i = 3 * entry(value, this.low, this.high);
    return [this.rgb[i], this.rgb[i + 1], this.rgb[i + 2]];
  }

  /**
   * Draw a raster into a canvas of the image's size; pixels without a value stay transparent.
   * @param {HTMLCanvasElement} canvas
   * @param {number} width
   * @param {number} height
   * @param {Raster | null} raster
   */
  paint(canvas, width, height, raster) {
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const context = pen(canvas);
    context.clearRect(0, 0, width, height);
    if (!raster?.width) return;
    const image = new ImageData(raster.width, raster.height);
    const out = new Uint32Array(image.data.buffer);
    const { values } = raster;
    if (this.flags) {
      const table = new Map();
      for (let i = 0; i < out.length; i += 1) {
        const v = values[i];
        if (Number.isNaN(v)) continue;
        if (!table.has(v)) {
          const [r, g, b] = this.colour(v);
          table.set(v, (255 << 24) | (b << 16) | (g << 8) | r);
        }
        out[i] = table.get(v);
      }
    } else {
      const table = new Uint32Array(ENTRIES);
      for (let i = 0; i < ENTRIES; i += 1) table[i] = (255 << 24) | (this.rgb[3 * i + 2] << 16) | (this.rgb[3 * i + 1] << 8) | this.rgb[3 * i];
      const { low } = this;
      const each = ENTRIES / (this.high - this.low);
      for (let i = 0; i < out.length; i += 1) {
        const v = values[i];
        if (Number.isNaN(v)) continue;
        const k = Math.floor((v - low) * each);
        out[i] = table[k < 0 ? 0 : k >= ENTRIES ? ENTRIES - 1 : k];
      }
    }
    context.putImageData(image, raster.x, raster.y);
  }
}
