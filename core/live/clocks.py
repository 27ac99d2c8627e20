"""Channels and frames on one clock: values between readings, and two clocks' offset from a motion that both saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.robust import MAD_TO_SIGMA

_MIN_READINGS = 8
_COARSE = 400  # offsets of the search
_ROUNDS = 50
_CONVERGED = 1e-4  # share of the standard uncertainty
_KINK = 1e-9  # share of the slopes' power
_ABOVE_NOISE = 3.0
_WIDEST = 1.0 / 16.0  # share of the sparse series' time: the longest interval over which a slope is taken
_MAX_U = 0.25  # share of the common time: an offset with a larger uncertainty counts as unknown


def value_at(time_s: ArrayLike, values: ArrayLike, at_s: float, max_gap_s: float) -> float:
    """Return a channel's value at a time, on the line between the readings about it.

    Parameters
    ----------
    time_s, values
        (n,) the readings, times in order.
    at_s
        The time asked for.
    max_gap_s
        Readings that are further apart are not joined.

    Returns
    -------
    float
        NaN outside the readings and in a gap.
    """
    t, y = np.asarray(time_s, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if len(t) == 0 or not t[0] <= at_s <= t[-1]:
        return float("nan")
    k = int(np.searchsorted(t, at_s))
    if t[k] == at_s:
        return float(y[k])
    gap = t[k] - t[k - 1]
    if gap > max_gap_s:
        return float("nan")
    share = (at_s - t[k - 1]) / gap
    return float((1.0 - share) * y[k - 1] + share * y[k])


@dataclass(frozen=True)
class ClockOffset:
    """Offset of a channel's clock from the frames' clock.

    Attributes
    ----------
    offset_s
        Is added to the channel's times to get times of the frames' clock.
    u_s
        Its standard uncertainty, from the scatter about the fit.
    gain, bias
        The gauge is ``bias + gain channel``.
    correlation
        Correlation of gauge and channel at the offset.
    readings
        Pairs that were compared.
    """

    offset_s: float
    u_s: float
    gain: float
    bias: float
    correlation: float
    readings: int


def clock_offset(
    channel_s: ArrayLike, channel: ArrayLike, gauge_s: ArrayLike, gauge: ArrayLike, *, within_s: float = 2.0
) -> ClockOffset:
    """Estimate the offset of a channel's clock from a motion that channel and gauge both show: a knock, or a ramp.

    Least squares of ``gauge(t) = bias + gain channel(t - offset)`` over offset, gain and bias, from the best of a
    search. The series with more readings a second is interpolated at the times of the other. A straight line alone has
    no offset: the ramp's beginning or end must be in the readings.

    Parameters
    ----------
    channel_s, channel
        (n,) readings and their times by the channel's clock, in order.
    gauge_s, gauge
        (m,) values of a gauge and their times by the frames' clock, in order.
    within_s
        Largest offset that is looked for, either way.

    Raises
    ------
    InputError
        ``clock_readings`` for too few readings, or times out of order.
    MeasurementError
        ``offset_unknown`` if the readings do not determine it.

    Notes
    -----
    The uncertainty is the linearised fit's, with the variance of the residuals and their correlation from reading to
    reading (a first-order autoregression), so that vibrations that only one of them sees count.
    """
    one, two = _series("channel", channel_s, channel), _series("gauge", gauge_s, gauge)
    if not (np.isfinite(within_s) and within_s > 0.0):
        raise InputError(f"within_s is {within_s}, it must be above 0.", code="option_out_of_range")
    swapped = _interval(one[0]) > _interval(two[0])
    dense, sparse = (two, one) if swapped else (one, two)
    found = _fit(dense, sparse, within_s)
    if found is None:
        raise MeasurementError(
            "The offset of the clocks is not determined by these readings.",
            code="offset_unknown",
            remedy="Knock at the specimen, or let the ramp begin or end, while both are read; within_s must hold the "
            "offset.",
        )
    offset, u, gain, bias, correlation, n = found
    if swapped:  # the channel as a function of the gauge
        offset, gain, bias = -offset, 1.0 / gain, -bias / gain
    return ClockOffset(offset, u, gain, bias, correlation, n)


def _series(name: str, time_s: ArrayLike, values: ArrayLike) -> tuple[Float, Float]:
    t, y = np.asarray(time_s, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if t.ndim != 1 or t.shape != y.shape or not (np.isfinite(t).all() and np.isfinite(y).all()):
        raise InputError(f"The {name}'s times and values must be finite, one of each.", code="clock_readings")
    if len(t) < _MIN_READINGS or (np.diff(t) <= 0.0).any():
        raise InputError(
            f"The {name} has {len(t)} readings; {_MIN_READINGS} and more are needed, their times in order.",
            code="clock_readings",
            remedy="Read both over some seconds, with a knock or a ramp's beginning among them.",
        )
    return t, y


def _interval(t: Float) -> float:
    return float(np.median(np.diff(t)))


def _fit(
    dense: tuple[Float, Float], sparse: tuple[Float, Float], within_s: float
) -> tuple[float, float, float, float, float, int] | None:
    """Offset, its u, gain, bias, correlation and number; None if it is not determined."""
    step = max(_interval(dense[0]), within_s / _COARSE)
    tried = np.arange(-within_s, within_s + step, step)
    misfits = np.array([_misfit(dense, sparse, offset) for offset in tried])
    if not np.isfinite(misfits).any():
        return None
    begin = float(tried[int(np.nanargmin(misfits))])
    # with many readings a second, slopes over few readings are noise; slopes over many readings miss a knock
    half, longest = _interval(sparse[0]), float(sparse[0][-1] - sparse[0][0]) * _WIDEST
    while True:
        found = _descended(dense, sparse, begin, half, step, within_s)
        if found is not None or 2.0 * half > longest:
            return found
        half *= 2.0


def _descended(
    dense: tuple[Float, Float], sparse: tuple[Float, Float], begin: float, half: float, step: float, within_s: float
) -> tuple[float, float, float, float, float, int] | None:
    """As `_fit`, from an offset to begin with and with slopes over ``half`` a second either way."""
    offset, scatter = begin, _noise_of(dense[1])
    for _ in range(_ROUNDS):
        at, y = _common(dense, sparse, offset, half)
        if len(at) < _MIN_READINGS:
            return None
        x = np.interp(at, *dense)
        slope = (np.interp(at + half, *dense) - np.interp(at - half, *dense)) / (2.0 * half)
        gain, bias = _line(x, y)
        left = y - bias - gain * x
        # effect of the offset beyond gain and bias; the readings' own noise adds no information
        change = -gain * (slope - np.polyval(_line(x, slope), x))
        power, by_noise = float(change @ change), len(at) * (gain * scatter / half) ** 2 / 2.0
        known = power - by_noise
        if known <= max(_ABOVE_NOISE * by_noise, _KINK * gain**2 * float(slope @ slope)):
            return None
        variance = float(left @ left) / max(len(left) - 3, 1) * _correlated(left)
        u = float(np.sqrt(variance / known))
        moved = float(change @ left) / power
        offset += float(np.clip(moved, -step, step))
        if abs(moved) <= max(_CONVERGED * u, 1e-9):
            break
    common_s = float(at[-1] - at[0])
    spread = float(np.std(x) * np.std(y))
    correlation = float(np.mean((x - x.mean()) * (y - y.mean())) / spread) if spread > 0.0 else 0.0
    if abs(offset) > within_s + step or not u < _MAX_U * common_s or gain == 0.0:
        return None
    return offset, u, gain, bias, correlation, len(at)


def _common(
    dense: tuple[Float, Float], sparse: tuple[Float, Float], offset: float, margin: float = 0.0
) -> tuple[Float, Float]:
    """Times on the dense series' clock that it covers, and the sparse series' values there."""
    at = sparse[0] - offset
    inside = (at >= dense[0][0] + margin) & (at <= dense[0][-1] - margin)
    return at[inside], sparse[1][inside]


def _misfit(dense: tuple[Float, Float], sparse: tuple[Float, Float], offset: float) -> float:
    at, y = _common(dense, sparse, offset)
    # a small overlap fits by chance
    if len(at) < max(_MIN_READINGS, len(sparse[0]) // 2):
        return float("nan")
    x = np.interp(at, *dense)
    if np.ptp(x) <= 0.0:
        return float("nan")
    gain, bias = _line(x, y)
    return float(np.mean((y - bias - gain * x) ** 2))


def _line(x: Float, y: Float) -> tuple[float, float]:
    arm = x - x.mean()
    power = float(arm @ arm)
    gain = float(arm @ (y - y.mean())) / power if power > 0.0 else 0.0
    return gain, float(y.mean() - gain * x.mean())


def _noise_of(values: Float) -> float:
    """Standard deviation of a series' noise, from its second differences."""
    return float(MAD_TO_SIGMA * np.median(np.abs(np.diff(values, 2))) / np.sqrt(6.0))


def _correlated(left: Float) -> float:
    """Factor on the variance of an estimate whose residuals follow a first-order autoregression; never below 1."""
    scale = MAD_TO_SIGMA * float(np.median(np.abs(left)))
    kept = np.clip(left, -5.0 * scale, 5.0 * scale) if scale > 0.0 else left
    power = float(kept @ kept)
    rho = float(kept[1:] @ kept[:-1]) / power if power > 0.0 else 0.0
    rho = min(max(rho, 0.0), 0.99)
    return (1.0 + rho) / (1.0 - rho)
