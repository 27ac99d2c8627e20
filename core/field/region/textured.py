"""Texture that a subset could be matched by, all over an image: gradients in both directions, the noise taken out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32

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
