"""What the points of a grid see: nothing reaches over a cut or over a mask's black.

A pixel of a subset counts if the straight line from the point to it meets no cut and stays on the white. Pixels next
to a cut do not count either: there the spline and the gradients of an image take in what lies beyond. Two points are
neighbours only if they see each other.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float, Float32
from core.field.region.line_crossings import find_near, look, part, parted_neighbours, variances
from core.field.region.neighbours import REACH
from core.field.region.region import PointGrid
from core.matching.arguments import VisiblePixels
from core.threads import run_ranges

MARGIN_PX = 2.0
"""How near to a cut, or to a mask's black, no pixel counts."""
LEAST_SHARE = 0.25
"""Of a subset's pixels; a point that sees fewer is not measured."""
_AT_ONCE = 256
_CHUNK = 4096
_known: weakref.WeakKeyDictionary[PointGrid, dict[int, Sight]] = weakref.WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Sight:
    """What each of the n points of a grid sees.

    Attributes
    ----------
    xy_px, shape, step_px
        (n, 2) the points, rows and columns, and their distance.
    pieces_px, white
        (m, 4) the cuts' straight pieces, and the mask, empty where there is none.
    visible
        Pixels that count, of the points that do not see all of their subset.
    share
        (n,) share of the subset's pixels that count.
    parted
        (r, c) uint32, bits as :func:`core.field.region.line_crossings.parted_neighbours`.
    """

    xy_px: Float
    shape: tuple[int, int]
    step_px: float
    pieces_px: Float
    white: NDArray[np.uint8]
    visible: VisiblePixels
    share: Float
    parted: NDArray[np.uint32]

    @property
    def enough(self) -> Bool:
        """(r, c) which points see enough of their subset to be measured."""
        return np.asarray(self.share >= LEAST_SHARE).reshape(self.shape)

    @property
    def whole(self) -> Bool:
        """(n,) which points see all of their subset."""
        return np.asarray(self.visible.of_point < 0)

    def at(self, xy_px: Float) -> VisiblePixels:
        """Return what points (m, 2) of the grid see.

        Raises
        ------
        ValueError
            If a place is not one of the grid's points.
        """
        rows, cols = self.shape
        col, row = np.rint((xy_px - self.xy_px[0]) / self.step_px).astype(np.int64).T
        inside = (row >= 0) & (col >= 0) & (row < rows) & (col < cols)
        index = np.where(inside, row * cols + col, 0)
        if not inside.all() or np.abs(self.xy_px[index] - xy_px).max(initial=0.0) > 1e-6:
            raise ValueError("a place that is not a point of the grid")
        return VisiblePixels(self.visible.patches, self.visible.of_point[index])

    def apart(self, a_px: Float, b_px: Float) -> Bool:
        """Return (n,) whether places a and b (n, 2) do not see each other."""
        out = np.zeros(len(a_px), bool)
        a, b = (np.ascontiguousarray(p, dtype=np.float64) for p in (a_px, b_px))
        run_ranges(lambda first, last: part(first, last, a, b, self.pieces_px, self.white, out), len(out), 4 * _AT_ONCE)
        return out

    def parted_at(self, dr: int, dc: int) -> Bool:
        """Return (n,) whether the neighbour ``dr`` rows and ``dc`` columns away, up to two, is parted from a point."""
        wide = 2 * REACH + 1
        place = (dr + REACH) * wide + dc + REACH
        bit = place - (1 if place > wide * wide // 2 else 0)
        return np.asarray((self.parted.ravel() >> np.uint32(bit)) & np.uint32(1), dtype=bool)

    def correct_variance(self, variance: Float, image: Float32) -> Float:
        """Return grey-level variances (n,) with those of cut subsets taken over the pixels that count alone."""
        index = np.flatnonzero(~self.whole)
        xy = np.ascontiguousarray(self.xy_px[index])
        own = np.empty(len(index))
        patches = self.visible.patches
        of = self.visible.of_point[index]
        for start in range(0, len(index), _CHUNK):
            some = slice(start, start + _CHUNK)
            chosen, places, out = patches[of[some]], xy[some], own[some]
            run_ranges(partial(_over, variances, (image, places, chosen, out)), len(out), _AT_ONCE)
        result = variance.copy()
        result[index] = own
        return result


def sight_of(grid: PointGrid, subset_px: int) -> Sight | None:
    """Return what the points of a grid see, None where nothing is in the way. Kept as long as the grid lives."""
    kept = _known.get(grid, {})
    if subset_px not in kept:
        if not grid.cuts and grid.white is None:
            return None
        keep_sight(grid, subset_px, _find(grid, subset_px))
    return _known[grid][subset_px]


def keep_sight(grid: PointGrid, subset_px: int, sight: Sight) -> None:
    """Keep what the points of a grid see, as long as the grid lives."""
    _known.setdefault(grid, {})[subset_px] = sight


def patches_seen(
    grid: PointGrid, points: NDArray[np.intp], width: int, margin_px: float, at_once: int
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.uint8]]]:
    """Yield points that do not see all of a square of ``width`` px about them, and what they see of it.

    Parameters
    ----------
    grid
        Cuts and mask.
    points
        Which of its points to look at.
    width, margin_px
        Of the square, odd, and how near to a cut or to black no pixel counts.
    at_once
        Points a yield, at most.
    """
    pieces, white = _obstacles(grid)
    clear, black_sums = _clear_of(white, margin_px)
    xy = np.ascontiguousarray(grid.xy_px.reshape(-1, 2)[points])
    near = np.zeros(len(xy), bool)
    run_ranges(
        lambda first, last: find_near(first, last, xy, width, margin_px, pieces, black_sums, near),
        len(xy),
        16 * _AT_ONCE,
    )
    index = np.flatnonzero(near)
    for start in range(0, len(index), at_once):
        some = index[start : start + at_once]
        places = np.ascontiguousarray(xy[some])
        patches, counts = np.empty((len(some), width, width), np.uint8), np.empty(len(some), np.int32)
        run_ranges(
            partial(_over, look, (places, width, margin_px, pieces, white, clear, patches, counts)), len(some), _AT_ONCE
        )
        yield points[some], patches


