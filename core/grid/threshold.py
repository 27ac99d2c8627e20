"""From grey levels to a binary picture of thin lines, whatever the lighting.

The paper thresholds the image. Here the threshold acts on the depth of a line below its own ground (above it, for
bright lines): grey-level closing fills every dark structure thinner than its kernel, and what it filled is the
depth. Vignetting, one-sided edges and broad dirt leave no depth, so that one threshold (Otsu's) serves the whole
image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import ImageError
from core.lens import Bool, Float
from core.target import GridTarget

_LEAST_SIDE_PX = 64
# a coarse picture of this many pixels on its short side shows every line of a grid worth measuring
_COARSE_SIDE_PX = 720.0


@dataclass(frozen=True)
class LinePicture:
    """Thin lines of an image, at the coarse scale.

    Parameters
    ----------
    depth
        (rows, columns) float32, how far each pixel lies below its ground, in grey levels (never negative).
    mask
        (rows, columns) depth above the threshold.
    threshold
        Grey levels.
    noise
        Grey levels, standard deviation of the full-size image's noise.
    factor
        Full-size pixels per coarse pixel.
    """

    depth: NDArray[np.float32]
    mask: Bool
    threshold: float
    noise: float
    factor: int


def checked_image(image: NDArray[Any]) -> NDArray[np.float32]:
    """Return a 2-D gray image as float32.

    Raises
    ------
    ImageError
        Not 2-D, too small, or with numbers that are not finite.
    """
    array = np.asarray(image)
    if array.ndim != 2:
        raise ImageError(f"a gray image has two axes, this one has shape {array.shape}", code="image_unsupported")
    if min(array.shape) < _LEAST_SIDE_PX:
        raise ImageError(
            f"the image has {array.shape[1]} x {array.shape[0]} px; a grid needs at least {_LEAST_SIDE_PX} each way",
            code="image_unusable",
        )
    if array.dtype.kind not in "uif":
        raise ImageError(f"grey levels must be numbers, got {array.dtype}", code="image_unsupported")
    grey = np.ascontiguousarray(array, dtype=np.float32)
    if array.dtype.kind == "f" and not np.isfinite(grey).all():
        raise ImageError("the image holds grey levels that are not finite", code="image_unusable")
    return grey


def noise_level(grey: NDArray[np.float32]) -> float:
    """Estimate the noise's standard deviation from second differences, blind to slopes and robust against edges."""
    d = grey[:, 2:] - 2.0 * grey[:, 1:-1] + grey[:, :-2]
    d = d[1::2] if d.size > 1_000_000 else d
    return float(np.median(np.abs(d)) / 0.6745 / np.sqrt(6.0))


def line_picture(grey: NDArray[np.float32], target: GridTarget) -> LinePicture:
    """Find what is thinner than the target's lines can be.

    Parameters
    ----------
    grey
        (rows, columns) as :func:`checked_image` returns it.
    target
        Tells the ratio of line width to pitch; the pitch in pixels is bounded by the image, since the whole grid
        must be seen.
    """
    noise = noise_level(grey)
    height, width = grey.shape
    ratio = target.line_width_mm / target.pitch_mm
    widest_pitch = max(height, width) / (min(target.lines) - 1)
    # a grid worth measuring fills a third of the view at least; coarse pixels no wider than its lines keep their
    # contrast
    factor = int(max(1.0, min(round(0.35 * ratio * widest_pitch), round(min(height, width) / _COARSE_SIDE_PX))))
    coarse = grey
    if factor > 1:
        size = (width // factor, height // factor)
        block = grey[: size[1] * factor, : size[0] * factor]
        coarse = np.asarray(cv2.resize(block, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    signed = coarse if target.dark_lines else -coarse
    smooth = cv2.GaussianBlur(signed, (0, 0), 0.8)
    widest_line = ratio * widest_pitch / factor + 3.0
    k = 2 * int(np.ceil(widest_line)) + 1
    ground = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (k, k)))
    depth = (ground - smooth).astype(np.float32)
    threshold = _otsu(depth)
    return LinePicture(depth, depth > threshold, threshold, noise, factor)


def _otsu(depth: NDArray[np.float32]) -> float:
    """Otsu's threshold over the depths, on a histogram that a few glints cannot stretch."""
    top = float(np.quantile(depth[::2, ::2], 0.9995))
    if top <= 0.0:
        return 0.0
    counts, edges = np.histogram(depth, bins=256, range=(0.0, top))
    centres = 0.5 * (edges[1:] + edges[:-1])
    w = np.cumsum(counts).astype(np.float64)
    m: Float = np.cumsum(counts * centres)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (m[-1] * w / w[-1] - m) ** 2 / (w * (w[-1] - w))
    between[~np.isfinite(between)] = -1.0
    return float(centres[int(np.argmax(between))])
