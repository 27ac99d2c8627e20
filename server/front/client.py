"""A client's connection: reads its requests, passes them on, and keeps it within its limits."""

from __future__ import annotations

import asyncio
import errno
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path
from typing import Any, cast

import h11

from stereorig.server.front.messages import (
    AWAY,
    CROWDED,
    MALFORMED,
    TWO_LENGTHS,
    Answer,
    ConnectionLimits,
    Halt,
    HaltFailed,
    HaltMade,
    Head,
    Headers,
    for_client,
    problem_answer,
    stopped,
)
from stereorig.server.front.web import FromWeb, WebConnection, reply_of_web

_log = logging.getLogger("stereorig.front")

# in one turn of the loop: a stop on another connection waits for no more than this
_EVENTS_A_TURN = 32
_HEAD_READ = 16 * 1024
_MAX_HEADERS = 200
_WAIT_FOR_REPLY_S = 0.15
_OPENED_AT_ONCE = 8
_FULL_BYTES = 64 * 1024


class _State(Enum):
    #: for a request
    WAITING = auto()
    #: a request's head has come, the web process does not take it yet
    OPENING = auto()
    #: it goes to the web process
    PASSING = auto()
    #: it is answered, and the rest of its body is thrown away
    DROPPING = auto()
    #: a WebSocket
    TUNNEL = auto()
    #: no more is read
    ENDED = auto()


@dataclass
class Clients:
    """All connections of a front, and their common part; see :class:`stereorig.server.front.front.Front`."""

    web: Path
    limits: ConnectionLimits
    max_open: int
    halt: Callable[[Halt], Awaitable[HaltMade]]
    may_halt: Callable[[Halt, Headers], bool]
    refused: Callable[[str], None]
    scheme: bytes
    trusted: frozenset[str]
    memory: memoryview = field(default_factory=lambda: memoryview(bytearray(256 * 1024)))
    open: set[ClientConnection] = field(default_factory=set)
    #: those that do nothing, and those that carry a live view; the oldest first
    idle: dict[ClientConnection, None] = field(default_factory=dict)
    views: dict[ClientConnection, None] = field(default_factory=dict)
    tasks: set[asyncio.Task[None]] = field(default_factory=set)
    #: so that many requests at once do not delay a halt that came after them
    opening: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(_OPENED_AT_ONCE))
    closing: bool = False

    def run(self, work: Coroutine[Any, Any, None]) -> None:
        """Let a task run to its end, whether its client stays or not."""
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    def make_room(self) -> bool:
        """End a connection that does nothing, or else a live view; return False if there is none."""
        weakest = next(iter(self.idle or self.views), None)
        if weakest is not None:
            weakest.end("too_many")
        return weakest is not None


