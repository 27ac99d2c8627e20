"""Choice between measuring a pair that has waited and waiting for the next one, which comes soon."""

from __future__ import annotations

from collections import deque
from statistics import median

_KNOWN_FROM, _REMEMBERED = 3, 9
_OLD = 0.5  # of a period: the next pair is nearer then than this one is old
_LATE = 1.25  # periods after a pair, from which on no next one is waited for


class Pace:
    """The period in which pairs come.

    A measurement that takes longer than a period finds a pair of any age when it ends. Measuring it adds its age to the
    latency of every value; waiting for the next pair, if that is nearer, loses fewer values than it gains in age.
    """

    def __init__(self) -> None:
        self._last_s: float | None = None
        self._distances_s: deque[float] = deque(maxlen=_REMEMBERED)

    def came(self, arrived_s: float, passed: int) -> None:
        """Note the arrival of a pair, and how many came since the one noted before and were passed over."""
        if self._last_s is not None and arrived_s > self._last_s:
            self._distances_s.append((arrived_s - self._last_s) / (passed + 1))
        self._last_s = arrived_s

    def wait_s(self, arrived_s: float, now_s: float) -> float:
        """Return how long a pair's successor is to be waited for; 0: the pair is to be measured."""
        if len(self._distances_s) < _KNOWN_FROM:
            return 0.0
        period_s, age_s = median(self._distances_s), now_s - arrived_s
        return _LATE * period_s - age_s if _OLD * period_s < age_s < _LATE * period_s else 0.0
