"""Deadlines on a machine that has other things to do: seconds of a quiet machine, as many times over as it is busy."""

from __future__ import annotations

import os
import time

_CORES = len(os.sched_getaffinity(0))


def busy() -> float:
    """Return how many tasks want each core, as Linux counts them over a minute; 1 on a quiet machine."""
    return max(1.0, os.getloadavg()[0] / _CORES)


class Deadline:
    """An end of waiting that comes later the busier the machine is while it waits.

    Parameters
    ----------
    seconds
        On a quiet machine.
    """

    def __init__(self, seconds: float) -> None:
        self._began, self._seconds, self._busiest = time.monotonic(), seconds, 1.0

    @property
    def is_over(self) -> bool:
        """True once the time is up."""
        self._busiest = max(self._busiest, busy())
        return time.monotonic() > self._began + self._seconds * self._busiest

    @property
    def left(self) -> bool:
        """True until then."""
        return not self.is_over
