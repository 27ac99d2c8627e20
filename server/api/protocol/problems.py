"""Every error as RFC 9457 problem+json: stable code, cause, remedy."""

from __future__ import annotations

import logging
import re
from http import HTTPStatus
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.routing import compile_path

from stereorig.core.errors import (
    CalibrationError,
    DeviceError,
    InputError,
    MeasurementError,
    StateError,
    StereorigError,
    StorageError,
)
from stereorig.server.base.errors import NotFoundError, QueueFullError, TooLargeError
from stereorig.server.base.problem import problem_of, without_paths
from stereorig.server.wording import field_problem

_log = logging.getLogger("stereorig.api")
_PARAMETER = re.compile(r"\{[^{}]*\}")

MEDIA_TYPE = "application/problem+json"
#: wrong values of a request that an answer lists
_FIRST = 20
RETRY_AFTER_S = 5

#: device errors that are the caller's doing, not the device's
_BY_CODE = {
    "configuration_state": 409,
    "not_in_configuration": 409,
    "units_changed": 409,
    "out_of_limits": 422,
    "out_of_range": 422,
    "invalid_axis": 422,
    "not_homed": 409,
    "motor_off": 409,
    "stage_stopped": 409,
    "wrong_trigger": 409,
    "skew_too_large": 409,
    "shutting_down": 503,
    "checksum_mismatch": 409,
    "file_missing": 409,
    "folder_copied": 409,
    "image_too_large": 413,
    "unknown_feature": 422,
    "wrong_camera": 409,
    "precondition_failed": 412,
    "precondition_required": 428,
    "metadata_changed": 412,
}

#: the first that fits counts
_BY_CLASS: tuple[tuple[type[StereorigError], int], ...] = (
    (NotFoundError, 404),
    (TooLargeError, 413),
    (QueueFullError, 503),
    (InputError, 422),
    (CalibrationError, 422),
    (StateError, 409),
    (MeasurementError, 409),
    (StorageError, 507),
    (DeviceError, 503),
)


class Problem(BaseModel):
    """An error (RFC 9457)."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="Stable URI reference of this kind of error.", examples=["/problems/hardware_busy"])
    title: str = Field(description="The status in words.")
    status: int = Field(description="HTTP status.")
    detail: str = Field(description="The cause, with the values that disagree.")
    code: str = Field(description="Stable snake_case code.")
    remedy: str = Field(description="Remedy for the caller.")


def status_of(error: StereorigError) -> int:
    """HTTP status of an error of the project's tree."""
    return status_of_class(type(error), error.code)


def status_of_class(cls: type[StereorigError], code: str) -> int:
    """HTTP status of the errors of a class with a code."""
    if code in _BY_CODE:
        return _BY_CODE[code]
    for base, status in _BY_CLASS:
        if issubclass(cls, base):
            return status
    return 500


def problem_response(
    status: int, code: str, detail: str, remedy: str, *, headers: dict[str, str] | None = None, **more: Any
) -> JSONResponse:
    """Build a problem+json response."""
    body = {
        "type": f"/problems/{code}",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": without_paths(detail),
        "code": code,
        "remedy": without_paths(remedy),
        **more,
    }
    return JSONResponse(body, status_code=status, media_type=MEDIA_TYPE, headers=headers)


def response_of(error: StereorigError) -> JSONResponse:
    """Return the problem of an error of the project's tree."""
    status = status_of(error)
    described = problem_of(error)
    headers = {"Retry-After": str(RETRY_AFTER_S)} if status == 503 else None
    context = {k: v for k, v in described.context.items() if k not in Problem.model_fields}
    return problem_response(status, error.code, error.cause, error.remedy, headers=headers, **context)


