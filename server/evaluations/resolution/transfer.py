"""What is left of a displacement or a strain that varies as a cosine along a row or a column of the image.

A patch fitted by least squares gives its middle a weighted mean of the displacement over the subset, a window of points
gives a weighted sum of their values. The transfer of both is the product of the weights' Fourier transforms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from stereorig.core.arrays import Float
from stereorig.core.field.points.smoothing_record import weight_square

_LEFT = 0.9  # of the amplitude, at the spatial resolution l10
_FINE = 400  # periods to each factor of ten, among which the crossing is looked for


@dataclass(frozen=True, eq=False)
class Filter:
    """Weights of values at equal distances, symmetric about the middle; of their slope if they are antisymmetric."""

    weights: Float
    step_px: float
    slope: bool = False

    def left(self, period_px: Float) -> Float:
        """Return (n,) the share of a cosine's amplitude that is left at periods (n,)."""
        at = (np.arange(len(self.weights)) - len(self.weights) // 2) * self.step_px
        turn = 2.0 * np.pi / np.asarray(period_px)[:, None]
        if self.slope:
            return np.asarray(np.sin(turn * at) @ self.weights / turn[:, 0])
        return np.asarray(np.cos(turn * at) @ self.weights)


@lru_cache(maxsize=64)
def patch_filter(width: int, order: int, step_px: float = 1.0) -> Filter:
    """Return the filter of a plane (order 1) or quadratic (2) patch over a square of ``width`` pixels or points."""
    return Filter(weight_square(width, order).sum(axis=0), step_px)


def slope_filter(window: int, spacing_px: float) -> Filter:
    """Return the filter of the slope of a plane over a window of points; a quadratic has the same in its middle."""
    side = np.arange(window) - window // 2
    return Filter(side / (float((side**2).sum()) * spacing_px), spacing_px, slope=True)


def l10_px(filters: Sequence[Filter]) -> float:
    """Return the period from which on at least 90 % of the amplitude is left after all filters, px."""
    widest = sum((len(one.weights) - 1) * one.step_px + 1.0 for one in filters)

    def above(period: float) -> float:
        return float(np.prod([one.left(np.array([period]))[0] for one in filters])) - _LEFT

    periods = np.geomspace(100.0 * widest, 2.0, int(_FINE * np.log10(50.0 * widest)))
    left = np.prod([one.left(periods) for one in filters], axis=0)
    first = int(np.argmax(left < _LEFT))
    return float(brentq(above, periods[first], periods[first - 1], rtol=1e-10))
