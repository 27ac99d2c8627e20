"""Delivery of answers: entity tags and 304, HEAD, gzip."""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import json
import zlib
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

import anyio
from fastapi import Header, Response
from pydantic import BaseModel
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stereorig.core.errors import StateError

_MIN_BYTES = 1024
_IN_THREAD = 64 * 1024  # more than this takes longer than the event loop may be held up
_LEVEL = 4
_COMPRESSIBLE = ("application/json", "application/problem+json", "text/", "image/svg+xml", "application/javascript")
_ENDLESS = ("text/event-stream", "multipart/")
_SUFFIX = "-gzip"


class Delivery:
    """Gives answers to GET an ETag and answers 304, answers HEAD, compresses answers that become smaller."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and deliver its answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        answer = _Answer(scope, receive, send)
        try:
            if scope["method"] == "HEAD":
                await answer.head(self._app)
            else:
                await self._app(answer.scope, receive, answer.forward)
        except* anyio.BrokenResourceError:
            # FastAPI lets this through where who followed a stream left while an event was on its way
            if not answer.endless:
                raise
        finally:
            # which operation it was: the counter of requests reads it from the scope that it was given
            if "route" in answer.scope:
                scope["route"] = answer.scope["route"]


def _plain(headers: list[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
    """Return a request's headers with the ETags of compressed answers replaced by the uncompressed ones."""
    conditional = (b"if-match", b"if-none-match")
    return [(k, v.replace(f'{_SUFFIX}"'.encode(), b'"') if k.lower() in conditional else v) for k, v in headers]


