"""Readings of channels: the value at an exposure with its uncertainty, and readings that are none any more."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.robust import MAD_TO_SIGMA

_ABOUT = 25  # readings on each side from which the noise is estimated
_GAPS = 3.0  # readings further apart than so many median intervals are not joined
_OF_LINE = 1.5  # variance of a reading about the line between its neighbours, over the noise's
_OF_CUBIC = 4.375  # the same for such a departure about the line between its neighbours': zero for a parabola
_OF_SECOND = 6.0  # the same for a second difference
_JUMP = 4.0  # beyond two standard deviations of the noise a jump is the signal's
_CHANCE = 1e-9  # probability of a run of equal digits that still counts as noise
_EARLIER = 50  # readings before a run, from which its chance is known
_MIN_RUN = 10
_NOISY = 0.6  # in digits: rounding alone scatters by up to 0.4 of one
_MOVED = 0.1  # share of a channel's range in memory: it moves, beyond its noise
_MIN_STRANGE, _MIN_DISTINCT = 5, 3
_MORE_THAN_CHANCE = 3
_AWAY = 5.0  # times a channel's own changes from reading to reading
_LOOKED_AT = 200  # newest readings that are compared with another channel's


@dataclass(frozen=True)
class ReadingAt:
    """A channel at a time.

    Attributes
    ----------
    value
        On the straight line between two readings; after the last one, its value.
    u
        Standard uncertainty.
    held_s
        Age of the last reading if the time is after it, else 0.
    """

    value: float
    u: float
    held_s: float = 0.0


def reading_at(t: Float, y: Float, at_s: float, *, resolution: float = 0.0, u_time_s: float = 0.0) -> ReadingAt | str:
    """Return a channel at a time; the reason if it is not known.

    Parameters
    ----------
    t, y
        (n,) times in order, s, and readings.
    at_s
        The time asked for.
    resolution
        Step of the last digit.
    u_time_s
        Standard uncertainty of the readings' times.

    Notes
    -----
    The uncertainty joins four parts: the readings' noise, by their scatter about a parabola through their neighbours;
    the signal's departure from the straight line; the resolution over the root of 12; the local slope times
    ``u_time_s``. The departure follows from the second differences at both readings. With opposite signs, they show a
    jump between both, of rms error ``jump sqrt(w (1 - w))`` at the share ``w`` of the way if it may be anywhere. With
    one sign, they show a bend: ``bend sqrt(w (1 - w)) / 2`` is about the rms error of a kink anywhere, and twice the
    rms error of a parabola.
    """
    n = len(t)
    k = int(np.searchsorted(t, at_s))
    if n < 2:
        return "it has had fewer than two readings"
    if k == 0 and at_s < t[0]:
        return "it was not read yet"
    lo, hi = max(k - _ABOUT, 0), min(k + _ABOUT, n)
    interval = float(np.median(np.diff(t[lo:hi])))
    bow = _departures(t[lo:hi], y[lo:hi])
    noise = _noise(t[lo:hi], bow)
    fixed = noise**2, resolution**2 / 12.0
    if k == n:
        age = at_s - float(t[-1])
        if age > _GAPS * interval:
            return f"its last reading is {age:.3g} s old"
        rate = float(np.max(np.abs(np.diff(y[-4:]) / np.diff(t[-4:]))))
        u = math.sqrt(sum(fixed) + rate**2 * (age**2 + u_time_s**2))
        return ReadingAt(float(y[-1]), u, age)
    k = max(k, 1)
    gap, change = float(t[k] - t[k - 1]), float(y[k] - y[k - 1])
    if gap > _GAPS * interval:
        return f"its readings are {gap:.3g} s apart there"
    w = (at_s - float(t[k - 1])) / gap
    known = [2.0 * float(bow[i]) for i in (k - 2 - lo, k - 1 - lo) if 0 <= i < len(bow)]
    before, behind = known if len(known) == 2 else (sum(known), -sum(known))  # one that is not known may be as bad
    bend, jump = abs(before + behind) / 2.0, min(abs(before), abs(behind)) if before * behind < 0.0 else 0.0
    of_noise = _OF_SECOND * noise**2
    shape = max(jump**2 - _JUMP * of_noise, 0.0) + max(bend**2 - of_noise, 0.0) / 4.0
    u = math.sqrt(
        fixed[0] * (w**2 + (1.0 - w) ** 2) + fixed[1] + shape * w * (1.0 - w) + (change / gap * u_time_s) ** 2
    )
    return ReadingAt(float(y[k - 1]) + w * change, u)


def _departures(t: Float, y: Float) -> Float:
    """Return each inner reading's departure from the line between its neighbours."""
    if len(t) < 3:
        return np.zeros(0)
    w = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    return np.asarray(y[1:-1] - (1.0 - w) * y[:-2] - w * y[2:], dtype=np.float64)


