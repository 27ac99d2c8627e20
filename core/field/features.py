"""Feature points of images and their matches: the raw material of automatic seeds.

SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelovic and Zisserman 2012), matched by the ratio test in both
directions. Nothing here knows the cameras; the geometry filters come after.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.lens import Float

MAX_KEYPOINTS = 8000
"""Brute-force matching grows with the square; 8,000 find all the seeds that a field needs."""
_RATIO = 0.85
_CHUNK = 1024
LARGE_PIXELS = 1_000_000
_LEAST_CONTRAST = 0.01


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image: ``xy_px`` (n, 2), unit ``descriptors`` (n, 128) float32."""

    xy_px: Float
    descriptors: NDArray[np.float32]


def eight_bit(image: NDArray[Any], region: tuple[int, int, int, int] | None = None) -> NDArray[np.uint8]:
    """Stretch grey levels of any depth between the 0.5 and 99.5 percentile of a region (x0, y0, x1, y1) to 8 bit."""
    part = image if region is None else image[region[1] : region[3] + 1, region[0] : region[2] + 1]
    low, high = np.percentile(part[:: max(1, part.shape[0] // 512), :: max(1, part.shape[1] // 512)], (0.5, 99.5))
    span = max(float(high - low), 1e-9)
    stretched = (image.astype(np.float32) - np.float32(low)) * np.float32(255.0 / span)
    return np.asarray(np.clip(stretched, 0.0, 255.0).astype(np.uint8))


def detect(
    image: NDArray[Any],
    *,
    mask: NDArray[np.bool_] | None = None,
    halve: bool = False,
    max_keypoints: int | None = None,
) -> Features:
    """Find keypoints and describe them.

    Parameters
    ----------
    image
        (rows, cols) grey levels of any depth.
    mask
        Where keypoints may lie; everywhere when left out.
    halve
        Work on the image at half its size: a quarter of the time, good to half a pixel.
    max_keypoints
        The strongest ones are kept; :data:`MAX_KEYPOINTS`, or five eighths of it at half size, when left out.
    """
    if max_keypoints is None:
        max_keypoints = MAX_KEYPOINTS * 5 // 8 if halve else MAX_KEYPOINTS
    if mask is not None and mask.any():
        # work on the mask's bounding box only, with a rim for the filters
        rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        y0, y1 = max(int(rows[0]) - 24, 0), min(int(rows[-1]) + 25, image.shape[0])
        x0, x1 = max(int(cols[0]) - 24, 0), min(int(cols[-1]) + 25, image.shape[1])
    else:
        x0, y0, y1, x1 = 0, 0, image.shape[0], image.shape[1]
    picture = eight_bit(np.ascontiguousarray(image[y0:y1, x0:x1]))
    allowed = None if mask is None else np.ascontiguousarray(mask[y0:y1, x0:x1]).astype(np.uint8) * np.uint8(255)
    scale = 1.0
    if halve and min(picture.shape) >= 64:
        scale = 2.0
        picture = np.asarray(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        if allowed is not None:
            size = (picture.shape[1], picture.shape[0])
            allowed = np.asarray(cv2.resize(allowed, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    sift = cv2.SIFT_create(nfeatures=max_keypoints, contrastThreshold=_LEAST_CONTRAST)  # type: ignore[attr-defined]
    keypoints, descriptors = sift.detectAndCompute(picture, allowed)
    if descriptors is None or len(keypoints) == 0:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    xy = np.array([k.pt for k in keypoints], dtype=np.float64)
    xy = (xy + 0.5) * scale - 0.5 + (x0, y0)
    d = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)).astype(np.float32)
    order = np.argsort([-k.response for k in keypoints], kind="stable")[:max_keypoints]
    return Features(xy[order], np.ascontiguousarray(d[order]))


def match(a: Features, b: Features, *, ratio: float = _RATIO) -> NDArray[np.int64]:
    """Return (m, 2) index pairs that are each other's best and pass the ratio test from ``a`` to ``b``."""
    n_a, n_b = len(a.xy_px), len(b.xy_px)
    if n_a == 0 or n_b < 2:
        return np.zeros((0, 2), np.int64)
    best = np.empty(n_a, np.int64)
    distinct = np.empty(n_a, bool)
    column_score = np.full(n_b, -np.inf, np.float32)
    column_best = np.zeros(n_b, np.int64)
    for start in range(0, n_a, _CHUNK):
        rows = slice(start, min(start + _CHUNK, n_a))
        score = a.descriptors[rows] @ b.descriptors.T
        j = np.argmax(score, axis=1)
        index = np.arange(len(j))
        top = score[index, j]
        i = np.argmax(score, axis=0)
        column = score[i, np.arange(n_b)]
        better = column > column_score
        column_score[better], column_best[better] = column[better], i[better] + start
        score[index, j] = -np.inf
        second = score.max(axis=1)
        best[rows] = j
        # |d1 - d2|^2 = 2 - 2 d1.d2 for unit vectors
        distinct[rows] = (1.0 - top) < ratio**2 * (1.0 - second)
    mutual = column_best[best] == np.arange(n_a)
    keep = np.flatnonzero(distinct & mutual)
    return np.stack([keep, best[keep]], axis=1)
