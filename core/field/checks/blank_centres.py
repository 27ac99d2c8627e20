"""Points next to the surface's end whose own position has no texture: the patch is extrapolated from the rim.

Next to a hole, or behind an outline in front of a plain background, a subset matches by its part on the surface. Its
centre, which the result is for, may have no surface: it is then in a plain area, as wide as a subset's centre, that
contains points without a match. A coarse texture has such areas of its own, amid the field: only a wider area counts.

A hole that is little wider than a subset leaves no point without a match: every subset over it reaches its rim. For
such a hole, an area that is half a subset wide, and well wider than the texture's own, is sufficient.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.status import PointStatus

CENTRE = 1.0 / 3.0
"""Width of a subset's centre, over the subset's width."""
_NOISE = 4.0  # multiple of the noise's variance: upper limit for a plain centre
_TEXTURE = 0.02  # share of the subset's variance
_WINDOW_PX = 5  # window of the variance about a pixel
_BAND_ROWS = 512
_RIM_PX = _WINDOW_PX // 2 + 2  # by which the plain area seems smaller than it is
_OWN = 0.25  # share of the places amid the field with plain areas, beyond which these are the texture's own
_PLACE = 2.0  # subsets
_AT_ONCE = 4096  # points
_ALONE_SUBSETS, _ALONE_OWN = 0.5, 1.5  # width of an area that suffices alone, over the subset's and the texture's own


def centre_px(subset_px: int) -> int:
    """Return the width of a subset's centre, odd."""
    return max(int(CENTRE * subset_px) | 1, 5)


def reject_blank_centres(
    points: PointFits,
    *,
    shape: tuple[int, int],
    texture: Float,
    taken: NDArray[Any],
    image: Float32,
    xy_px: Float,
    subset_px: int,
    spacing_px: float,
) -> int:
    """Reject points, LOW_TEXTURE, within a subset of points without a match whose centre is plain; return their number.

    A centre also counts as plain if it is in a plain area, as wide as itself, together with points without a match; in
    an area of half a subset no point without a match is needed.

    Parameters
    ----------
    points
        n = rows x columns points of a shape, changed in place.
    shape
        Rows and columns.
    texture
        (n,) grey-level variance of the subset, camera 1's reference image.
    taken, image
        (rows, cols) that image as it was taken, which decides if a centre is plain, and as it is compared.
    xy_px
        (n, 2) the points in it.
    subset_px, spacing_px
        Width of the subset, distance of neighbouring points.
    """
    noise = np.nan_to_num(points.noise) ** 2 + 1.0 / 12.0  # rounding's, too
    most = np.minimum(_NOISE * noise, _TEXTURE * texture)
    plain = _plain_centres(taken, xy_px, points.ok, centre_px(subset_px), most)
    if points.ok.all() and not plain.any():
        return 0
    before = int(points.ok.sum())
    level = _NOISE * float(np.median(noise[points.ok])) if before else 0.0
    amid = points.ok & ~_near_gaps(points.ok, shape, subset_px / spacing_px)
    plain_pixels = _plain_pixels(image, level)
    own = _width_of_own(amid, plain_pixels, xy_px, subset_px)
    if own is None:
        return 0
    alone = max(_ALONE_SUBSETS * subset_px, _ALONE_OWN * own)
    points.reject(points.ok & (_plain_areas(plain_pixels, round(alone) | 1, xy_px) > 0), PointStatus.LOW_TEXTURE)
    area = _plain_areas(plain_pixels, own, xy_px)
    inside = (area > 0) & np.isin(area, area[~points.ok])
    beside = _near_gaps(points.ok, shape, subset_px / spacing_px)
    points.reject(points.ok & beside & (inside | (plain & (own == centre_px(subset_px)))), PointStatus.LOW_TEXTURE)
    return before - int(points.ok.sum())


def _plain_centres(image: NDArray[Any], xy_px: Float, which: Bool, width_px: int, most: Float) -> Bool:
    """Return (n,) True where the variance in the square of ``width_px`` about a point ``which`` is below ``most`` (n,).

    Nine pixels exclude nearly all textured centres first: their sum of squares is a part of the square's.
    """
    plain = np.zeros(len(xy_px), bool)
    half = width_px // 2
    index = np.flatnonzero(which)
    for left in np.array_split(index, len(index) // _AT_ONCE + 1):
        for step in (half, 1):
            offset = np.arange(-half, half + 1, step)
            x, y = (np.rint(xy_px[left, k]).astype(np.intp)[:, None] + offset for k in (0, 1))
            rows, cols = np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)
            grey = image[rows[:, :, None], cols[:, None, :]].astype(np.float64)
            square = ((grey - grey.mean(axis=(1, 2), keepdims=True)) ** 2).sum(axis=(1, 2))
            left = left[square < width_px**2 * most[left]]
        plain[left] = True
    return plain


def _width_of_own(amid: Bool, plain_pixels: NDArray[np.uint8], xy_px: Float, subset_px: int) -> int | None:
    """Return the least width, px, of plain areas that are not the texture's own; None if all are."""
    place = xy_px[amid] / (_PLACE * subset_px)
    for width in range(centre_px(subset_px), subset_px + 1, 2):
        if not _of_the_texture((_plain_areas(plain_pixels, width, xy_px) > 0)[amid], place):
            return width
    return None


def _near_gaps(ok: Bool, shape: tuple[int, int], reach: float) -> Bool:
    side = 2 * int(np.ceil(reach)) + 1
    gaps = (~ok.reshape(shape)).astype(np.uint8)
    return np.asarray(cv2.dilate(gaps, np.ones((side, side), np.uint8)).ravel() > 0)


def _of_the_texture(plain: Bool, place: Float) -> bool:
    """Return True if plain areas occur at so many places (n, 2), counted in unit cells, that they are no holes."""
    with_plain, every = (len(np.unique(np.floor(p), axis=0)) for p in (place[plain], place))
    return with_plain > _OWN * every


def _plain_pixels(image: Float32, variance: float) -> NDArray[np.uint8]:
    """Return (rows, cols) one where the grey levels about a pixel scatter less than a variance, else zero."""
    window, half, rows = (_WINDOW_PX, _WINDOW_PX), _WINDOW_PX // 2, image.shape[0]
    out, mean = np.empty(image.shape, np.uint8), np.float32(image.mean())
    for first in range(0, rows, _BAND_ROWS):  # for a large image the sums would need half a gigabyte
        last, top = min(first + _BAND_ROWS, rows), max(first - half, 0)
        about = image[top : last + half] - mean
        scatter = cv2.blur(about * about, window) - cv2.blur(about, window) ** 2
        out[first:last] = scatter[first - top : last - top] < variance
    return out


def _plain_areas(plain_pixels: NDArray[np.uint8], width_px: int, xy_px: Float) -> NDArray[np.int32]:
    """Return (n,) number of the plain area, at least ``width_px`` wide, that contains each point; 0 without one."""
    wide = cv2.morphologyEx(plain_pixels, cv2.MORPH_OPEN, np.ones((width_px, width_px), np.uint8))
    rim = 2 * _RIM_PX + 1
    areas = cv2.connectedComponents(cv2.dilate(wide, np.ones((rim, rim), np.uint8)))[1]
    rows, cols = plain_pixels.shape
    x, y = (np.clip(np.rint(xy_px[:, k]), 0, last - 1).astype(int) for k, last in ((0, cols), (1, rows)))
    return np.asarray(areas[y, x], dtype=np.int32)
