"""What windows and subsets lose where a field bends the most.

A filter that leaves the share T(k) = 1 - m k^2 / 2 + ... of a cosine returns f + m f'' / 2 of a smooth f, m being the
second moment of its weights. The second derivatives come from the measured values, by quadratics over a window; where
the field bends within the filter's own width they are too small, and so is the bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.server.evaluations.resolution.transfer import Filter

_LONG = 1e3  # widths of the filter, at which its transfer is a parabola


class Bent(NamedTuple):
    """Bias at the place where it is largest, and that place's row and column."""

    bias: float
    row: int
    col: int


def moment_px2(filters: Sequence[Filter]) -> float:
    """Return the second moment m of filters one after the other, px^2."""
    period = _LONG * sum(len(one.weights) * one.step_px for one in filters)
    left = np.prod([one.left(np.array([period]))[0] for one in filters])
    return float(2.0 * (1.0 - left) * (period / (2.0 * np.pi)) ** 2)


def bias_of(values: Float, spacing_px: float, window: int, along_px2: float, down_px2: float) -> Float:
    """Return (r, c) m f'' / 2 of values (r, c), of both directions; NaN where a window is not whole.

    Parameters
    ----------
    values
        At points ``spacing_px`` apart; NaN where there is none.
    window
        Points across the quadratics, odd.
    along_px2, down_px2
        Second moments along the rows and down the columns.
    """
    out = np.full(values.shape, np.nan)
    if min(values.shape) < window:
        return out
    side = np.arange(window) - window // 2
    bend = (side**2 - np.mean(side**2)) / float(((side**2 - np.mean(side**2)) ** 2).sum() * window)
    # 2 a of a x^2, the window's mean over the other direction
    kernel = (along_px2 * np.outer(np.ones(window), bend) + down_px2 * np.outer(bend, np.ones(window))) / spacing_px**2
    windows = np.lib.stride_tricks.sliding_window_view(values, (window, window))
    half = window // 2
    out[half : values.shape[0] - half, half : values.shape[1] - half] = np.einsum("rcij,ij->rc", windows, kernel)
    return out


def whole_windows(valid: Bool, window: int) -> Bool:
    """Return (r, c) True at points whose window of points is whole; at others a strain is that of a place beside it."""
    out = np.zeros(valid.shape, bool)
    if min(valid.shape) >= window:
        half = window // 2
        every = np.lib.stride_tricks.sliding_window_view(valid, (window, window)).all(axis=(2, 3))
        out[half : valid.shape[0] - half, half : valid.shape[1] - half] = every
    return out


def steepest(bias: Float) -> Bent | None:
    """Return the largest of biases (r, c); None if there is none."""
    if not np.isfinite(bias).any():
        return None
    row, col = np.unravel_index(int(np.nanargmax(np.abs(bias))), bias.shape)
    return Bent(float(bias[row, col]), int(row), int(col))
