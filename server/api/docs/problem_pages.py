"""One page that lists every code with its cause and remedy; the types of problems point to it."""

from __future__ import annotations

import functools
import html
import json
from pathlib import Path
from typing import Any

from fastapi import APIRouter
from fastapi.responses import HTMLResponse, JSONResponse, Response
from starlette.requests import Request

from stereorig.server.api.docs.shell import page
from stereorig.server.base.errors import NotFoundError

router = APIRouter(include_in_schema=False)
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
