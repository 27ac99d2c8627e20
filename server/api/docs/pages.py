"""The front page and the API's interactive documentation: Swagger UI, served from the service's own files."""

from __future__ import annotations

import functools
import html
import json
from pathlib import Path
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, Response
from fastapi.staticfiles import StaticFiles
from starlette.requests import Request

from stereorig.server.base.errors import NotFoundError
from stereorig.server.formats.version import software_version

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


# The page: the files of `server/static`, unchanged.

STATIC = Path(__file__).resolve().parents[2] / "static"


class _Files(StaticFiles):
    """Static files that a browser asks for again after each update of the program (by ETag, so mostly 304)."""

    def file_response(self, *args: object, **kwargs: object) -> Response:
        response = super().file_response(*args, **kwargs)  # type: ignore[arg-type]
        response.headers["Cache-Control"] = "no-cache"
        return response


def install(app: FastAPI) -> None:
    """Serve the page at ``/`` and its files below ``/static``."""

    def index() -> FileResponse:
        return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})

    app.add_api_route("/", index, include_in_schema=False, response_class=FileResponse)
    app.mount("/static", _Files(directory=STATIC), name="static")


# The service's own pages: plain HTML with nothing from elsewhere.

_HEAD = (
    "<!doctype html><html lang='en'><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
    "<link rel='stylesheet' href='/static/reference.css'>"
)
_LINKS = {"/": "stereorig", "/docs": "API", "/docs/operations": "Operations", "/problems": "Problems"}
_NAVIGATION = f"<nav>{' '.join(f'<a href={link!r}>{name}</a>' for link, name in _LINKS.items())}</nav>"


def page(title: str, body: str, *, more_head: str = "") -> str:
    """Return a page; ``body`` and ``more_head`` are HTML, ``title`` is text."""
    shown = html.escape(title)
    version = html.escape(software_version())
    return (
        f"{_HEAD}<title>{shown} - stereorig</title>{more_head}{_NAVIGATION}<main><h1>{shown}</h1>{body}</main>"
        f"<footer>stereorig {version}</footer></html>"
    )


# One page that lists every code with its cause and remedy; the types of problems point to it.

_LIST = Path(__file__).resolve().parents[2] / "static" / "problems.json"
_INTRODUCTION = (
    "<p>Every error is <code>problem+json</code> (RFC 9457): the <code>code</code> is stable, <code>detail</code> is "
    "the cause with the values that disagree, <code>remedy</code> is the advice. Words in braces stand for "
    "values. The command line prints the same codes. The same list as <a href='/problems.json'>JSON</a>.</p>"
)


@functools.cache
def known_problems() -> dict[str, Any]:
    """Return status, causes and remedies of every code that can be raised."""
    return dict(json.loads(_LIST.read_text(encoding="utf-8")))


def _row(code: str, problem: dict[str, Any]) -> str:
    cells = ["<br>".join(html.escape(text) for text in problem[part]) for part in ("causes", "remedies")]
    status = ", ".join(str(status) for status in problem["status"])
    name = f"<a href='/problems/{code}'><code>{code}</code></a>"
    return f"<tr id='{code}'><td>{name}<td>{status}<td>{cells[0]}<td>{cells[1]}"


def _table(codes: dict[str, Any]) -> str:
    rows = "".join(_row(code, problem) for code, problem in codes.items())
    return f"<table><tr><th>code<th>HTTP status<th>cause<th>remedy{rows}</table>"


def _wants_json(request: Request) -> bool:
    accepted = request.headers.get("accept", "")
    return "json" in accepted and "text/html" not in accepted


@router.get("/problems")
def list_problems(request: Request) -> Response:
    """Return every code, cause and remedy; as JSON to those who ask for it."""
    if _wants_json(request):
        return JSONResponse(known_problems())
    return HTMLResponse(page("Problems", _INTRODUCTION + _table(known_problems())))


@router.get("/problems.json")
def problems_json() -> Response:
    """Return the same as JSON."""
    return JSONResponse(known_problems())


@router.get("/problems/{code}")
def one_problem(request: Request, code: str) -> Response:
    """Return the description of a problem, to which its ``type`` points."""
    problem = known_problems().get(code)
    if problem is None:
        raise NotFoundError(f"There is no problem {code[:60]!r}.", kind="problem", remedy="See /problems.")
    if _wants_json(request):
        return JSONResponse({"code": code, **problem})
    text = f"{_table({code: problem})}<p><a href='/problems#{code}'>All problems</a></p>"
    return HTMLResponse(page(code, text))
