"""Images prepared for matching: spline coefficients, gradients and noise.

B-spline coefficients are exact to float32 (mirror boundary: the image continues symmetrically about its outermost
pixel centres), so the spline passes through every pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Float32
from stereorig.core.errors import ImageError, InputError
from stereorig.core.matching.blur import Blur, fitted_share, spread_of
from stereorig.core.matching.filters import correlate, derivative, in_bands, prefilter
from stereorig.core.matching.options import SPLINE_ORDER
from stereorig.core.matching.slopes import SlopeFilter, slope_filter
from stereorig.core.noise import NoiseModel
from stereorig.core.settings import Interpolation

Box = tuple[int, int, int, int]

PAD = 4
"""Mirrored coefficients kept around the image, so that no tap needs a test (quintic: 2 left, 3 right, and rounding)."""

_ONE = np.ones(1)
_SAMPLE = 4  # every fourth pixel is enough for a mean variance
_LEVEL_PX = 0.5  # standard deviation of the smoothing before weights are taken: a larger one mixes levels at edges


@dataclass(frozen=True, eq=False)
class ImageData:
    """One prepared image.

    Attributes
    ----------
    coefficients
        (rows + 2 PAD, cols + 2 PAD) float32 B-spline coefficients. float32 rounds them by 6e-8 of their size, some
        1e-5 grey levels of an 8-bit image: a shift of 1e-6 px.
    raw
        (rows, cols) grey levels as given.
    order
        3 or 5.
    noise
        The noise model of ``raw``, or None if it is not known.
    blur
        Blur of ``raw``; None without one.
    unblurred
        (rows, cols) grey levels before the blur; None without one.
    defects
        (m,) flat indices of pixels that count in no subset of this image as a reference; None: all count.
    """

    coefficients: Float32
    raw: NDArray[Any]
    order: int
    noise: NoiseModel | None = None
    blur: Blur | None = None
    unblurred: NDArray[Any] | None = None
    defects: NDArray[np.int64] | None = None
    _spreads: dict[tuple[int, int], Float32] = field(default_factory=dict, init=False, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return int(self.raw.shape[0]), int(self.raw.shape[1])

    @cached_property
    def pixels(self) -> Float32:
        """(rows, cols) grey levels, float32. Computed on the first call: only a reference image needs them."""
        return np.ascontiguousarray(self.raw, dtype=np.float32)

    @cached_property
    def noise_variance(self) -> float | None:
        """Variance of the noise of a pixel of weight 1, grey levels squared, or None if it is not known."""
        if self.noise is None:
            return None
        return float(1.0 / np.mean(1.0 / self.noise.variance(self.raw[::_SAMPLE, ::_SAMPLE])))

    @cached_property
    def weights(self) -> Float32 | None:
        """(rows, cols) float32 inverse variance of the pixels' noise, about 1 in the mean; None if all count alike.

        The weight is taken from neighbouring pixels too, so that a pixel's own noise has little effect on its weight.
        """
        if self.noise is None or self.noise_variance is None:
            return None if self.defects is None else self._without_defects(np.ones(self.shape, np.float32))
        out = np.empty(self.shape, np.float32)
        model, one = self.noise, self.noise_variance

        def weigh(source: NDArray[Any]) -> Any:
            level = cv2.GaussianBlur(source.astype(np.float32), (3, 3), _LEVEL_PX, borderType=cv2.BORDER_REFLECT_101)
            return one / model.variance(level)

        in_bands(self.raw, 1, weigh, out)
        return self._without_defects(out)

    def _without_defects(self, weights: Float32) -> Float32:
        if self.defects is not None:
            weights.ravel()[self.defects] = 0.0
        return weights

    @cached_property
    def slopes(self) -> SlopeFilter | None:
        """The derivative that is best under this image's noise; None for an image without texture."""
        return slope_filter(self.raw, self.order, self.noise_variance, blur=self.blur, unblurred=self.unblurred)

    @property
    def slope_noise(self) -> float:
        """Variance of ``gradients`` per variance of white noise in the pixels, mean of both directions."""
        return self.slopes.gain if self.slopes else float((derivative(self.order) ** 2).sum())

    @property
    def slope_share(self) -> float:
        """Share of noise in the squares of ``gradients``, over the image's texture, that is allowed for in them."""
        return self.slopes.share if self.slopes else 0.0

    @cached_property
    def gradients(self) -> tuple[Float32, Float32]:
        """Derivatives along x and y at the pixel centres, (rows, cols), grey levels per px."""
        if self.slopes:
            return self.slopes.apply(self.raw)
        slope = derivative(self.order)
        gx, gy = np.empty(self.shape, np.float32), np.empty(self.shape, np.float32)
        correlate(self.raw, _ONE, slope, gx)
        correlate(self.raw, slope, _ONE, gy)
        return gx, gy

    @cached_property
    def sharp(self) -> ImageData | None:
        """The image before its blur, prepared alike; None without one. Its residuals give the noise."""
        if self.unblurred is None:
            return None
        return prepare(self.unblurred, "cubic" if self.order == 3 else "quintic")

    def spread(self, subset_px: int, degree: int = 1) -> Float32 | None:
        """Return (rows, cols), the ratio of blurred noise's effect to white noise's in subsets about each pixel.

        None without a blur; ``degree`` is 1 for plane and 2 for curved patches.
        """
        if self.blur is None:
            return None
        key = subset_px, degree
        if key not in self._spreads:
            found = spread_of(self.blur, self.gradients, subset_px)
            share = fitted_share(self.blur, self.pixels, self.gradients, subset_px, degree, found)
            self._spreads[key] = found * np.float32(share)
        return self._spreads[key]


