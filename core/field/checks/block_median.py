"""Robust level of a quantity about each point of a grid, from the points in a window of some subsets."""

from __future__ import annotations

import numpy as np

from core.arrays import Bool, Float

_REACH_SUBSETS, _MIN_REACH, _MAX_REACH = 1.5, 3, 24
_FEW = 12


def spacing_of(xy_px: Float, shape: tuple[int, int]) -> float:
    """Return the median distance of neighbouring points, px, from their positions (n, 2) row by row.

    Points of a later reference lie where they have moved; those that it does not show may lie anywhere.
    """
    rows, cols = shape
    grid = xy_px.reshape(rows, cols, 2)
    steps = np.diff(grid, axis=1) if cols > 1 else np.diff(grid, axis=0)
    distance = np.hypot(steps[..., 0], steps[..., 1])
    known = distance[np.isfinite(distance) & (distance > 0.0)]
    return float(np.median(known)) if known.size else 1.0


def reach_of(subset_px: int, spacing_px: float) -> int:
    """Return how many points to each side are neighbours: so many that a wrong match fills a small part of them."""
    return int(np.clip(np.ceil(_REACH_SUBSETS * subset_px / spacing_px), _MIN_REACH, _MAX_REACH))


def block_medians(
    values: Float, known: Bool, shape: tuple[int, int], reach: int, *, otherwise: float, quantile: float = 0.5
) -> Float:
    """Return (n,) the median of the known values about each point; ``otherwise`` where there are too few.

    Parameters
    ----------
    values, known
        (n,) of points row by row.
    shape
        Rows and columns.
    reach
        Points; the median is that of a block ``reach`` points wide and of as many about it.
    otherwise
        Value where fewer than a dozen are known.
    quantile
        Another one than the median.
    """
    rows, cols = shape
    level, used = values.reshape(shape), known.reshape(shape)
    out = np.full(shape, otherwise)
    for top in range(0, rows, reach):
        for left in range(0, cols, reach):
            about = (
                slice(max(top - reach // 2, 0), top + reach + reach // 2 + 1),
                slice(max(left - reach // 2, 0), left + reach + reach // 2 + 1),
            )
            there = level[about][used[about]]
            if len(there) >= _FEW:
                out[top : top + reach, left : left + reach] = (
                    np.median(there) if quantile == 0.5 else np.quantile(there, quantile)
                )
    return out.ravel()
