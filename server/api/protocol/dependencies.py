"""Parameters of routes: the service, the Idempotency-Key, ids in paths."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import time
from typing import Annotated

from fastapi import Depends, Header, Path, Query, Request
from pydantic import BaseModel
from starlette.convertors import StringConvertor, register_url_convertor

from stereorig.core.errors import StateError
from stereorig.core.names import CameraName
from stereorig.core.settings import MAX_COVERAGE, MAX_COVERAGE_FACTOR, Coverage, CoverageFields
from stereorig.server.api.protocol.paging import WHOLE
from stereorig.server.formats.results.uncertainty import coverage_of
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import FINAL
from stereorig.server.workflows.service import Service


class _NoAction(StringConvertor):
    """An id at the end of a path, where ``id:action`` is another operation."""

    regex = "[^/:]+"


class _NoNeighbour(StringConvertor):
    """A camera at the end of a path, where another word is another operation."""

    regex = "(?!texture$)[^/]+"


# else a method that an operation does not have would be answered by the operation whose parameter takes its name
register_url_convertor("plain_id", _NoAction())
register_url_convertor("camera", _NoNeighbour())


def get_service(request: Request) -> Service:
    """Return the service that the app was made for."""
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(get_service)]
KeyHeader = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        description="Send the same key again after a lost reply: the request has one effect.",
    ),
]
TestId = Annotated[str, Path(max_length=40, description="Id of a test.")]
AnalysisId = Annotated[str, Path(max_length=40, description="Id of an analysis.")]
CalibrationId = Annotated[str, Path(max_length=40, description="Id of a calibration.")]
JobId = Annotated[str, Path(max_length=40, description="Id of a job.")]
Camera = Annotated[CameraName, Path(description="Which camera.")]
FrameText = Annotated[
    str | None,
    Query(
        max_length=2000,
        description="Frame of positions, displacements and strain: `system`, as stored (the default); `specimen`, the "
        "test's; or one written out in JSON, as a gauge's `align`.",
        examples=["specimen"],
    ),
]
StepNumber = Annotated[int, Path(ge=0, le=9999, description="Number of a step.")]
_ABOUT_COVERAGE = {name: field.description for name, field in CoverageFields.model_fields.items()}


def get_coverage(
    k: Annotated[
        float | None, Query(gt=0.0, le=MAX_COVERAGE_FACTOR, description=_ABOUT_COVERAGE["k"], examples=[2.0])
    ] = None,
    coverage: Annotated[float | None, Query(gt=0.0, le=MAX_COVERAGE, description=_ABOUT_COVERAGE["coverage"])] = None,
) -> Coverage:
    """Return the coverage of the intervals that a request asks for."""
    return coverage_of(k, coverage)


CoverageDep = Annotated[Coverage, Depends(get_coverage)]


def mark(scope: str, key: str | None, body: BaseModel | None, *parts: bytes) -> RequestMark:
    """Return a request's mark: the hash of the stated values only, since defaults may change some day."""
    digest = hashlib.sha256(b"" if body is None else body.model_dump_json(exclude_unset=True).encode())
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return RequestMark(scope, key, digest.hexdigest())


def person_name(request: Request) -> str:
    """Return the caller's name, to be stored with a change; ``local`` if no key is required."""
    person = getattr(request.state, "person", None)
    return "local" if person is None else str(person.name)


# Answering at once, or staying with a job to its end.

Attached = Annotated[
    bool,
    Query(
        description="Answer when the job has ended; should the client go away before, it is cancelled and the stage "
        "stopped (a handle that must be held)."
    ),
]
#: longest wait; proxies give up on an answer after a minute, mostly
MAX_WAIT_S = 60
Wait = Annotated[
    float,
    Query(
        ge=0,
        le=MAX_WAIT_S,
        allow_inf_nan=False,
        description="Seconds to wait, at most, for the job's end; the answer shows the job as it is then. It continues "
        "whether the client stays or not.",
    ),
]
_ATTEND_S = 0.05


async def waited(request: Request, service: Service, job_id: str, wait_s: float) -> None:
    """Return when the job has ended, the time is over or the client has gone."""
    until = time.monotonic() + wait_s
    while (
        service.jobs.document(job_id).state not in FINAL
        and (left := until - time.monotonic()) > 0.0
        and not await request.is_disconnected()
    ):
        await asyncio.sleep(min(_ATTEND_S, left))


async def job_reply(
    request: Request, service: Service, job_id: str, attached: bool = False, wait_s: float = 0.0
) -> dict[str, object]:
    """Answer at once or after a wait; or stay with the job to its end and stop it when the client goes away."""
    if not attached:
        await waited(request, service, job_id, wait_s)
    while attached and service.jobs.document(job_id).state not in FINAL:
        if await request.is_disconnected():
            with contextlib.suppress(StateError):  # it ended just now
                await asyncio.get_running_loop().run_in_executor(service.stop_thread, service.jobs.cancel, job_id)
            break
        await asyncio.sleep(_ATTEND_S)
    return {"job": service.jobs.document(job_id).bounded(WHOLE).plain()}
