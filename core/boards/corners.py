"""Coarse inner corners of checkerboards and ChArUco boards, found by OpenCV."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32
from stereorig.core.boards.board import BoardTarget, dictionary_id
from stereorig.core.boards.pictures import COARSE_SIDE_PX, FINE_SIDE_PX, Pictures, full_scale
from stereorig.core.boards.refine import sample

_LEAST_SEEN = 4
_SEED = 3  # corners a side from which any checkerboard is grown
# range of a board's mean level between its dark and its light, at any blur; of the squares that a search finds in a
# blurred line grid, seen at 45 degrees, the mean is nearer to the ground's: 0.55 and more, with bright lines 0.45 and
# less (grids of 5 to 15 lines)
_BALANCED = (0.44, 0.54)


def find_checkerboard(pictures: Pictures, size: tuple[int, int], *, coarsely: bool = False) -> Float | None:
    """Return coarse corners (columns, rows, 2) of a whole board, None if none is found.

    ``coarsely``: on the smallest picture only.
    """
    for picture, factor in pictures.scales(1 if coarsely else 3):
        found, corners = cv2.findChessboardCornersSB(picture, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if found:
            grid = _arranged(_settled(picture, np.asarray(corners), size), size, factor)
            if _alternates(pictures.grey, grid):
                return grid
    return None


def search_checkerboard(pictures: Pictures, size: tuple[int, int]) -> Float | None:
    """Search longer, after :func:`find_checkerboard` found nothing."""
    for picture, factor in pictures.scales(2):
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, corners = cv2.findChessboardCornersSB(picture, size, flags=flags)
        if not found:
            flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
            found, corners = cv2.findChessboardCorners(picture, size, flags=flags)
        if found:
            grid = _arranged(_settled(picture, np.asarray(corners), size), size, factor)
            if _alternates(pictures.grey, grid):
                return grid
    return None


def any_checkerboard(pictures: Pictures) -> Float | None:
    """Return the corners (columns, rows, 2) of the largest checkerboard seen, more columns than rows, or None."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    picture, factor = pictures.reduced(COARSE_SIDE_PX)
    try:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(picture, (_SEED, _SEED), flags)
    except cv2.error:
        return None
    if not found or meta is None:
        return None
    rows, columns = (int(n) for n in np.asarray(meta).shape[:2])
    if max(rows, columns) == _SEED:  # which the search, that draws lots, finds by chance in a line grid now and then
        return None
    grid = _arranged(np.asarray(corners), (columns, rows), factor)
    if not (_alternates(pictures.grey, grid) and _BALANCED[0] < _balance(pictures.grey, grid) < _BALANCED[1]):
        return None
    if extends_beyond(pictures.grey, grid):  # a rectangle out of a line grid's diamond
        return None
    return grid if columns >= rows else np.swapaxes(grid, 0, 1)


def find_charuco(pictures: Pictures, target: BoardTarget, *, coarsely: bool = False) -> Float | None:
    """Return coarse corners (columns, rows, 2), NaN where hidden; None if fewer than four are seen.

    ``coarsely``: on the smallest picture only, if it shows any.
    """
    best: Float | None = None
    for side in (COARSE_SIDE_PX, FINE_SIDE_PX):
        picture, factor = pictures.reduced(side)
        best = _charuco(picture, factor, target, best)
        if best is not None and np.isfinite(best).all():
            break
        if factor == 1.0 or (coarsely and best is not None):
            break
    if best is None and not coarsely and max(pictures.size_px) <= FINE_SIDE_PX:
        # markers of few pixels a cell are read in a picture twice as large
        picture, _ = pictures.reduced(FINE_SIDE_PX)
        return _charuco(cv2.resize(picture, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC), 0.5, target, None)
    return best


