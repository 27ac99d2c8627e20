"""A channel read as lines of text, over TCP or from a serial port: a number in each line, stamped when it arrives.

A line that cannot be reached or that ended is opened again, again and again; a line that falls silent is said to be
silent. Nothing is asked of the device unless a query is given.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol
from urllib.parse import urlsplit

import serial

from core.errors import InputError

_log = logging.getLogger("stereorig.channels")

State = Literal["unreachable", "silent", "reading"]

_WAIT_S = 0.1  # longest wait for bytes, so that an end is noticed
_AGAIN_S = (0.2, 0.5, 1.0, 2.0)  # pauses before the line is opened again
_OPEN_S = 3.0
_CHUNK = 4096
_LONGEST_LINE = 1024
_APART = re.compile(r"[,;\s]+")


@dataclass(frozen=True, kw_only=True)
class LineSource:
    """Where a channel is read, and what of a line is its value.

    Attributes
    ----------
    name
        The channel.
    url
        ``tcp://host:port``, or a serial port as pyserial takes it.
    baudrate
        Of a serial port.
    pattern
        Regular expression whose first group is the number; None: ``column`` counts.
    column
        Which part of the line, from 1; parts are set apart by commas, semicolons or blanks.
    query
        Text that is sent, with a line's end, each time a value is wanted; None: the device sends by itself.
    rate_hz
        How often ``query`` is sent.
    silence_s
        A line without a value for this long is silent.
    """

    name: str
    url: str
    baudrate: int = 9600
    pattern: str | None = None
    column: int = 1
    query: str | None = None
    rate_hz: float = 10.0
    silence_s: float = 1.0

    def value_of(self, line: str) -> float | None:
        """Return the number in a line; None where there is none."""
        if self.pattern is None:
            parts = _APART.split(line.strip())
            text = parts[self.column - 1] if self.column <= len(parts) else ""
        else:
            found = re.search(self.pattern, line)
            text = "" if found is None else found.group(1) or ""
        try:
            value = float(text)
        except ValueError:
            return None
        return value if math.isfinite(value) else None


@dataclass(frozen=True)
class LineState:
    """How a line stands: its state, lines that had a value and lines that had none, times it was lost, and why."""

    state: State
    values: int
    unreadable: int
    losses: int
    reason: str


class _Port(Protocol):
    """An open line."""

    def read(self) -> bytes:
        """Return what came; empty after a short wait."""

    def write(self, data: bytes) -> None:
        """Send."""

    def close(self) -> None:
        """Close it."""


class _Socket:
    def __init__(self, host: str, port: int) -> None:
        self._link = socket.create_connection((host, port), timeout=_OPEN_S)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._link.settimeout(_WAIT_S)

    def read(self) -> bytes:
        try:
            data = self._link.recv(_CHUNK)
        except TimeoutError:
            return b""
        if not data:
            raise OSError("the other side closed the connection")
        return data

    def write(self, data: bytes) -> None:
        self._link.sendall(data)

    def close(self) -> None:
        self._link.close()


class _Serial:
    def __init__(self, url: str, baudrate: int) -> None:
        self._port = serial.serial_for_url(url, baudrate=baudrate, timeout=_WAIT_S, write_timeout=_OPEN_S)

    def read(self) -> bytes:
        first: bytes = self._port.read(1)
        return first + self._port.read(min(self._port.in_waiting, _CHUNK)) if first else first

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()


def _open(source: LineSource) -> _Port:
    if not source.url.startswith("tcp://"):
        return _Serial(source.url, source.baudrate)
    parts = urlsplit(source.url)
    if parts.hostname is None or parts.port is None:
        raise InputError(f"{source.url} names no host and port.", code="option_out_of_range")
    return _Socket(parts.hostname, parts.port)


class ChannelLine:
    """Reads one channel in a thread of its own.

    Parameters
    ----------
    source
        Where, and what.
    put
        Called with the monotonic time of arrival, s, and the value; from that thread. Of values that arrived together
        the last one counts: when the others came is not known.
    """

    def __init__(self, source: LineSource, put: Callable[[float, float], None]) -> None:
        self.source, self._put = source, put
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"channel {source.name}", daemon=True)
        self._lock = threading.Lock()
        self._open = False
        self._values, self._unreadable, self._losses, self._reason = 0, 0, 0, "not opened yet"
        self._last_s = -math.inf

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> None:
        """End; returns when the line is closed."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=_OPEN_S + 1.0)

    @property
    def state(self) -> LineState:
        """How it stands now."""
        with self._lock:
            silent = time.monotonic() - self._last_s > self.source.silence_s
            state: State = "unreachable" if not self._open else ("silent" if silent else "reading")
            reason = self._reason
            if state == "silent":
                reason = f"no value for {self.source.silence_s:g} s"
            return LineState(state, self._values, self._unreadable, self._losses, "" if state == "reading" else reason)

    def _run(self) -> None:
        failures = 0
        while not self._ending.is_set():
            try:
                port = _open(self.source)
            except Exception as error:  # noqa: BLE001 - of pyserial and the system; the state says it
                self._lost(error, first=failures == 0)
                self._ending.wait(_AGAIN_S[min(failures, len(_AGAIN_S) - 1)])
                failures += 1
                continue
            failures = 0
            with self._lock:
                self._open = True
            try:
                self._read(port)
            except Exception as error:  # noqa: BLE001 - as above
                with self._lock:
                    self._losses += 1
                self._lost(error, first=True)
            finally:
                with contextlib.suppress(Exception):
                    port.close()
            self._ending.wait(_AGAIN_S[0])

    def _lost(self, error: Exception, *, first: bool) -> None:
        with self._lock:
            self._open, self._reason = False, str(error) or type(error).__name__
        if first:
            _log.warning("channel %s at %s: %s", self.source.name, self.source.url, error)

    def _read(self, port: _Port) -> None:
        held, asked_s = b"", -math.inf
        while not self._ending.is_set():
            now = time.monotonic()
            if self.source.query is not None and now - asked_s >= 1.0 / self.source.rate_hz:
                port.write(self.source.query.encode() + b"\n")
                asked_s = now
            data = port.read()
            arrived_s = time.monotonic()
            *lines, held = (held + data).replace(b"\r", b"\n").split(b"\n")
            if len(held) > _LONGEST_LINE:  # noise, or no lines at all
                lines, held = [*lines, held[:_LONGEST_LINE]], b""
            self._take(lines, arrived_s)

    def _take(self, lines: list[bytes], arrived_s: float) -> None:
        texts = [line.decode("ascii", "replace") for line in lines if line.strip(b"\0 \t")]
        values = [self.source.value_of(text) for text in texts]
        known = [value for value in values if value is not None]
        with self._lock:
            self._unreadable += len(values) - len(known)
            self._values += len(known)
            if known:
                self._last_s = arrived_s
        if known:
            self._put(arrived_s, known[-1])
