"""Live values as lines over TCP, for the controllers of test machines: a few queries in the manner of SCPI.

::

    *IDN?                   stereorig,live,<test id>,<version>
    *CLS                    forget the errors
    CONF:GAUGES?            e1:extensometer,a1:area
    READ:GAUGE? e1          <valid>,<value>,<u>,<frame>,<time s>,<reason>
    READ:GAUGE? e1,length_mm     another quantity than strain, w_mm of a point, eyy of an area
    READ:ALL?               <name>, and the same, of every gauge, separated by semicolons
    SYST:ERR?               <code>,"<text>", the oldest error; 0,"No error"
    SYST:PASS <word>        where the rig file has a tcp_token

A value that does not hold is ``NAN``, and the valid flag 0. A line ends with LF; CR before it is ignored. An error is
put into the connection's queue; a query that failed answers nothing, as in SCPI.

The word is due within 10 s and three lines; a wrong one costs a second, ten of them a minute (`shutout`). There are 32
places, 8 for one address; one is kept for the address that gave the right word last. A connection that is refused or
ended gets a line with the reason.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import socket
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

from stereorig.core.names import UNITS
from stereorig.server.config.rig_file import LiveSection
from stereorig.server.formats.version import software_version
from stereorig.server.http.shutout import ShutOut
from stereorig.server.workflows.live.runs import LiveRuns

_log = logging.getLogger("stereorig.lines")

MAX_LINE = 256
MAX_CLIENTS = 32
MAX_OF_ADDRESS = 8
WORD_S = 10.0
MAX_WRONG = 3
_DELAY_S = 1.0
_ERRORS = 20
_IDLE_S = 3600.0
_UNREAD_S = 60.0
_FAREWELL_S = 1.0
_MAX_FAREWELLS = 64
_LOG_EVERY_S = 60.0
#: a peer that is gone without a word is noticed after two minutes
_KEEPALIVE = {"TCP_KEEPIDLE": 60, "TCP_KEEPINTVL": 15, "TCP_KEEPCNT": 4}
_NO_ERROR = (0, "No error")
_MAIN = {"point": "w_mm", "extensometer": "strain", "area": "eyy"}


class LineError(Exception):
    """An error of a line, by its SCPI number and text."""

    def __init__(self, number: int, text: str) -> None:
        super().__init__(text)
        self.entry = number, text


class LineServer:
    """Serves the newest values of the live measurement; one task of the event loop a client.

    Parameters
    ----------
    section
        Port, address and word.
    runs
        The live measurements.
    shut_out
        Addresses that are shut out for wrong words or keys.
    """

    def __init__(self, section: LiveSection, runs: LiveRuns, shut_out: ShutOut) -> None:
        self._section, self._runs, self._shut_out = section, runs, shut_out
        self._server: asyncio.Server | None = None
        self._clients: dict[asyncio.Task[None], str] = {}
        self._farewells: set[asyncio.Task[None]] = set()
        self._known: str | None = None
        self._refused, self._logged_s = 0, -_LOG_EVERY_S

    @property
    def port(self) -> int | None:
        """Port that is listened at; None while it is off."""
        if self._server is None or not self._server.sockets:
            return None
        return int(self._server.sockets[0].getsockname()[1])

    async def start(self) -> None:
        """Listen, if the rig file names a port; a port that is taken is logged, and the service continues."""
        section = self._section
        if section.tcp_port is None:
            return
        try:
            self._server = await asyncio.start_server(
                self._serve, section.tcp_host, section.tcp_port, limit=MAX_LINE, backlog=MAX_CLIENTS
            )
        except OSError as error:
            _log.warning("no lines at %s:%s: %s", section.tcp_host, section.tcp_port, error)

    async def close(self) -> None:
        """End it and its connections."""
        if self._server is None:
            return
        self._server.close()
        tasks = [*self._clients, *self._farewells]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        address = str((writer.get_extra_info("peername") or ("unknown",))[0])
        try:
            if (reason := self._no_place(address)) is not None:
                self._farewells.add(task)
                await self._end(reader, writer, address, reason)
                return
            self._clients[task] = address
            _prepare(writer.get_extra_info("socket"))
            reason = await self._talk(reader, writer, address)
            if reason is not None:
                del self._clients[task]  # its place is free from now on
                self._farewells.add(task)
                await self._end(reader, writer, address, reason)
        except (OSError, TimeoutError, asyncio.CancelledError):
            pass
        except Exception:  # noqa: BLE001 - it concerns one client, and the service continues
            _log.exception("a line client was dropped")
        finally:
            self._clients.pop(task, None)
            self._farewells.discard(task)
            writer.close()
            with contextlib.suppress(OSError, asyncio.CancelledError):
                await writer.wait_closed()

    def _no_place(self, address: str) -> str | None:
        """Return the error for a connection that gets no place; None if it gets one."""
        if (left_s := self._shut_out.left_s(address)) > 0.0:
            return f"Command protected;shut out for {left_s:.0f} s after wrong words"
        addresses = list(self._clients.values())
        if addresses.count(address) >= MAX_OF_ADDRESS:
            return f"Execution error;{MAX_OF_ADDRESS} connections of {address} are open already"
        kept = self._known not in (None, address) and self._known not in addresses
        if len(addresses) >= MAX_CLIENTS - kept:
            return f"Execution error;all {MAX_CLIENTS} places are taken"
        return None

    async def _end(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, address: str, reason: str) -> None:
        """Send the reason as an error, and wait a moment for the client to take it; one log line a minute at most."""
        self._refused += 1
        if (now := time.monotonic()) - self._logged_s >= _LOG_EVERY_S:
            _log.warning("%d line connections were refused, the last from %s: %s", self._refused, address, reason)
            self._refused, self._logged_s = 0, now
        if len(self._farewells) > _MAX_FAREWELLS:
            return
        writer.write(f'-200,"{reason}"\n'.encode("ascii", "replace"))
        writer.write_eof()
        async with asyncio.timeout(_FAREWELL_S):  # unread input at the close would take the line away from the client
            while await reader.read(MAX_LINE):
                pass

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, address: str) -> str | None:
        """Answer a client's lines; return the error with which the connection must end, None if the client ended it."""
        client = LineClient(self._runs, self._section.tcp_token)
        loop = asyncio.get_running_loop()
        due = loop.time() + WORD_S
        while True:
            try:
                async with asyncio.timeout_at(loop.time() + _IDLE_S if client.open else due):
                    line = await _line(reader)
            except TimeoutError:
                return None if client.open else f"Command protected;the word was due within {WORD_S:.0f} s"
            if line is None:
                return None
            was_open, wrong = client.open, client.wrong_words
            reply = client.answer(line)
            if client.open and not was_open:
                self._known = address
            if client.wrong_words > wrong:
                self._shut_out.wrong(address)
            if not client.open and (client.errors >= MAX_WRONG or self._shut_out.left_s(address) > 0.0):
                return f"Command protected;{client.errors} errors before the word"
            if client.wrong_words > wrong:
                await asyncio.sleep(min(_DELAY_S, max(0.0, due - loop.time())))
            if reply is not None:
                async with asyncio.timeout(_UNREAD_S):
                    writer.write(reply.encode("ascii", "replace") + b"\n")
                    await writer.drain()


