"""Feature points of images and their matches: the raw material of automatic seeds.

SIFT (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94) with RootSIFT descriptors (Arandjelovic and Zisserman 2012,
doi:10.1109/CVPR.2012.6248018), matched by the ratio test in both directions. The cameras' geometry is applied later.

Images are reduced as far as seeds allow, and processed in tiles: all tiles of all images share the threads, and the
memory in use does not grow with the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32
from stereorig.core.threads import run_ranges

MAX_KEYPOINTS = 4000
"""The time of matching grows with the square; this number is enough for the seeds of a field."""
_RATIO = 0.85
_CHUNK = 256
_MIN_CONTRAST = 0.01
_TILE_PX = 832
_RIM_PX = 24
_SHARE_MORE = 1.5  # a tile may keep so much more than its share of the keypoints: texture is seldom even

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image: ``xy_px`` (n, 2), unit ``descriptors`` (n, 128) float32.

    ``scale`` is the factor by which the image was reduced when they were found: their standard deviation is a third of
    it, px.
    """

    xy_px: Float
    descriptors: Float32
    scale: int = 1


class Picture(NamedTuple):
    """An image (rows, cols) and the box (x0, y0, x1, y1), half open, in which features are searched for."""

    image: NDArray[Any]
    box: Box


def stretch_to_eight_bit(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Stretch grey levels of any depth between their 0.5 and 99.5 percentile to 8 bit."""
    some = image[:: max(1, image.shape[0] // 512), :: max(1, image.shape[1] // 512)]
    low, high = np.percentile(some, (0.5, 99.5))
    span = max(float(high - low), 1e-9)
    stretched = (image.astype(np.float32) - np.float32(low)) * np.float32(255.0 / span)
    return np.asarray(np.clip(stretched, 0.0, 255.0).astype(np.uint8))


def reduced(image: NDArray[Any], scale: int) -> NDArray[Any]:
    """Return the means of squares of ``scale`` x ``scale`` pixels, with their fractions; a remainder is cut off."""
    if scale == 1:
        return image
    rows, cols = image.shape[0] // scale * scale, image.shape[1] // scale * scale
    size = (cols // scale, rows // scale)
    part = image[:rows, :cols]
    # a few rows at a time: as float32 a large image would take four times its memory
    out = np.empty((size[1], size[0]), np.float32)
    step = max(1, 4_000_000 // (cols * scale)) * scale
    for y in range(0, rows, step):
        band = part[y : y + step].astype(np.float32)
        out[y // scale : (y + len(band)) // scale] = cv2.resize(
            band, (size[0], len(band) // scale), interpolation=cv2.INTER_AREA
        )
    return out


def detect(
    image: NDArray[Any], *, box: Box | None = None, scale: int = 1, max_keypoints: int = MAX_KEYPOINTS
) -> Features:
    """Find keypoints of one image and describe them, see :func:`detect_all`."""
    whole = (0, 0, image.shape[1], image.shape[0])
    return detect_all([Picture(image, whole if box is None else box)], scale=scale, max_keypoints=max_keypoints)[0]


def detect_all(pictures: Sequence[Picture], *, scale: int = 1, max_keypoints: int = MAX_KEYPOINTS) -> list[Features]:
    """Find keypoints of several images and describe them.

    Parameters
    ----------
    pictures
        Images (rows, cols), grey levels of any depth, and the box of each that is searched for keypoints.
    scale
        Work on the images at a ``scale``-th of their size.
    max_keypoints
        The strongest ones of each image are kept.
    """
    small: list[NDArray[np.uint8]] = [np.zeros((0, 0), np.uint8)] * len(pictures)

    def shrink(first: int, last: int) -> None:
        for k in range(first, last):
            x0, y0, x1, y1 = _with_rim(pictures[k], scale)
            small[k] = stretch_to_eight_bit(reduced(pictures[k].image[y0:y1, x0:x1], scale))

    run_ranges(shrink, len(pictures), 1)
    tiles = [(k, core) for k, picture in enumerate(small) for core in _tiles((picture.shape[0], picture.shape[1]))]
    found: list[tuple[Float, Float32, Float]] = [(np.zeros((0, 2)),) * 3] * len(tiles)  # type: ignore[list-item]

    def search(first: int, last: int) -> None:
        for i in range(first, last):
            k, core = tiles[i]
            share = (core[2] - core[0]) * (core[3] - core[1]) / small[k].size
            found[i] = _search(small[k], core, int(max_keypoints * min(1.0, _SHARE_MORE * share)) + 1)

    run_ranges(search, len(tiles), 1)
    out = []
    for k, picture in enumerate(pictures):
        parts = [found[i] for i, (owner, _) in enumerate(tiles) if owner == k]
        xy, descriptors, response = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        corner = np.array(_with_rim(picture, scale)[:2])
        xy = (xy + 0.5) * scale - 0.5 + corner
        x0, y0, x1, y1 = picture.box
        inside = (xy[:, 0] >= x0) & (xy[:, 1] >= y0) & (xy[:, 0] <= x1 - 1) & (xy[:, 1] <= y1 - 1)
        order = np.flatnonzero(inside)[np.argsort(-response[inside], kind="stable")][:max_keypoints]
        out.append(Features(xy[order], np.ascontiguousarray(descriptors[order]), scale))
    return out


def _with_rim(picture: Picture, scale: int) -> Box:
    return with_rim((picture.image.shape[0], picture.image.shape[1]), picture.box, scale)


def with_rim(shape: tuple[int, int], box: Box, scale: int) -> Box:
    """Return a box with a rim for the filters, as far as the image of this shape goes."""
    rows, cols = shape
    x0, y0, x1, y1 = box
    rim = _RIM_PX * scale
    return max(x0 - rim, 0), max(y0 - rim, 0), min(x1 + rim, cols), min(y1 + rim, rows)


def _tiles(shape: tuple[int, int]) -> list[Box]:
    """Cut an image into equal parts of at most 832 px."""
    ys, xs = (np.linspace(0, n, -(-n // _TILE_PX) + 1).astype(int).tolist() for n in shape)
    return [(x0, y0, x1, y1) for y0, y1 in pairwise(ys) for x0, x1 in pairwise(xs)]


def _search(picture: NDArray[np.uint8], core: Box, max_features: int) -> tuple[Float, Float32, Float]:
    """Keypoints (n, 2) inside ``core``, their descriptors and strengths; the rim around it is for the filters."""
    x0, y0, x1, y1 = _with_rim(Picture(picture, core), 1)
    sift = cv2.SIFT_create(nfeatures=max_features, contrastThreshold=_MIN_CONTRAST)  # type: ignore[attr-defined]
    allowed = np.zeros((y1 - y0, x1 - x0), np.uint8)
    allowed[core[1] - y0 : core[3] - y0, core[0] - x0 : core[2] - x0] = 255
    keypoints, descriptors = sift.detectAndCompute(np.ascontiguousarray(picture[y0:y1, x0:x1]), allowed)
    if descriptors is None or len(keypoints) == 0:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros(0)
    xy = np.array([k.pt for k in keypoints], dtype=np.float64) + np.array([x0, y0])
    d = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)).astype(np.float32)
    return xy, d, np.array([k.response for k in keypoints])


def match(a: Features, b: Features, *, ratio: float = _RATIO) -> NDArray[np.int64]:
    """Return (m, 2) index pairs that are each other's best and pass the ratio test from ``a`` to ``b``."""
    n_a, n_b = len(a.xy_px), len(b.xy_px)
    if n_a == 0 or n_b < 2:
        return np.zeros((0, 2), np.int64)
    best = np.empty(n_a, np.int64)
    top = np.empty(n_a, np.float32)
    second = np.empty(n_a, np.float32)
    max_features = np.empty((-(-n_a // _CHUNK), n_b), np.float32)  # largest of each column over a chunk of rows
    transposed = np.ascontiguousarray(b.descriptors.T)

    def compare(first: int, last: int) -> None:
        score = a.descriptors[first:last] @ transposed
        j = np.argmax(score, axis=1)
        index = np.arange(len(j))
        best[first:last], top[first:last] = j, score[index, j]
        max_features[first // _CHUNK] = score.max(axis=0)
        score[index, j] = -np.inf
        second[first:last] = score.max(axis=1)

    run_ranges(compare, n_a, _CHUNK)
    mutual = top >= max_features.max(axis=0)[best]
    # |d1 - d2|^2 = 2 - 2 d1.d2 for unit vectors
    distinct = (1.0 - top) < ratio**2 * (1.0 - second)
    keep = np.flatnonzero(distinct & mutual)
    return np.stack([keep, best[keep]], axis=1)
