"""Visibility: the pixels of its subset, and the neighbours, that no cut and no black of a mask separates from a point.

A pixel of a subset counts if the straight line from the point to it meets no cut and stays on the white. Pixels next to
a cut do not count either: there the spline and the gradients of an image include pixels beyond it. Two points are
neighbours only if no cut or black is between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.field.region.line_crossings import find_separated, variances
from stereorig.core.field.region.neighbours import REACH
from stereorig.core.matching.arguments import VisiblePixels
from stereorig.core.threads import run_ranges

MIN_SHARE = 0.25
"""Least visible share of a subset's pixels; a point with a smaller share is not measured."""
AT_ONCE = 256
CHUNK = 4096


@dataclass(frozen=True, eq=False)
class Visibility:
    """Visibility of the n points of a grid.

    Attributes
    ----------
    xy_px, shape, spacing_px
        (n, 2) the points, rows and columns, and their distance.
    pieces_px, white
        (m, 4) the cuts' straight pieces, and the mask, empty without one.
    visible
        Visible pixels of the points with a partly visible subset.
    share
        (n,) share of the subset's pixels that are visible.
    separated
        (r, c) uint32, bits as :func:`stereorig.core.field.region.line_crossings.separated_neighbours`.
    """

    xy_px: Float
    shape: tuple[int, int]
    spacing_px: float
    pieces_px: Float
    white: NDArray[np.uint8]
    visible: VisiblePixels
    share: Float
    separated: NDArray[np.uint32]

    @property
    def subset_px(self) -> int:
        """Width of the subsets."""
        return int(self.visible.patches.shape[1])

    @property
    def enough(self) -> Bool:
        """(r, c) True where enough of a subset is visible to measure the point."""
        return np.asarray(self.share >= MIN_SHARE).reshape(self.shape)

    @property
    def whole(self) -> Bool:
        """(n,) True where all of a subset is visible."""
        return np.asarray(self.visible.of_point < 0)

    def at(self, xy_px: Float) -> VisiblePixels:
        """Return the visible pixels of points (m, 2) of the grid.

        Raises
        ------
        ValueError
            If a position is not one of the grid's points.
        """
        rows, cols = self.shape
        col, row = np.rint((xy_px - self.xy_px[0]) / self.spacing_px).astype(np.int64).T
        inside = (row >= 0) & (col >= 0) & (row < rows) & (col < cols)
        index = np.where(inside, row * cols + col, 0)
        if not inside.all() or np.abs(self.xy_px[index] - xy_px).max(initial=0.0) > 1e-6:
            raise ValueError("a position that is not a point of the grid")
        return VisiblePixels(self.visible.patches, self.visible.of_point[index])

    def are_separated(self, a_px: Float, b_px: Float) -> Bool:
        """Return (n,) True if a cut or black is between positions a and b (n, 2)."""
        out = np.zeros(len(a_px), bool)
        a, b = (np.ascontiguousarray(p, dtype=np.float64) for p in (a_px, b_px))
        run_ranges(
            lambda first, last: find_separated(first, last, a, b, self.pieces_px, self.white, out),
            len(out),
            4 * AT_ONCE,
        )
        return out

    def separated_at(self, dr: int, dc: int) -> Bool:
        """Return (n,) True where the neighbour ``dr`` rows and ``dc`` columns away, up to two, is separated."""
        wide = 2 * REACH + 1
        index = (dr + REACH) * wide + dc + REACH
        bit = index - (1 if index > wide * wide // 2 else 0)
        return np.asarray((self.separated.ravel() >> np.uint32(bit)) & np.uint32(1), dtype=bool)

    def correct_variance(self, variance: Float, image: Float32) -> Float:
        """Return grey-level variances (n,), for cut subsets over the visible pixels alone."""
        index = np.flatnonzero(~self.whole)
        xy = np.ascontiguousarray(self.xy_px[index])
        own = np.empty(len(index))
        patches = self.visible.patches
        of = self.visible.of_point[index]
        for start in range(0, len(index), CHUNK):
            some = slice(start, start + CHUNK)
            chosen, centres, out = patches[of[some]], xy[some], own[some]
            run_ranges(over(variances, image, centres, chosen, out), len(out), AT_ONCE)
        result = variance.copy()
        result[index] = own
        return result


def over(kernel: Callable[..., None], *arguments: Any) -> Callable[[int, int], None]:
    """Return a kernel for :func:`stereorig.core.threads.run_ranges`, and the arguments that follow the range."""
    return lambda first, last: kernel(first, last, *arguments)
