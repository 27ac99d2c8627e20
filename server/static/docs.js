// Shows the API with Swagger UI, from files of this service alone. Where a key is asked for, the page asks for it first.
"use strict";

const DESCRIPTION = "/api/v1/openapi.json";

async function show() {
  const answer = await fetch(DESCRIPTION, { credentials: "same-origin" });
  if (answer.status === 401 || answer.status === 403) {
    document.getElementById("log-in").hidden = false;
    return;
  }
  document.getElementById("log-in").hidden = true;
  SwaggerUIBundle({
    spec: await answer.json(),
    dom_id: "#api",
    deepLinking: true,
    displayRequestDuration: true,
    docExpansion: "list",
    filter: true,
    validatorUrl: null, // nothing is sent elsewhere
    presets: [SwaggerUIBundle.presets.apis],
    layout: "BaseLayout",
  });
}

document.getElementById("log-in").addEventListener("submit", async (event) => {
  event.preventDefault();
  const key = new FormData(event.target).get("key");
  const answer = await fetch("/api/v1/session", { method: "POST", headers: { Authorization: `Bearer ${key}` } });
  document.getElementById("refused").hidden = answer.ok;
  if (answer.ok) show();
});

show();
