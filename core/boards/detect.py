"""Detection of a board in one image: coarse search, fit of every point, and the cause if it fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.boards.board import BoardTarget
from stereorig.core.boards.corners import (
    any_checkerboard,
    dark_at_start,
    extends_beyond,
    find_charuco,
    find_checkerboard,
    search_checkerboard,
    squares_hold_markers,
)
from stereorig.core.boards.dots import DotSearch, Marks, find_dots
from stereorig.core.boards.naming import declared_text, other_target, shown_target
from stereorig.core.boards.pictures import Pictures
from stereorig.core.boards.refine import Refined, refine_corners, refine_dots
from stereorig.core.boards.view import BoardView, neighbour_distances_px
from stereorig.core.errors import TargetError
from stereorig.core.grid.threshold import checked_image

_LEAST_CHARUCO = 8
_LEAST_PITCH_PX = 8.0
_LEAST_LATTICE = 16  # dots in rows and columns, to speak of a grid of another size
_WIDEST_BLUR = 0.22  # share of the distance of neighbouring points; at a larger blur edges run into each other
_LARGEST_SIGMA_PX = 0.5  # a point with a larger uncertainty has no value for a calibration
_IRREGULAR = 0.35  # share of a step, by which neighbouring steps of one board may differ
_SHOW_WHOLE = "Show the whole board, evenly lit and in focus; check size and kind of the target's description."


@dataclass(frozen=True)
class _Coarse:
    """Points found before their fit: (columns, rows, 2), NaN where hidden; of dots their outlines too."""

    xy_px: Float
    moments: Float | None = None
    hollow: Bool | None = None
    marks: tuple[tuple[int, int], ...] = ()


def detect_board(image: NDArray[Any], target: BoardTarget, *, marks: Marks = ()) -> BoardView:
    """Find a board's points with no start values but its description.

    Parameters
    ----------
    image
        (rows, columns) gray image, any unsigned or float type.
    target
        The board.
    marks
        (column, row) of a dot grid's three orientation marks, as :class:`BoardView` has them: with these a part of the
        grid that shows them is found, too.

    Returns
    -------
    BoardView
        Points in pixels. Indices follow the board: the colours of a checkerboard with an odd sum of columns and rows, a
        ChArUco board's markers, a grid's orientation marks, the rows of an asymmetric grid with an odd number of them.
        If a board looks the same turned by half a turn (or a quarter, with as many columns as rows), X is the direction
        nearest to the image's rows, to the right.

    Raises
    ------
    ImageError
        ``image_unsupported``, ``image_unusable``: no gray image.
    TargetError
        ``target_not_found``; ``target_other``: the image shows another target; ``target_size``: another number of
        points; ``target_too_small``; ``target_partly_seen``: the board leaves the image, or too few of its points can
        be located; ``target_blurred``: no point can be located to half a pixel; ``target_irregular``: the markers do
        not fit such a board; ``image_mirrored``: an asymmetric grid seen in a mirror.
    """
    pictures = Pictures(checked_image(image))
    coarse = _find(pictures, target, marks=marks)
    if coarse.moments is not None:
        fit = refine_dots(pictures.grey, coarse.xy_px, coarse.moments, target, coarse.hollow)
    else:
        fit = refine_corners(pictures.grey, coarse.xy_px, target)
    with np.errstate(invalid="ignore"):
        # a dot cut by the border may have its centre outside, and the visible part of its rim determines it poorly
        inside = np.asarray(((fit.xy_px > -0.5) & (fit.xy_px < np.array(pictures.size_px) - 0.5)).all(axis=-1))
    fit = replace(
        fit,
        xy_px=np.where(inside[..., None], fit.xy_px, np.nan),
        covariance_px2=np.where(inside[..., None, None], fit.covariance_px2, np.nan),
        ellipse=None if fit.ellipse is None else np.where(inside[..., None, None], fit.ellipse, np.nan),
    )
    sigma = np.sqrt(0.5 * np.trace(fit.covariance_px2, axis1=-2, axis2=-1))
    _check(fit, sigma, coarse.xy_px, target, partly=bool(marks))
    radius = None
    if fit.ellipse is not None:
        with np.errstate(invalid="ignore"):
            radius = np.linalg.det(fit.ellipse) ** -0.5
    return BoardView(
        target=target,
        xy_px=fit.xy_px,
        sigma_px=sigma,
        radius_px=radius,
        pitch_px=float(np.nanmedian(neighbour_distances_px(fit.xy_px, target))),
        image_size_px=pictures.size_px,
        covariance_px2=fit.covariance_px2,
        ellipse_per_px=fit.ellipse,
        blur_px=fit.blur_px,
        contrast=fit.contrast,
        noise=fit.noise,
        marks=coarse.marks,
    )


def find_board(image: NDArray[Any], target: BoardTarget) -> Float:
    """Find a board's points coarsely, for a live picture: within about half a pixel of the image's own.

    Parameters
    ----------
    image, target
        As for :func:`detect_board`.

    Returns
    -------
    Float
        (columns, rows, 2) px, NaN where a point was not seen, indexed as :func:`detect_board` does.

    Raises
    ------
    ImageError, TargetError
        As :func:`detect_board`, except those that only the fit of the points raises; a search that finds nothing does
        not look for another target in the image.
    """
    return _find(Pictures(checked_image(image)), target, coarsely=True).xy_px


def _find(pictures: Pictures, target: BoardTarget, *, coarsely: bool = False, marks: Marks = ()) -> _Coarse:
    if target.kind in ("circles", "circles_asymmetric"):
        search = find_dots(pictures, target, coarsely=coarsely, marks=marks)
        if search.found is None:
            raise _nothing(target) if coarsely else _no_dots(pictures, target, search)
        dots = search.found
        return _Coarse(dots.centres, dots.moments, dots.hollow, dots.marks)
    if target.kind == "charuco":
        corners = find_charuco(pictures, target, coarsely=coarsely)
        if corners is None:
            raise _nothing(target) if coarsely else _not_found(pictures, target)
        _check_markers(corners, target)
        return _Coarse(corners)
    corners = find_checkerboard(pictures, target.size, coarsely=coarsely)
    if corners is None:
        if coarsely:
            raise _nothing(target)
        failure = _not_found(pictures, target)
        corners = None if failure.code == "target_other" else search_checkerboard(pictures, target.size)
        if corners is None:
            raise failure
    if squares_hold_markers(pictures.grey, corners):
        shown = shown_target(pictures, with_lines=False)
        other = None if shown is None else other_target(shown, target)
        raise other or TargetError(
            f"The light squares of the {declared_text(target)} hold dark parts, as those of a ChArUco board.",
            code="target_other",
            remedy="Correct kind in the target's description, or use the target declared.",
        )
    if extends_beyond(pictures.grey, corners):
        raise _larger(pictures, target)
    return _Coarse(corners.reshape(-1, 2)[_upright(corners, pictures.grey)])


def _larger(pictures: Pictures, target: BoardTarget) -> TargetError:
    """Return the error for a checkerboard that has more corners than declared, with their number if it is sure."""
    seen = any_checkerboard(pictures)
    size = "" if seen is None else f" of {seen.shape[0]} x {seen.shape[1]} inner corners"
    if seen is not None and sorted(seen.shape[:2]) == sorted(target.size):
        size = ""
    return TargetError(
        f"The image shows a checkerboard{size} that extends beyond the {target.size[0]} x {target.size[1]} inner "
        "corners declared.",
        code="target_size",
        remedy="Correct size in the target's description: it counts inner corners.",
        expected=list(target.size),
    )


def _check(fit: Refined, sigma: Float, coarse_px: Float, target: BoardTarget, *, partly: bool) -> None:
    """Raise an error if too little of a board can be located, or not well enough."""
    name = declared_text(target)
    pitch = float(np.nanmedian(neighbour_distances_px(coarse_px, target)))
    if pitch < _LEAST_PITCH_PX:
        raise TargetError(
            f"Neighbouring points of the {name} lie {pitch:.1f} px apart, not {_LEAST_PITCH_PX:g} px.",
            code="target_too_small",
            remedy="Show the board larger, or use one with fewer points.",
        )
    if fit.blur_px > _WIDEST_BLUR * pitch:
        raise TargetError(
            f"The edges of the {name} are blurred by {fit.blur_px:.1f} px, more than {_WIDEST_BLUR:g} of the points'"
            f" distance of {pitch:.1f} px.",
            code="target_blurred",
            remedy="Focus on the board, shorten the exposure, or hold the board still.",
            blur_px=fit.blur_px,
        )
    found = np.isfinite(fit.xy_px).all(axis=-1)
    least = _LEAST_CHARUCO if target.kind == "charuco" or partly else int(0.5 * found.size)
    if found.sum() < least:
        raise TargetError(
            f"Only {int(found.sum())} of {found.size} points of the {name} can be located.",
            code="target_partly_seen",
            remedy="Show more of the board, evenly lit and in focus.",
            points_px=coarse_px.reshape(-1, 2).tolist(),
        )
    typical = float(np.nanmedian(sigma))
    if typical > _LARGEST_SIGMA_PX:
        raise TargetError(
            f"The points of the {name} can be located to {typical:.2f} px only: edges blurred by {fit.blur_px:.1f} px"
            f" with a contrast of {fit.contrast:.3g} over a noise of {fit.noise:.3g} grey levels.",
            code="target_blurred",
            remedy="Focus on the board, shorten the exposure, and light it better.",
            blur_px=fit.blur_px,
        )


def _check_markers(corners: Float, target: BoardTarget) -> None:
    """Raise an error for corners whose numbers are in no regular order: a board of another size or dictionary."""
    bends = []
    for axis in (0, 1):
        step = np.diff(corners, axis=axis)
        change = np.linalg.norm(np.diff(step, axis=axis), axis=-1)
        a = step[1:] if axis == 0 else step[:, 1:]
        b = step[:-1] if axis == 0 else step[:, :-1]
        mean = 0.5 * (np.linalg.norm(a, axis=-1) + np.linalg.norm(b, axis=-1))
        bends.append((change / mean).ravel())
    ratio = np.concatenate(bends)
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) and float(np.median(ratio)) > _IRREGULAR:
        raise TargetError(
            f"The numbers of the markers lie on no {declared_text(target)}.",
            code="target_irregular",
            remedy="Check size and dictionary of the target's description, and that one board only is seen.",
        )


def _no_dots(pictures: Pictures, target: BoardTarget, search: DotSearch) -> TargetError:
    if search.mirrored:
        return TargetError(
            f"The {declared_text(target)} is seen in a mirror: its second row begins where the first should.",
            code="image_mirrored",
            remedy="Mirror the camera's images back, or turn the board's printed side to the cameras.",
        )
    shown = shown_target(pictures)
    other = None if shown is None else other_target(shown, target)
    if other is not None and shown is not None and len(shown.outline_px) >= len(search.outline_px):
        return other
    if len(search.outline_px) >= _LEAST_LATTICE:
        return _other_size(search.counts, search.outline_px, pictures, target, "dots")
    return _nothing(target)


def _not_found(pictures: Pictures, target: BoardTarget) -> TargetError:
    shown = shown_target(pictures)
    if shown is None:
        return _nothing(target)
    other = other_target(shown, target)
    if other is not None:
        return other
    if shown.size is not None:
        corners = any_checkerboard(pictures)
        outline = shown.outline_px if corners is None else corners.reshape(-1, 2)
        return _other_size(shown.size, outline, pictures, target, "inner corners")
    return _nothing(target)


def _other_size(
    counts: tuple[int, int], outline_px: Float, pictures: Pictures, target: BoardTarget, what: str
) -> TargetError:
    """Return the error for a board of other counts: cut by the image's border, or another one."""
    found, declared = sorted(counts), sorted(target.size)
    fewer = len(outline_px) < target.size[0] * target.size[1]
    if fewer and found != declared and _reaches_border(outline_px, counts, pictures.size_px):
        return TargetError(
            f"The board leaves the image: {counts[0]} x {counts[1]} {what} are seen, declared are {target.size[0]} x"
            f" {target.size[1]}.",
            code="target_partly_seen",
            remedy="Move the board or the camera until the whole board lies inside the image.",
            found=list(counts),
            expected=list(target.size),
            points_px=outline_px.tolist(),
        )
    if found == declared:
        return _nothing(target)
    return TargetError(
        f"The image shows a board of {counts[0]} x {counts[1]} {what}, declared are {target.size[0]} x"
        f" {target.size[1]}.",
        code="target_size",
        remedy="Correct size in the target's description, or show the whole board.",
        found=list(counts),
        expected=list(target.size),
        points_px=outline_px.tolist(),
    )


