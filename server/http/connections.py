"""Connections: how many there may be, and how slow one may be before it is ended.

A client that sends its headers or its body drop by drop, or takes nothing of its answer, holds a connection and what
belongs to it. Each has its time. Where there are too many, those that ask for nothing go first, then live views; a
stop is served even then.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

_log = logging.getLogger("stereorig.connections")


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of a connection.

    Parameters
    ----------
    max_open
        Connections at once.
    header_s
        Time for a request's headers, from the connection's beginning or the headers' first byte.
    body_bytes_per_s
        Pace below which a body is too slow, over ``body_s``.
    body_s
        Time over which the pace is measured.
    unread_s
        How long a client may take nothing of an answer that waits for it.
    idle_s
        How long a connection without a request stays. Clients take up an idle one for some seconds (httpx for 5, other
        programs for up to 60): where the server ends it in that moment, the request is lost. So it waits longer.
    """

    max_open: int = 1000
    header_s: float = 15.0
    body_bytes_per_s: float = 1000.0
    body_s: float = 20.0
    unread_s: float = 60.0
    idle_s: int = 75


def _count_nothing(_why: str) -> None:
    """Stand in for a counter."""


@dataclass
class Connections:
    """The connections of one server.

    Parameters
    ----------
    limits
        What each may take.
    refused
        Called with the reason when one is ended: ``too_many``, ``slow_headers``, ``slow_body``, ``unread``.
    """

    limits: ConnectionLimits
    refused: Callable[[str], None] = _count_nothing

    def protocol(self) -> type[LimitedProtocol]:
        """Return the protocol class to give to uvicorn."""
        return type("LimitedProtocol", (LimitedProtocol,), {"keeper": self})

    def sweep(self, connections: set[Any]) -> None:
        """End what is too slow; call it about once a second from the event loop."""
        now = time.monotonic()
        for connection in [c for c in connections if isinstance(c, LimitedProtocol)]:
            why = connection.too_slow(now)
            if why is not None:
                connection.end(why)

    def make_room(self, newcomer: LimitedProtocol, connections: set[Any]) -> bool:
        """Return whether ``newcomer`` may stay as any other; ends a connection that does nothing to that end."""
        if len(connections) <= self.limits.max_open:
            return True
        others = [c for c in connections if isinstance(c, LimitedProtocol) and c is not newcomer and not c.ending]
        idle = [c for c in others if not c.busy]
        # views give way to requests that change something
        weakest = idle or [c for c in others if c.is_live_view]
        if weakest:
            min(weakest, key=lambda c: c.since).end("too_many")
            return True
        return False


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 with limits, see :class:`Connections`."""

    keeper: Connections

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        #: since when it does what it does: waits for headers, works on a request
        self.since = time.monotonic()
        self.ending = False
        self._header_since: float | None = self.since
        self._body_from: tuple[float, int] | None = None
        self._received = 0
        self._unread: tuple[float, int] | None = None

    @property
    def busy(self) -> bool:
        """Return True if a request is being answered."""
        return self.cycle is not None and not self.cycle.response_complete

    @property
    def is_live_view(self) -> bool:
        """Return True if it carries a live view."""
        return self.busy and str(self.scope["path"]).endswith("/stream.mjpg")

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin; where there are too many, only a stop will be served."""
        super().connection_made(transport)
        if len(self.connections) > 2 * self.keeper.limits.max_open:  # whoever floods does not get an answer
            self.end("too_many")
        elif not self.keeper.make_room(self, self.connections):
            self.keeper.refused("too_many")
            self.app_state = {**self.app_state, "crowded": True}

    def data_received(self, data: bytes) -> None:
        """Take what came in, and note when."""
        self._received += len(data)
        before = self.cycle
        if not self.busy and self._header_since is None:
            self._header_since = time.monotonic()
        super().data_received(data)
        if self.cycle is not before:
            self.since = time.monotonic()
        if self.busy or self.cycle is not before:
            self._header_since = None

    def on_response_complete(self) -> None:
        """Note since when it waits."""
        self.since = time.monotonic()
        self._body_from = self._unread = None
        super().on_response_complete()

    def too_slow(self, now: float) -> str | None:
        """Return why it must end, or None."""
        limits = self.keeper.limits
        if self._header_since is not None and now - self._header_since > limits.header_s:
            return "slow_headers"
        if self._body_too_slow(now):
            return "slow_body"
        waiting = self.transport.get_write_buffer_size()
        if waiting == 0 or not self.flow.write_paused:
            self._unread = None
        elif self._unread is None or self._unread[1] != waiting:
            self._unread = now, waiting
        elif now - self._unread[0] > limits.unread_s:
            return "unread"
        return None

    def _body_too_slow(self, now: float) -> bool:
        limits = self.keeper.limits
        # while we do not read, the client cannot send
        if not self.busy or not self.cycle.more_body or self.flow.read_paused:
            self._body_from = None
            return False
        if self._body_from is None:
            self._body_from = now, self._received
        since, received = self._body_from
        if now - since < limits.body_s:
            return False
        self._body_from = now, self._received
        return self._received - received < limits.body_bytes_per_s * (now - since)

    def end(self, why: str) -> None:
        """End it at once, whatever it does."""
        if self.ending:
            return
        self.ending = True
        self.keeper.refused(why)
        _log.info("a connection from %s is ended: %s", self.client, why)
        # not close(): that would wait until the client has read what it does not read
        self.transport.abort()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, as a problem like any other."""
        body = json.dumps(
            {
                "type": "/problems/malformed_request",
                "title": "Bad Request",
                "status": 400,
                "detail": msg,
                "code": "malformed_request",
                "remedy": "Send HTTP/1.1 (RFC 9112).",
            }
        ).encode()
        headers = [
            (b"content-type", b"application/problem+json"),
            (b"content-length", str(len(body)).encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"connection", b"close"),
        ]
        for event in (h11.Response(status_code=400, headers=headers), h11.Data(data=body), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()
