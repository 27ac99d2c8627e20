"""A camera's clock brought to the host's, so that exposures of cameras without a common clock can be compared.

By arrival: a frame arrives some time after its exposure began: exposure, read-out, transmission, the host's own delays.
The smallest ``arrival - device time`` of the last frames is the clocks' offset plus the shortest delay; any further
delay of a frame is jitter, and drops out. The shortest delay stays in.

By latch: the camera keeps its time of a moment between two times of the host, which bounds the offset by a round trip,
independent of frames. Several such bounds also bound the drift.
"""

from __future__ import annotations

import math
import threading
from collections import deque

import numpy as np

from stereorig.drivers.cameras.protocol import Latch

# Frames that the offset is taken from: long enough to meet an undelayed one, short enough that 50 ppm stay below 0.3 ms
_FRAMES = 64
_LONGEST_NS = 5_000_000_000
# No frame is this late; a clock that was set again looks like it
_JUMP_NS = 1_000_000_000

# Latches that are kept: the offset's drift changes with the temperature, within minutes
_LATCHES = 64
_KEPT_NS = 120_000_000_000
# Two crystals of 50 ppm each, and twice that: the drift that is allowed for until it is known
_DRIFT = 200e-6
# A clock that was set again differs by more than a busy host's reading of two clocks
_SET_AGAIN_NS = 1_000_000
# From the beginning of an exposure to its arrival: beyond it, a latch is not of the frames' clock. An arrival is
# converted from the wall clock, and so may seem a little early
_EARLIEST_NS, _LATEST_NS = -1_000_000, 60_000_000_000


class DeviceClock:
    """Maps one camera's device times to the host's monotonic clock; latches may come from another thread."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, int]] = deque(maxlen=_FRAMES)  # host time, offset
        self._last_ns = 0
        self._ties: deque[Latch] = deque(maxlen=_LATCHES)
        self._bounds: _Bounds | None = None
        self._lock = threading.Lock()

    def on_host(self, device_ns: int, host_ns: int) -> int:
        """Return when the exposure began, plus the camera's shortest delay, by the host's clock.

        Parameters
        ----------
        device_ns
            Begin of the exposure by the device's clock.
        host_ns
            Arrival by the host's monotonic clock.

        Returns
        -------
        int
            In ns, never after the arrival.
        """
        offset = host_ns - device_ns
        while self._seen and host_ns - self._seen[0][0] > _LONGEST_NS:
            self._seen.popleft()
        if device_ns < self._last_ns or (self._seen and abs(offset - self._seen[-1][1]) > _JUMP_NS):
            self._seen.clear()
        self._last_ns = device_ns
        self._seen.append((host_ns, offset))
        return device_ns + min(known for _, known in self._seen)

    def tie(self, latch: Latch) -> None:
        """Take one reading of the camera's clock."""
        with self._lock:
            ties, bounds = self._ties, self._bounds
            if ties:
                backwards = latch.device_ns <= ties[-1].device_ns
                low, high = (0.0, 0.0) if bounds is None else bounds.at(latch.device_ns)
                early, late = latch.before_ns - latch.device_ns, latch.after_ns - latch.device_ns
                if backwards or (bounds is not None and not early - high <= _SET_AGAIN_NS >= low - late):
                    ties.clear()
            ties.append(latch)
            while latch.device_ns - ties[0].device_ns > _KEPT_NS:
                ties.popleft()
            # a single reading may be a register that keeps no time; older ones go if the drift changed since
            self._bounds = None
            while len(ties) > 1:
                bounds = _Bounds(list(ties))
                if bounds.possible:
                    self._bounds = bounds
                    break
                for _ in range((len(ties) + 1) // 2):
                    ties.popleft()

    def latched(self, device_ns: int, host_ns: int) -> tuple[int, int] | None:
        """Return when the exposure began by the host's clock, and the largest error, in ns; None without latches.

        Parameters
        ----------
        device_ns, host_ns
            As of `on_host`.
        """
        with self._lock:
            if self._bounds is None:
                return None
            low, high = sorted(self._bounds.at(device_ns))
        begun, error = device_ns + round((low + high) / 2), math.ceil((high - low) / 2)
        return (begun, error) if _EARLIEST_NS - error <= host_ns - begun <= _LATEST_NS else None

    def device_ns(self, host_ns: int) -> int | None:
        """Return the camera's time at a time of the host's monotonic clock; None without latches."""
        with self._lock:
            if self._bounds is None:
                return None
            near = self._ties[-1].device_ns + host_ns - self._ties[-1].after_ns
            low, high = self._bounds.at(near)
        return host_ns - round((low + high) / 2)


class _Bounds:
    """Every offset and drift that all latches allow.

    Each one bounds the offset (host's time minus device time) between two numbers; each two of them, the drift.
    """

    def __init__(self, ties: list[Latch]) -> None:
        self._base = ties[0].device_ns
        self._first = ties[0].before_ns - self._base
        self._at = np.array([tie.device_ns - self._base for tie in ties], float)
        self._low = np.array([tie.before_ns - tie.device_ns - self._first for tie in ties], float)
        self._high = np.array([tie.after_ns - tie.device_ns - self._first for tie in ties], float)
        one, two = np.triu_indices(len(ties), 1)
        between = self._at[two] - self._at[one]
        least = float(np.max((self._low[two] - self._high[one]) / between, initial=-_DRIFT))
        most = float(np.min((self._high[two] - self._low[one]) / between, initial=_DRIFT))
        self._drift = least, most
        low, high = self.at(ties[-1].device_ns)
        #: True if some offset and drift suit all latches
        self.possible = least <= most and low <= high

    def at(self, device_ns: int) -> tuple[float, float]:
        """Return the lowest and the highest offset at a device time, in ns."""
        since = (device_ns - self._base) - self._at
        least, most = (since * drift for drift in self._drift)
        low = float(np.max(self._low + np.minimum(least, most)))
        high = float(np.min(self._high + np.maximum(least, most)))
        return self._first + low, self._first + high
