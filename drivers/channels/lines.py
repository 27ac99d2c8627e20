"""A channel read as lines of text from `stereorig.drivers.channels.ports`: a number in each line, stamped on arrival.

A line that cannot be reached or that ended is opened again and again; the state of a line without new values is
``silent``. The device is only asked if a query is given.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal
from urllib.parse import urlsplit

from stereorig.core.errors import InputError
from stereorig.drivers.channels.numbers import Decimal, Notation
from stereorig.drivers.channels.ports import OPEN_S, Analog, Port, Program, Serial, Socket

_log = logging.getLogger("stereorig.channels")

State = Literal["unreachable", "silent", "reading"]

_AGAIN_S = (0.2, 0.5, 1.0, 2.0)  # pauses before the line is opened again
_LONGEST_LINE = 1024
_DELAYS = 0.1  # weight of a new delay in their mean


@dataclass(frozen=True, kw_only=True)
class LineSource:
    """Source of a channel, and the part of a line that is its value.

    Attributes
    ----------
    name
        The channel.
    url
        ``tcp://host:port``, or a serial port as pyserial takes it; empty with ``exec`` or ``daq``.
    exec
        A program and its arguments, whose lines are read.
    daq
        An analog input of National Instruments, ``Dev1/ai0``; its lines are volts.
    baudrate
        Rate of a serial port.
    pattern
        Regular expression whose first group is the number; None: ``column`` counts.
    column
        Number of the line's part that counts, from 1; commas, semicolons or blanks separate parts.
    decimal, thousands
        See `stereorig.drivers.channels.numbers.Notation`.
    scale, offset
        The value is the number times ``scale``, plus ``offset``.
    frame
        Bits, parity and stop bits of a serial port: ``8N1``, ``7E1``.
    line_end
        Characters other than CR and LF that end a line, as ``$`` or a prompt ``:``.
    query
        Text that is sent, with ``query_end``, each time a value is wanted; None: the device sends by itself.
    rate_hz
        How often ``query`` is sent, or ``daq`` read.
    silence_s
        A line without a value for this long is silent.
    """

    name: str
    url: str | None = None
    exec: tuple[str, ...] | None = None
    daq: str | None = None
    baudrate: int = 9600
    pattern: str | None = None
    column: int = 1
    decimal: Decimal | None = None
    thousands: Literal[",", ".", " ", "'"] | None = None
    scale: float = 1.0
    offset: float = 0.0
    frame: str = "8N1"
    line_end: str = ""
    query: str | None = None
    query_end: str = "\n"
    rate_hz: float = 10.0
    silence_s: float = 1.0

    def value_of(self, line: str) -> float | str:
        """Return the value in a line; the reason if there is none."""
        if self.daq is not None:
            return float(line) * self.scale + self.offset
        notation = Notation(decimal=self.decimal, thousands=self.thousands)
        if self.pattern is None:
            number = notation.column(line, self.column)
        else:
            number = notation.group(line, re.compile(self.pattern))
        return number if isinstance(number, str) else number * self.scale + self.offset


@dataclass(frozen=True)
class LineState:
    """State of a line: the state, lines with a value and lines without one, times it was lost, and the reason."""

    state: State
    values: int
    unreadable: int
    losses: int
    reason: str


def _open(source: LineSource) -> Port:
    if source.exec is not None:
        return Program(source.exec)
    if source.daq is not None:
        return Analog(source.daq, source.rate_hz)
    if source.url is None:
        raise InputError(f"The channel {source.name} names nothing to read.", code="option_out_of_range")
    if not source.url.startswith("tcp://"):
        return Serial(source.url, source.baudrate, source.frame)
    parts = urlsplit(source.url)
    if parts.hostname is None or parts.port is None:
        raise InputError(f"{source.url} names no host and port.", code="option_out_of_range")
    return Socket(parts.hostname, parts.port)


class ChannelLine:
    """Reads one channel in a thread of its own.

    Parameters
    ----------
    source
        Source of the channel, and the part of a line that counts.
    put
        Called with the monotonic time of arrival, s, and the value; from that thread. If several values arrived
        together, only the last one counts: the others' times are not known.
    """

    def __init__(self, source: LineSource, put: Callable[[float, float], None]) -> None:
        self.source, self._put = source, put
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"channel {source.name}", daemon=True)
        self._lock = threading.Lock()
        self._open = False
        self._values, self._unreadable, self._losses, self._reason = 0, 0, 0, "not opened yet"
        self._why_unreadable = ""
        self._last_s = -math.inf
        #: time from the measurement to the arrival, s, as far as line and queries show it; it may err by as much
        self.delay_s = 0.0

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def end(self) -> None:
        """Let it end."""
        self._ending.set()

    def stop(self) -> None:
        """End it; returns when the line is closed."""
        self.end()
        if self._thread.ident is not None:
            self._thread.join(timeout=OPEN_S + 1.0)

    @property
    def state(self) -> LineState:
        """State of the line now."""
        with self._lock:
            silent = time.monotonic() - self._last_s > self.source.silence_s
            state: State = "unreachable" if not self._open else ("silent" if silent else "reading")
            reason = self._reason
            if state == "silent":
                reason = f"no value for {self.source.silence_s:g} s"
                if self._why_unreadable:
                    reason += f"; the last line that could not be read: {self._why_unreadable}"
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
            with self._lock:
                self._open, before = True, self._values
            try:
                self._read(port)
            except Exception as error:  # noqa: BLE001 - as above
                with self._lock:
                    self._losses += 1
                self._lost(error, first=True)
            finally:
                with contextlib.suppress(Exception):
                    port.close()
            failures = 0 if self._values > before else failures + 1
            self._ending.wait(_AGAIN_S[min(failures, len(_AGAIN_S) - 1)])

    def _lost(self, error: Exception, *, first: bool) -> None:
        with self._lock:
            self._open, self._reason = False, str(error) or type(error).__name__
        if first:
            where = self.source.url or self.source.daq or "its program"
            _log.warning("channel %s at %s: %s", self.source.name, where, error)

    def _read(self, port: Port) -> None:
        held, asked_s = b"", -math.inf
        ends = bytes.maketrans(f"\r{self.source.line_end}".encode(), b"\n" * (1 + len(self.source.line_end)))
        while not self._ending.is_set():
            now = time.monotonic()
            if self.source.query is not None and now - asked_s >= 1.0 / self.source.rate_hz:
                port.write((self.source.query + self.source.query_end).encode())
                asked_s = now
            data = port.read()
            arrived_s = time.monotonic()
            way_s = None if self.source.query is None else min(arrived_s - asked_s, 1.0)
            *lines, held = (held + data).translate(ends).split(b"\n")
            if len(held) > _LONGEST_LINE:  # noise, or no lines at all
                lines, held = [*lines, held[:_LONGEST_LINE]], b""
            self._take(lines, arrived_s, way_s, port.byte_s)

    def _take(self, lines: list[bytes], arrived_s: float, way_s: float | None, byte_s: float) -> None:
        texts = [line.decode("ascii", "replace") for line in lines if line.strip(b"\0 \t")]
        values = [self.source.value_of(text) for text in texts]
        known = [value for value in values if not isinstance(value, str)]
        with self._lock:
            self._unreadable += len(values) - len(known)
            self._why_unreadable = next((value for value in values if isinstance(value, str)), self._why_unreadable)
            self._values += len(known)
            if known:
                self._last_s = arrived_s
                # it was measured before its first byte was sent, and after it was asked for
                delay_s = byte_s * (1 + max(map(len, lines))) if way_s is None else way_s / 2.0
                weight = _DELAYS if self._values > len(known) else 1.0
                self.delay_s += weight * (delay_s - self.delay_s)
        if known:
            self._put(arrived_s, known[-1])
