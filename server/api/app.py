"""The app: routes, guard, problems, its own documentation page."""

from __future__ import annotations

import html
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from anyio import CapacityLimiter
from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from server.api import analyses, calibrations, gauges, jobs, noise, problems, results, rig, stage, system, tests
from server.api.guard import LOOPBACK_NAMES, Guard
from server.service import Service
from server.version import software_version

PREFIX = "/api/v1"
_DESCRIPTION = """Stereo measurement of shape and 3-D displacement.

Anything that takes long answers 202 with a job; follow it at `/jobs/{id}` or `/jobs/{id}/events`. Errors are
problem+json (RFC 9457) with a stable `code`, the cause in `detail` and a `remedy`. POSTs that make something take an
`Idempotency-Key`. Lengths are in millimetres in the calibration target's frame unless a name says otherwise."""


def create_app(service: Service, *, hosts: frozenset[str] = LOOPBACK_NAMES, close_service: bool = True) -> FastAPI:
    """Make the app of a service.

    Parameters
    ----------
    hosts
        Host names under which it may be addressed.
    close_service
        Close the service when the app shuts down.
    """

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        yield
        if close_service:
            service.close()

    app = FastAPI(
        title="stereorig",
        version=software_version().split("+")[0],
        description=_DESCRIPTION,
        lifespan=lifespan,
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,  # the stock page loads from elsewhere
        redoc_url=None,
    )
    app.state.service = service
    app.state.streams = 0
    app.state.view_limiter = CapacityLimiter(4)
    problems.install(app)
    for module in (system, rig, stage, noise, calibrations, tests, analyses, results, gauges, jobs):
        app.include_router(module.router, prefix=PREFIX)
    app.add_api_route("/healthz", system.healthz, include_in_schema=False)
    app.add_api_route("/metrics", system.metrics, include_in_schema=False)
    app.add_api_route("/docs", lambda: HTMLResponse(_page(app)), include_in_schema=False, response_class=HTMLResponse)
    app.add_api_route("/", lambda: HTMLResponse(_page(app)), include_in_schema=False, response_class=HTMLResponse)
    _name_problem(app)
    app.add_middleware(Guard, allowed=hosts)
    return app


def _name_problem(app: FastAPI) -> None:
    """Put the problem's schema where the operations' error responses point, in place of FastAPI's own."""
    make = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = make()
            components = schema.setdefault("components", {}).setdefault("schemas", {})
            components["Problem"] = problems.Problem.model_json_schema()
            for name in ("HTTPValidationError", "ValidationError"):
                components.pop(name, None)
            for path in schema["paths"].values():
                for operation in path.values():
                    # the guard's, before any operation sees the request
                    operation.setdefault("responses", {}).update(problems.errors(403))
                    invalid = operation.get("responses", {}).get("422")
                    if invalid is not None and "application/json" in invalid.get("content", {}):
                        operation["responses"]["422"] = problems.errors(422)[422]
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _page(app: FastAPI) -> str:
    rows = []
    for path, operations in app.openapi()["paths"].items():
        for method, operation in operations.items():
            summary, text = html.escape(operation.get("summary", "")), html.escape(operation.get("description", ""))
            rows.append(
                f"<tr><td><code>{method.upper()}</code><td><code>{html.escape(path)}</code>"
                f"<td><b>{summary}</b><br><small>{text}</small>"
            )
    return (
        "<!doctype html><meta charset=utf-8><title>stereorig</title><style>body{font:15px system-ui,sans-serif;"
        "margin:2em;max-width:72em;color-scheme:light dark}td{padding:.3em .8em .3em 0;vertical-align:top}</style>"
        f"<h1>stereorig {html.escape(software_version())}</h1><p>Every operation of the API; its full description is "
        f'<a href="{PREFIX}/openapi.json">openapi.json</a>. The rig is at <a href="{PREFIX}/rig">{PREFIX}/rig</a>.'
        f"<table>{''.join(rows)}</table>"
    )
