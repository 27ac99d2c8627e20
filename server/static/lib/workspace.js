// Drawing and settings of a test, saved with it as they are made: it outlives the screen, the browser and the service.
import * as api from "./api.js";
import { h, replace } from "./dom.js";

/** @import { Body, Reply } from "#routes" */
/** @typedef {Body<"put", "/tests/{test_id}/workspace">} Kept */
/** @typedef {Reply<"get", "/tests/{test_id}/workspace">} Read */

const LATER_MS = 300;
const AGAIN_MS = 2000;
/** Event of the window after a drawing or setting was saved. */
export const SAVED = "workspacesaved";
// browsers send no more than this for a page that is being closed
const CLOSING_BYTES = 60_000;

const text = (/** @type {unknown} */ value) => JSON.stringify(value ?? null);

export class Workspace {
  /** @param {string} testId */
  constructor(testId) {
    this.path = /** @type {`/tests/${string}/workspace`} */ (`/tests/${testId}/workspace`);
    /** @type {Kept} */
    this.value = {};
    /** @type {Kept} as the service has it */
    this.stored = {};
    /** @type {string | null} */
    this.etag = null;
    /** @type {Kept} changed here, not saved yet */
    this.open = {};
    /** @type {number | undefined} */
    this.timer = undefined;
    /** @type {Promise<void>} */
    this.saving = Promise.resolve();
    this.state = h("span.quiet", { role: "status", "data-role": "saved" });
    this.closing = () => {
      if (document.visibilityState === "hidden") this.flush(true);
    };
    document.addEventListener("visibilitychange", this.closing);
    window.addEventListener("pagehide", this.closing);
  }

  /** @param {string} testId */
  static async open(testId) {
    const made = new Workspace(testId);
    await made.#read();
    made.value = { ...made.stored };
    return made;
  }

  async #read() {
    const { value, etag } = await api.getTagged(this.path);
    this.stored = /** @type {Kept} */ (value);
    this.etag = etag;
  }

  /**
   * Parts that were drawn or set; unchanged ones are not sent.
   * @param {Kept} parts
   */
  change(parts) {
    const names = /** @type {(keyof Kept)[]} */ (Object.keys(parts)).filter((name) => text(parts[name]) !== text(this.value[name]));
    if (!names.length) return;
    for (const name of names) Object.assign(this.open, { [name]: parts[name] });
    this.value = { ...this.value, ...this.open };
    this.#say("Saving …");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.flush(), LATER_MS);
  }

  /** Save the open changes, after the save that is under way. */
  flush(closing = false) {
    clearTimeout(this.timer);
    this.saving = this.saving.then(() => this.#save(closing));
    return this.saving;
  }

  /**
   * @param {boolean} [closing]
   * @returns {Promise<void>}
   */
  async #save(closing = false) {
    const part = this.open;
    if (!Object.keys(part).length) return;
    this.open = {};
    try {
      await this.#put(part, closing);
      if (!Object.keys(this.open).length) this.#say("Saved with the test.");
    } catch (error) {
      this.open = { ...part, ...this.open };
      const problem = /** @type {api.Problem} */ (error);
      if (problem.code === "precondition_failed") return this.#conflict(part);
      if (problem.status === 0 || problem.status >= 500) {
        this.#say("Not saved: the service does not answer. It is tried again.", true);
        clearTimeout(this.timer);
        this.timer = setTimeout(() => this.flush(), AGAIN_MS);
      } else this.#say(`Not saved: ${problem.message}`, true);
    }
  }

  /**
   * @param {Kept} part
   * @param {boolean} closing
   */
  async #put(part, closing) {
    const body = { ...this.stored, ...part };
    const keepalive = closing && text(body).length < CLOSING_BYTES;
    const { value, etag } = await api.putTagged(this.path, body, this.etag === null ? {} : { "If-Match": this.etag }, keepalive);
    this.stored = /** @type {Kept} */ (value);
    this.etag = etag;
    window.dispatchEvent(new Event(SAVED));
  }

  /**
   * Another window changed it: other parts than these are taken over; for these, the operator chooses the version to keep.
   * @param {Kept} part
   * @returns {Promise<void>}
   */
  async #conflict(part) {
    const before = this.stored;
    await this.#read();
    const same = /** @type {(keyof Kept)[]} */ (Object.keys(part)).every((name) => text(this.stored[name]) === text(before[name]));
    if (same) return this.#save();
    this.state.classList.add("problem");
    replace(
      this.state,
      "Changed in another window since. ",
      h("button", { type: "button", onclick: () => location.reload() }, "Take that"),
      " ",
      h("button", { type: "button", onclick: () => this.flush() }, "Keep this one"),
    );
    clearTimeout(this.timer);
  }

  /** @param {string} words */
  #say(words, bad = false) {
    this.state.classList.toggle("problem", bad);
    replace(this.state, words);
  }

  /** The screen is left: save the open changes now. */
  close() {
    document.removeEventListener("visibilitychange", this.closing);
    window.removeEventListener("pagehide", this.closing);
    return this.flush();
  }
}
