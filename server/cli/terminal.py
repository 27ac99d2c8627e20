"""Progress on the terminal: one line that is rewritten, or a line now and then where the output is no terminal."""

from __future__ import annotations

import sys
import threading
import time
from typing import TextIO

_REDRAW_S = 0.2
_QUIET_S = 15.0
_MIN_FRACTION = 0.03  # of all the work must be done before an estimate means something


def duration(seconds: float) -> str:
    """Write a duration as a person would: ``0.4 s``, ``12 s``, ``2 min 05 s``, ``1 h 10 min``."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    s = round(seconds)
    if s < 60:
        return f"{s} s"
    if s < 3600:
        return f"{s // 60} min {s % 60:02d} s"
    return f"{s // 3600} h {s % 3600 // 60:02d} min"


class ProgressLine:
    """Shows how far the work is and an estimate of the time left, on stderr; any thread may report.

    Parameters
    ----------
    stream
        Where to write; stderr when left out.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._last = time.monotonic()
        self._start: tuple[float, float] | None = None
        self._width = 0
        self._lock = threading.RLock()

    def note(self, text: str) -> None:
        """Write a line that stays."""
        with self._lock:
            self._clear()
            self._stream.write(f"{text}\n")
            self._stream.flush()

    def show(self, text: str, fraction: float) -> None:
        """Say where the work is; ``fraction`` of all of it is done."""
        now = time.monotonic()
        if self._start is None:  # loading and checking before the first report is no part of the pace
            self._start = (now, fraction)
        if now - self._last < (_REDRAW_S if self._live else _QUIET_S):
            return
        self._last = now
        line = f"{text}, {100 * fraction:.0f} % of all"
        began, before = self._start
        if fraction - before > _MIN_FRACTION:
            left = (now - began) * (1.0 - fraction) / (fraction - before)
            line += f", about {duration(max(1.0, left))} left"
        self._draw(line)

    def status(self, text: str) -> None:
        """Say something about the work, without an estimate of its own."""
        now = time.monotonic()
        if now - self._last >= (_REDRAW_S if self._live else _QUIET_S):
            self._last = now
            self._draw(text)

    def _draw(self, line: str) -> None:
        if not self._live:
            self.note(line)
            return
        with self._lock:
            self._stream.write("\r" + line.ljust(self._width))
            self._stream.flush()
            self._width = len(line)

    def close(self) -> None:
        """Leave the terminal clean."""
        with self._lock:
            self._clear()

    def _clear(self) -> None:
        if self._live and self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
            self._width = 0
