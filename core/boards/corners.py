"""Inner corners of checkerboards and ChArUco boards: found by OpenCV, then fitted by their blurred picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.boards.board import BoardTarget
from core.boards.models import corner
from core.boards.view import neighbour_distances_px, steps_px
from core.boards.windows import fit_windows, sample
from core.errors import TargetError

_COARSE_SIDE_PX = 1400  # OpenCV's search is slow on large images and finds no more there
_RADIUS = 0.4  # of the distance of neighbouring corners
_MAX_RADIUS_PX = 24
_MIN_RADIUS_PX = 3
_RIM_PX = 2.0  # blur of a marker's own edges
_MAX_MOVE = 0.25  # of the distance of neighbouring corners, from the coarse corner


def find_checkerboard(grey8: NDArray[np.uint8], size: tuple[int, int]) -> Float | None:
    """Return coarse corners (columns, rows, 2) of a whole board, None where it is not found."""
    small, factor = _reduced(grey8)
    pictures = [(small, factor)] if factor == 1.0 else [(small, factor), (grey8, 1.0)]
    for picture, scale in pictures:
        for flags in (cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE):
            found, corners = cv2.findChessboardCornersSB(picture, size, flags=flags)
            if found:
                return _arranged(np.asarray(corners), size, scale)
        found, corners = cv2.findChessboardCorners(
            picture, size, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        )
        if found:
            return _arranged(np.asarray(corners), size, scale)
    return None


def checkerboard_size(grey8: NDArray[np.uint8]) -> tuple[int, int] | None:
    """Return the size, the longer side first, of the checkerboard that an image shows; None where there is none."""
    small, _ = _reduced(grey8)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    try:
        found, _corners, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    except cv2.error:
        return None
    if not found or meta is None:
        return None
    sides = np.asarray(meta).shape[:2]
    return int(max(sides)), int(min(sides))


def find_charuco(grey8: NDArray[np.uint8], target: BoardTarget) -> Float | None:
    """Return coarse corners (columns, rows, 2), NaN where hidden; None where fewer than four are seen."""
    dictionary = cv2.aruco.getPredefinedDictionary(dictionary_id(target.dictionary))
    columns, rows = target.size
    small, factor = _reduced(grey8, 2200)
    best: Float | None = None
    for legacy in (False, True):
        board = cv2.aruco.CharucoBoard(
            (columns + 1, rows + 1), float(target.pitch_mm), float(target.marker_mm or 0.0), dictionary
        )
        board.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(small)
        if ids is None or len(ids) < 4:
            continue
        out = np.full((columns, rows, 2), np.nan)
        index = np.asarray(ids).ravel()
        out[index % columns, index // columns] = _full_scale(np.asarray(corners).reshape(-1, 2), factor)
        if best is None or np.isfinite(out).sum() > np.isfinite(best).sum():
            best = out
    return best


def dictionary_id(name: str) -> int:
    """Return OpenCV's number of a dictionary of markers.

    Raises
    ------
    TargetError
        Code ``target_invalid`` where there is none of that name.
    """
    value = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(value, int):
        raise TargetError(
            f"There is no dictionary {name!r} of markers.",
            code="target_invalid",
            remedy="Name one of OpenCV's, such as DICT_5X5_100.",
        )
    return value


def refine_corners(grey: Float, coarse_px: Float, target: BoardTarget) -> tuple[Float, Float]:
    """Fit each corner's crossed edges.

    Returns
    -------
    xy_px, sigma_px
        (columns, rows, 2), and (columns, rows); NaN where a corner is hidden, or its picture is none of crossed edges.
    """
    shape = coarse_px.shape[:2]
    pitch = neighbour_distances_px(coarse_px, target)
    along_x, along_y = steps_px(coarse_px, 0), steps_px(coarse_px, 1)
    usable = np.isfinite(pitch) & np.isfinite(along_x).all(axis=-1) & np.isfinite(along_y).all(axis=-1)
    xy, sigma = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
    if not usable.any():
        return xy, sigma
    start_xy, ex, ey, step = coarse_px[usable], along_x[usable], along_y[usable], pitch[usable]
    radius = int(np.clip(round(_RADIUS * float(np.median(step))), _MIN_RADIUS_PX, _MAX_RADIUS_PX))
    low, high = _levels(grey, start_xy, radius)
    start = np.column_stack(
        [
            start_xy,
            np.arctan2(ex[:, 1], ex[:, 0]),
            np.arctan2(ey[:, 1], ey[:, 0]),
            0.5 * (low + high),
            _signed_amplitude(grey, start_xy, ex, ey, 0.5 * (high - low)),
            np.full(len(start_xy), 1.0),
        ]
    )
    # half of the white frame about a marker, in pitches
    frame = np.inf if target.kind != "charuco" else 0.5 * (1.0 - float(target.marker_mm or 0.0) / target.pitch_mm)
    axes = np.stack([ex, ey], axis=-1)
    to_board = np.linalg.inv(axes)
    rim = _RIM_PX / step

    def weight_of(index: NDArray[np.intp], dx: Float, dy: Float) -> Float:
        d = np.stack([dx, dy], axis=-1)
        board = np.abs(np.einsum("nij,nmj->nmi", to_board[index], d))
        near = (board <= _RADIUS + 0.05).all(axis=-1)
        free = board.min(axis=-1) < np.maximum(frame - rim[index], 0.0)[:, None]
        return np.asarray(near & free, dtype=np.float64)

    for _ in range(2):  # the second time about the corner found, so that the window is symmetric about it
        fit = fit_windows(grey, start, radius, weight_of, corner)
        moved = np.linalg.norm(fit.parameters[:, :2] - start_xy, axis=1)
        good = fit.good & (moved < _MAX_MOVE * step)
        start = np.where(good[:, None], fit.parameters, start)
    good &= np.abs(np.sin(fit.parameters[:, 2] - fit.parameters[:, 3])) > 0.15
    out, spread = np.full((len(start_xy), 2), np.nan), np.full(len(start_xy), np.nan)
    out[good], spread[good] = fit.parameters[good, :2], fit.sigma_px[good]
    xy[usable], sigma[usable] = out, spread
    return xy, sigma


def dark_at_start(grey: Float, xy_px: Float) -> bool:
    """Return True where the square beyond corner [0, 0], diagonally outside, is darker than its neighbour."""
    ex, ey = xy_px[1, 0] - xy_px[0, 0], xy_px[0, 1] - xy_px[0, 0]
    outside = _mean_at(grey, xy_px[0, 0] - 0.35 * (ex + ey))
    beside = _mean_at(grey, xy_px[0, 0] + 0.35 * (ex - ey))
    return outside < beside


def _mean_at(grey: Float, xy: Float) -> float:
    x, y = (int(v) for v in np.rint(xy))
    part = grey[max(y - 1, 0) : max(y + 2, 1), max(x - 1, 0) : max(x + 2, 1)]
    return float(part.mean()) if part.size else float("nan")


def _reduced(grey8: NDArray[np.uint8], side_px: int = _COARSE_SIDE_PX) -> tuple[NDArray[np.uint8], float]:
    factor = max(grey8.shape) / side_px
    if factor <= 1.0:
        return grey8, 1.0
    size = (round(grey8.shape[1] / factor), round(grey8.shape[0] / factor))
    return np.asarray(cv2.resize(grey8, size, interpolation=cv2.INTER_AREA), dtype=np.uint8), factor


def _full_scale(xy: NDArray[Any], factor: float) -> Float:
    return (xy.astype(np.float64) + 0.5) * factor - 0.5


def _arranged(corners: NDArray[Any], size: tuple[int, int], factor: float) -> Float:
    return np.swapaxes(_full_scale(corners.reshape(size[1], size[0], 2), factor), 0, 1)


def _levels(grey: Float, xy: Float, radius: int) -> tuple[Float, Float]:
    offsets = np.arange(-radius, radius + 1)
    dy, dx = (d.ravel() for d in np.meshgrid(offsets, offsets, indexing="ij"))
    samples = sample(grey, xy[:, None, :] + np.stack([dx, dy], axis=-1))
    low, high = np.percentile(samples, [20.0, 80.0], axis=1)
    return low, high


def _signed_amplitude(grey: Float, xy: Float, ex: Float, ey: Float, size: Float) -> Float:
    # u is the distance to the edge along ex, positive along ey; v that to the edge along ey, positive against ex
    inside = sample(grey, xy + 0.25 * (ex + ey)) + sample(grey, xy - 0.25 * (ex + ey))
    across = sample(grey, xy + 0.25 * (ex - ey)) + sample(grey, xy - 0.25 * (ex - ey))
    amplitude = np.maximum(size, 1e-3)
    return np.where(inside > across, -amplitude, amplitude)  # u v is negative at xy + ex + ey
