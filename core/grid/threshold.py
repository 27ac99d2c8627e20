"""A binary picture of thin lines from grey levels, under any lighting.

The paper thresholds the image. Here the threshold acts on the depth of a line below its own ground (above it, for
bright lines): grey-level closing fills every dark structure thinner than its kernel, and the difference is the depth.
Vignetting, one-sided edges and broad dirt have no depth, so that one threshold (Otsu's) is enough for the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.errors import ImageError
from stereorig.core.target import GridTarget

_MIN_SIDE_PX = 64
# a coarse picture of this many pixels on its short side shows every line of a grid worth measuring
_COARSE_SIDE_PX = 720.0
# second differences whose median gives the noise to a few tenths of a per cent
_NOISE_PIXELS = 500_000


@dataclass(frozen=True)
class LinePicture:
    """Thin lines of an image, at the coarse scale.

    Attributes
    ----------
    depth
        (rows, columns) float32, depth of each pixel below its ground, grey levels (never negative).
    mask
        (rows, columns) depth above the threshold.
    threshold
        Grey levels.
    noise
        Grey levels, standard deviation of the full-size image's noise.
    factor
        Full-size pixels per coarse pixel.
    """

    depth: Float32
    mask: Bool
    threshold: float
    noise: float
    factor: float

    @property
    def clearness(self) -> float:
        """The threshold over the noise: the same for images of any depth, averaged or not; infinite without noise."""
        return self.threshold / self.noise if self.noise > 0.0 else float("inf")


def checked_image(image: NDArray[Any]) -> Float32:
    """Return a 2-D gray image as float32.

    Raises
    ------
    ImageError
        Not 2-D, too small, or with numbers that are not finite.
    """
    array = np.asarray(image)
    if array.ndim != 2:
        raise ImageError(f"a gray image has two axes, this one has shape {array.shape}", code="image_unsupported")
    if min(array.shape) < _MIN_SIDE_PX:
        raise ImageError(
            f"the image has {array.shape[1]} x {array.shape[0]} px; a grid needs at least {_MIN_SIDE_PX} each way",
            code="image_unusable",
        )
    if array.dtype.kind not in "uif":
        raise ImageError(f"grey levels must be numbers, got {array.dtype}", code="image_unsupported")
    grey = np.ascontiguousarray(array, dtype=np.float32)
    if array.dtype.kind == "f" and not np.isfinite(grey).all():
        raise ImageError("the image holds grey levels that are not finite", code="image_unusable")
    return grey


def noise_level(grey: Float32) -> float:
    """Estimate the noise's standard deviation from second differences, free of slopes and robust against edges."""
    size = grey.shape[0] * (grey.shape[1] - 2)
    some = grey[1 :: max(2, size // _NOISE_PIXELS)] if size > 1_000_000 else grey
    d = some[:, 2:] - 2.0 * some[:, 1:-1] + some[:, :-2]
    return float(np.median(np.abs(d)) / 0.6745 / np.sqrt(6.0))


def coarse_factors(size_px: tuple[int, int], target: GridTarget) -> tuple[float, ...]:
    """Full-size pixels per coarse pixel to try in turn; 0.5 doubles the image for narrow spacings."""
    max_pitch = _max_pitch_px(size_px, target)
    # a grid worth measuring fills a third of the view at least; coarse pixels no wider than its lines keep them
    by_width = 0.35 * max_pitch * target.line_width_mm / target.pitch_mm
    first = float(int(max(1.0, min(round(by_width), round(min(size_px) / _COARSE_SIDE_PX)))))
    return (first, 0.5 * first, 2.0 * first) if first > 1.0 else (1.0, 0.5, 2.0)


def _max_pitch_px(size_px: tuple[int, int], target: GridTarget) -> float:
    return max(size_px) / (min(target.lines) - 1)


def line_picture(grey: Float32, target: GridTarget, factor: float) -> LinePicture:
    """Find structures no wider than the target's lines can be.

    Parameters
    ----------
    grey
        (rows, columns) as :func:`checked_image` returns it.
    target
        Gives the ratio of line width to pitch; the pitch in pixels is bounded by the image, since the whole grid must
        be seen.
    factor
        Full-size pixels per coarse pixel, see :func:`coarse_factors`.
    """
    noise = noise_level(grey)
    height, width = grey.shape
    coarse = grey
    if factor != 1.0:
        step = max(int(factor), 1)
        block = grey[: height // step * step, : width // step * step]
        size = (round(block.shape[1] / factor), round(block.shape[0] / factor))
        resampling = cv2.INTER_AREA if factor > 1.0 else cv2.INTER_CUBIC
        coarse = np.asarray(cv2.resize(block, size, interpolation=resampling), dtype=np.float32)
    signed = coarse if target.dark_lines else -coarse
    smooth = cv2.GaussianBlur(signed, (0, 0), 0.8 / min(factor, 1.0))
    max_pitch = _max_pitch_px((width, height), target)
    max_line_px = (target.line_width_mm / target.pitch_mm * max_pitch + 3.0) / factor
    k = 2 * int(np.ceil(max_line_px)) + 1
    ground = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (k, k)))
    depth = (ground - smooth).astype(np.float32)
    threshold = _otsu(depth)
    return LinePicture(depth, depth > threshold, threshold, noise, factor)


def _otsu(depth: Float32) -> float:
    """Otsu's threshold over the depths, on a histogram that is robust to a few glints."""
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
