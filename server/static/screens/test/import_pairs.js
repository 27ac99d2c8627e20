// Import of existing pairs of images as steps.
import * as api from "../../lib/api.js";
import { h, replace, field, action, table, badge, problemText } from "../../lib/dom.js";

/** @import { Ends } from "#dom" */

/**
 * Pairs of files in the order of their names, numbers in them counted as numbers.
 * @param {ArrayLike<File>} one
 * @param {ArrayLike<File>} two
 * @returns {[File, File][]}
 */
export function pairsOf(one, two) {
  const order = new Intl.Collator("en", { numeric: true });
  const sorted = (/** @type {ArrayLike<File>} */ files) => Array.from(files).sort((a, b) => order.compare(a.name, b.name));
  const [first, second] = [sorted(one), sorted(two)];
  if (first.length !== second.length || !first.length)
    throw api.problemOf({
      detail: `Camera 1 has ${first.length} images, camera 2 has ${second.length}.`,
      remedy: "Choose as many images of each camera; they are matched in the order of their names.",
    });
  return first.map((file, index) => [file, second[index]]);
}

/**
 * @param {string} id
 * @param {() => unknown} refresh
 * @param {Ends} ends
 */
export function importPairs(id, refresh, ends) {
  const accept = ".tif,.tiff,.png,.bmp,.jpg,.jpeg";
  const one = h("input", { type: "file", multiple: true, accept });
  const two = h("input", { type: "file", multiple: true, accept });
  const matched = h("div", { role: "status" });
  const progress = h("div", { role: "status" });
  const byName = h("input", { type: "checkbox", checked: true });
  /** @type {AbortController | null} */
  let going = null;
  const files = (/** @type {HTMLInputElement} */ input) => input.files ?? [];
  ends.push(() => going?.abort());

  function match() {
    if (!files(one).length || !files(two).length) return replace(matched);
    try {
      const pairs = pairsOf(files(one), files(two));
      return replace(
        matched,
        table(
          [
            ["Number", (row) => String(row[2] + 1), { unseen: true }],
            ["Camera 1", (row) => row[0].name],
            ["Camera 2", (row) => row[1].name],
          ],
          pairs.map(([a, b], k) => /** @type {const} */ ([a, b, k])).slice(0, 200),
          { caption: `${pairs.length} pairs, in the order of their names` },
        ),
      );
    } catch (error) {
      return replace(matched, problemText(error));
    }
  }
  one.addEventListener("change", match);
  two.addEventListener("change", match);
  const start = action(
    "Import",
    async () => {
      const pairs = pairsOf(files(one), files(two));
      const stopping = new AbortController();
      going = stopping;
      const bar = h("progress", { max: pairs.length, value: 0, "aria-label": "Progress of the import" });
      const text = h("span");
      replace(
        progress,
        h("div.row", h("span", { style: { flex: 1 } }, bar), text, h("button.danger", { type: "button", onclick: () => stopping.abort() }, "Stop")),
      );
      let ready = 0;
      try {
        for (const [first, second] of pairs) {
          if (stopping.signal.aborted) break;
          text.textContent = `${ready} of ${pairs.length}: ${first.name}`;
          const form = new FormData();
          form.append("cam1", first);
          form.append("cam2", second);
          form.append("label", byName.checked ? first.name.replace(/\.[^.]*$/, "").slice(0, 300) : "");
          try {
            await api.upload(`/tests/${id}/steps:import`, form);
          } catch (error) {
            if (error instanceof Error) error.message = `${first.name} and ${second.name}: ${error.message}`;
            throw error;
          }
          ready += 1;
          bar.value = ready;
        }
      } finally {
        replace(
          progress,
          h(
            "p",
            badge(ready === pairs.length ? "imported" : "stopped", ready === pairs.length ? "good" : "warn"),
            ` ${ready} of ${pairs.length} pairs imported as steps.`,
          ),
        );
        await refresh();
      }
    },
    { kind: "primary" },
  );
  return h(
    "details",
    { style: { marginTop: "0.75rem" } },
    h("summary", "Import existing pairs"),
    h("div.fields", field("Images of camera 1", one), field("Images of camera 2", two)),
    h("label.check", byName, "label each step by its file's name"),
    matched,
    h("div.row", { style: { marginTop: "0.5rem" } }, start),
    progress,
  );
}