def install(app: FastAPI) -> None:
    """Make ``app`` answer every error as a problem."""

    @app.exception_handler(StereorigError)
    async def _known(request: Request, error: StereorigError) -> JSONResponse:
        if isinstance(error, NotFoundError | StorageError) or error.code in ("file_missing", "file_unreadable"):
            folder = _folder_problem(request)
            if folder is not None and (folder.code == "data_folder_gone" or isinstance(error, StorageError)):
                return response_of(folder)
        return response_of(error)

    @app.exception_handler(RequestValidationError)
    async def _invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        every = error.errors()
        found = [(str(one["loc"][0]), field_problem(one, skip=1)) for one in every[:_FIRST]]
        fields = [{"field": one.field or where, "in": where, "problem": one.problem} for where, one in found]
        wrong = " ".join(str(one) for _, one in found[:3])
        more = f" {len(found) - 3} more values are wrong; `fields` has them." if len(found) > 3 else ""
        if len(every) > _FIRST:
            more = f" These are of the first {_FIRST} of {len(every)} values that are wrong."
        if all(item["type"] == "values_disagree" for item in every):
            return problem_response(
                422,
                "values_disagree",
                f"{wrong}{more}",
                "Each value is right by itself; change one of them so that they fit each other.",
                fields=fields,
            )
        return problem_response(
            422, "invalid_request", f"{wrong}{more}", "Correct the values named above.", fields=fields
        )

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        codes = {400: "malformed_request", 404: "not_found", 405: "method_not_allowed", 413: "body_too_large"}
        # a body that cannot be parsed at all is as invalid as one with a wrong field
        status = 422 if error.status_code == 400 else error.status_code
        code = codes.get(error.status_code, "http_error")
        headers = dict(error.headers) if error.headers else {}
        if error.status_code == 405:
            # the router considers the first route with this path only
            headers["Allow"] = ", ".join(_methods_of(app, request.scope["path"]))
        return problem_response(
            status, code, f"{str(error.detail).rstrip('.')}.", "See /docs for the API.", headers=headers
        )

    @app.exception_handler(FileNotFoundError)
    async def _gone(request: Request, error: FileNotFoundError) -> JSONResponse:
        if (folder := _folder_problem(request)) is not None:
            return response_of(folder)
        cause = f"{Path(error.filename or 'A file').name} was deleted while it was being read."
        return problem_response(404, "not_found", cause, "List the entries, and use one of their ids.")

    @app.exception_handler(Exception)
    async def _unknown(_request: Request, error: Exception) -> JSONResponse:
        _log.exception("unexpected error")
        cause = f"{type(error).__name__} inside the service."
        return problem_response(500, "internal_error", cause, "Report this with the service's log.")


def _folder_problem(request: Request) -> StorageError | None:
    """Return the error of a data folder that is gone or read-only; None if it is there."""
    service = getattr(request.app.state, "service", None)
    try:
        if service is not None:
            service.folder.require_there()
    except StorageError as error:
        return error
    return None


def _methods_of(app: FastAPI, path: str) -> list[str]:
    """Return every method that a path serves; of templates that fit it, the one with most words of its own counts."""
    paths = app.openapi()["paths"]
    fitting = [template for template in paths if compile_path(template)[0].match(path)]
    if not fitting:
        return ["GET"]
    operations = paths[max(fitting, key=lambda template: len(_PARAMETER.sub("", template)))]
    return sorted({method.upper() for method in operations} | ({"HEAD"} if "get" in operations else set()))


def errors(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the ``responses`` of an operation: its problems, for OpenAPI."""
    texts = {
        401: "No key, or a wrong one",
        403: "Foreign Host, Origin or site, or a role that may not",
        429: "Too many requests",
        404: "No such thing",
        409: "Wrong moment: busy hardware or wrong state",
        412: "It was changed since: If-Match names another state",
        413: "Body or image too large",
        415: "Not a form this operation reads",
        422: "Invalid input",
        428: "If-Match is missing",
        503: "Device fault, or too many computations waiting; see Retry-After",
        507: "The disk did not keep its promise",
    }
    later = {"Retry-After": {"description": "Seconds to wait.", "schema": {"type": "integer", "minimum": 1}}}
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        s: {"description": texts[s], "content": content, **({"headers": later} if s in (429, 503) else {})}
        for s in statuses
    }
