"""A simulated load frame: an actuator driven by lines over TCP, a specimen that follows it less than it should.

::

    *IDN?             stereorig,simulated load frame
    RATE <per s>      let the actuator move, in strain of the specimen a second at full stiffness; 0 holds
    HOLD              RATE 0
    POS?              the actuator's position
    FORCE?            force, N

A frame gives way, grips slip, a specimen yields: its strain is ``position (1 - compliance)`` at first, and more of each
step once it yields. A controller that wants a constant strain rate has to see the specimen.
"""

from __future__ import annotations

import contextlib
import math
import socketserver
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

_STEP_S = 0.02
_LONGEST_LINE = 200
_MAX_RATE = 1.0
_STIFFNESS_N = 2.0e5


class LoadFrame:
    """Moves its actuator in a thread and serves lines in others; use it as a context manager.

    Parameters
    ----------
    apply
        Called with the specimen's strain after each step of the motion; from one thread.
    compliance
        Share of the actuator's way that frame and grips take.
    yields_at
        Strain at which the specimen gets softer, and takes all of the way.
    port
        TCP port on loopback, 0 for any free one.
    """

    def __init__(
        self, apply: Callable[[float], None], *, compliance: float = 0.35, yields_at: float = 0.004, port: int = 0
    ) -> None:
        self._apply, self._compliance, self._yields_at = apply, compliance, yields_at
        self._lock = threading.Lock()
        self._rate, self._position = 0.0, 0.0
        self._ending = threading.Event()
        self.strains: list[tuple[float, float]] = []
        """Monotonic time and strain of each step that was applied."""
        frame = self

        class Client(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                with contextlib.suppress(OSError):
                    while line := self.rfile.readline(_LONGEST_LINE):
                        self.wfile.write(frame.answer(line.decode("ascii", "replace")).encode() + b"\n")

        self._server = socketserver.ThreadingTCPServer(("127.0.0.1", port), Client)
        self._server.daemon_threads = True
        self._threads = [
            threading.Thread(target=self._server.serve_forever, name="load frame lines", daemon=True),
            threading.Thread(target=self._move, name="load frame", daemon=True),
        ]

    @property
    def port(self) -> int:
        """TCP port that it answers at."""
        return int(self._server.server_address[1])

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._ending.set()
        self._server.shutdown()
        self._server.server_close()
        for thread in self._threads:
            thread.join(5.0)

    def strain_at(self, position: float) -> float:
        """Return the specimen's strain at a position of the actuator."""
        elastic = position * (1.0 - self._compliance)
        return (
            elastic
            if elastic <= self._yields_at
            else self._yields_at + position - self._yields_at / (1.0 - self._compliance)
        )

    def answer(self, line: str) -> str:
        """Return the answer to a line: ``OK``, a value, or ``ERR`` and why."""
        word, _, rest = line.strip().partition(" ")
        with self._lock:
            if word == "RATE":
                try:
                    rate = float(rest)
                except ValueError:
                    return "ERR a rate is a number"
                if not math.isfinite(rate) or abs(rate) > _MAX_RATE:
                    return f"ERR a rate lies within {_MAX_RATE:g} a second"
                self._rate = rate
                return "OK"
            if word == "HOLD":
                self._rate = 0.0
                return "OK"
            known: dict[str, Callable[[], Any]] = {
                "*IDN?": lambda: "stereorig,simulated load frame",
                "POS?": lambda: f"{self._position:.9f}",
                "FORCE?": lambda: f"{_STIFFNESS_N * min(self.strain_at(self._position), self._yields_at):.3f}",
            }
            return str(known[word]()) if word in known else "ERR no such command"

    def _move(self) -> None:
        before = time.monotonic()
        while not self._ending.wait(_STEP_S):
            now = time.monotonic()
            with self._lock:
                self._position += self._rate * (now - before)
                strain, moving = self.strain_at(self._position), self._rate != 0.0
            before = now
            if moving or not self.strains:
                self._apply(strain)
                self.strains.append((time.monotonic(), strain))
