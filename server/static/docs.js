// Shows the API with Swagger UI, from files of this service alone. If the service requires a key, the page asks for it first.
/** @import { SwaggerUI } from "#swagger" */

const swagger = /** @type {{ SwaggerUIBundle: SwaggerUI }} */ (/** @type {unknown} */ (window)).SwaggerUIBundle;
/** @param {string} id */
const part = (id) => /** @type {HTMLElement} */ (document.getElementById(id));
const DESCRIPTION = "/api/v1/openapi.json";

async function show() {
  const answer = await fetch(DESCRIPTION, { credentials: "same-origin" });
  if (answer.status === 401 || answer.status === 403) {
    part("log-in").hidden = false;
    return;
  }
  part("log-in").hidden = true;
  swagger({
    spec: await answer.json(),
    dom_id: "#api",
    deepLinking: true,
    displayRequestDuration: true,
    docExpansion: "list",
    filter: true,
    validatorUrl: null, // nothing is sent elsewhere
    presets: [swagger.presets.apis],
    layout: "BaseLayout",
  });
}

part("log-in").addEventListener("submit", async (event) => {
  event.preventDefault();
  const key = new FormData(/** @type {HTMLFormElement} */ (event.target)).get("key");
  const answer = await fetch("/api/v1/session", { method: "POST", headers: { Authorization: `Bearer ${key}` } });
  part("refused").hidden = answer.ok;
  if (answer.ok) show();
});

show();
