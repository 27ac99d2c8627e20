"""Noise of a field, estimated from the field itself: differences of neighbours, to which smooth parts do not add.

Fourth differences over a few steps along the rows take out whatever is a cubic there: the specimen's own deformation.
Noise stays, and by how much follows from the pixels that subsets share. The ratio of what is seen to what the results
tell is the answer; it holds for what changes from point to point and not for errors that neighbours have in common.
"""

from __future__ import annotations

from math import comb

import numpy as np
from scipy.signal import fftconvolve

from stereorig.core.arrays import Float
from stereorig.core.field.points.shared_pixels import SharedPixels

ORDER = 4


def window_slope(window: int, axis: int) -> Float:
    """Weights (window, window) with which a whole strain window's points make the slope along x (0) or y (1)."""
    side = np.arange(window) - window // 2
    x, y = np.meshgrid(side, side)
    along = x if axis == 0 else y
    return np.asarray(along / (along**2).sum())


def observed_over_reported(
    values: Float, sigma: Float, weights: Float, shared: SharedPixels, spacing_px: float, lag: int
) -> float:
    """Return the noise that is observed over that which is reported.

    Parameters
    ----------
    values, sigma
        (r, c) a quantity that is the same weighted sum of the points about each point, and its reported noise.
    weights
        (m, n) of that sum; ``[[1]]`` for the points themselves.
    shared
        The correlation of neighbouring points.
    spacing_px
        Distance of neighbouring points.
    lag
        Steps between the positions that are differenced.
    """
    signs = np.zeros((1, ORDER * lag + 1))
    signs[0, ::lag] = [(-1) ** k * comb(ORDER, k) for k in range(ORDER + 1)]
    count = values.shape[1] - ORDER * lag
    seen = sum(s * values[:, k * lag : k * lag + count] for k, s in enumerate(signs[0, ::lag]))
    share = _variance(fftconvolve(weights, signs), shared, spacing_px) / _variance(weights, shared, spacing_px)
    return float(np.sqrt(np.nanmean(np.square(seen)) / (share * np.nanmean(sigma**2))))


def _variance(weights: Float, shared: SharedPixels, spacing_px: float) -> float:
    """Variance of a weighted sum of points of variance 1."""
    reach = spacing_px * (np.arange(-(max(weights.shape) - 1), max(weights.shape)))
    rho = shared.correlation(*np.meshgrid(reach, reach))
    return float((weights * fftconvolve(weights, rho, mode="same")).sum())