def _charuco(picture: NDArray[Any], factor: float, target: BoardTarget, known: Float | None) -> Float | None:
    """Return the corners seen in one picture if they are more than those known, else the known ones."""
    dictionary = cv2.aruco.getPredefinedDictionary(dictionary_id(target.dictionary))
    columns, rows = target.size
    seen = 0 if known is None else int(np.isfinite(known[..., 0]).sum())
    for legacy in (False, True):
        board = cv2.aruco.CharucoBoard(
            (columns + 1, rows + 1), float(target.pitch_mm), float(target.marker_mm or 0.0), dictionary
        )
        board.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(picture)
        if ids is None or len(ids) < max(_LEAST_SEEN, seen + 1):
            continue
        seen = len(ids)
        known = np.full((columns, rows, 2), np.nan)
        index = np.asarray(ids).ravel()
        flat = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        known[index % columns, index // columns] = full_scale(flat, factor)
        if seen == columns * rows:
            break
    return known


def dark_at_start(grey: Float32, xy_px: Float) -> bool:
    """Return True if the square beyond corner [0, 0], diagonally outside, is darker than its neighbour."""
    ex, ey = xy_px[1, 0] - xy_px[0, 0], xy_px[0, 1] - xy_px[0, 0]
    nine = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
    outside = sample(grey, xy_px[0, 0] - 0.35 * (ex + ey) + nine).mean()
    beside = sample(grey, xy_px[0, 0] + 0.35 * (ex - ey) + nine).mean()
    return bool(outside < beside)


def squares_hold_markers(grey: Float32, xy_px: Float) -> bool:
    """Return True if the light squares between corners (columns, rows, 2) of a board hold dark parts."""
    one, other = _squares(grey, xy_px)
    light, dark = (one, other) if _lightness(one) > _lightness(other) else (other, one)
    middle = 0.5 * (np.median(dark) + np.percentile(light, 90))
    return bool(np.median((light < middle).mean(axis=-1)) > 0.2)


def _alternates(grey: Float32, xy_px: Float) -> bool:
    """Return True if the squares between corners are light and dark in turn, as the cells of a line grid are not."""
    one, other = _squares(grey, xy_px)
    low, high = np.percentile(np.concatenate([one.ravel(), other.ravel()]), [5.0, 95.0])
    return abs(_lightness(one) - _lightness(other)) > 0.4 * float(high - low)


def _balance(grey: Float32, xy_px: Float) -> float:
    """Return the mean level between corners, from 0 (middle of dark squares) to 1 (middle of light ones)."""
    one, other = _squares(grey, xy_px, rim=1.0 / 18.0)
    middles = [float(np.median(squares[:, squares.shape[1] // 2])) for squares in (one, other)]
    return float((0.5 * (one.mean() + other.mean()) - min(middles)) / max(abs(middles[0] - middles[1]), 1e-9))


def _squares(grey: Float32, xy_px: Float, rim: float = 0.25) -> tuple[Float, Float]:
    """Grey levels (n, 81) within the squares of either colour, but for a rim of this part of a square."""
    c00, c10, c01, c11 = xy_px[:-1, :-1], xy_px[1:, :-1], xy_px[:-1, 1:], xy_px[1:, 1:]
    s, t = (v.ravel()[:, None, None, None] for v in np.meshgrid(*2 * (np.linspace(rim, 1.0 - rim, 9),)))
    places = (1 - s) * (1 - t) * c00 + s * (1 - t) * c10 + (1 - s) * t * c01 + s * t * c11
    inside = np.moveaxis(sample(grey, places), 0, -1)
    first = (np.add.outer(np.arange(inside.shape[0]), np.arange(inside.shape[1])) % 2) == 0
    return inside[first], inside[~first]


def _lightness(squares: Float) -> float:
    """Level of squares (n, m) that may hold markers."""
    return float(np.median(np.percentile(squares, 80.0, axis=-1)))


def _settled(picture: NDArray[np.uint8], corners: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Return corners moved to the saddles near them: findChessboardCornersSB leaves them up to half a pixel off."""
    grid = corners.reshape(size[1], size[0], 2).astype(np.float64)
    steps = np.concatenate([np.linalg.norm(np.diff(grid, axis=k), axis=-1).ravel() for k in (0, 1)])
    half = int(np.clip(0.2 * np.min(steps), 2, 10))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    start = corners.reshape(-1, 1, 2).astype(np.float32)
    moved = np.asarray(cv2.cornerSubPix(picture, start.copy(), (half, half), (-1, -1), criteria))
    return np.where(np.linalg.norm(moved - start, axis=-1, keepdims=True) < half, moved, start)


def _arranged(corners: NDArray[Any], size: tuple[int, int], factor: float) -> Float:
    return np.swapaxes(full_scale(corners.reshape(size[1], size[0], 2), factor), 0, 1)


# Test for corners of a checkerboard outside those found: the board then has more corners than were declared.

_OF_INNER = 0.75  # share of the inner corners' contrast; at a board's own rim, on a light margin, half of it is left
_MOST = 0.7  # share of a side's places that must show a corner
_LEAST_PLACES = 3
_REACH = (0.2, 0.28)  # parts of a square along both edges at which the light and dark are sampled


def extends_beyond(grey: Float32, corners_px: Float) -> bool:
    """Return True if the image shows corners of the same board one square outside the outermost ones on some side.

    Parameters
    ----------
    grey
        (rows, columns) image.
    corners_px
        (columns, rows, 2) corners found.
    """
    along, across = np.gradient(corners_px, axis=0), np.gradient(corners_px, axis=1)
    inner = float(np.median(np.abs(_saddle(grey, corners_px, along, across))))
    size = np.array([grey.shape[1], grey.shape[0]]) - 1.0
    for axis in (0, 1):
        for end in (0, -1):
            rim = np.take(corners_px, end, axis=axis)
            before = np.take(corners_px, 1 if end == 0 else -2, axis=axis)
            place = 2.0 * rim - before
            steps = [np.take(s, end, axis=axis) for s in (along, across)]
            reach = 0.3 * np.abs(np.stack(steps)).sum(axis=0)
            inside = ((place > reach) & (place < size - reach)).all(axis=-1)
            if inside.sum() < _LEAST_PLACES:
                continue
            strength = np.abs(_saddle(grey, place[inside], steps[0][inside], steps[1][inside]))
            if np.mean(strength > _OF_INNER * inner) > _MOST:
                return True
    return False


def _saddle(grey: Float32, places_px: Float, along: Float, across: Float) -> Float:
    """Difference of the squares on both diagonals of each place, (...)."""
    total = np.zeros(places_px.shape[:-1])
    for reach in _REACH:
        a, b = reach * (along + across), reach * (along - across)
        total += sample(grey, places_px + a) + sample(grey, places_px - a)
        total -= sample(grey, places_px + b) + sample(grey, places_px - b)
    return total
