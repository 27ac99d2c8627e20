"""A connection to the web process: sends one request after the other, and hands on the answers."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Protocol, cast

import h11

from stereorig.server.front.messages import Answer, for_client

_HEAD_BYTES = 64 * 1024

#: a part of an answer, bytes of a WebSocket, or None: the web process has ended the connection
FromWeb = h11.Response | h11.InformationalResponse | h11.Data | h11.EndOfMessage | bytes | None


class Owner(Protocol):
    """The client's side of a connection to the web process."""

    def from_web(self, part: FromWeb) -> None:
        """Take a part of an answer."""

    def flush(self) -> None:
        """Send it on: for the moment no more has come."""

    def web_full(self, full: bool) -> None:
        """Send no more for the moment, or again."""


class WebConnection(asyncio.BufferedProtocol):
    """A connection to the web process.

    Parameters
    ----------
    owner
        The client's side.
    memory
        Memory for reads; shared by all connections.
    """

    def __init__(self, owner: Owner, memory: memoryview) -> None:
        self._owner: Owner | None = owner
        self._memory = memory
        self._http = h11.Connection(h11.CLIENT, max_incomplete_event_size=_HEAD_BYTES)
        self._transport: asyncio.Transport | None = None
        self._out: list[bytes] = []
        self._tunnel = False
        #: False once no further request may be sent
        self.reusable = True

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        if self._owner is None:
            transport.abort()

    def send(self, part: h11.Request | h11.Data | h11.EndOfMessage | bytes) -> None:
        """Put a part of a request, or bytes of a WebSocket, in line; :meth:`flush` sends it."""
        self._out += [part] if isinstance(part, bytes) else self._http.send_with_data_passthrough(part) or ()

    def flush(self) -> None:
        """Send the parts in line."""
        if self._out and self._transport is not None:
            out, self._out = self._out, []
            self._transport.write(out[0] if len(out) == 1 else b"".join(out))

    def open_tunnel(self) -> bytes:
        """Pass raw bytes from now on; returns those that have come already."""
        self._tunnel = True
        return bytes(self._http.trailing_data[0])

    def next_request(self) -> bool:
        """Return True if another request may be sent."""
        done = self._http.states == {h11.CLIENT: h11.DONE, h11.SERVER: h11.DONE}
        if not (self.reusable and done) or self._http.trailing_data[0]:  # more than the answer
            return False
        self._http.start_next_cycle()
        return True

    def hold(self, held: bool) -> None:
        """Read no more for the moment, or again."""
        if self._transport is not None and not self._transport.is_closing():
            (self._transport.pause_reading if held else self._transport.resume_reading)()

    def leave(self) -> None:
        """End the connection, so that the web process sees that its client is gone."""
        self._owner = None
        if self._transport is not None:
            self._transport.abort()

    def get_buffer(self, _sizehint: int) -> memoryview:
        """Return memory for the next read."""
        return self._memory

    def buffer_updated(self, nbytes: int) -> None:
        """Hand the received parts on."""
        owner = self._owner
        if owner is None:
            return
        if self._tunnel:
            owner.from_web(bytes(self._memory[:nbytes]))
            return
        try:
            if self._http.our_state is h11.IDLE:
                raise h11.RemoteProtocolError("an answer to no request")
            self._http.receive_data(cast(bytes, self._memory[:nbytes]))  # which copies it, of whatever type
            self._hand_on(owner)
        except h11.RemoteProtocolError:
            self.connection_lost(None)
        owner.flush()

    def _hand_on(self, owner: Owner) -> None:
        while self._owner is owner and not self._tunnel:
            event = self._http.next_event()
            if not isinstance(event, (h11.Response, h11.InformationalResponse, h11.Data, h11.EndOfMessage)):
                return
            owner.from_web(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Hand on an answer that is still unread, then let the client know that the connection has ended."""
        if exc is not None:  # a web process that refuses a body answers, and ends the connection before all is sent
            self._read_rest()
        owner = self._owner
        self.leave()
        if owner is not None:
            owner.from_web(None)

    def _read_rest(self) -> None:
        if self._transport is None:
            return
        with contextlib.suppress(OSError), self._transport.get_extra_info("socket").dup() as rest:
            rest.setblocking(False)
            while self._owner is not None and (size := rest.recv_into(self._memory)):
                self.buffer_updated(size)

    def pause_writing(self) -> None:
        """Let the client wait."""
        if self._owner is not None:
            self._owner.web_full(True)

    def resume_writing(self) -> None:
        """Let the client continue."""
        if self._owner is not None:
            self._owner.web_full(False)


async def reply_of_web(path: Path, request: h11.Request, wait_s: float) -> Answer | None:
    """Send a request without its body on a connection of its own; return the answer, or None if none came in time."""
    http = h11.Connection(h11.CLIENT)
    dropped = (b"content-length", b"transfer-encoding", b"expect", b"connection", b"upgrade")
    headers = [(name, value) for name, value in request.headers if name not in dropped]
    head, body = None, b""
    try:
        async with asyncio.timeout(wait_s):
            reader, writer = await asyncio.open_unix_connection(str(path))
            with contextlib.closing(writer):
                writer.write(http.send(h11.Request(method=request.method, target=request.target, headers=headers)))
                http.send(h11.EndOfMessage())
                while not isinstance(event := http.next_event(), h11.EndOfMessage):
                    if event is h11.NEED_DATA:
                        http.receive_data(await reader.read(_HEAD_BYTES))
                    elif isinstance(event, h11.Response):
                        head = for_client(event)
                    elif isinstance(event, h11.Data):
                        body += event.data
                    elif not isinstance(event, h11.InformationalResponse):
                        return None
    except (OSError, h11.RemoteProtocolError):  # of a timeout too
        return None
    return None if head is None else Answer(head, body)
