"""Parameters of routes: the service, the Idempotency-Key, ids in paths."""

from __future__ import annotations

import hashlib
from typing import Annotated

from fastapi import Depends, Header, Path, Query, Request
from pydantic import BaseModel
from starlette.convertors import StringConvertor, register_url_convertor

from stereorig.core.names import CameraName
from stereorig.core.settings import MAX_COVERAGE, MAX_COVERAGE_FACTOR, Coverage, CoverageFields
from stereorig.server.formats.results.uncertainty import coverage_of
from stereorig.server.jobs.idempotency import RequestMark
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
