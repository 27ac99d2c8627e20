"""The wire side of a simulated controller: command lines in, replies out, a log of received lines, and line faults."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self, TypedDict, Unpack

from stereorig.sim.controllers.axis import SimAxis, SimClock


@dataclass
class LineFaults:
    """Faults of the line; every value may be set while it runs.

    Attributes
    ----------
    silent
        Commands are carried out, replies never come.
    deaf
        Nothing arrives and nothing comes back, as with the power or the cable gone.
    lose_replies
        So many of the next replies are lost.
    halve_replies
        So many of the next replies break off in the middle, without their end.
    garble_replies
        So many of the next replies arrive as noise.
    stray
        Bytes sent before the next reply.
    delay_s
        Wait before each reply.
    """

    silent: bool = False
    deaf: bool = False
    lose_replies: int = 0
    halve_replies: int = 0
    garble_replies: int = 0
    stray: bytes = b""
    delay_s: float = 0.0

    def apply(self, reply: bytes) -> bytes:
        """Return the bytes of a reply that are sent."""
        if not reply or self.silent or self.deaf:
            return b""
        if self.lose_replies > 0:
            self.lose_replies -= 1
            return b""
        if self.halve_replies > 0:
            self.halve_replies -= 1
            return reply[: max(1, (len(reply) - 1) // 2)]
        if self.garble_replies > 0:
            self.garble_replies -= 1
            return b"\xff\x80" + bytes(byte ^ 0x55 for byte in reply.strip()) + b"\r\n"
        stray, self.stray = self.stray, b""
        return stray + reply


class Motion(TypedDict, total=False):
    """Motion parameters of a controller's axes.

    Attributes
    ----------
    travel_mm
        (low, high) software limits that it reports, measured from home; -50 to 50.
    velocity_mm_s, acceleration_mm_s2
        Power-on values, 10 and 40; up to four and ten times as much can be set.
    time_scale
        Factor by which the axes run faster than real ones; the reported speeds are the stage's.
    start_mm
        Positions of the axes at power-on, from home.
    """

    travel_mm: tuple[float, float]
    velocity_mm_s: float
    acceleration_mm_s2: float
    time_scale: float
    start_mm: float


@dataclass
class WireAxis:
    """An axis with the limits that its controller keeps."""

    motor: SimAxis
    low_mm: float
    high_mm: float
    max_velocity_mm_s: float
    max_acceleration_mm_s2: float

    @classmethod
    def make(cls, clock: SimClock, **motion: Unpack[Motion]) -> Self:
        """Make one as it is at power-on."""
        low_mm, high_mm = motion.get("travel_mm", (-50.0, 50.0))
        velocity, acceleration = motion.get("velocity_mm_s", 10.0), motion.get("acceleration_mm_s2", 40.0)
        motor = SimAxis(
            clock, velocity_mm_s=velocity, acceleration_mm_s2=acceleration, start_mm=motion.get("start_mm", 0.0)
        )
        return cls(motor, low_mm, high_mm, 4 * velocity, 10 * acceleration)


#: some ten minutes of a service that asks where its stage is
_MAX_RECEIVED = 20_000


@dataclass(frozen=True)
class Received:
    """One command line as it came in, and when by the host's monotonic clock."""

    at_s: float
    text: str


class WireController(ABC):
    """Base of the simulated controllers. One instance may serve several connections; calls are serialised."""

    terminator: bytes

    def __init__(self, time_scale: float = 1.0) -> None:
        self.clock = SimClock(time_scale)
        self.line_faults = LineFaults()
        self.received: list[Received] = []
        self._lock = threading.RLock()

    def take_line(self, line: bytes) -> bytes:
        """Carry out one command line, without its terminator, and return the bytes to send."""
        if self.line_faults.deaf:
            return b""
        text = line.decode("ascii", errors="replace").strip("\r\n")
        with self._lock:
            if len(self.received) >= _MAX_RECEIVED:  # in a service it receives commands for weeks
                del self.received[: _MAX_RECEIVED // 2]
            self.received.append(Received(time.monotonic(), text))
            reply = self.line_faults.apply(self._execute(text))
        if reply and self.line_faults.delay_s > 0:
            time.sleep(self.line_faults.delay_s)
        return reply

    def commands(self, word: str) -> list[str]:
        """Return every command line that came in and contains ``word``."""
        return [entry.text for entry in self.received if word in entry.text]

    @abstractmethod
    def _execute(self, text: str) -> bytes:
        """Carry out a command line."""

    @abstractmethod
    def axis(self, number: int) -> SimAxis:
        """Give access to an axis and its faults."""

    def true_position_mm(self, axis: int) -> float:
        """Return the true position of an axis' load along its axis, in mm from home."""
        return self.axis(axis).true_position_mm()

    def true_displacement_mm(self, axis: int) -> tuple[float, float, float]:
        """Return the true position of an axis' load: across, across, along the axis, in mm from home."""
        return self.axis(axis).true_displacement_mm()
