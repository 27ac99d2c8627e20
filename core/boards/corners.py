"""Coarse inner corners of checkerboards and ChArUco boards, found by OpenCV."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Float, Float32
from core.boards.board import BoardTarget, dictionary_id
from core.boards.pictures import COARSE_SIDE_PX, FINE_SIDE_PX, Pictures, full_scale
from core.boards.refine import sample

_LEAST_SEEN = 4


def find_checkerboard(pictures: Pictures, size: tuple[int, int], *, coarsely: bool = False) -> Float | None:
    """Return coarse corners (columns, rows, 2) of a whole board, None where it is not found.

    ``coarsely``: on the smallest picture only.
    """
    for picture, factor in pictures.scales()[: 1 if coarsely else None]:
        found, corners = cv2.findChessboardCornersSB(picture, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if found:
            grid = _arranged(np.asarray(corners), size, factor)
            if _alternates(pictures.grey, grid):
                return grid
    return None


def search_checkerboard(pictures: Pictures, size: tuple[int, int]) -> Float | None:
    """Search longer, where :func:`find_checkerboard` found nothing."""
    for picture, factor in pictures.scales()[:2]:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, corners = cv2.findChessboardCornersSB(picture, size, flags=flags)
        if not found:
            flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
            found, corners = cv2.findChessboardCorners(picture, size, flags=flags)
        if found:
            grid = _arranged(np.asarray(corners), size, factor)
            if _alternates(pictures.grey, grid):
                return grid
    return None


def any_checkerboard(pictures: Pictures) -> Float | None:
    """Return the corners (columns, rows, 2) of the largest checkerboard seen, more columns than rows, or None."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    picture, factor = pictures.reduced(COARSE_SIDE_PX)
    try:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(picture, (3, 3), flags)
    except cv2.error:
        return None
    if not found or meta is None:
        return None
    rows, columns = (int(n) for n in np.asarray(meta).shape[:2])
    grid = _arranged(np.asarray(corners), (columns, rows), factor)
    if not _alternates(pictures.grey, grid):
        return None
    return grid if columns >= rows else np.swapaxes(grid, 0, 1)


def find_charuco(pictures: Pictures, target: BoardTarget, *, coarsely: bool = False) -> Float | None:
    """Return coarse corners (columns, rows, 2), NaN where hidden; None where fewer than four are seen.

    ``coarsely``: on the smallest picture only, if it shows any.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(dictionary_id(target.dictionary))
    columns, rows = target.size
    squares = (columns + 1, rows + 1)
    best: Float | None = None
    seen = 0
    for side in (COARSE_SIDE_PX, FINE_SIDE_PX):
        picture, factor = pictures.reduced(side)
        for legacy in (False, True):
            board = cv2.aruco.CharucoBoard(squares, float(target.pitch_mm), float(target.marker_mm or 0.0), dictionary)
            board.setLegacyPattern(legacy)
            corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(picture)
            if ids is None or len(ids) < max(_LEAST_SEEN, seen + 1):
                continue
            seen = len(ids)
            best = np.full((columns, rows, 2), np.nan)
            index = np.asarray(ids).ravel()
            best[index % columns, index // columns] = full_scale(
                np.asarray(corners, dtype=np.float64).reshape(-1, 2), factor
            )
            if seen == columns * rows:
                return best
        if factor == 1.0 or (coarsely and best is not None):
            break
    return best


def dark_at_start(grey: Float32, xy_px: Float) -> bool:
    """Return True where the square beyond corner [0, 0], diagonally outside, is darker than its neighbour."""
    ex, ey = xy_px[1, 0] - xy_px[0, 0], xy_px[0, 1] - xy_px[0, 0]
    nine = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
    outside = sample(grey, xy_px[0, 0] - 0.35 * (ex + ey) + nine).mean()
    beside = sample(grey, xy_px[0, 0] + 0.35 * (ex - ey) + nine).mean()
    return bool(outside < beside)


def squares_hold_markers(grey: Float32, xy_px: Float) -> bool:
    """Return True where the light squares between corners (columns, rows, 2) of a board hold dark parts."""
    one, other = _squares(grey, xy_px)
    light, dark = (one, other) if _lightness(one) > _lightness(other) else (other, one)
    middle = 0.5 * (np.median(dark) + np.percentile(light, 90))
    return bool(np.median((light < middle).mean(axis=-1)) > 0.2)


def _alternates(grey: Float32, xy_px: Float) -> bool:
    """Return True where the squares between corners are light and dark in turn, as the cells of a line grid are not."""
    one, other = _squares(grey, xy_px)
    low, high = np.percentile(np.concatenate([one.ravel(), other.ravel()]), [5.0, 95.0])
    return abs(_lightness(one) - _lightness(other)) > 0.4 * float(high - low)


def _squares(grey: Float32, xy_px: Float) -> tuple[Float, Float]:
    """Grey levels (n, 81) within the squares of either colour."""
    c00, c10, c01, c11 = xy_px[:-1, :-1], xy_px[1:, :-1], xy_px[:-1, 1:], xy_px[1:, 1:]
    s, t = (v.ravel()[:, None, None, None] for v in np.meshgrid(np.linspace(0.25, 0.75, 9), np.linspace(0.25, 0.75, 9)))
    places = (1 - s) * (1 - t) * c00 + s * (1 - t) * c10 + (1 - s) * t * c01 + s * t * c11
    inside = np.moveaxis(sample(grey, places), 0, -1)
    first = (np.add.outer(np.arange(inside.shape[0]), np.arange(inside.shape[1])) % 2) == 0
    return inside[first], inside[~first]


def _lightness(squares: Float) -> float:
    """Level of squares (n, m) that may hold markers."""
    return float(np.median(np.percentile(squares, 80.0, axis=-1)))


def _arranged(corners: NDArray[Any], size: tuple[int, int], factor: float) -> Float:
    return np.swapaxes(full_scale(corners.reshape(size[1], size[0], 2), factor), 0, 1)
