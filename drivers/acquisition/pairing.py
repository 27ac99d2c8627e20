"""Pairing of two cameras' frames: every trigger has exactly one outcome.

::

    triggered = paired + unpaired + incomplete + dropped

``paired``: both cameras delivered (``refused`` of them with too much skew to measure with). ``incomplete``: at least
one camera delivered a damaged frame. ``unpaired``: one camera delivered, the other never did. ``dropped``: neither did.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from pydantic import Field

from core.errors import CameraError
from core.names import CAMERAS, CameraName
from drivers.cameras.protocol import Frame, FrameStatus


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames of one trigger.

    Attributes
    ----------
    cam1, cam2
        The frames.
    number
        Trigger or frame number, counted from the first; in pairing by time, of the pair.
    skew_ms
        Beginning of camera 2's exposure minus that of camera 1.
    max_skew_ms
        Largest skew that the rig allows.
    """

    cam1: Frame
    cam2: Frame
    number: int
    skew_ms: float
    max_skew_ms: float

    def __getitem__(self, cam: CameraName) -> Frame:
        return self.cam1 if cam == "cam1" else self.cam2

    @property
    def accepted(self) -> bool:
        """True if its skew is within the limit."""
        return abs(self.skew_ms) <= self.max_skew_ms

    def require(self) -> Pair:
        """Return the pair itself; code ``skew_too_large`` when its skew is above the limit."""
        if not self.accepted:
            raise CameraError(
                f"The exposures of pair {self.number} began {abs(self.skew_ms):.3f} ms apart, "
                f"the rig allows {self.max_skew_ms:g} ms.",
                code="skew_too_large",
                remedy="Use a common hardware trigger, or raise max_skew_ms for a specimen at rest.",
                skew_ms=self.skew_ms,
                max_skew_ms=self.max_skew_ms,
            )
        return self


@dataclass(frozen=True)
class PairingAccount:
    """Counters of the triggers: triggered = paired + unpaired + incomplete + dropped."""

    triggered: Annotated[int, Field(description="Occasions on which a pair was due.")] = 0
    paired: Annotated[int, Field(description="Both frames came.")] = 0
    unpaired: Annotated[int, Field(description="One frame came.")] = 0
    incomplete: Annotated[int, Field(description="A frame had lines or packets missing.")] = 0
    dropped: Annotated[int, Field(description="No frame came.")] = 0
    refused: Annotated[int, Field(description="Of the paired, those whose skew was too large.")] = 0
    late: Annotated[int, Field(description="Frames that came after their occasion was given up.")] = 0

    def as_dict(self) -> dict[str, int]:
        """Return names and numbers, for reports."""
        return asdict(self)


@dataclass(eq=False)
class _Slot:
    number: int
    frames: dict[CameraName, Frame]

    def fate(self) -> str:
        if any(frame.status is not FrameStatus.OK for frame in self.frames.values()):
            return "incomplete"
        return ("dropped", "unpaired", "paired")[len(self.frames)]


class _Pairing:
    """Counts and skews, common to both ways of pairing."""

    def __init__(self, *, max_skew_ms: float, common_clock: bool) -> None:
        if not max_skew_ms >= 0:
            raise ValueError(f"max_skew_ms must not be negative, got {max_skew_ms}")
        self._max_skew_ms = max_skew_ms
        self._common_clock = common_clock
        self._counts: dict[str, int] = {}

    @property
    def account(self) -> PairingAccount:
        """Counters of the closed triggers."""
        fates = ("paired", "unpaired", "incomplete", "dropped")
        return PairingAccount(triggered=sum(self._counts.get(name, 0) for name in fates), **self._counts)

    def _count(self, name: str) -> None:
        self._counts[name] = self._counts.get(name, 0) + 1

    def _time_ns(self, frame: Frame) -> int:
        if self._common_clock:
            return frame.device_ns
        return frame.host_ns if frame.exposed_ns is None else frame.exposed_ns

    def _pair(self, frames: Mapping[CameraName, Frame], number: int) -> Pair:
        one, two = frames["cam1"], frames["cam2"]
        skew = (self._time_ns(two) - self._time_ns(one)) / 1e6
        pair = Pair(one, two, number, skew, self._max_skew_ms)
        self._count("paired")
        if not pair.accepted:
            self._count("refused")
        return pair


