// The verification certificates: verdict, whether each still holds, its page.
import * as api from "../lib/api.js";
import * as events from "../lib/events.js";
import { badge, h, problemText, replace, table, when } from "../lib/dom.js";

/** @import { Model } from "#routes" */
/** @typedef {Model<"CertificateEntry">} Certificate */

const KINDS = /** @type {const} */ ({
  pass: "good",
  conditional: "warn",
  fail: "bad",
  valid: "good",
  failed: "bad",
  expired: "warn",
  void: "warn",
  withdrawn: "warn",
});

/** A panel with the certificates, which follows those that are made; it is empty and hidden while there is none. */
export function certificates() {
  const element = h("section.panel", { hidden: true });

  async function draw() {
    try {
      const found = (await api.get("/certificates")).certificates.reverse();
      element.hidden = !found.length;
      replace(
        element,
        h("h2", "Certificates"),
        table(
          [
            ["Certificate", (one) => h("a", { href: `${api.BASE}/certificates/${one.id}/report`, target: "_blank", rel: "noopener" }, one.title || one.id)],
            ["Verdict", (one) => badge(one.outcome, KINDS[one.outcome])],
            ["Now", (one) => h("span", { title: one.why }, badge(one.state, KINDS[one.state]))],
            ["Valid until", (one) => (one.valid_until_utc ? when(one.valid_until_utc) : "–")],
          ],
          /** @type {Certificate[]} */ (found),
          { caption: "Certificates, newest first" },
        ),
      );
    } catch (error) {
      element.hidden = false;
      replace(element, h("h2", "Certificates"), problemText(error));
    }
  }

  const ended = events.on("job", (job) => {
    if (job.kind === "certificate" && job.state === "succeeded") draw();
  });
  draw();
  return { element, close: ended };
}
