"""Skew of two cameras' exposures, with its source and the largest error that the source allows.

``clock``: both cameras stamp by one clock. ``latch``: both clocks are tied to the host's by latches. ``wire``: both
expose at one edge, so that their stamps differ by a constant and a drift. A pair's difference from these is its jitter,
known to microseconds, while a constant delay of one camera's input stays unseen. ``arrival``: frames come at the host,
after read-outs of unknown length.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import numpy as np

from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.cameras.protocol import CameraDescription, Frame, FrameStatus

SkewSource = Literal["clock", "latch", "wire", "arrival"]
#: the sources, for the description of the API
SKEW_SOURCES = (
    "Source of the skew: `clock`, both cameras stamp by one clock; `latch`, their clocks are tied to the host's; "
    "`wire`, stamps of common pulses, in which constant delays stay unseen; `arrival` at the host, after read-outs of "
    "unknown length."
)

_WIRE_PAIRS = 64
_WIRE_LEAST = 5  # the median of their ten slopes bears one outlier
_WIRE_KEPT_NS = 300_000_000_000
_DRIFT_CHANGE = 1e-6  # change of drift of a crystal that warms up, between two pulses that are minutes apart
_CRYSTALS = 200e-6  # stamps that drift more are no clock's
_TICK_NS = 1000.0  # the coarsest clock of stamps counts microseconds
_LINE_NS = 50_000.0  # a sensor begins with a line: its jitter
# Latches of a host and cameras that answer at once; a coarser one only contradicts the wire
_GOOD_LATCH_MS = 1.0
# A busy host takes all of some frames so much later; clocks that are no common one differ by seconds
_LATE_MS = 2000.0
_LATE_FRAMES = 64
# Neither is a frame so late: its camera's clock was set
_SET_NS = 1_000_000_000
_ARRIVAL_MS = 10.0
# Clocks that follow a master by packets agree within this when they have settled
_FOLLOWS_MS = 0.01


class Skew(NamedTuple):
    """Beginning of camera 2's exposure minus the beginning of camera 1's, with its largest error, and its source."""

    ms: float
    uncertainty_ms: float
    source: SkewSource


class Wire:
    """Jitter of two cameras' stamps of common edges, without any common clock."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, int]] = deque(maxlen=_WIRE_PAIRS)  # camera 1's stamp, difference

    def restart(self) -> None:
        """Forget all pairs: a clock was set again."""
        self._seen.clear()

    def jitter_ns(self, one_ns: int, two_ns: int) -> tuple[float, float] | None:
        """Return the deviation of a pair's difference from the others', and its largest error; None for the first ones.

        Parameters
        ----------
        one_ns, two_ns
            The stamps, each by its camera's clock.
        """
        while self._seen and not 0 <= one_ns - self._seen[0][0] <= _WIRE_KEPT_NS:
            self._seen.popleft()
        difference = two_ns - one_ns
        expected = self._expected(one_ns)
        jitter = None if expected is None else (difference - expected[0], expected[1])
        # others are no part of the constant, however many there are
        if jitter is None or abs(jitter[0]) <= max(2.0 * jitter[1], _LINE_NS):
            self._seen.append((one_ns, difference))
        return jitter

    def _expected(self, at_ns: int) -> tuple[float, float] | None:
        if len(self._seen) < _WIRE_LEAST:
            return None
        begin, first = self._seen[0]
        time = np.array([at - begin for at, _ in self._seen], float)
        rest = np.array([known - first for _, known in self._seen], float)
        one, two = np.triu_indices(len(time), 1)
        drift = float(np.median((rest[two] - rest[one]) / np.maximum(time[two] - time[one], 1.0)))
        if abs(drift) > _CRYSTALS:
            return None
        rest -= drift * time
        middle = float(np.median(rest))
        spread = 3.0 * 1.4826 * float(np.median(np.abs(rest - middle))) + _TICK_NS
        ahead_ns = max(0.0, at_ns - begin - float(time[-1]))
        error = spread * (2.0 + 2.0 * ahead_ns / max(float(time[-1]), 1.0)) + _DRIFT_CHANGE * ahead_ns
        return first + middle + drift * (at_ns - begin), error


