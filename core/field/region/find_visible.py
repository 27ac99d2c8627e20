"""Computation of a grid's visibility: lines from each point, intersected with cuts and mask."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.region.line_crossings import find_near, mark_visible, separated_neighbours
from stereorig.core.field.region.neighbours import REACH
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.region.visibility import AT_ONCE, CHUNK, Visibility, over
from stereorig.core.matching.arguments import VisiblePixels
from stereorig.core.threads import run_ranges

MARGIN_PX = 2.0
"""Distance to a cut, or to a mask's black, below which no pixel counts."""


def with_visibility(grid: PointGrid, subset_px: int) -> PointGrid:
    """Return the grid with its visibility; the same grid if that is known, or without cuts and mask."""
    if grid.visibility is None and not grid.cuts and grid.white is None:
        return grid
    if grid.visibility is not None and grid.visibility.subset_px == subset_px:
        return grid
    return replace(grid, visibility=_find(grid, subset_px))


def visible_patches(
    grid: PointGrid, points: NDArray[np.intp], width: int, margin_px: float, at_once: int
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.uint8]]]:
    """Yield points with a partly invisible square of ``width`` px about them, and the visible pixels of it.

    Parameters
    ----------
    grid
        Cuts and mask.
    points
        Indices of its points to examine.
    width, margin_px
        Width of the square, odd, and the distance to a cut or to black below which no pixel counts.
    at_once
        Points a yield, at most.

    Yields
    ------
    points, patches
        (k,) indices and (k, width, width) uint8, 1 for a visible pixel.
    """
    pieces, white = _obstacles(grid)
    clear, black_sums = _clear_of(white, margin_px)
    xy = np.ascontiguousarray(grid.xy_px.reshape(-1, 2)[points])
    near = np.zeros(len(xy), bool)
    run_ranges(
        lambda first, last: find_near(first, last, xy, width, margin_px, pieces, black_sums, near),
        len(xy),
        16 * AT_ONCE,
    )
    index = np.flatnonzero(near)
    for start in range(0, len(index), at_once):
        some = index[start : start + at_once]
        centres = np.ascontiguousarray(xy[some])
        patches, counts = np.empty((len(some), width, width), np.uint8), np.empty(len(some), np.int32)
        run_ranges(
            over(mark_visible, centres, width, margin_px, pieces, white, clear, patches, counts), len(some), AT_ONCE
        )
        yield points[some], patches


def _obstacles(grid: PointGrid) -> tuple[Float, NDArray[np.uint8]]:
    pieces = grid.cuts.pieces_px if grid.cuts else np.zeros((0, 4))
    white = np.zeros((0, 0), np.uint8) if grid.white is None else np.ascontiguousarray(grid.white, np.uint8)
    return pieces, white


def _clear_of(white: NDArray[np.uint8], margin_px: float) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Return the part of a mask's white that may count, and the integral image of its black."""
    if not white.size:
        return white, np.zeros((1, 1), np.int32)
    # the same distance is kept to the mask's black as to a cut
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(margin_px) - 1, 2 * int(margin_px) - 1))
    clear = np.ascontiguousarray(cv2.erode(white, disc, borderType=cv2.BORDER_REPLICATE), np.uint8)
    return clear, np.asarray(cv2.integral(1 - white), np.int32)


def _find(grid: PointGrid, subset: int) -> Visibility:
    pieces, white = _obstacles(grid)
    clear, black_sums = _clear_of(white, MARGIN_PX)
    xy = np.ascontiguousarray(grid.xy_px.reshape(-1, 2))
    n = len(xy)
    near = np.zeros(n, bool)
    run_ranges(
        lambda first, last: find_near(first, last, xy, subset, MARGIN_PX, pieces, black_sums, near), n, 16 * AT_ONCE
    )
    near &= grid.allowed.ravel()
    share, of_point = np.ones(n), np.full(n, -1, np.int32)
    index = np.flatnonzero(near)
    kept: list[NDArray[np.uint8]] = []
    n_kept = 0
    for start in range(0, len(index), CHUNK):
        some = index[start : start + CHUNK]
        centres = np.ascontiguousarray(xy[some])
        patches, counts = np.empty((len(some), subset, subset), np.uint8), np.empty(len(some), np.int32)
        run_ranges(
            over(mark_visible, centres, subset, MARGIN_PX, pieces, white, clear, patches, counts), len(some), AT_ONCE
        )
        share[some] = counts / float(subset * subset)
        cut = counts < subset * subset
        of_point[some[cut]] = n_kept + np.arange(int(cut.sum()), dtype=np.int32)
        n_kept += int(cut.sum())
        kept.append(patches[cut])
    patches = np.concatenate(kept) if kept else np.zeros((0, subset, subset), np.uint8)
    separated = np.zeros(grid.shape, np.uint32)
    x, y = np.ascontiguousarray(grid.x_px), np.ascontiguousarray(grid.y_px)
    run_ranges(
        lambda first, last: separated_neighbours(first, last, x, y, REACH, pieces, white, separated), grid.shape[0], 4
    )
    return Visibility(
        xy, grid.shape, grid.spacing_px, pieces, white, VisiblePixels(patches, of_point), share, separated
    )
