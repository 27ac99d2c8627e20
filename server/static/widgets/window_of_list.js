// Part of a long list, with controls that lead to the others: a document of thousands of entries is neither drawn nor laid out at once.
import { h, replace, number } from "../lib/dom.js";

const MOST = 100;

/**
 * Beginning of the part that shows an entry, of a list of so many.
 * @param {number} index
 * @param {number} length
 */
export const partOf = (index, length) => Math.max(0, Math.min(Math.floor(index / MOST) * MOST, Math.floor(Math.max(length - 1, 0) / MOST) * MOST));

/**
 * A list of which a hundred entries are shown at a time; the newest, until another part is chosen.
 * @template T
 * @param {HTMLElement} box where the entries are drawn
 * @param {(entry: T) => Node} draw
 * @param {{ what: string, name: (entry: T) => number }} of name of the entries, and the number of each
 */
export function windowOfList(box, draw, { what, name }) {
  /** @type {readonly T[]} */
  let entries = [];
  let begin = 0;
  let following = true;
  const text = h("span", { role: "status" });
  const wanted = number(null, { min: 0, step: 1, "aria-label": `Number of the ${what} to show` });
  /** @type {(text: string, label: string, to: () => number) => HTMLButtonElement} */
  const button = (shown, label, to) => h("button", { type: "button", "aria-label": label, onclick: () => go(to()) }, shown);
  const first = button("First", `First ${what}s`, () => 0);
  const earlier = button("◀ Earlier", `Earlier ${what}s`, () => begin - MOST);
  const later = button("Later ▶", `Later ${what}s`, () => begin + MOST);
  const newest = button("Newest", `Newest ${what}s`, () => entries.length);
  wanted.addEventListener("change", () => {
    const n = Number(wanted.value);
    const at = entries.findIndex((entry) => name(entry) >= n);
    if (wanted.value !== "") go(at < 0 ? entries.length : at);
  });
  const bar = h("div.row", { "data-role": `${what}s-window`, hidden: true }, first, earlier, text, later, newest, h("label", `go to ${what} `, wanted));

  /** @param {number} to */
  function go(to) {
    begin = partOf(to, entries.length);
    following = begin === partOf(entries.length, entries.length);
    show();
    box.scrollTop = 0;
  }

  function show() {
    const shown = entries.slice(begin, begin + MOST);
    replace(box, shown.map(draw));
    bar.hidden = entries.length <= MOST;
    if (bar.hidden || !shown.length) return;
    text.textContent = `${what}s ${name(shown[0])} to ${name(/** @type {T} */ (shown.at(-1)))}, ${entries.length} in all`;
    first.disabled = earlier.disabled = begin === 0;
    later.disabled = newest.disabled = begin + MOST >= entries.length;
  }

  return {
    bar,
    /** @param {readonly T[]} fresh */
    lay(fresh) {
      entries = fresh;
      begin = partOf(following ? entries.length : begin, entries.length);
      show();
    },
  };
}
