// Brush, eraser, inversion and files of the mask that a region can be.
import { field, h, number } from "../../lib/dom.js";
import { Mask, wholeMask } from "./mask.js";
/** @import { RegionEditor } from "../region_editor.js" */
/** @import { Spot } from "./shapes.js" */

export class Painting {
  /** @param {RegionEditor} editor */
  constructor(editor) {
    this.editor = editor;
    this.mask = new Mask();
    this.brush = 20;
    this.size = number(this.brush, { min: 1, max: 1000, step: 1 });
    this.size.addEventListener("change", () => this.setBrush(Number(this.size.value)));
    this.file = h("input", { type: "file", accept: "image/png,.png", title: "PNG of camera 1's size, white where points are allowed" });
    this.file.addEventListener("change", () => this.#load());
    this.trouble = h("p.problem", { role: "alert", hidden: true });
    this.controls = [
      field("Brush", this.size, "px"),
      h(
        "button",
        { type: "button", title: "Points are placed where there were none, and the other way round; the region becomes a mask", onclick: () => this.invert() },
        "Invert",
      ),
      field("Mask file", this.file),
      h("button", { type: "button", title: "The whole region as a PNG, also for stereorig measure --mask", onclick: () => this.#save() }, "Save the mask"),
      this.trouble,
    ];
  }

  /** @param {number} px */
  setBrush(px) {
    this.brush = Math.min(Math.max(Math.round(px) || 1, 1), 1000);
    this.size.value = String(this.brush);
    this.editor.draw();
  }

  /** @param {string} text empty: none */
  say(text) {
    this.trouble.textContent = text;
    this.trouble.hidden = !text;
  }

  get erases() {
    return this.editor.tool === "eraser";
  }

  /** Begin to paint; false if there is nothing to erase. */
  begin() {
    if (this.erases && this.editor.region() === null) {
      this.editor.hint.textContent = "There is nothing to erase yet: draw or paint a region first.";
      return false;
    }
    this.mask.begin(this.editor.drawn, this.editor.one);
    return true;
  }

  /**
   * @param {Spot} from
   * @param {Spot} to
   */
  strokeTo(from, to) {
    this.mask.stroke(from, to, this.brush, this.erases);
  }

  /** Keep the painting, in place of the outlines that it began with. */
  end(more = {}) {
    const mask = this.mask.kept();
    this.editor.change((state) => Object.assign(state, { mask, outlines: [] }, more));
  }

  /** @param {Spot} spot painted by keyboard */
  dab(spot) {
    if (!this.begin()) return;
    this.strokeTo(spot, spot);
    this.end();
  }

  invert() {
    if (!this.editor.one.width) return;
    this.mask.begin(this.editor.drawn, this.editor.one, true);
    this.mask.invert();
    this.end({ holes: [] });
  }

  async #load() {
    const [file] = this.file.files ?? [];
    if (!file) return;
    const wrong = await this.mask.read(file, this.editor.one);
    this.file.value = "";
    this.say(wrong);
    if (wrong) this.editor.repaint();
    else this.end();
  }

  async #save() {
    const png = await wholeMask(this.editor.drawn, this.editor.one);
    this.say(png === null ? "There is no region to be saved: draw one first." : "");
    if (png !== null) h("a", { href: `data:image/png;base64,${png}`, download: "mask.png" }).click();
  }
}