def _noise(t: Float, bow: Float) -> float:
    left = _departures(t[1:-1], bow)
    return 0.0 if len(left) == 0 else float(MAD_TO_SIGMA * np.median(np.abs(left)) / math.sqrt(_OF_CUBIC))


def stuck_since(t: Float, y: Float) -> tuple[float, bool] | None:
    """Return when a channel's digits began to stay the same for longer than its earlier readings allow.

    Returns
    -------
    tuple
        That time, and True if the earlier readings had noise; without it the quantity itself may have come to rest.
        None if the channel is not stuck, or has too few readings.
    """
    other = np.flatnonzero(y != y[-1]) if len(y) else np.zeros(0, dtype=np.intp)
    if len(other) == 0:
        return None
    begin = int(other[-1]) + 1
    run, t0, y0 = len(y) - begin, t[: begin + 1], y[: begin + 1]
    if run < _MIN_RUN or begin < _EARLIER:
        return None
    same = np.diff(y0) == 0.0
    longest = max((len(part) for part in np.split(same, np.flatnonzero(~same))), default=0)
    allowed = math.log(_CHANCE) / math.log((np.count_nonzero(same) + 1.0) / (len(same) + 2.0))
    if run <= max(allowed, 2.0 * longest):
        return None
    digit = float(np.min(np.abs(np.diff(y0))[~same]))
    bow = np.abs(_departures(t0, y0))
    bow = np.minimum(bow, 5.0 * float(np.median(bow)) + digit)  # a jump of the signal is no noise
    scatter = float(np.sqrt(np.mean(bow**2) / _OF_LINE))
    return float(t[begin]), scatter > _NOISY * digit


def has_moved(t: Float, y: Float, since_s: float) -> bool:
    """Return True if a channel has gone through a tenth of its range, and beyond its noise, since a time."""
    lately = y[t >= since_s]
    if len(lately) < 6:
        return False
    third = len(lately) // 3
    went = abs(float(np.mean(lately[-third:]) - np.mean(lately[:third])))
    return went > max(_MOVED * float(np.ptp(y)), 5.0 * _noise(t, _departures(t, y)) * math.sqrt(2.0 / third))


def appears_in(one: tuple[Float, Float], two: tuple[Float, Float], within_s: float) -> bool:
    """Return True if readings of one channel appear in another, by their digits and at their time.

    Parameters
    ----------
    one, two
        Times and numbers as the instruments sent them; the readings ``one`` are searched for among the newest of
        ``two``.
    within_s
        Readings so near in time are compared. Readings at five such times before and after show the number of
        coincidences by chance.
    """
    (t1, y1), (t2, y2) = one, (two[0][-_LOOKED_AT:], two[1][-_LOOKED_AT:])
    begin = int(np.searchsorted(t1, t2[0] - 7.0 * within_s)) if len(t2) else 0
    t1, y1 = t1[begin:], y1[begin:]
    if not np.isin(y2, y1).any():
        return False
    same = y2[:, None] == y1[None, :]
    apart = t2[:, None] - t1[None, :]
    near = same & (np.abs(apart) <= within_s)
    found = near.any(axis=1)
    chance = max(int((same & (np.abs(apart - s * within_s) <= within_s)).any(axis=1).sum()) for s in (-5.0, 5.0))
    strange = y2[found]
    if len(strange) < max(_MIN_STRANGE, _MORE_THAN_CHANCE * chance):
        return False
    if len(np.unique(strange)) < _MIN_DISTINCT:
        return False
    own_t, own = t2[~found], y2[~found]
    if len(own) < _MIN_STRANGE:
        return True
    # in the channel that they belong to they are among the other readings
    away = float(np.median(np.abs(strange - np.interp(t2[found], own_t, own))))
    return away > _AWAY * max(float(np.median(np.abs(_departures(own_t, own)))), float(np.median(np.abs(np.diff(own)))))


# Moments in the readings of a channel: a level or a slope reached, peaks and valleys, phases of its cycles.

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
