"""Defective pixels: dead, hot or under a grain of dust, found by a contrast that no lens can image.

Every lens spreads a point over some pixels, so that a pixel of a sharp image still follows those about it. A pixel
whose difference from the quadratic through its 24 neighbours is many times their own differences shows the sensor, not
the specimen. Such a pixel takes no part in a subset of the reference. A compared image needs some value there for its
spline, and gets the quadratic's; its error is in the residuals and so in the standard deviations.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float

MAX_SHARE = 0.05
"""Share of an image's pixels: more are a texture of points as small as a pixel, and no defects."""

MAX_SHARED = 0.25
"""Ratio of spots that share their light with a neighbouring pixel to single ones. For specks of a pixel at random
places it is 1.4 and more; for 1 % defects at random 0.1, for 3 % 0.2, as some are side by side.
"""

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
_EVERY, _ROWS = 8, 160  # rows that are looked at for the usual scatter, and columns of large images
_SECOND_DIFFERENCE = 0.6745 * float(np.sqrt(1.5))  # median absolute second difference, halved, of white noise of sd 1
_BEYOND = 6.0  # usual scatters: noise alone exceeds all eight neighbours by so much once in 1e14 pixels
# multiple of the neighbours' differences from the quadratic (18 degrees of freedom: chance is 1e-5, but see _BEYOND)
_OFF = 6.0
_CLEAR = 1.7  # multiple of the limit that half of the found pixels must exceed: few are then below it
_REACH = 2
# shares of a spot's own height for the highest pixel next to it: a lens' blur leaves 0.1 and more
_SINGLE, _SHARED = 0.2, 0.4
_NEAR_PX = 1.2  # sd of the neighbours' weights in the value that a compared image gets
_FEWEST = 12  # neighbours that a quadratic of six terms needs
_AT_ONCE = 50_000


class Defects(NamedTuple):
    """Defective pixels of one image.

    Attributes
    ----------
    where
        (m,) int64 into the flat image.
    filled
        (rows, cols) the image, with the neighbours' value at each of them.
    """

    where: NDArray[np.int64]
    filled: NDArray[Any]


def find_defects(image: NDArray[Any], known: NDArray[np.int64] | None = None) -> Defects | None:
    """Find the defective pixels of an image; None without any.

    Parameters
    ----------
    image
        (rows, cols) grey levels, uint8, uint16 or float.
    known
        Flat indices of pixels that are known to be defective; they need not show it.

    Notes
    -----
    Specks as small as a pixel look like defects if they are on a pixel's middle. Most of them are between pixels and
    share their light among several: an image with many such shared spots shows a fine texture, and keeps all its
    pixels.
    """
    index = np.zeros(0, np.int64) if known is None else np.unique(known)
    usual = _usual_scatter(image)
    found = _suspects(image, usual)
    if len(found):
        _, off = _predicted(image, found, usual)
        found, off = found[off > _OFF], off[off > _OFF]
        single, shared = _spots(image, found)
        # where only the largest are found, points with others would be the odd ones out
        clear = len(found) > 0 and float(np.median(off)) > _CLEAR * _OFF
        if clear and len(single) and len(shared) <= MAX_SHARED * len(single):
            index = np.union1d(index, found)
    if len(index) == 0:
        return None
    value, _ = _predicted(image, index, usual)
    filled = image.copy()
    if image.dtype.kind == "u":
        value = np.clip(np.rint(value), 0, np.iinfo(image.dtype).max)
    filled.ravel()[index] = value.astype(image.dtype)
    return Defects(index, filled)


