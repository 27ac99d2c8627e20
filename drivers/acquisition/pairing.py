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

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.simultaneity import Simultaneity, SkewSource, in_words, simultaneity
from stereorig.drivers.cameras.protocol import Frame, FrameStatus


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
        Beginning of camera 2's exposure minus the beginning of camera 1's.
    max_skew_ms
        Largest skew that the rig allows.
    skew_uncertainty_ms, skew_source
        Largest error of the skew, and its source (`stereorig.drivers.acquisition.simultaneity`).
    """

    cam1: Frame
    cam2: Frame
    number: int
    skew_ms: float
    max_skew_ms: float
    skew_uncertainty_ms: float = 0.0
    skew_source: SkewSource = "clock"

    def __getitem__(self, cam: CameraName) -> Frame:
        return self.cam1 if cam == "cam1" else self.cam2

    @property
    def accepted(self) -> bool:
        """True unless its skew is surely above the limit."""
        return abs(self.skew_ms) - self.skew_uncertainty_ms <= self.max_skew_ms

    def require(self) -> Pair:
        """Return the pair itself; code ``skew_too_large`` when its skew is above the limit."""
        if not self.accepted:
            raise CameraError(
                f"The exposures of pair {self.number} began {abs(self.skew_ms):.3f} ms apart "
                f"({in_words(self.skew_source, self.skew_uncertainty_ms)}), the rig allows {self.max_skew_ms:g} ms.",
                code="skew_too_large",
                remedy="Use a common hardware trigger, or raise max_skew_ms for a specimen at rest.",
                skew_ms=self.skew_ms,
                max_skew_ms=self.max_skew_ms,
                skew_uncertainty_ms=self.skew_uncertainty_ms,
                skew_source=self.skew_source,
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
    slips: Annotated[
        int, Field(description="Times that a camera missed a pulse and its numbers were aligned anew.")
    ] = 0

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

    def __init__(self, *, max_skew_ms: float, common_clock: bool | Simultaneity) -> None:
        if not max_skew_ms >= 0:
            raise ValueError(f"max_skew_ms must not be negative, got {max_skew_ms}")
        self._max_skew_ms = max_skew_ms
        self._times = simultaneity(common_clock)
        self._counts: dict[str, int] = {}

    @property
    def account(self) -> PairingAccount:
        """Counters of the closed triggers."""
        fates = ("paired", "unpaired", "incomplete", "dropped")
        return PairingAccount(triggered=sum(self._counts.get(name, 0) for name in fates), **self._counts)

    def _count(self, name: str) -> None:
        self._counts[name] = self._counts.get(name, 0) + 1

    def _pair(self, frames: Mapping[CameraName, Frame], number: int) -> Pair:
        skew_ms, uncertainty_ms, source = self._times.skew(frames)
        pair = Pair(frames["cam1"], frames["cam2"], number, skew_ms, self._max_skew_ms, uncertainty_ms, source)
        self._count("paired")
        if not pair.accepted:
            self._count("refused")
        return pair


class NumberPairing(_Pairing):
    """Pairs by a number that both cameras share: the trigger's number, or the frame number since both were armed.

    Frame numbers must be unwrapped and start at ``origin`` in both cameras (the reader does the first). Numbers of one
    camera may arrive late by ``depth``; then their trigger is closed.

    Parameters
    ----------
    by
        ``trigger`` or ``frame``.
    max_skew_ms
        Above it a pair is made and counted, but not accepted.
    common_clock
        Knowledge of both cameras' times. True if their device times may be compared; False if only the exposures' times
        converted to the host's clock may be, or the arrivals at the host without a conversion.
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
        common_clock: bool | Simultaneity,
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
        self._times.see(cam, frame)
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

    def __init__(
        self, *, period_ms: float, max_skew_ms: float, common_clock: bool | Simultaneity, depth: int = 8
    ) -> None:
        super().__init__(max_skew_ms=max_skew_ms, common_clock=common_clock)
        if not period_ms > 0:
            raise ValueError(f"period_ms must be positive, got {period_ms}")
        self._window_ns = round(period_ms * 1e6 / 2)
        self._depth = depth
        self._waiting: dict[CameraName, list[Frame]] = {"cam1": [], "cam2": []}
        self._number = 0

    def feed(self, cam: CameraName, frame: Frame) -> Pair | None:
        """Take a frame, complete or not, in the order of its camera; returns a pair when it makes one."""
        self._times.see(cam, frame)
        other: CameraName = "cam2" if cam == "cam1" else "cam1"
        now = self._times.time_ns(frame)
        # the other camera's frames are in order: a frame before this frame's window can find no partner any more
        while self._waiting[other] and self._times.time_ns(self._waiting[other][0]) < now - self._window_ns:
            self._close(other)
        if self._waiting[other] and self._times.time_ns(self._waiting[other][0]) < now + self._window_ns:
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