def _over(kernel: Callable[..., None], rest: tuple[Any, ...], first: int, last: int) -> None:
    kernel(first, last, *rest)


def _obstacles(grid: PointGrid) -> tuple[Float, NDArray[np.uint8]]:
    pieces = grid.cuts.pieces_px if grid.cuts else np.zeros((0, 4))
    white = np.zeros((0, 0), np.uint8) if grid.white is None else np.ascontiguousarray(grid.white, np.uint8)
    return pieces, white


def _clear_of(white: NDArray[np.uint8], margin_px: float) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Return what of a mask's white may count, and the integral image of its black."""
    if not white.size:
        return white, np.zeros((1, 1), np.int32)
    # as far as a cut is kept clear of, the mask's black is too
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(margin_px) - 1, 2 * int(margin_px) - 1))
    clear = np.ascontiguousarray(cv2.erode(white, disc, borderType=cv2.BORDER_REPLICATE), np.uint8)
    return clear, np.asarray(cv2.integral(1 - white), np.int32)


def _find(grid: PointGrid, subset: int) -> Sight:
    pieces, white = _obstacles(grid)
    clear, black_sums = _clear_of(white, MARGIN_PX)
    xy = np.ascontiguousarray(grid.xy_px.reshape(-1, 2))
    n = len(xy)
    near = np.zeros(n, bool)
    run_ranges(
        lambda first, last: find_near(first, last, xy, subset, MARGIN_PX, pieces, black_sums, near), n, 16 * _AT_ONCE
    )
    near &= grid.allowed.ravel()
    share, of_point = np.ones(n), np.full(n, -1, np.int32)
    index = np.flatnonzero(near)
    kept: list[NDArray[np.uint8]] = []
    n_kept = 0
    for start in range(0, len(index), _CHUNK):
        some = index[start : start + _CHUNK]
        places = np.ascontiguousarray(xy[some])
        patches, counts = np.empty((len(some), subset, subset), np.uint8), np.empty(len(some), np.int32)
        rest = (places, subset, MARGIN_PX, pieces, white, clear, patches, counts)
        run_ranges(partial(_over, look, rest), len(some), _AT_ONCE)
        share[some] = counts / float(subset * subset)
        cut = counts < subset * subset
        of_point[some[cut]] = n_kept + np.arange(int(cut.sum()), dtype=np.int32)
        n_kept += int(cut.sum())
        kept.append(patches[cut])
    patches = np.concatenate(kept) if kept else np.zeros((0, subset, subset), np.uint8)
    parted = np.zeros(grid.shape, np.uint32)
    x, y = np.ascontiguousarray(grid.x_px), np.ascontiguousarray(grid.y_px)
    run_ranges(lambda first, last: parted_neighbours(first, last, x, y, REACH, pieces, white, parted), grid.shape[0], 4)
    return Sight(xy, grid.shape, grid.step_px, pieces, white, VisiblePixels(patches, of_point), share, parted)