def _usual_scatter(image: NDArray[Any]) -> float:
    """Noise and texture from pixel to pixel, grey levels, as a standard deviation from the median."""
    rows = image[:: max(_EVERY, len(image) // _ROWS)].astype(np.float32)
    second = (rows[:, 1:-1] - 0.5 * (rows[:, :-2] + rows[:, 2:]))[:, :: max(1, image.shape[1] // _ROWS)]
    least = 0.3 if image.dtype.kind == "u" else 1e-6  # rounding
    return max(float(np.median(np.abs(second))) / _SECOND_DIFFERENCE, least)


def _suspects(image: NDArray[Any], usual: float) -> NDArray[np.int64]:
    """Flat indices of pixels far off the median about them; empty if no pixel exceeds all its neighbours."""
    own = image if image.dtype != np.float64 else image.astype(np.float32)
    limit = _BEYOND * usual
    beyond = cv2.max(cv2.subtract(own, cv2.dilate(own, _AROUND)), cv2.subtract(cv2.erode(own, _AROUND), own))
    if not float(beyond.max()) > limit:
        return np.zeros(0, np.int64)
    off = np.asarray(cv2.absdiff(own, cv2.medianBlur(own, 3)))
    found = np.flatnonzero(off > limit)
    if len(found) > MAX_SHARE * image.size:  # sharp texture: its corners leave the median too
        found = np.flatnonzero(np.asarray(beyond) > limit)
    return found if len(found) <= MAX_SHARE * image.size else np.zeros(0, np.int64)


def _spots(image: NDArray[Any], found: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the highest suspect of each spot: single ones, and those that share light with a neighbouring pixel."""
    y, x, terms = _window()
    inner = np.flatnonzero((np.abs(x) < _REACH) & (np.abs(y) < _REACH))
    at_r, at_c, inside = _places(found, image.shape, y, x)
    grey, own = image[at_r, at_c].astype(np.float64), image.ravel()[found].astype(np.float64)
    ring = inside.astype(np.float64)
    ring[:, inner] = 0.0
    level = _fitted(grey, ring, terms)
    height = own - level[:, 0]
    beside = (grey[:, inner] - level @ terms[inner].T) * np.sign(height)[:, None] * inside[:, inner]
    share = beside.max(axis=1) / np.maximum(np.abs(height), 1e-12)
    return found[share < _SINGLE], found[(share > _SHARED) & (share <= 1.0)]


def _window() -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
    """Offsets (24,) of a pixel's neighbours along y and x, and the terms of a quadratic there."""
    y, x = (np.delete(a.ravel(), a.size // 2) for a in np.mgrid[-_REACH : _REACH + 1, -_REACH : _REACH + 1])
    return y, x, np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=-1)


def _places(index: NDArray[np.int64], shape: tuple[int, ...], y: Any, x: Any) -> tuple[Any, Any, NDArray[np.bool_]]:
    """Rows and columns (m, 24) about pixels, moved into the image, and True for those that were inside."""
    r, c = np.divmod(index, shape[1])
    at_r, at_c = r[:, None] + y, c[:, None] + x
    inside = (at_r >= 0) & (at_r < shape[0]) & (at_c >= 0) & (at_c < shape[1])
    return np.clip(at_r, 0, shape[0] - 1), np.clip(at_c, 0, shape[1] - 1), inside


def _predicted(image: NDArray[Any], index: NDArray[np.int64], usual: float) -> tuple[Float, Float]:
    """Values (m,) at pixels from their neighbours, and how far the pixels are off, in the neighbours' own scatter."""
    value, off = np.empty(len(index)), np.full(len(index), np.inf)
    y, x, terms = _window()
    near = np.exp(-0.5 * (x * x + y * y) / _NEAR_PX**2)
    suspect = np.zeros(image.shape, bool)
    suspect.ravel()[index] = True
    for first in range(0, len(index), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        at_r, at_c, inside = _places(index[part], image.shape, y, x)
        use = inside & ~suspect[at_r, at_c]
        use |= inside & (use.sum(axis=1) < _FEWEST)[:, None]
        grey, own = image[at_r, at_c].astype(np.float64), image.ravel()[index[part]].astype(np.float64)
        even = _fitted(grey, use.astype(np.float64), terms)
        left = ((grey - even @ terms.T) ** 2 * use).sum(axis=1) / np.maximum(use.sum(axis=1) - terms.shape[1], 1)
        off[part] = np.abs(own - even[:, 0]) / np.maximum(np.sqrt(left), max(usual, 1e-12))
        value[part] = np.clip(
            _fitted(grey, use * near, terms)[:, 0],
            np.where(use, grey, np.inf).min(axis=1),
            np.where(use, grey, -np.inf).max(axis=1),
        )
    return value, off


def _fitted(grey: Float, weight: Float, terms: Float) -> Float:
    """(m, 6) coefficients of quadratics through weighted grey levels (m, 24)."""
    normal = np.einsum("mk,ki,kj->mij", weight, terms, terms, optimize=True) + 1e-9 * np.eye(terms.shape[1])
    return np.asarray(np.linalg.solve(normal, ((weight * grey) @ terms)[..., None])[..., 0])


# Columns and rows of a sensor, seen in its images: pixels far apart along a line share the line and nothing else.

SURE = 5.0
"""Standard deviations of a variance that is there."""
_ROUGH = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)  # white lines keep their variance, texture leaves little
# pixels that are averaged along a line, and between them: texture is independent at a larger distance
_STRIP_PX, _GAP_PX = 24, 12
_MIN_STRIPS, _MAX_STRIPS, MIN_LINES = 4, 16, 48
_OUTLIER = 5.0  # robust sd of a line: an edge of the specimen along it
_MAD_TO_SIGMA = 1.4826


def box_about(xy_px: Float, subset_px: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of an image of this shape that contain the subsets of points (n, 2)."""
    half = subset_px // 2
    low, high = np.floor(xy_px.min(axis=0)) - half, np.ceil(xy_px.max(axis=0)) + half + 1
    (x0, y0), (x1, y1) = np.maximum(low, 0).astype(int), np.minimum(high, np.array(shape[::-1])).astype(int)
    return slice(int(y0), int(y1)), slice(int(x0), int(x1))


def strips_along(image: NDArray[Any], axis: int) -> Float:
    """Return (k, n) rough part of the means of k strips along n lines: columns (axis 0) or rows (axis 1)."""
    lines = image if axis == 0 else image.T
    step = _STRIP_PX + _GAP_PX
    count = (len(lines) + _GAP_PX) // step
    every = max(1, -(-count // _MAX_STRIPS))  # some strips of a large image are enough
    if count == 0 or lines.shape[1] < len(_ROUGH):
        return np.zeros((0, 0))
    first = range(0, count * step, every * step)
    means = [lines[k : k + _STRIP_PX].mean(axis=0, dtype=np.float64) for k in first]
    return np.stack([np.convolve(mean, _ROUGH, mode="valid") for mean in means])


def line_covariance(one: Float, two: Float, moved_px: float = 0.0) -> tuple[float, float]:
    """Return the covariance of two images' lines, grey levels squared, and its standard deviation; NaN if not known.

    Parameters
    ----------
    one, two
        (k, n) of :func:`strips_along` of the same part of the sensor; twice the same gives a variance.
    moved_px
        By which the texture moved along the lines.
    """
    k, n = one.shape
    place = np.arange(k) * (_STRIP_PX + _GAP_PX)
    # no strip may show the same place as another one before
    apart = np.abs(place[None, :] - place[:, None] - moved_px) >= _STRIP_PX + 0.5 * _GAP_PX
    np.fill_diagonal(apart, False)
    if k < _MIN_STRIPS or n < MIN_LINES or apart.sum() < k:
        return float("nan"), float("nan")
    usual: Bool = np.ones(n, bool)
    for values in (one, two):
        mean = np.abs(values.mean(axis=0) - np.median(values.mean(axis=0)))
        usual &= mean <= _OUTLIER * _MAD_TO_SIGMA * np.median(mean)
    products = ((apart @ two) * one)[:, usual].sum(axis=0) / apart.sum()
    # the filter makes neighbours' products correlate
    return float(products.mean()), float(products.std() * np.sqrt(2.0 / max(int(usual.sum()), 1)))