def _reaches_border(outline_px: Float, counts: tuple[int, int], size_px: tuple[int, int]) -> bool:
    """Return True if one more row of points would be at the image's border or outside."""
    low, high = outline_px.min(axis=0), outline_px.max(axis=0)
    step = np.sqrt(np.prod(high - low) / max(float((counts[0] - 1) * (counts[1] - 1)), 1.0))
    return bool((low - 1.3 * step < 0.0).any() or (high + 1.3 * step > np.array(size_px) - 1.0).any())


def _nothing(target: BoardTarget) -> TargetError:
    return TargetError(f"No {declared_text(target)} was found.", code="target_not_found", remedy=_SHOW_WHOLE)


def _upright(points: Float, grey: Float32) -> NDArray[np.intp]:
    """Number a checkerboard's corners by its colours, or by the image's axes if the colours are symmetric.

    Returns the (columns, rows) numbers of the points, counted in the order of ``points`` (columns, rows, 2).
    """
    size = points.shape[:2]
    flat = points.reshape(-1, 2)
    order = np.arange(len(flat)).reshape(size)
    ex, ey = _sides(flat[order])
    if ex[0] * ey[1] - ex[1] * ey[0] < 0.0:
        order = order[:, ::-1]
    if size[0] == size[1]:
        # a square board may be numbered in four ways; X is the direction nearest to the rows
        for _ in range(3):
            ex, _ey = _sides(flat[order])
            if ex[0] >= abs(ex[1]) - 1e-9:
                break
            order = order.T[::-1]
    if sum(size) % 2:
        half_turn = not dark_at_start(grey, flat[order])
    else:
        ex, ey = _sides(flat[order])
        half_turn = bool(ex[0] / np.linalg.norm(ex) + ey[1] / np.linalg.norm(ey) < 0.0)
    return order[::-1, ::-1] if half_turn else order


def _sides(xy: Float) -> tuple[Float, Float]:
    return xy[-1, 0] - xy[0, 0], xy[0, -1] - xy[0, 0]
