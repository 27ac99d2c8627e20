"""Texture that repeats itself: a start on it may be wrong by a period.

Growth from a right start follows such a texture, since neighbours determine the period. A seed must not be on it:
neither search nor features distinguish its periods, though noise and sampling may seem to.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.robust import spread_indices
from stereorig.core.threads import run_ranges

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