class Simultaneity:
    """Times and skews of both cameras' frames.

    Parameters
    ----------
    common
        Returns the largest error of the clock that both cameras stamp by, in ms; None while there is no such clock.
    wired
        True if one edge starts both cameras' exposures.
    read_out_ms
        Returns how much longer than the other's one camera's frame may be on its way.
    """

    def __init__(
        self, *, common: Callable[[], float | None], wired: bool = False, read_out_ms: Callable[[], float] = lambda: 0.0
    ) -> None:
        self._common = common
        self._wire = Wire() if wired else None
        self._read_out_ms = read_out_ms
        self._latched: dict[CameraName, bool] = dict.fromkeys(CAMERAS, False)
        # arrivals after the stamps: the least one holds no delay of the host's
        self._delays_ns: dict[CameraName, deque[int]] = {cam: deque(maxlen=_LATE_FRAMES) for cam in CAMERAS}

    def see(self, cam: CameraName, frame: Frame) -> None:
        """Take notice of a camera's newest frame; a damaged one shows nothing."""
        if frame.status is FrameStatus.OK:
            self._latched[cam] = frame.latched_ns is not None
            delays, delay = self._delays_ns[cam], _arrived(frame) - frame.device_ns
            if delays and abs(delay - delays[-1]) > _SET_NS:
                delays.clear()
            delays.append(delay)

    def time_ns(self, frame: Frame) -> int:
        """Return a time of the frame that can be compared with the other camera's."""
        if self._common() is not None and frame.stamped:
            return frame.device_ns
        return frame.begun_ns if all(self._latched.values()) else _arrived(frame)

    def skew(self, frames: Mapping[CameraName, Frame]) -> Skew:
        """Return the skew of a pair by the source that proves most."""
        one, two = (frames[cam] for cam in CAMERAS)
        stamped = one.stamped and two.stamped
        arrival = Skew((_arrived(two) - _arrived(one)) / 1e6, self._read_out_ms(), "arrival")
        jitter = None
        if self._wire is not None and stamped:
            jitter = self._wire.jitter_ns(one.device_ns, two.device_ns)
        common = self._common()
        by_clock = (two.device_ns - one.device_ns) / 1e6
        if common is not None and stamped and self._apart_ms(one, two) <= arrival.uncertainty_ms + _LATE_MS:
            return Skew(by_clock, common, "clock")
        proved = arrival
        if one.latched_ns is not None and two.latched_ns is not None:
            error_ms = (one.latched_error_ns + two.latched_error_ns) / 1e6
            proved = Skew((two.latched_ns - one.latched_ns) / 1e6, error_ms, "latch")
            if error_ms <= _GOOD_LATCH_MS:
                return proved
        if jitter is None or self._wire is None:
            return proved
        wire = Skew(jitter[0] / 1e6, jitter[1] / 1e6, "wire")
        # the first arrivals hold some jitter still; frames of two pulses differ by more
        room_ms = _ARRIVAL_MS if proved is arrival else 0.0
        if abs(wire.ms - proved.ms) <= wire.uncertainty_ms + proved.uncertainty_ms + room_ms:
            return wire
        self._wire.restart()
        return proved

    def _apart_ms(self, *frames: Frame) -> float:
        """Return the difference between the cameras' clocks from the least delayed arrivals."""
        least = [
            min([_arrived(frame) - frame.device_ns, *self._delays_ns[cam]])
            for cam, frame in zip(CAMERAS, frames, strict=True)
        ]
        return abs(least[1] - least[0]) / 1e6


def _arrived(frame: Frame) -> int:
    return frame.host_ns if frame.exposed_ns is None else frame.exposed_ns


_BY = {
    "clock": "by the clock that both cameras stamp by",
    "latch": "by latches of both cameras' clocks",
    "wire": "by stamps of common pulses, constant delays unseen",
    "arrival": "by arrival, read-out unknown",
}


def in_words(source: SkewSource, uncertainty_ms: float) -> str:
    """Return a skew's uncertainty and source as a phrase."""
    return f"+- {uncertainty_ms:.2g} ms {_BY[source]}"


def no_common_ptp(cameras: Mapping[CameraName, CameraDescription]) -> str:
    """Return why cameras do not follow one PTP master closely, as a phrase; empty if they do, or have another clock."""
    for cam, known in cameras.items():
        if not known.clock:
            return f"{cam} follows no master that it names, its state is {known.extra.get('ptp_status', 'not known')}"
        if known.clock.startswith("ptp:") and known.clock_error_ms > _FOLLOWS_MS:
            return f"{cam} is {known.clock_error_ms:.3g} ms off its master, {_FOLLOWS_MS:g} ms are close"
    clocks = sorted({known.clock for known in cameras.values()})
    return "" if len(clocks) == 1 else f"they follow different masters, {' and '.join(clocks)}"


def simultaneity(known: bool | Simultaneity) -> Simultaneity:
    """Return the knowledge of two cameras' times that goes with a plain yes or no about a common clock."""
    if isinstance(known, Simultaneity):
        return known
    return Simultaneity(common=lambda: 0.0 if known else None)
