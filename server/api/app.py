"""The app: routes, guard, problems, its own documentation page."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from anyio import CapacityLimiter
from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from starlette.types import Lifespan

from stereorig.server.api.docs import openapi
from stereorig.server.api.docs import pages as doc_pages
from stereorig.server.api.protocol import problems
from stereorig.server.api.protocol.audit import Recorder
from stereorig.server.api.protocol.auth import AccessRules, Door
from stereorig.server.api.protocol.bodies import Bodies
from stereorig.server.api.protocol.delivery import Delivery
from stereorig.server.api.protocol.guard import Guard
from stereorig.server.api.routes.analyses import (
    analyses,
    comparison,
    evaluations,
    exports,
    gauges,
    history,
    picking,
    previews,
    region,
    repetition,
    report,
    results,
)
from stereorig.server.api.routes.calibrations import calibrations, guide, noise, repair, review, uploads
from stereorig.server.api.routes.calibrations import checks as calibration_checks
from stereorig.server.api.routes.calibrations import exports as calibration_exports
from stereorig.server.api.routes.certificates import certificates, procedure
from stereorig.server.api.routes.rig import cameras, devices, live_check, prints, stage
from stereorig.server.api.routes.service import jobs, session, system
from stereorig.server.api.routes.tests import channels, frame, live, metadata, models, recipes, tests, watch, workspace
from stereorig.server.api.routes.tests.trash import router as trash_router
from stereorig.server.http.line_protocol import LineServer
from stereorig.server.http.rights import LOOPBACK_NAMES, Callers
from stereorig.server.http.shutout import ShutOut
from stereorig.server.store.audit_log import AuditLog
from stereorig.server.workflows.calibration.guided import Guides
from stereorig.server.workflows.live.runs import LiveRuns
from stereorig.server.workflows.live_check import LiveChecks
from stereorig.server.workflows.recording import Recordings
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.watch import Watches

PREFIX = "/api/v1"
_DESCRIPTION = """Stereo measurement of shape and 3-D displacement.

Anything that takes long answers 202 with a job; with `?wait=30` once the job has ended, or after so many seconds; so
does `GET /jobs/{id}?wait=30`, and `/jobs/{id}/events` follows it. Errors are problem+json (RFC 9457) with a stable
`code`, the cause in `detail` and a `remedy`; so is the `problem` of a job. What is no plain reading or changing of a
thing is `thing:verb`. POSTs that make something take an `Idempotency-Key`. What GET answers, HEAD does without a body.
Answers have an ETag; asked with it in `If-None-Match`, they come as 304 while nothing has changed, and changes with
`If-Match` are refused where something has. Lists come in pages: `next_cursor` leads to the next one. Answers are
compressed for those who accept gzip. Lengths are in millimetres in the calibration target's frame unless a name states
another one."""


def create_app(
    service: Service,
    *,
    hosts: frozenset[str] = LOOPBACK_NAMES,
    keys_required: bool | None = None,
    close_service: bool = True,
) -> FastAPI:
    """Make the app of a service.

    Parameters
    ----------
    hosts
        Host names under which it may be addressed.
    keys_required
        True if every request needs a key; left out, as the rig file demands.
    close_service
        Close the service when the app shuts down.
    """

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        await lines.start()
        audit.open()
        yield
        await lines.close()
        await run_in_threadpool(live_runs.close)
        audit.close()
        if close_service:
            service.close()

    section = service.config.service
    audit = AuditLog(service.folder.root)
    shut_out = ShutOut(audit.write)
    rules = AccessRules(
        Callers(service.folder.root),
        required=section.require_key if keys_required is None else keys_required,
        requests_per_s=section.requests_per_s,
        shut_out=shut_out,
    )

    live_runs = LiveRuns(service)
    lines = LineServer(service.config.live, live_runs, shut_out)
    app = bare_app(lifespan)
    app.state.live_runs = live_runs
    app.state.lines = lines
    app.state.service = service
    app.state.callers = rules.callers
    app.state.watches = Watches(service)
    app.state.recordings = Recordings(service)
    app.state.guides = Guides(service)
    app.state.live_checks = LiveChecks(service)
    app.state.view_limiter = CapacityLimiter(4)
    app.add_api_route("/healthz", system.healthz, include_in_schema=False)
    app.add_api_route("/readyz", system.readyz, include_in_schema=False)
    app.add_api_route("/metrics", system.metrics, include_in_schema=False)
    app.include_router(doc_pages.router)
    doc_pages.install(app)
    # the last that is added is the first that a request meets
    app.add_middleware(Delivery)
    app.add_middleware(Bodies, service=service)
    app.add_middleware(Door, rules=rules)
    app.add_middleware(Guard, allowed=hosts | frozenset(section.allowed_hosts))
    app.add_middleware(Recorder, log=audit, metrics=service.metrics)
    return app


def bare_app(lifespan: Lifespan[FastAPI] | None = None) -> FastAPI:
    """Make the app without a service: its routes, and the description of them."""
    app = FastAPI(
        title="stereorig",
        version=openapi.API_VERSION,
        description=_DESCRIPTION,
        lifespan=lifespan,
        openapi_url=f"{PREFIX}/openapi.json",
        generate_unique_id_function=openapi.operation_id,
        docs_url=None,  # the stock page loads from elsewhere
        redoc_url=None,
    )
    problems.install(app)
    for module in (
        system,
        session,
        cameras,
        devices,
        live_check,
        prints,
        stage,
        noise,
        calibrations,
        repair,
        uploads,
        calibration_exports,
        calibration_checks,
        review,
        guide,
        tests,
        metadata,
        frame,
        workspace,
        recipes,
        watch,
        channels,
        models,
        live,
        analyses,
        picking,
        region,
        repetition,
        results,
        history,
        gauges,
        comparison,
        evaluations,
        exports,
        report,
        certificates,
        procedure,
        jobs,
        previews,
    ):
        app.include_router(module.router, prefix=PREFIX)
    app.include_router(trash_router, prefix=PREFIX)
    make = app.openapi

    def described() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = openapi.describe(make())
        return app.openapi_schema

    app.openapi = described  # type: ignore[method-assign]
    return app
