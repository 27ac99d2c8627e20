"""Images prepared for matching: spline coefficients and gradients.

B-spline coefficients are found exactly (recursive prefilter, mirror boundary: the image continues symmetrically about
its outermost pixel centres), so the spline passes through every pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from core.errors import ImageError, InputError
from core.matching.options import SPLINE_ORDER, Interpolation

PAD = 4
"""Mirrored coefficients kept around the image, so that no tap needs a test (quintic: 2 left, 3 right, and rounding)."""

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ImageData:
    """One prepared image.

    Attributes
    ----------
    coefficients
        (rows + 2 PAD, cols + 2 PAD) float32 B-spline coefficients. float32 rounds them by 6e-8 of their size, some
        1e-5 grey levels of an 8-bit image: a shift of 1e-6 px.
    pixels
        (rows, cols) float32 grey levels.
    order
        3 or 5.
    weights
        (rows, cols) float32 relative inverse noise variance of the pixels, mean about 1; None: all alike.
    noise_variance
        Variance of the noise of a pixel of weight 1, grey levels squared; None: to be estimated from residuals.
    """

    coefficients: Float32
    pixels: Float32
    order: int
    weights: Float32 | None = None
    noise_variance: float | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return int(self.pixels.shape[0]), int(self.pixels.shape[1])

    @cached_property
    def gradients(self) -> tuple[Float32, Float32]:
        """The spline's derivatives along x and y at the pixel centres, (rows, cols), grey levels per px."""
        if self.order == 3:
            smooth, slope = np.array([1.0, 4.0, 1.0]) / 6.0, np.array([-1.0, 0.0, 1.0]) / 2.0
        else:
            smooth, slope = (
                np.array([1.0, 26.0, 66.0, 26.0, 1.0]) / 120.0,
                np.array([-1.0, -10.0, 0.0, 10.0, 1.0]) / 24.0,
            )
        inner = slice(PAD, -PAD)
        along_y = ndimage.correlate1d(self.coefficients, smooth, axis=0)[inner]
        gx = ndimage.correlate1d(along_y, slope, axis=1)[:, inner]
        along_x = ndimage.correlate1d(self.coefficients, smooth, axis=1)[:, inner]
        gy = ndimage.correlate1d(along_x, slope, axis=0)[inner]
        return np.ascontiguousarray(gx, dtype=np.float32), np.ascontiguousarray(gy, dtype=np.float32)


def prepare(image: ArrayLike | ImageData, interpolation: Interpolation = "quintic") -> ImageData:
    """Find the spline coefficients of an image.

    Parameters
    ----------
    image
        (rows, cols) grey levels, any real type; or an image already prepared, which comes back unchanged.
    interpolation
        ``cubic`` or ``quintic``.

    Raises
    ------
    ImageError
        If the image is not 2-D, smaller than 16 px, not real, or holds NaN or infinite values.
    InputError
        If a prepared image has another spline order.
    """
    if interpolation not in SPLINE_ORDER:
        raise InputError(
            f"interpolation is {interpolation!r}, it must be 'cubic' or 'quintic'.", code="option_out_of_range"
        )
    order: Literal[3, 5] = 3 if interpolation == "cubic" else 5
    if isinstance(image, ImageData):
        if image.order != order:
            raise InputError(
                f"the image was prepared with a spline of order {image.order}, {interpolation} needs {order}.",
                code="interpolation_mismatch",
                remedy="Prepare the images with the interpolation that the matching uses.",
            )
        return image
    pixels = np.asarray(image)
    if pixels.ndim != 2 or min(pixels.shape) < 16:
        raise ImageError(f"an image of shape {pixels.shape} cannot be matched; it must be 2-D and 16 px or more wide.")
    if pixels.dtype.kind not in "uif":
        raise ImageError(f"an image of type {pixels.dtype} has no grey levels.")
    if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
        raise ImageError("the image holds NaN or infinite grey levels.")
    coefficients = ndimage.spline_filter(pixels.astype(np.float64), order=order, output=np.float64, mode="mirror")
    padded = np.pad(coefficients.astype(np.float32), PAD, mode="reflect")
    return ImageData(padded, np.array(pixels, dtype=np.float32, order="C"), order)