def prepare(
    image: ArrayLike | ImageData,
    interpolation: Interpolation = "quintic",
    noise: NoiseModel | None = None,
    blur: Blur | None = None,
    defects: NDArray[np.int64] | None = None,
) -> ImageData:
    """Find the spline coefficients of an image.

    Parameters
    ----------
    image
        (rows, cols) grey levels, any real type; or an image already prepared, which is returned unchanged.
    interpolation
        ``cubic`` or ``quintic``.
    noise
        The camera's noise model; it weighs the pixels, and gives the covariance of a match.
    blur
        A Gaussian that the image is blurred with before anything else; None: no blur.
    defects
        Flat indices of pixels that count in no subset, see :mod:`stereorig.core.matching.defects`; None: all count.

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
    if blur is not None:
        blurred = blur.apply(pixels)
        left = None if noise is None else noise.times(blur.gain)
        return ImageData(_coefficients(blurred, order), blurred, order, left, blur, pixels, defects)
    return ImageData(_coefficients(pixels, order), np.array(pixels, order="C"), order, noise, defects=defects)


def prepare_part(pixels: NDArray[Any], order: int, noise: NoiseModel | None, box: Box) -> ImageData:
    """Return an image with its coefficients in a box alone, and NaN elsewhere: a subset that reaches there is refused.

    Parameters
    ----------
    pixels
        (rows, cols) grey levels, checked; they are not copied.
    order
        3 or 5.
    noise
        As in :func:`prepare`.
    box
        First column and row, and one past the last ones, inside the image.
    """
    rows, cols = pixels.shape
    padded = np.full((rows + 2 * PAD, cols + 2 * PAD), np.nan, np.float32)
    x0, y0, x1, y1 = box
    padded[PAD + y0 : PAD + y1, PAD + x0 : PAD + x1] = coefficients_in(pixels, order, box)
    mirror_padding(padded, 0, rows)
    return ImageData(padded, pixels, order, noise)


def coefficients_in(pixels: NDArray[Any], order: int, box: Box) -> Float32:
    """Return the coefficients of a box of an image, equal to the whole image's to the last bit."""
    taps = prefilter(order)
    reach = len(taps) // 2
    x0, y0, x1, y1 = box
    left, top = max(x0 - reach, 0), max(y0 - reach, 0)
    part = pixels[top : y1 + reach, left : x1 + reach]
    found = np.empty(part.shape, np.float32)
    correlate(part, taps, taps, found)
    return found[y0 - top : y1 - top, x0 - left : x1 - left]


def _coefficients(pixels: NDArray[Any], order: int) -> Float32:
    rows, cols = pixels.shape
    padded = np.empty((rows + 2 * PAD, cols + 2 * PAD), np.float32)
    taps = prefilter(order)
    correlate(pixels, taps, taps, padded[PAD:-PAD, PAD:-PAD])
    mirror_padding(padded, 0, rows)
    return padded


def mirror_padding(padded: Float32, first: int, last: int) -> None:
    """Fill the padding left and right of the image's rows ``first`` to ``last``, and above and below it."""
    beside = padded[PAD + first : PAD + last]
    inner = beside[:, PAD:-PAD]
    beside[:, :PAD] = inner[:, PAD:0:-1]
    beside[:, -PAD:] = inner[:, -2 : -PAD - 2 : -1]
    padded[:PAD] = padded[2 * PAD : PAD : -1]
    padded[-PAD:] = padded[-PAD - 2 : -2 * PAD - 2 : -1]
