"""Columns and rows of a sensor, seen in its images: pixels far apart along a line share the line and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float

SURE = 5.0
"""Standard deviations of a variance that is there."""
_ROUGH = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)  # white lines keep their variance, texture leaves little
# pixels that are averaged along a line, and between them: texture is independent at a larger distance
_STRIP_PX, _GAP_PX = 24, 12
_MIN_STRIPS, _MAX_STRIPS, MIN_LINES = 4, 16, 48
_OUTLIER = 5.0  # robust sd of a line: an edge of the specimen along it
_MAD_TO_SIGMA = 1.4826


def box_about(xy_px: Float, subset_px: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of an image of this shape that contain the subsets of points (n, 2)."""
    half = subset_px // 2
    low, high = np.floor(xy_px.min(axis=0)) - half, np.ceil(xy_px.max(axis=0)) + half + 1
    (x0, y0), (x1, y1) = np.maximum(low, 0).astype(int), np.minimum(high, np.array(shape[::-1])).astype(int)
    return slice(int(y0), int(y1)), slice(int(x0), int(x1))


def strips_along(image: NDArray[Any], axis: int) -> Float:
    """Return (k, n) rough part of the means of k strips along n lines: columns (axis 0) or rows (axis 1)."""
    lines = image if axis == 0 else image.T
    step = _STRIP_PX + _GAP_PX
    count = (len(lines) + _GAP_PX) // step
    every = max(1, -(-count // _MAX_STRIPS))  # some strips of a large image are enough
    if count == 0 or lines.shape[1] < len(_ROUGH):
        return np.zeros((0, 0))
    first = range(0, count * step, every * step)
    means = [lines[k : k + _STRIP_PX].mean(axis=0, dtype=np.float64) for k in first]
    return np.stack([np.convolve(mean, _ROUGH, mode="valid") for mean in means])


def line_covariance(one: Float, two: Float, moved_px: float = 0.0) -> tuple[float, float]:
    """Return the covariance of two images' lines, grey levels squared, and its standard deviation; NaN if not known.

    Parameters
    ----------
    one, two
        (k, n) of :func:`strips_along` of the same part of the sensor; twice the same gives a variance.
    moved_px
        By which the texture moved along the lines.
    """
    k, n = one.shape
    place = np.arange(k) * (_STRIP_PX + _GAP_PX)
    # no strip may show the same place as another one before
    apart = np.abs(place[None, :] - place[:, None] - moved_px) >= _STRIP_PX + 0.5 * _GAP_PX
    np.fill_diagonal(apart, False)
    if k < _MIN_STRIPS or n < MIN_LINES or apart.sum() < k:
        return float("nan"), float("nan")
    usual: Bool = np.ones(n, bool)
    for values in (one, two):
        mean = np.abs(values.mean(axis=0) - np.median(values.mean(axis=0)))
        usual &= mean <= _OUTLIER * _MAD_TO_SIGMA * np.median(mean)
    products = ((apart @ two) * one)[:, usual].sum(axis=0) / apart.sum()
    # the filter makes neighbours' products correlate
    return float(products.mean()), float(products.std() * np.sqrt(2.0 / max(int(usual.sum()), 1)))
