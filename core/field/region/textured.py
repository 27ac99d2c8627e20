"""Texture that a subset could be matched by, all over an image: gradients in both directions, the noise taken out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.robust import spread_indices
from stereorig.core.threads import run_ranges

_PER_SUBSET = 10  # samples along a subset's side
_BAND_PIXELS = 2_000_000


@dataclass(frozen=True, eq=False)
class TextureMap:
    """Texture of an image in squares of a subset's width, at every ``stride_px``-th pixel.

    Attributes
    ----------
    stride_px
        Distance of the samples: sample (i, j) is about pixel (row, column) = ``stride_px`` (i, j).
    strength
        (r, c) smaller eigenvalue of the mean product of gradients, grey levels squared per px^2, without the noise's
        share; about zero for noise alone, or edges of one direction only.
    structured
        (r, c) ``strength`` over its sum with the noise's share of the mean squared gradient, the smallest within a
        subset: over a slanted edge, neighbouring rows differ by more than noise.
    mean
        (r, c) mean grey level.
    """

    stride_px: int
    strength: Float32
    structured: Float32
    mean: Float32

    def at(self, xy_px: Float) -> NDArray[np.intp]:
        """Return the flat index (n,) of the sample nearest to each position (n, 2) inside the image."""
        rows, cols = self.strength.shape
        ij = np.rint(np.asarray(xy_px)[:, ::-1] / self.stride_px).astype(np.intp)
        return np.asarray(np.clip(ij[:, 0], 0, rows - 1) * cols + np.clip(ij[:, 1], 0, cols - 1))


def texture_map(image: NDArray[Any], subset_px: int) -> TextureMap:
    """Measure the texture all over an image.

    Parameters
    ----------
    image
        (rows, cols) grey levels of any depth.
    subset_px
        Width of the squares, odd.

    Notes
    -----
    A pixel's gradient is multiplied with the gradients of the pixels to the right and below: these differences have no
    pixel in common, and the noise of different pixels is independent, so that its mean product is zero at any noise
    level. All three products of gradients use the same pixels: an edge of any direction has no smaller eigenvalue.
    """
    rows, cols = image.shape
    stride = max(1, subset_px // _PER_SUBSET)
    shape = (rows - 1) // stride + 1, (cols - 1) // stride + 1
    strength, noise, mean = (np.empty(shape, np.float32) for _ in range(3))
    rim = subset_px // 2 + 2
    # in bands of whole strides: as float32 a large image would take gigabytes
    step = max(_BAND_PIXELS // cols // stride, 1) * stride
    for top in range(0, rows, step):
        above, below = min(rim, top), min(rim, max(rows - top - step, 0))
        band = np.asarray(image[top - above : min(top + step, rows) + below], dtype=np.float32)
        found = _band(band, subset_px)
        some = slice(top // stride, -(-min(top + step, rows) // stride))
        for target, values in zip((strength, noise, mean), found, strict=True):
            target[some] = values[above : len(band) - below : stride, ::stride]
    near = 2 * (subset_px // stride) + 1
    noise = np.asarray(cv2.erode(noise, np.ones((near, near), np.uint8)), np.float32)
    structured = strength / np.maximum(strength + noise, 1e-12)
    return TextureMap(stride, strength, np.asarray(structured, np.float32), mean)


def _band(pixels: Float32, subset_px: int) -> tuple[Float32, Float32, Float32]:
    about = cv2.boxFilter(pixels, -1, (subset_px, subset_px), borderType=cv2.BORDER_REFLECT)
    grey = cv2.copyMakeBorder(pixels - pixels.mean(), 1, 2, 1, 2, cv2.BORDER_REFLECT_101)
    gx = 0.5 * (grey[1:-1, 2:] - grey[1:-1, :-2])  # one row and one column more than the pixels
    gy = 0.5 * (grey[2:, 1:-1] - grey[:-2, 1:-1])
    x, y = gx[:-1, :-1], gy[:-1, :-1]
    next_x, next_y = (0.5 * (g[:-1, 1:] + g[1:, :-1]) for g in (gx, gy))  # to the right, and below
    products = (x * next_x, 0.5 * (x * next_y + y * next_x), y * next_y)
    all_of_it = 0.5 * (x * x + y * y)
    xx, xy, yy, raw = (
        cv2.boxFilter(np.ascontiguousarray(part), -1, (subset_px, subset_px), borderType=cv2.BORDER_REFLECT)
        for part in (*products, all_of_it)
    )
    smaller = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    noise = np.maximum(raw - 0.5 * (xx + yy), 0.0)
    return np.asarray(smaller, np.float32), np.asarray(noise, np.float32), np.asarray(about, np.float32)


# Texture that repeats itself: a start on it may be wrong by a period.
#
# Growth from a right start follows such a texture, since neighbours determine the period. A seed must not be on it:
# neither search nor features distinguish its periods, though noise and sampling may seem to.

_ALIKE = 0.85  # correlation of a square, twice a subset wide, with another one; random speckles reach half of it
_OWN_PEAK = 0.5  # connected to the square's own position above this: its own peak
_MIN_HALF_PX = 12
_TRIED = 24


Peaks = dict[tuple[int, int, int], float]
"""Highest correlation with another square, by the subset's width and the pixel (x, y)."""


def repeats(pixels: NDArray[Any], xy_px: Float, *, subset_px: int, known: Peaks | None = None) -> Bool:
    """Return (n,) True at positions whose texture in camera 1 repeats itself within two subsets.

    Parameters
    ----------
    pixels
        (rows, cols) image.
    xy_px
        (n, 2) positions; two dozen spread over them are examined, each of the others follows the nearest of these.
    subset_px
        Width of a subset.
    known
        Results found in this image before; the new ones are added.
    """
    n = len(xy_px)
    if n == 0:
        return np.zeros(0, bool)
    known = {} if known is None else known
    tried = np.unique(spread_indices(n, min(_TRIED, n)))
    places = [(subset_px, round(float(x)), round(float(y))) for x, y in xy_px[tried]]
    new = [place for place in places if place not in known]

    def look(first: int, last: int) -> None:
        for place in new[first:last]:
            known[place] = _second_peak(pixels, *place)

    run_ranges(look, len(new), 1)
    found = np.array([known[place] > _ALIKE for place in places])
    nearest = np.asarray(cKDTree(xy_px[tried]).query(xy_px)[1])
    return np.asarray(found[nearest])


def _second_peak(pixels: NDArray[Any], subset_px: int, x: int, y: int) -> float:
    """Highest correlation of the square about a pixel with another one; -1 too near to the image's border."""
    rows, cols = pixels.shape
    half = min(max(subset_px, _MIN_HALF_PX), x, y, cols - 1 - x, rows - 1 - y)
    if half < _MIN_HALF_PX:
        return -1.0
    reach = half + 2 * subset_px
    left, top = max(x - reach, 0), max(y - reach, 0)
    window = np.ascontiguousarray(pixels[top : y + reach + 1, left : x + reach + 1], dtype=np.float32)
    square = np.ascontiguousarray(pixels[y - half : y + half + 1, x - half : x + half + 1], dtype=np.float32)
    score = np.array(cv2.matchTemplate(window, square, cv2.TM_CCOEFF_NORMED))
    _, label = cv2.connectedComponents((score > _OWN_PEAK).astype(np.uint8), connectivity=8)
    own = label[y - half - top, x - half - left]
    score[label == own] = -1.0
    return float(score.max())
