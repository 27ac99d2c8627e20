"""The account of a live measurement's frames: each is measured, skipped or refused, with its reason."""

from __future__ import annotations

import threading
from collections import Counter, deque
from statistics import median

import numpy as np

_RECENT = 500


class Account:
    """Counters of frames, and the latency of the last ones; every method may be called from any thread.

    ``frames = measured + skipped + refused + waiting``; a wait without a frame (a lost camera) has its own counter.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = Counter[str]()
        self._refused = Counter[str]()
        self._without = Counter[str]()
        self._latency_ms: deque[float] = deque(maxlen=_RECENT)
        self._times: deque[float] = deque(maxlen=_RECENT)

    def came(self, frames: int) -> None:
        """Count frame pairs that the cameras delivered."""
        with self._lock:
            self._counts["frames"] += frames

    def skipped(self, frames: int) -> None:
        """Count pairs that a newer one replaced before they were measured."""
        with self._lock:
            self._counts["skipped"] += frames

    def refused(self, code: str) -> None:
        """Count a pair that could not be measured."""
        with self._lock:
            self._counts["refused"] += 1
            self._refused[code] += 1

    def without_frame(self, code: str) -> None:
        """Count a wait for a pair that ended in an error."""
        with self._lock:
            self._without[code] += 1

    def measured(self, how: str, latency_ms: float, now_s: float) -> None:
        """Count a measured pair, with the time from its arrival in memory to its values."""
        with self._lock:
            self._counts["measured"] += 1
            self._counts[how] += 1
            self._latency_ms.append(latency_ms)
            self._times.append(now_s)

    def counts(self) -> dict[str, int]:
        """Return the counters by name; counts by reason are ``refused_by`` and ``without_by`` of the document."""
        names = ("frames", "measured", "followed", "step", "skipped", "refused")
        with self._lock:
            return {name: self._counts[name] for name in names}

    def document(self) -> dict[str, object]:
        """Return all of it as plain values."""
        counts = self.counts()
        with self._lock:
            latency = np.array(self._latency_ms)
            times = list(self._times)
            reasons = {"refused_by": dict(self._refused), "without_frame_by": dict(self._without)}
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else None
        waiting = counts["frames"] - counts["measured"] - counts["skipped"] - counts["refused"]
        shown = None
        if len(latency):
            shown = {f"p{q:g}": round(float(np.percentile(latency, q)), 3) for q in (50, 99)}
        return {**counts, "waiting": max(waiting, 0), **reasons, "latency_ms": shown, "rate_hz": rate}


# Choice between measuring a pair that has waited and waiting for the next one, which comes soon.

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
