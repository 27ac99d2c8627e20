"""Detection of a board in one image, and the name of another target that it shows instead."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.boards.board import BoardTarget
from core.boards.corners import checkerboard_size, dark_at_start, find_charuco, find_checkerboard, refine_corners
from core.boards.dots import count_dots, find_dots, refine_dots
from core.boards.view import BoardView, neighbour_distances_px
from core.errors import TargetError
from core.grid.threshold import checked_image

_NAMES = {
    "checkerboard": "checkerboard",
    "charuco": "ChArUco board",
    "circles": "grid of dots",
    "circles_asymmetric": "asymmetric grid of dots",
}
_LEAST_CHARUCO = 8
_LEAST_PITCH_PX = 8.0
_MANY_DOTS = 25
_DICTIONARIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")
_LEAST_MARKERS = 4


def detect_board(image: NDArray[Any], target: BoardTarget) -> BoardView:
    """Find a board's points with no start values but its description.

    Parameters
    ----------
    image
        (rows, columns) gray image, any unsigned or float type.
    target
        The board.

    Returns
    -------
    BoardView
        Points in pixels; indices follow the board, and where it looks the same turned by half a turn, the image.

    Raises
    ------
    ImageError
        ``image_unsupported``, ``image_unusable``: no gray image.
    TargetError
        ``target_not_found``, ``target_other`` (the image shows another target), ``target_size`` (another number of
        corners), ``target_too_small``, ``target_partly_seen``.
    """
    grey = checked_image(image).astype(np.float64)
    grey8 = _eight_bit(grey)
    radius: Float | None = None
    if target.kind in ("circles", "circles_asymmetric"):
        dots = find_dots(grey8, target)
        if dots is None:
            raise _not_found(grey8, target)
        centres, moments = dots
        order = _upright(centres, None, target)
        xy, sigma, radius = refine_dots(grey, centres.reshape(-1, 2)[order], moments.reshape(-1, 2, 2)[order], target)
    else:
        coarse = find_charuco(grey8, target) if target.kind == "charuco" else find_checkerboard(grey8, target.size)
        if coarse is None:
            raise _not_found(grey8, target)
        if target.kind == "checkerboard":
            coarse = coarse.reshape(-1, 2)[_upright(coarse, grey, target)]
        xy, sigma = refine_corners(grey, coarse, target)
    found = np.isfinite(xy).all(axis=-1)
    least = _LEAST_CHARUCO if target.kind == "charuco" else int(0.5 * found.size)
    if found.sum() < least:
        raise TargetError(
            f"Only {int(found.sum())} of {found.size} points of the {_NAMES[target.kind]} can be located.",
            code="target_partly_seen",
            remedy="Show more of the board, evenly lit and in focus.",
        )
    pitch = float(np.nanmedian(neighbour_distances_px(xy, target)))
    if pitch < _LEAST_PITCH_PX:
        raise TargetError(
            f"Neighbouring points of the {_NAMES[target.kind]} lie {pitch:.1f} px apart, not {_LEAST_PITCH_PX:g} px.",
            code="target_too_small",
            remedy="Show the board larger, or use one with fewer points.",
        )
    return BoardView(
        target=target,
        xy_px=xy,
        sigma_px=sigma,
        radius_px=radius,
        pitch_px=pitch,
        image_size_px=(grey.shape[1], grey.shape[0]),
    )


def _not_found(grey8: NDArray[np.uint8], target: BoardTarget) -> TargetError:
    wanted = f"{_NAMES[target.kind]} of {target.size[0]} x {target.size[1]}"
    markers = _shows_markers(grey8)
    dots = count_dots(grey8)
    size = None if markers else checkerboard_size(grey8)
    if size is not None and dots > size[0] * size[1]:
        size = None  # the gaps between dots look like a few squares too
    if target.kind == "checkerboard" and size is not None and sorted(size) != sorted(target.size):
        return TargetError(
            f"The image shows a checkerboard of {size[0]} x {size[1]} inner corners, described are "
            f"{target.size[0]} x {target.size[1]}.",
            code="target_size",
            remedy="Correct size in the target's description, or show the whole board.",
        )
    other = None
    if markers:
        other = "ChArUco board (or markers of ArUco)"
    elif size is not None:
        other = f"checkerboard of {size[0]} x {size[1]} inner corners"
    elif dots >= _MANY_DOTS:
        other = f"grid of about {dots} dots"
    if other is not None and not other.startswith(_NAMES[target.kind]):
        if target.kind.startswith("circles") and other.startswith("grid of about"):
            return TargetError(
                f"The image shows a {other}, but no {wanted} dots.",
                code="target_not_found",
                remedy="Check size and kind of the target's description, and show the whole board.",
            )
        return TargetError(
            f"This is a {other}, described is a {wanted}.",
            code="target_other",
            remedy="Correct kind in the target's description, or use the target described.",
        )
    return TargetError(
        f"No {wanted} was found.",
        code="target_not_found",
        remedy="Show the whole board, evenly lit and in focus; check size and kind of the target's description.",
    )


def _shows_markers(grey8: NDArray[np.uint8]) -> bool:
    for name in _DICTIONARIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        corners, _, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey8)
        if len(corners) >= _LEAST_MARKERS:
            return True
    return False


def _eight_bit(grey: Float) -> NDArray[np.uint8]:
    low, high = np.percentile(grey, [0.5, 99.5])
    scale = 255.0 / max(float(high - low), 1e-9)
    return np.asarray(np.clip((grey - low) * scale, 0.0, 255.0), dtype=np.uint8)


def _upright(points: Float, grey: Float | None, target: BoardTarget) -> NDArray[np.intp]:
    """Index the points as the board's own colours or rows do; where these do not tell, as the image does.

    Returns the (columns, rows) numbers of the points, counted as they lie in ``points`` (columns, rows, 2).
    """
    flat = points.reshape(-1, 2)
    order = np.arange(len(flat)).reshape(target.size)
    asymmetric = target.kind == "circles_asymmetric"
    ex, ey = _sides(flat[order])
    if ex[0] * ey[1] - ex[1] * ey[0] < 0.0 and not asymmetric:
        order = order[:, ::-1]
    if target.size[0] == target.size[1] and not asymmetric:
        # a square board may be indexed in four ways; X is what lies nearest to the rows
        for _ in range(3):
            ex, _ey = _sides(flat[order])
            if ex[0] >= abs(ex[1]) - 1e-9:
                break
            order = order.T[::-1]
    if asymmetric and target.size[1] % 2:
        return order
    if target.kind == "checkerboard" and sum(target.size) % 2 and grey is not None:
        half_turn = not dark_at_start(grey, flat[order])
    else:
        ex, ey = _sides(flat[order])
        half_turn = bool(ex[0] / np.linalg.norm(ex) + ey[1] / np.linalg.norm(ey) < 0.0)
    return order[::-1, ::-1] if half_turn else order


def _sides(xy: Float) -> tuple[Float, Float]:
    return xy[-1, 0] - xy[0, 0], xy[0, -1] - xy[0, 0]
