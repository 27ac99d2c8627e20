"""The account of a live measurement's frames: each is measured, skipped or refused, with its reason."""

from __future__ import annotations

import threading
from collections import Counter, deque

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
