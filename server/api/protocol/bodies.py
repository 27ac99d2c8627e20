"""Bodies: their size by the kind of the request, the thing that they are for, and the number of values in JSON.

No body is taken for a thing that does not exist, and no JSON is parsed that would hold the event loop: the validator
makes a document of each wrong value before one is shown.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable

from fastapi.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stereorig.core.errors import StereorigError
from stereorig.server.api.protocol.problems import problem_response, response_of
from stereorig.server.base.errors import TooLargeError
from stereorig.server.http.rights import by_name
from stereorig.server.workflows.service import Service

JSON_LIMIT = 2**20
#: of a body that may hold a mask
MASK_LIMIT = 32 * 2**20
UPLOAD_LIMIT = 1024 * 2**20
#: entries of lists and objects, and names of objects among them, in a body of JSON
MAX_VALUES = 60_000
MAX_NAMES = 12_000
#: the readings of a live measurement have few names each, and end at the first that is wrong
MAX_READING_NAMES, MAX_NAMES_OF_ONE = 60_000, 1000

_UPLOADS = re.compile(r".*(?:/steps:import|/models|/calibrations:upload)")
_FORMS = re.compile(r".*(?:/calibrations:(?:import|aspect)|/channels:(?:import|preview))")
_MASKS = re.compile(r".*(?:/analyses|/texture|/recipes(?:/[^/]+)?|/workspace|/calibrations/[^/]+:repair)")
_READINGS = re.compile(r".*/live/channels")
_FOR = re.compile(
    r"/api/v1/(tests|calibrations|recipes|certificates)/([^/:]+)(?:/(analyses|steps)/([^/:]+))?(?:[/:].*)?"
)
#: a smaller body is taken before its test or calibration is looked up
_SMALL = 64 * 1024


def limit_of(path: str) -> int:
    """Return the largest body that a request to this path may have, in bytes."""
    if _UPLOADS.fullmatch(path):
        return UPLOAD_LIMIT
    return MASK_LIMIT if _FORMS.fullmatch(path) or _MASKS.fullmatch(path) else JSON_LIMIT


def require_target(service: Service, path: str) -> None:
    """Raise an error if the test, analysis, step, calibration, recipe or certificate of a path is not there.

    Raises
    ------
    NotFoundError
        As the operation itself would.
    """
    found = _FOR.fullmatch(path)
    if found is None:
        return
    kind, name, part, inner = found.groups()
    look: dict[str, Callable[[str], object]] = {
        "tests": service.tests.path,
        "calibrations": service.calibrations.path,
        "recipes": service.recipes.read,
        "certificates": service.certificates.read,
    }
    look[kind](name)
    if kind == "tests" and part == "analyses":
        service.tests.analyses.path(name, inner)
    if kind == "tests" and part == "steps" and inner.isascii() and inner.isdecimal() and len(inner) <= 4:
        service.tests.steps.read(name, int(inner))


class Bodies:
    """Refuses a body that is too large, that no operation reads, or that has too many values; passes all others on."""

    def __init__(self, app: ASGIApp, service: Service) -> None:
        self._app = app
        self._service = service

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check, then pass on."""
        headers = by_name(scope["headers"]) if scope["type"] == "http" else {}
        length = headers.get(b"content-length", "0")
        unknown = b"transfer-encoding" in headers
        if length == "0" and not unknown:
            await self._app(scope, receive, send)
            return
        limit = limit_of(scope["path"])
        if not re.fullmatch("[0-9]{1,15}", length) or int(length) > limit:
            await _too_large(limit)(scope, receive, send)
            return
        if unknown or int(length) > _SMALL:
            try:
                await run_in_threadpool(require_target, self._service, scope["path"])
            except StereorigError as error:
                refusal = response_of(error)
                refusal.headers["Connection"] = "close"  # the body is not taken
                await refusal(scope, receive, send)
                return
        if _UPLOADS.fullmatch(scope["path"]) or _FORMS.fullmatch(scope["path"]):
            await _counted(self._app, limit, scope, receive, send)
            return
        await self._whole(limit, scope, receive, send)

    async def _whole(self, limit: int, scope: Scope, receive: Receive, send: Send) -> None:
        """Take a body of JSON, look at it, and pass it on in one piece."""
        parts, size, more = [], 0, True
        while more:
            message = await receive()
            if message["type"] != "http.request":
                return  # the client is gone
            part, more = message.get("body", b""), message.get("more_body", False)
            size += len(part)
            if size > limit:
                await _too_large(limit)(scope, receive, send)
                return
            parts.append(part)
        body = b"".join(parts)
        refusal = _too_many(body, bool(_READINGS.fullmatch(scope["path"])))
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        given = False

        async def replayed() -> Message:
            nonlocal given
            if given:
                return await receive()
            given = True
            return {"type": "http.request", "body": body, "more_body": False}

        await self._app(scope, replayed, send)


def _too_many(body: bytes, readings: bool) -> ASGIApp | None:
    """Return the answer to a body of too many values; None if it may be parsed. Its texts are counted with it."""
    values = body.count(b",") + body.count(b"[") + body.count(b"{")
    names = body.count(b":")
    most = MAX_READING_NAMES if readings else MAX_NAMES
    if values <= MAX_VALUES and names <= most and (names <= MAX_NAMES or _widest(body) <= MAX_NAMES_OF_ONE):
        return None
    return problem_response(
        422,
        "too_many_values",
        f"The body has about {values} values and {names} names; {MAX_VALUES} and {most} are taken.",
        "Send fewer values in one request.",
        fields=[{"field": "body", "in": "body", "problem": "must have fewer values"}],
    )


def _widest(body: bytes) -> int:
    """Return the most names of one object in a body; 0 for a body that is no JSON."""
    widest = 0

    def look(pairs: list[tuple[str, object]]) -> None:
        nonlocal widest
        widest = max(widest, len(pairs))

    try:
        json.loads(body, object_pairs_hook=look)
    except (ValueError, RecursionError):
        return 0  # it will be refused for that
    return widest


def _too_large(limit: int) -> ASGIApp:
    return problem_response(
        413, "body_too_large", f"The body is larger than {limit} bytes.", "Send less.", headers={"Connection": "close"}
    )


async def _counted(app: ASGIApp, limit: int, scope: Scope, receive: Receive, send: Send) -> None:
    """Pass on, and cut off a body that does not say beforehand how long it is."""
    seen, answered, cut_off = 0, False, False

    async def counted() -> Message:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        if seen > limit:
            raise TooLargeError(f"The body is larger than {limit} bytes.")
        return message

    async def noted(message: Message) -> None:
        nonlocal answered, cut_off
        if cut_off:
            return
        if seen > limit and not answered:
            # overrides the answer of the body's reader
            cut_off = True
            await _too_large(limit)(scope, receive, send)
            return
        answered = True
        await send(message)

    await app(scope, counted, noted)
