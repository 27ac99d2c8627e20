"""The front page and the API's interactive documentation: Swagger UI, served from the service's own files."""

from __future__ import annotations

import html

from fastapi import APIRouter
from fastapi.responses import HTMLResponse
from starlette.requests import Request

from stereorig.server.api.docs.shell import page

router = APIRouter(include_in_schema=False)
_SWAGGER = """
<form id="log-in" hidden><p>This service asks for a key.</p>
<label>Key <input name="key" type="password" autocomplete="off" required></label> <button>Log in</button>
<p id="refused" hidden>No user has this key.</p></form>
<div id="api"></div>
<noscript><p>This page needs JavaScript; <a href="/docs/operations">another</a> does without.</p></noscript>
<script src="/static/vendor/swagger-ui/swagger-ui-bundle.js"></script>
<script src="/static/docs.js"></script>
"""


@router.get("/docs", response_class=HTMLResponse)
def docs() -> str:
    """Show every operation, and let it be tried out."""
    return page("API", _SWAGGER, more_head="<link rel='stylesheet' href='/static/vendor/swagger-ui/swagger-ui.css'>")


@router.get("/docs/operations", response_class=HTMLResponse)
def operations(request: Request) -> str:
    """List every operation, for readers without JavaScript too."""
    rows = []
    for path, methods in request.app.openapi()["paths"].items():
        for method, operation in methods.items():
            summary, text = html.escape(operation.get("summary", "")), html.escape(operation.get("description", ""))
            rows.append(
                f"<tr><td><code>{method.upper()}</code><td><code>{html.escape(path)}</code>"
                f"<td><b>{summary}</b><br><small>{text}</small>"
            )
    return page(
        "Operations",
        "<p>Every operation of the API. <a href='/docs'>Try them out</a>; the description for programs is "
        "<a href='/api/v1/openapi.json'>openapi.json</a>, every error is <a href='/problems'>explained</a>, the rig is "
        f"at <a href='/api/v1/rig'>/api/v1/rig</a>.</p><table>{''.join(rows)}</table>",
    )