class ClientConnection(asyncio.BufferedProtocol):
    """A client's connection.

    Parameters
    ----------
    clients
        All connections of its front.
    """

    def __init__(self, clients: Clients) -> None:
        self._clients = clients
        self._http = h11.Connection(h11.SERVER)
        self._state = _State.WAITING
        self._transport: asyncio.Transport
        self._peer = ""
        self._crowded = False
        self._out: list[bytes] = []
        self._web: WebConnection | None = None
        self._request: Head | None = None
        self._body_left: int | None = 0
        #: the answer has begun; the request has come to its end
        self._begun = self._complete = False
        #: the web process takes no more; a request waits for the one before it; there is more to take up; the client
        #: takes no more; reading from the client
        self._web_full = self._pipelined = self._more = self._full = False
        self._reads = True
        # for the limits
        self._since = time.monotonic()
        self._header_since: float | None = self._since
        self._received = 0
        self._body_from: tuple[float, int] | None = None
        self._unread: tuple[float, int] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin; if there are too many connections, only a halt is served."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=_FULL_BYTES)
        peer = transport.get_extra_info("peername")
        self._peer = str(peer[0]) if isinstance(peer, tuple) else ""
        clients = self._clients
        if clients.closing:
            transport.abort()
            return
        if len(clients.open) >= 2 * clients.max_open:
            self.end("too_many")
            return
        if len(clients.open) >= clients.max_open and not clients.make_room():
            clients.refused("too_many")
            self._crowded = True
        clients.open.add(self)
        clients.idle[self] = None

    def connection_lost(self, _exc: Exception | None) -> None:
        """Forget the connection."""
        self._clients.open.discard(self)
        self._forget()

    # -- requests

    def get_buffer(self, _sizehint: int) -> memoryview:
        """Return memory for the next read: little while headers are expected, since their parsing takes time."""
        size = len(self._clients.memory)
        if self._state is not _State.TUNNEL:
            size = max(_HEAD_READ, min(self._body_left or 0, size))
        return self._clients.memory[:size]

    def buffer_updated(self, nbytes: int) -> None:
        """Take bytes of the client."""
        if self._state is _State.ENDED:
            return
        data = self._clients.memory[:nbytes]
        if self._state is _State.TUNNEL:
            if self._web is not None:
                self._web.send(bytes(data))
                self._web.flush()
            return
        self._received += nbytes
        if self._request is None and self._header_since is None:
            self._header_since = time.monotonic()
        self._http.receive_data(cast(bytes, data))  # which copies it, of whatever type
        self._advance()

    def _advance(self) -> None:
        """Take up the received parts of requests; the rest in another turn of the loop if there are many."""
        self._more = self._pipelined = False
        try:
            for _ in range(_EVENTS_A_TURN):
                if self._state in (_State.OPENING, _State.TUNNEL, _State.ENDED):
                    break
                event = self._http.next_event()
                if isinstance(event, h11.Data):
                    self._body_left = None if self._body_left is None else self._body_left - len(event.data)
                    if self._state is _State.PASSING and self._web is not None:
                        self._web.send(event)
                elif isinstance(event, h11.EndOfMessage):
                    self._complete = True
                    if self._state is _State.PASSING and self._web is not None:
                        self._web.send(h11.EndOfMessage())
                    elif self._state is _State.DROPPING:
                        self._await_next()
                elif isinstance(event, h11.Request):
                    self._begin(Head.of(event))
                else:
                    self._pipelined = event is h11.PAUSED
                    break
            else:
                self._more = True
                asyncio.get_running_loop().call_soon(self._advance)
        except h11.RemoteProtocolError:
            self._answer(MALFORMED)
        if self._web is not None:
            self._web.flush()
        self._read_or_not()

    def _begin(self, request: Head) -> None:
        clients = self._clients
        self._request, self._body_left = request, request.body_length
        self._begun = self._complete = False
        self._since, self._header_since = time.monotonic(), None
        clients.idle.pop(self, None)
        halt = request.halt
        if len(request.headers) > _MAX_HEADERS:
            self._answer(MALFORMED)
        elif self._body_left is None and request.value(b"content-length") is not None:
            # a proxy in front may believe the second, and see another request than we do
            self._answer(TWO_LENGTHS)
        elif self._crowded and halt is None:
            self._answer(CROWDED)
        elif halt is not None and clients.may_halt(halt, request.headers):
            self._state = _State.OPENING
            clients.run(self._halt(request, halt))
        elif self._web is not None:
            self._forward(self._web, request)
        else:
            self._state = _State.OPENING
            clients.run(self._open(request))

    async def _halt(self, request: Head, halt: Halt) -> None:
        """Halt the stage, and give the web process a moment for the usual reply."""
        clients = self._clients
        try:
            made = await clients.halt(halt)
        except HaltFailed as error:
            self._answer(problem_answer(503, error.code, error.cause, error.remedy, wait_s=5))
            return
        # the client may be gone: the web process cancels the job of the stage all the same
        reply = await reply_of_web(clients.web, self._for_web(request, made), _WAIT_FOR_REPLY_S)
        self._answer(stopped(made) if reply is None else reply)

    async def _open(self, request: Head) -> None:
        web = WebConnection(self, self._clients.memory)
        try:
            async with self._clients.opening:
                if self._request is not request:
                    return  # the client is gone
                await asyncio.get_running_loop().create_unix_connection(lambda: web, str(self._clients.web))
        except OSError as error:
            self._answer(CROWDED if error.errno in (errno.EMFILE, errno.ENFILE) else AWAY)
            return
        if self._state is not _State.OPENING:
            web.leave()
            return
        self._web = web
        self._forward(web, request)
        self._advance()

    def _forward(self, web: WebConnection, request: Head) -> None:
        web.reusable = not request.opens_websocket
        web.send(self._for_web(request))
        if self._full:
            web.hold(True)
        if request.path.endswith("/stream.mjpg"):
            self._clients.views[self] = None
        self._state = _State.PASSING

    def _for_web(self, request: Head, halted: HaltMade | None = None) -> h11.Request:
        clients = self._clients
        return request.for_web(peer=self._peer, scheme=clients.scheme, trusted=clients.trusted, halted=halted)

    # -- answers

    def from_web(self, part: FromWeb) -> None:
        """Pass a part of an answer on; if the web process is gone, refuse the request, or cut the answer."""
        if isinstance(part, bytes):
            self._transport.write(part)
        elif isinstance(part, (h11.Data, h11.EndOfMessage)):
            self._put(part)
            if isinstance(part, h11.EndOfMessage):
                self._answered()
        elif isinstance(part, h11.Response):
            self._begun = True
            self._put(for_client(part))
        elif part is not None and part.status_code != 101:
            self._put(h11.InformationalResponse(status_code=part.status_code, headers=[]))
        elif part is not None and self._web is not None:
            self._put(h11.InformationalResponse(status_code=101, headers=part.headers.raw_items()))
            self._out.append(self._web.open_tunnel())
            self._web.send(bytes(self._http.trailing_data[0]))
            self._web.flush()
            self._begun, self._pipelined, self._state = True, False, _State.TUNNEL
            self._read_or_not()
        elif self._state is _State.TUNNEL:
            self._close()
        else:
            self._web = None
            if self._request is not None:
                self._answer(AWAY)

    def _put(self, part: h11.Response | h11.InformationalResponse | h11.Data | h11.EndOfMessage) -> None:
        """Put a part of an answer in line; :meth:`flush` sends it."""
        self._out += self._http.send_with_data_passthrough(part) or ()

    def flush(self) -> None:
        """Send the parts in line."""
        if self._out:
            out, self._out = self._out, []
            self._transport.write(out[0] if len(out) == 1 else b"".join(out))

    def _answer(self, answer: Answer) -> None:
        """Give an answer that is whole; cut the connection if another one has begun."""
        self._leave_web()
        if self._state is _State.ENDED:
            return
        if self._begun or self._http.our_state not in (h11.IDLE, h11.SEND_RESPONSE):
            self._close(at_once=True)
            return
        self._begun = True
        self._put(answer.head)
        if self._request is None or self._request.method != b"HEAD":
            self._put(h11.Data(data=answer.body))
        self._put(h11.EndOfMessage())
        self._answered()
        self._advance()

    def _answered(self) -> None:
        """Note that a request is answered; take up the next one, or end."""
        self.flush()
        self._request = None
        self._since = time.monotonic()
        self._body_from = self._unread = None
        self._clients.views.pop(self, None)
        self._clients.idle[self] = None
        if self._web is not None and not (self._complete and self._web.next_request()):
            self._leave_web()
        if self._http.our_state is not h11.DONE or self._clients.closing:
            self._close()
        elif self._complete:
            self._await_next()
            self._advance()
        else:
            self._state = _State.DROPPING
            self._read_or_not()

    def _await_next(self) -> None:
        self._http.start_next_cycle()
        self._state = _State.WAITING
        if self._http.trailing_data[0]:  # the next request has begun
            self._header_since = time.monotonic()
        self._body_left = 0

    # -- flow

    def web_full(self, full: bool) -> None:
        """Read from the client as long as the web process takes it."""
        self._web_full = full
        self._read_or_not()

    def pause_writing(self) -> None:
        """Let the web process wait until the client has read."""
        self._full = True
        if self._web is not None:
            self._web.hold(True)

    def resume_writing(self) -> None:
        """Let the web process continue."""
        self._full = False
        if self._web is not None:
            self._web.hold(False)

    def _read_or_not(self) -> None:
        """Read from the client while there is room for its bytes."""
        wanted = not (self._state is _State.OPENING or self._web_full or self._pipelined or self._more)
        if wanted != self._reads and not self._transport.is_closing():
            self._reads = wanted
            (self._transport.resume_reading if wanted else self._transport.pause_reading)()

    # -- limits and ends

    def check(self, now: float) -> None:
        """End the connection if it is too slow; close it if it has waited too long for a request."""
        limits = self._clients.limits
        if self._header_since is not None and now - self._header_since > limits.header_s:
            self.end("slow_headers")
        elif self._body_too_slow(now):
            self.end("slow_body")
        elif self._unread_too_long(now):
            self.end("unread")
        elif self in self._clients.idle and self._header_since is None and now - self._since > limits.idle_s:
            self._close()

    def _body_too_slow(self, now: float) -> bool:
        limits = self._clients.limits
        # while nothing is read, the client cannot send
        if self._request is None or self._complete or not self._reads:
            self._body_from = None
            return False
        if self._body_from is None:
            self._body_from = now, self._received
        since, received = self._body_from
        if now - since < limits.body_s:
            return False
        self._body_from = now, self._received
        return self._received - received < limits.body_bytes_per_s * (now - since)

    def _unread_too_long(self, now: float) -> bool:
        waiting = self._transport.get_write_buffer_size()
        if waiting == 0 or not (self._full or self._transport.is_closing()):
            self._unread = None
        elif self._unread is None or self._unread[1] != waiting:
            self._unread = now, waiting
        return self._unread is not None and now - self._unread[0] > self._clients.limits.unread_s

    def end(self, why: str | None = None) -> None:
        """End the connection at once, in any state; count it if there is a reason."""
        if why is not None:
            self._clients.refused(why)
            _log.info("a connection from %s is ended: %s", self._peer, why)
        self._close(at_once=True)

    def close_after_answer(self) -> None:
        """Close once nothing is being answered."""
        if self._request is None:
            self._close()

    def _close(self, *, at_once: bool = False) -> None:
        self._forget()
        # close() waits until the client has read all of its answer, which it may never do
        (self._transport.abort if at_once else self._transport.close)()

    def _forget(self) -> None:
        """Count for nothing from now on, and let the web process know that the client is gone."""
        self._state = _State.ENDED
        self._clients.idle.pop(self, None)
        self._clients.views.pop(self, None)
        self._header_since = self._request = None
        self._leave_web()

    def _leave_web(self) -> None:
        web, self._web, self._web_full = self._web, None, False
        if web is not None:
            web.leave()
