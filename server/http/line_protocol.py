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
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
from collections import deque
from collections.abc import Mapping
from typing import Any

from core.live.gauges import UNITS
from server.config.rig_file import LiveSection
from server.formats.version import software_version
from server.workflows.live.runs import LiveRuns

_log = logging.getLogger("stereorig.lines")

MAX_LINE = 256
MAX_CLIENTS = 32
_ERRORS = 20
_IDLE_S = 3600.0
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
    """

    def __init__(self, section: LiveSection, runs: LiveRuns) -> None:
        self._section, self._runs = section, runs
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()

    @property
    def port(self) -> int | None:
        """Port that is listened at; None while it is off."""
        if self._server is None or not self._server.sockets:
            return None
        return int(self._server.sockets[0].getsockname()[1])

    async def start(self) -> None:
        """Listen, where the rig file names a port; a port that is taken is logged, and the service goes on."""
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
        for client in list(self._clients):
            client.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if len(self._clients) >= MAX_CLIENTS:
            writer.close()
            return
        self._clients.add(task)
        try:
            await self._talk(reader, writer)
        except (OSError, TimeoutError, asyncio.CancelledError):
            pass
        except Exception:  # noqa: BLE001 - one client's, and the service goes on
            _log.exception("a line client was dropped")
        finally:
            self._clients.discard(task)
            writer.close()
            with contextlib.suppress(OSError, asyncio.CancelledError):
                await writer.wait_closed()

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = LineClient(self._runs, self._section.tcp_token)
        while True:
            line = await asyncio.wait_for(_line(reader), _IDLE_S)
            if line is None:
                return
            reply = client.answer(line)
            if reply is not None:
                writer.write(reply.encode("ascii", "replace") + b"\n")
                await writer.drain()


async def _line(reader: asyncio.StreamReader) -> bytes | None:
    """Return the next line, one byte longer than allowed where it was longer; None at the end."""
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
    """One connection: its errors, and whether it has said the word."""

    def __init__(self, runs: LiveRuns, token: str | None) -> None:
        self._runs, self._token = runs, token
        self._open = token is None
        self._errors: deque[tuple[int, str]] = deque()

    def answer(self, line: bytes) -> str | None:
        """Return the answer to a line; None where there is none."""
        try:
            return self._answer(line)
        except LineError as error:
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
        if not self._open:
            raise LineError(-203, "Command protected;send SYST:PASS and the word first")
        return self._query(header, rest)

    def _query(self, header: str, rest: str) -> str:
        run = self._runs.current
        if header == "*IDN?":
            return f"stereorig,live,{'none' if run is None else run.test_id},{software_version()}"
        if header not in ("CONF:GAUGES?", "READ:GAUGE?", "READ:ALL?"):
            raise LineError(-113, "Undefined header")
        if run is None or not run.active:
            raise LineError(-221, "Settings conflict;no live measurement goes on")
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
            raise LineError(-203, "Command protected;the word is wrong")
        self._open = True


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