def _prepare(connection: Any) -> None:
    """Send each line at once, and notice a peer that is gone."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE.items():
            if (number := getattr(socket, option, None)) is not None:
                connection.setsockopt(socket.IPPROTO_TCP, number, value)


async def _line(reader: asyncio.StreamReader) -> bytes | None:
    """Return the next line, one byte longer than allowed if it was longer; None at the end."""
    try:
        return await reader.readuntil(b"\n")
    except asyncio.IncompleteReadError as error:
        return error.partial or None
    except asyncio.LimitOverrunError:
        # to its end, without keeping it
        while True:
            try:
                await reader.readuntil(b"\n")
            except asyncio.LimitOverrunError as error:
                await reader.readexactly(max(error.consumed, 1))
                continue
            except asyncio.IncompleteReadError:
                return None
            return b"x" * (MAX_LINE + 1)


class LineClient:
    """One connection: its errors, and whether it is open: the right word was given, or none is asked for."""

    def __init__(self, runs: LiveRuns, token: str | None) -> None:
        self._runs, self._token = runs, token
        self.open = token is None
        self.errors = self.wrong_words = 0
        self._errors: deque[tuple[int, str]] = deque()

    def answer(self, line: bytes) -> str | None:
        """Return the answer to a line; None for a line without one."""
        try:
            return self._answer(line)
        except LineError as error:
            self.errors += 1
            if len(self._errors) >= _ERRORS:
                self._errors[-1] = (-350, "Queue overflow")
            else:
                self._errors.append(error.entry)
            return None

    def _answer(self, line: bytes) -> str | None:
        if len(line) > MAX_LINE:
            raise LineError(-363, f"Input buffer overrun;lines have {MAX_LINE} bytes at most")
        try:
            text = line.decode("ascii").strip()
        except UnicodeDecodeError as error:
            raise LineError(-101, "Invalid character") from error
        if not text:
            return None
        if not text.isprintable():
            raise LineError(-101, "Invalid character")
        head, _, rest = text.partition(" ")
        header, rest = head.upper(), rest.strip()
        if header == "SYST:PASS":
            self._pass(rest)
            return None
        if header == "SYST:ERR?":
            number, words = self._errors.popleft() if self._errors else _NO_ERROR
            return f'{number},"{words}"'
        if header == "*CLS":
            self._errors.clear()
            return None
        if not self.open:
            raise LineError(-203, "Command protected;send SYST:PASS and the word first")
        return self._query(header, rest)

    def _query(self, header: str, rest: str) -> str:
        run = self._runs.current
        if header == "*IDN?":
            return f"stereorig,live,{'none' if run is None else run.test_id},{software_version()}"
        if header not in ("CONF:GAUGES?", "READ:GAUGE?", "READ:ALL?"):
            raise LineError(-113, "Undefined header")
        if run is None or not run.active:
            raise LineError(-221, "Settings conflict;no live measurement is running")
        if header == "CONF:GAUGES?":
            return ",".join(f"{name}:{kind}" for name, kind in run.kinds.items())
        newest = run.newest()
        if header == "READ:ALL?":
            return ";".join(f"{name},{_text(newest, name, kind, None)}" for name, kind in run.kinds.items())
        name, _, quantity = (part.strip() for part in rest.partition(","))
        if not name:
            raise LineError(-109, "Missing parameter;name a gauge")
        if name not in run.kinds:
            raise LineError(-224, "Illegal parameter value;no such gauge, see CONF:GAUGES?")
        return _text(newest, name, run.kinds[name], quantity or None)

    def _pass(self, word: str) -> None:
        if self._token is not None and not hmac.compare_digest(word.encode(), self._token.encode()):
            self.wrong_words += 1
            raise LineError(-203, "Command protected;the word is wrong")
        self.open = True


def _text(newest: Mapping[str, Any], name: str, kind: str, quantity: str | None) -> str:
    """Answer of one gauge: valid flag, value, u, number of the frame, time of its exposure, reason."""
    wanted = quantity or _MAIN[kind]
    if wanted not in UNITS[kind]:  # type: ignore[index]
        raise LineError(-224, f"Illegal parameter value;{kind} has {' '.join(UNITS[kind])}")  # type: ignore[index]
    gauge = newest["gauges"].get(name, {"valid": False, "reason": newest["reason"], "values": {}})
    number = gauge["values"].get(wanted)
    value, u = (None, None) if number is None else (number["value"], number["u"])
    time_s = newest.get("time_s")
    fields = [
        "1" if gauge["valid"] and value is not None else "0",
        "NAN" if value is None else f"{value:.9E}",
        "NAN" if u is None else f"{u:.3E}",
        str(newest["number"]),
        "NAN" if time_s is None else f"{time_s:.6f}",
        gauge["reason"] or "ok",
    ]
    return ",".join(fields)
