"""A camera's clock brought to the host's, so that exposures of cameras without a common clock can be compared.

A frame arrives some time after its exposure began: read-out, transmission, the host's own delays. The device's clock
does not include these, and has a constant offset to the host's and a few ppm of drift. The smallest ``arrival - device
time`` of the last frames is that offset and the shortest delay there is; what a frame was late beyond it is jitter, and
drops out. Two cameras of one model share the shortest delay, so it drops out of their skew too.
"""

from __future__ import annotations

from collections import deque

# Frames that the offset is taken from: long enough to meet an undelayed one, short enough that 50 ppm stay below 0.3 ms
_FRAMES = 64
_LONGEST_NS = 5_000_000_000
# No frame is this late; a clock that was set anew looks like it
_JUMP_NS = 1_000_000_000


class DeviceClock:
    """Maps one camera's device times to the host's monotonic clock."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, int]] = deque(maxlen=_FRAMES)  # host time, offset
        self._last_ns = 0

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
