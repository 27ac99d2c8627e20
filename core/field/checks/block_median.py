"""Robust level of a quantity about each point of a grid, from the points in a window of some subsets."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from stereorig.core.arrays import Bool, Float
from stereorig.core.robust import median

SIGMAS_OF_QUARTER, SIGMAS_OF_TENTH = 0.6745, 1.2816  # below the middle of a normal distribution
_REACH_SUBSETS, _MIN_REACH, _MAX_REACH = 1.5, 3, 24
_FEW = 12


def spacing_of(xy_px: Float, shape: tuple[int, int]) -> float:
    """Return the median distance of neighbouring points, px, from their positions (n, 2) row by row.

    Points of a later reference are at their moved positions; points that it does not show may be anywhere.
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


def least_about(values: Float, ok: Bool, shape: tuple[int, int], reach: int, *, every: int = 1) -> tuple[Float, Float]:
    """Return (n,) level and scatter of the values about each point, from those that are least.

    A feature that costs correlation at many points in a row, as an edge or an open crack, raises their middle and
    widens their scatter; so only the quarter and the tenth with the least loss are used.

    Parameters
    ----------
    values, ok
        (n,) of points row by row.
    shape
        Rows and columns.
    reach
        Points, as in :func:`block_medians`.
    every
        Only one of so many rows and columns is used: enough for the quantiles of some subsets' points.
    """
    counted = np.zeros(shape, bool)
    counted[::every, ::every] = True
    shares = (0.25, 0.1)
    quarter, tenth = _block_quantiles(
        values, ok & counted.ravel(), shape, reach, otherwise=lambda: np.quantile(values[ok], shares), quantiles=shares
    )
    scatter = np.maximum((quarter - tenth) / (SIGMAS_OF_TENTH - SIGMAS_OF_QUARTER), 0.0)
    return quarter + SIGMAS_OF_QUARTER * scatter, scatter


def block_medians(
    values: Float,
    known: Bool,
    shape: tuple[int, int],
    reach: int,
    *,
    otherwise: float | None = None,
    quantile: float = 0.5,
) -> Float:
    """Return (n,) the median of the known values about each point; ``otherwise`` if there are too few.

    Parameters
    ----------
    values, known
        (n,) of points row by row.
    shape
        Rows and columns.
    reach
        Number of points; the median is over a block ``reach`` points wide and as many on each side of it.
    otherwise
        Value if fewer than a dozen are known; None: the median of all that are known.
    quantile
        The quantile in place of the median.
    """
    return _block_quantiles(
        values,
        known,
        shape,
        reach,
        otherwise=lambda: [median(values[known]) if otherwise is None else otherwise],
        quantiles=(quantile,),
    )[0]


def _block_quantiles(
    values: Float,
    known: Bool,
    shape: tuple[int, int],
    reach: int,
    *,
    otherwise: Callable[[], Sequence[float] | Float],
    quantiles: tuple[float, ...],
) -> list[Float]:
    """Several quantiles of the same blocks, each with its value for blocks with too few."""
    rows, cols = shape
    beside = reach // 2
    width = reach + 2 * beside + 1
    # all blocks at once; unknown values, and places outside the grid, are sorted to the end
    padded = np.full((rows + reach + width, cols + reach + width), np.inf)
    padded[beside : beside + rows, beside : beside + cols] = np.where(known, values, np.inf).reshape(shape)
    total = np.zeros((padded.shape[0] + 1, padded.shape[1] + 1), np.int64)  # number of the points known before
    total[beside + 1 : beside + rows + 1, beside + 1 : beside + cols + 1] = known.reshape(shape)
    np.cumsum(total, axis=0, out=total)
    np.cumsum(total, axis=1, out=total)
    ordered = sliding_window_view(padded, (width, width))[:rows:reach, :cols:reach]
    blocks = ordered.shape[:2]
    ordered = ordered.reshape(*blocks, -1)
    ordered.sort(axis=-1)
    first, last = (slice(0, rows, reach), slice(0, cols, reach)), (slice(width, None, reach), slice(width, None, reach))
    after, left, above = total[last], total[last[0], first[1]], total[first[0], last[1]]
    r, c = blocks
    count = after[:r, :c] - left[:r, :c] - above[:r, :c] + total[first]
    enough = count >= _FEW
    unknowns = [0.0] * len(quantiles) if enough.all() else otherwise()
    found = []
    for quantile, unknown in zip(quantiles, unknowns, strict=True):
        at = quantile * (np.maximum(count, 1) - 1)
        low = np.floor(at).astype(int)
        share = at - low
        below, above = (
            np.take_along_axis(ordered, i[..., None], axis=-1)[..., 0]
            for i in (low, np.where(share > 0.0, low + 1, low))
        )
        below, above = np.where(enough, below, 0.0), np.where(enough, above, 0.0)
        # rounded as numpy's interpolation between the two
        step = above - below
        between = np.where(share < 0.5, below + step * share, above - step * (1.0 - share))
        if quantile == 0.5:
            between = (below + above) / 2.0
        level = np.where(enough, between, unknown)
        found.append(np.repeat(np.repeat(level, reach, axis=0), reach, axis=1)[:rows, :cols].ravel())
    return found
