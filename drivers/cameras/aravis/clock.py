"""Arrival times of frames by the monotonic clock."""

from __future__ import annotations

import time
from collections.abc import Callable

# Between two looks at the clocks (20 ms) the kernel's slewing shifts them by 10 us at most
_STEP_NS = 2_000_000


class ArrivalClock:
    """Turns Aravis' arrival times, which are those of the wall clock, into times of the monotonic clock.

    The wall clock may be set while frames wait. Such a step shows as a change of the difference between both clocks;
    frames that had come before it then get the time at which they are taken.

    Parameters
    ----------
    wall_ns, steady_ns
        The clocks, in ns.
    """

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, steady_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns = wall_ns
        self._steady_ns = steady_ns
        self._difference = self._measure()
        self._doubtful = 0
        self._stepped = False

    def _measure(self) -> int:
        # the thread may be put aside between both looks: the quickest of three counts
        readings = []
        for _ in range(3):
            before = self._steady_ns()
            wall = self._wall_ns()
            after = self._steady_ns()
            readings.append((after - before, wall - (before + after) // 2))
        return min(readings)[1]

    def watch(self) -> None:
        """Look at the clocks; to be called often."""
        difference = self._measure()
        if abs(difference - self._difference) > _STEP_NS:
            self._stepped = True
        self._difference = difference

    def monotonic_ns(self, wall_ns: int, waiting: int) -> int:
        """Return when a frame arrived, and expect ``waiting`` more that may have come before it was taken."""
        self.watch()
        now = self._steady_ns()
        if self._stepped:
            self._stepped = False
            self._doubtful = waiting + 1
        arrived = wall_ns - self._difference
        if self._doubtful > 0:
            self._doubtful -= 1
            return now
        return min(arrived, now)