class NumberPairing(_Pairing):
    """Pairs by a number that both cameras share: that of the trigger, or the frame number since both were armed.

    Frame numbers must be unwrapped and start at ``origin`` in both cameras (the reader does the first). Numbers
    of one camera may arrive late by ``depth``; then their trigger is closed.

    Parameters
    ----------
    by
        ``trigger`` or ``frame``.
    max_skew_ms
        Above it a pair is made and counted, but not accepted.
    common_clock
        True if the device times of both cameras may be compared; else skew is that of the exposures converted to the
        host's clock, or of the arrival at the host where that was not done.
    origin
        Frame number, in each camera, of the first trigger; its trigger number in pairing by trigger (cam1's counts).
    depth
        Triggers that stay open for late frames.
    """

    def __init__(
        self,
        *,
        by: Literal["trigger", "frame"],
        max_skew_ms: float,
        common_clock: bool,
        origin: Mapping[CameraName, int] | None = None,
        depth: int = 8,
    ) -> None:
        super().__init__(max_skew_ms=max_skew_ms, common_clock=common_clock)
        self._by = by
        self._origin = dict(origin) if origin is not None else dict.fromkeys(CAMERAS, 0)
        self._depth = depth
        self._open: dict[int, _Slot] = {}
        self._done: set[int] = set()
        self._next = 0  # every number below is closed
        self._seen = 0  # every number below was triggered

    def triggered(self, count: int) -> None:
        """Record that ``count`` triggers were fired up to now; those whose frames never come are then counted too."""
        self._see(count)

    def feed(self, cam: CameraName, frame: Frame) -> Pair | None:
        """Take a frame, complete or not; returns a pair when it makes one."""
        raw = frame.trigger if self._by == "trigger" else frame.sequence
        if raw is None:
            raise CameraError(
                f"{cam} does not say which trigger its frame {frame.sequence} belongs to.",
                code="frame_format",
                remedy="Pair by frame number or by time in the rig file.",
                camera=cam,
            )
        number = raw - self._origin[cam]
        if number < self._next or number in self._done:
            self._count("late")
            return None
        self._see(number + 1)
        slot = self._open.setdefault(number, _Slot(number, {}))
        if cam in slot.frames:
            self._count("late")
            return None
        slot.frames[cam] = frame
        if len(slot.frames) < len(CAMERAS):
            return None
        pair: Pair | None = None
        if slot.fate() == "paired":
            pair = self._pair(slot.frames, number)
        else:
            self._count(slot.fate())
        del self._open[number]
        self._done.add(number)
        self._advance()
        return pair

    def finish(self) -> PairingAccount:
        """Close all triggers and return their counters."""
        self._close_below(self._seen)
        return self.account

    def _see(self, count: int) -> None:
        self._seen = max(self._seen, count)
        self._close_below(self._seen - self._depth)

    def _close_below(self, end: int) -> None:
        while self._next < end:
            if self._next in self._done:
                self._done.discard(self._next)
            else:
                self._count(self._open.pop(self._next, _Slot(self._next, {})).fate())
            self._next += 1
        self._advance()

    def _advance(self) -> None:
        while self._next in self._done:
            self._done.discard(self._next)
            self._next += 1


class TimePairing(_Pairing):
    """Pairs by time, for cameras without a common trigger: frames that began within half a period belong together.

    ``triggered`` is then the number of frames or pairs that came or are known to be missing.

    Parameters
    ----------
    period_ms
        Frame period of both cameras.
    max_skew_ms, common_clock
        As in `NumberPairing`; the same clock does the pairing.
    depth
        Frames of one camera that wait for the other.
    """

    def __init__(self, *, period_ms: float, max_skew_ms: float, common_clock: bool, depth: int = 8) -> None:
        super().__init__(max_skew_ms=max_skew_ms, common_clock=common_clock)
        if not period_ms > 0:
            raise ValueError(f"period_ms must be positive, got {period_ms}")
        self._window_ns = round(period_ms * 1e6 / 2)
        self._depth = depth
        self._waiting: dict[CameraName, list[Frame]] = {"cam1": [], "cam2": []}
        self._number = 0

    def feed(self, cam: CameraName, frame: Frame) -> Pair | None:
        """Take a frame, complete or not, in the order of its camera; returns a pair when it makes one."""
        other: CameraName = "cam2" if cam == "cam1" else "cam1"
        now = self._time_ns(frame)
        # the other camera's frames are in order: what lies before this frame's window can find no partner any more
        while self._waiting[other] and self._time_ns(self._waiting[other][0]) < now - self._window_ns:
            self._close(other)
        if self._waiting[other] and self._time_ns(self._waiting[other][0]) < now + self._window_ns:
            partner = self._waiting[other].pop(0)
            slot = _Slot(self._number, {cam: frame, other: partner})
            self._number += 1
            if slot.fate() == "paired":
                return self._pair(slot.frames, slot.number)
            self._count(slot.fate())
            return None
        self._waiting[cam].append(frame)
        if len(self._waiting[cam]) > self._depth:  # the other camera may be silent for long
            self._close(cam)
        return None

    def missing(self, count: int) -> None:
        """Record that both cameras lost so many frames, as their counters show."""
        for _ in range(count):
            self._count("dropped")

    def finish(self) -> PairingAccount:
        """Close waiting frames and return the counters."""
        for cam in CAMERAS:
            while self._waiting[cam]:
                self._close(cam)
        return self.account

    def _close(self, cam: CameraName) -> None:
        frame = self._waiting[cam].pop(0)
        self._count(_Slot(self._number, {cam: frame}).fate())
        self._number += 1
