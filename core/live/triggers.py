"""Moments in the readings of a channel: a level or a slope reached, peaks and valleys, phases of its cycles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from stereorig.core.arrays import Float

_REVERSAL = 0.2  # share of the range of all readings so far: a smaller reversal is noise


def level_reached(t: Float, y: Float, level: float, *, falling: bool = False) -> float | None:
    """Return the time at which readings first pass a level, between two of them; None if they do not."""
    side = y <= level if falling else y >= level
    passed = np.flatnonzero(side[1:] & ~side[:-1])
    if len(passed) == 0:
        return None
    k = int(passed[0])
    return float(t[k] + (t[k + 1] - t[k]) * (level - y[k]) / (y[k + 1] - y[k]))


def slope_reached(t: Float, y: Float, slope_per_s: float, *, over_s: float) -> float | None:
    """Return the time at which the mean slope over a span first reaches a slope (at or below one below zero)."""
    begin = np.searchsorted(t, t - over_s, side="right") - 1
    known = np.flatnonzero(begin >= 0)
    slope = (y[known] - y[begin[known]]) / (t[known] - t[begin[known]])
    reached = known[slope >= slope_per_s] if slope_per_s >= 0.0 else known[slope <= slope_per_s]
    return float(t[reached[0]]) if len(reached) else None


class Cycles:
    """Peaks and valleys of readings that come bit by bit, each known once the readings have gone back from it.

    Parameters
    ----------
    reversal
        How far they go back from one, in the channel's unit; None: a fifth of the range so far.
    """

    def __init__(self, reversal: float | None = None) -> None:
        self._reversal = reversal
        self._low = self._high = np.nan
        self._best: list[tuple[float, float]] = []  # the extreme so far with a reading before and behind it
        self._before: tuple[float, float] | None = None
        self._rising = True
        self.peaks: list[float] = []
        self.valleys: list[float] = []

    def see(self, y: Float) -> None:
        """Take earlier readings into the range."""
        if len(y):
            self._low, self._high = float(np.min(y)), float(np.max(y))

    def feed(self, t: Float, y: Float) -> None:
        """Take readings that follow those before."""
        for at, value in zip(t.tolist(), y.tolist(), strict=True):
            self._low, self._high = float(np.fmin(self._low, value)), float(np.fmax(self._high, value))
            one = at, value
            if not self._best:
                self._best = [one]
            elif (value > self._best[0][1]) == self._rising and value != self._best[0][1]:
                self._best = [one] if self._before is None else [one, self._before]
            elif len(self._best) < 3 and (len(self._best) == 2):
                self._best.append(one)
            back = abs(value - self._best[0][1])
            enough = _REVERSAL * (self._high - self._low) if self._reversal is None else self._reversal
            if back >= enough > 0.0 and (value < self._best[0][1]) == self._rising:
                if len(self._best) > 1:  # the first reading of all is no extreme
                    (self.peaks if self._rising else self.valleys).append(_vertex(self._best))
                self._rising, self._best = not self._rising, [one]
            self._before = one


def _vertex(readings: Sequence[tuple[float, float]]) -> float:
    """Return the time of the extreme of the parabola through a reading and those before and behind it."""
    at, value = readings[0]
    if len(readings) < 3:
        return at
    (before, low), (behind, high) = readings[1:]
    left, right = (value - low) / (at - before), (high - value) / (behind - at)
    if left == right:
        return at
    # the slope changes from the middle of one interval to the middle of the other
    middle = (before + at) / 2.0
    return middle + left / (left - right) * (behind - before) / 2.0


def moments(
    cycles: Cycles, kind: Literal["peak", "valley", "phase"], *, every: int, phases_deg: Sequence[float]
) -> list[float]:
    """Return the times of a kind in each N-th cycle; phases count from a peak to the next one."""
    if kind != "phase":
        return (cycles.peaks if kind == "peak" else cycles.valleys)[every - 1 :: every]
    pairs = list(zip(cycles.peaks, cycles.peaks[1:], strict=False))[every - 1 :: every]
    return [begin + (end - begin) * (phase % 360.0) / 360.0 for begin, end in pairs for phase in sorted(phases_deg)]