class _Answer:
    """One answer on its way."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        asked = Headers(scope=scope)
        self._head = scope["method"] == "HEAD"
        self._reads = scope["method"] in ("GET", "HEAD")
        self.scope: Scope = {
            **scope,
            "headers": _plain(scope["headers"]),
            "method": "GET" if self._head else scope["method"],
        }
        self._known = Headers(scope=self.scope).get("if-none-match")
        self._gzip = "gzip" in asked.get("accept-encoding", "")
        self._receive, self._send = receive, send
        self._start: Message | None = None
        self._compressor: Any = None
        self._ended = asyncio.Event()
        self.endless = False

    async def head(self, app: ASGIApp) -> None:
        """Let the GET be answered, send its headers alone, and end an endless answer."""
        work = asyncio.ensure_future(app(self.scope, self._receive, self.forward))
        waiting = asyncio.ensure_future(self._ended.wait())
        try:
            await asyncio.wait({work, waiting}, return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                work.result()
        finally:
            for task in (work, waiting):
                task.cancel()
            await asyncio.gather(work, waiting, return_exceptions=True)

    async def forward(self, message: Message) -> None:
        """Take a message of the app."""
        if message["type"] == "http.response.start":
            self._start = message
            if MutableHeaders(scope=message).get("content-type", "").startswith(_ENDLESS):
                self.endless = True
                # nothing may happen for long: who listens must hear at once that it is heard
                if self._head:
                    await self._finish_head()
                else:
                    self._start = None
                    await self._send(message)
        elif message["type"] == "http.response.body" and not self._ended.is_set():
            await self._body(message)
        elif message["type"] not in ("http.response.body",):
            await self._send(message)

    async def _body(self, message: Message) -> None:
        body, more = message.get("body", b""), message.get("more_body", False)
        if self._start is not None:
            start, self._start = self._start, None
            headers = MutableHeaders(scope=start)
            kind = headers.get("content-type", "")
            if self._reads and start["status"] == 200 and not more and kind.startswith("application/json"):
                headers.setdefault("ETag", f'"{hashlib.sha256(body).hexdigest()[:32]}"')
            if self._unchanged(start["status"], headers):
                await self._not_modified(start)
                return
            body = await self._compressed_first(start, headers, kind, body, more)
            if self._head:
                self._start = start
                await self._finish_head()
                return
            await self._send(start)
        elif self._compressor is not None:
            body = self._compressor.compress(body) + (b"" if more else self._compressor.flush())
        await self._send({**message, "body": body})

    def _unchanged(self, status: int, headers: MutableHeaders) -> bool:
        etag = headers.get("etag")
        if not self._reads or status != 200 or etag is None or self._known is None:
            return False
        return self._known.strip() == "*" or etag.removeprefix("W/") in tags_in(self._known)

    async def _not_modified(self, start: Message) -> None:
        headers = MutableHeaders(scope=start)
        for name in ("content-length", "content-type", "content-disposition", "accept-ranges"):
            if name in headers:
                del headers[name]
        headers.add_vary_header("Accept-Encoding")
        await self._send({**start, "status": 304})
        await self._send({"type": "http.response.body", "body": b""})
        self._ended.set()

    async def _compressed_first(
        self, start: Message, headers: MutableHeaders, kind: str, body: bytes, more: bool
    ) -> bytes:
        fits = kind.startswith(_COMPRESSIBLE) and not kind.startswith(_ENDLESS) and "content-encoding" not in headers
        if not fits or start["status"] == 206:
            return body
        headers.add_vary_header("Accept-Encoding")
        if not self._gzip or (not more and len(body) < _MIN_BYTES):
            return body
        if more:
            self._compressor = zlib.compressobj(_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
            body = self._compressor.compress(body)
            del headers["content-length"]
        elif len(body) > _IN_THREAD:
            body = await anyio.to_thread.run_sync(gzip.compress, body, _LEVEL)
        else:
            body = gzip.compress(body, _LEVEL)
        if not more:
            headers["Content-Length"] = str(len(body))
        headers["Content-Encoding"] = "gzip"
        if "accept-ranges" in headers:
            del headers["accept-ranges"]
        etag = headers.get("etag")
        if etag is not None and etag.endswith('"'):
            headers["ETag"] = f'{etag[:-1]}{_SUFFIX}"'
        return body

    async def _finish_head(self) -> None:
        assert self._start is not None
        start, self._start = self._start, None
        await self._send(start)
        await self._send({"type": "http.response.body", "body": b""})
        self._ended.set()


# Entity tags: which state of a thing a client has seen, and refusing a change that was meant for another one.

IfMatch = Annotated[
    str | None,
    Header(
        max_length=1000,
        description="ETag of the state that is to be changed, as it was read; `*` for any. Another state is refused.",
    ),
]


class PreconditionFailedError(StateError):
    """The thing was changed since it was read."""

    code = "precondition_failed"
    remedy = "Read it again, then send the change with the new ETag."


class PreconditionRequiredError(StateError):
    """A change must say which state it was meant for."""

    code = "precondition_required"
    remedy = "Send If-Match with the ETag that reading it gave, or `If-Match: *` to change any state."


def etag_of(document: Any) -> str:
    """Return the entity tag of a document."""
    if isinstance(document, BaseModel):
        document = document.model_dump(exclude_unset=True)
    text = json.dumps(document, sort_keys=True, ensure_ascii=False, default=str)
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


D = TypeVar("D", bound=Mapping[str, object] | BaseModel)


def tagged(response: Response, document: D) -> D:
    """Return the document, and name its state in the answer's ETag."""
    response.headers["ETag"] = etag_of(document)
    return document


def tags_in(header: str) -> list[str]:
    """Return the tags of If-Match or If-None-Match, weak or not."""
    return [tag.strip().removeprefix("W/") for tag in header.split(",")]


def require_match(header: str | None, etag: str, subject: str, *, required: bool = True) -> None:
    """Refuse a change that was meant for another state.

    Raises
    ------
    PreconditionRequiredError
        ``precondition_required`` if the header is missing and required.
    PreconditionFailedError
        ``precondition_failed``.
    """
    if header is None:
        if required:
            raise PreconditionRequiredError(f"A change of {subject} needs If-Match.")
        return
    if header.strip() != "*" and etag not in tags_in(header):
        raise PreconditionFailedError(f"The state of {subject} is not the one that If-Match names.", etag=etag)
