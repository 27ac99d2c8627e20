"""Deadlines on a machine that has other things to do: seconds of a quiet machine, as many times over as it is busy."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

_CORES = len(os.sched_getaffinity(0))
_STEAL_OVER_S = 1.0  # ticks of 10 ms: over less, a stolen share is chance


def _ticks() -> tuple[float, int, int]:
    """The time, and of all cores since the machine's start the ticks that were wanted, and those its host kept back."""
    line = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    user, nice, system, _, _, irq, softirq, steal = (int(word) for word in line[1:9])
    return time.monotonic(), user + nice + system + irq + softirq + steal, steal


_earlier = _later = _ticks()


def _given() -> float:
    """The share of the processor time that this machine wanted in the last seconds and that its host gave it."""
    global _earlier, _later
    now = _ticks()
    if now[0] - _later[0] > _STEAL_OVER_S:
        _earlier, _later = _later, now
    wanted, kept_back = now[1] - _earlier[1], now[2] - _earlier[2]
    return max(0.05, 1.0 - kept_back / wanted) if wanted > 0 else 1.0


def _running() -> float:
    """How many tasks run or want to, the median of a few looks: threads that wake together are no load."""
    looks = []
    for _ in range(5):
        time.sleep(0.001)
        looks.append(int(Path("/proc/loadavg").read_text().split()[3].partition("/")[0]))
    return float(statistics.median(looks))


def busy() -> float:
    """Return how many tasks want each core, now or as Linux counts them over a minute; 1 on a quiet machine.

    It is more where the machine's host keeps back processor time that was wanted.
    """
    return max(1.0, os.getloadavg()[0] / _CORES, _running() / _CORES) / _given()


def within(limit_s: float, seconds_of: Callable[[], float], rounds: int = 5) -> None:
    """Assert that what takes these seconds keeps a limit in one round of a few.

    A machine with other work may stop everything for a while; what is too slow by itself is so in every round.
    """
    took: list[float] = []
    while not took or took[-1] >= limit_s:
        assert len(took) < rounds, f"{limit_s} s are allowed, it took {', '.join(f'{s:.3f}' for s in took)} s"
        took.append(seconds_of())


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
        self._busiest = max(self._busiest, os.getloadavg()[0] / _CORES)
        if time.monotonic() <= self._began + self._seconds * self._busiest:
            return False
        self._busiest = max(self._busiest, busy())
        return time.monotonic() > self._began + self._seconds * self._busiest

    @property
    def left(self) -> bool:
        """True until then."""
        return not self.is_over
