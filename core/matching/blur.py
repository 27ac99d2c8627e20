"""A Gaussian blur of all images before they are matched, and its effect on their noise.

White noise comes out of the blur correlated from pixel to pixel. A match is a least-squares fit with gradients g over
the subset; its right-hand side ``sum g n`` has the variance ``sum_xy g(x) g(y) C(x - y)``, with C the noise's
autocorrelation, and not ``C(0) sum g^2`` as with white noise. The ratio of both, the ``spread``, is the factor missing
in a covariance for white noise.

Residuals of blurred images are a bad measure of their noise: most of it is removed, and the rest of the residuals are
differences of the views, which are systematic. So the noise is estimated from the images before the blur.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32
from stereorig.core.errors import InputError
from stereorig.core.matching.filters import correlate

_REACH_SD = 4.0  # the taps beyond hold 6e-5 of the kernel
_EDGE_SD = 3.0
_SAMPLES = 7  # along each side of the image
_BARE = 1e-3  # share of the squared gradients: less is no texture


@dataclass(frozen=True)
class Blur:
    """A Gaussian of ``sd_px``, the same both ways; images continue as their mirror about the outermost pixels.

    Raises
    ------
    InputError
        ``option_out_of_range`` for a standard deviation that is not positive and finite.
    """

    sd_px: float

    def __post_init__(self) -> None:
        if not 0.0 < self.sd_px < np.inf:
            raise InputError(
                f"a blur of {self.sd_px:g} px is none; it must be positive and finite.", code="option_out_of_range"
            )

    @cached_property
    def taps(self) -> Float:
        """(2 r + 1,) along one axis, sum 1."""
        r = max(1, int(np.ceil(_REACH_SD * self.sd_px)))
        taps = np.exp(-0.5 * (np.arange(-r, r + 1) / self.sd_px) ** 2)
        return np.asarray(taps / taps.sum())

    @cached_property
    def gain(self) -> float:
        """Variance of white noise of variance 1 after the blur."""
        return float((self.taps**2).sum() ** 2)

    @cached_property
    def correlation(self) -> Float:
        """(4 r + 1,) correlation of blurred white noise over the lag along one axis, 1 in the middle."""
        c = np.correlate(self.taps, self.taps, mode="full")
        return np.asarray(c / c.max())

    @property
    def edge_px(self) -> int:
        """Distance from an image's border within which its mirror image has an effect."""
        return int(np.ceil(_EDGE_SD * self.sd_px))

    def correlation_at(self, lag: NDArray[np.integer[Any]]) -> Float:
        """Correlation of blurred white noise at lags along one axis, any shape."""
        c, middle = self.correlation, len(self.correlation) // 2
        inside = np.abs(lag) <= middle
        return np.where(inside, c[np.where(inside, lag, 0) + middle], 0.0)

    def spectrum(self, side: int) -> Float:
        """Power (side, side // 2 + 1) of blurred white noise of variance 1, mean 1 over all frequencies."""
        k = 2.0 * np.pi * np.fft.fftfreq(side)
        r = len(self.taps) // 2
        one = (self.taps[:, None] * np.cos(np.arange(-r, r + 1)[:, None] * k)).sum(axis=0) ** 2
        one /= (self.taps**2).sum()
        return np.asarray(one[:, None] * one[: side // 2 + 1])

    def apply(self, image: NDArray[Any]) -> Float32:
        """Blur an image (rows, cols)."""
        out = np.empty(image.shape, np.float32)
        correlate(image, self.taps, self.taps, out)
        return out


def spread_of(blur: Blur, gradients: tuple[Float32, Float32], subset_px: int) -> Float32:
    """Return (rows, cols), the ratio of blurred noise's effect to the effect of white noise of its variance, by subset.

    Parameters
    ----------
    blur
        The blur.
    gradients
        (rows, cols) along x and y, of the blurred reference image.
    subset_px
        Width of the subset about each pixel.

    Notes
    -----
    With S the subset, ``sum_{x, y in S} g(x) g(y) C(x - y)`` is taken as ``sum_{x in S} g(x) (C_S * g)(x)``, where C_S
    is C times the share of the subset's pixels whose partner is in the subset too. A displacement estimated from
    gradients has the covariance ``G^-1 K G^-1``, G the sums of their products and K the same under C; the ratio
    compares its trace with the trace of ``G^-1``.
    """
    lag = np.arange(len(blur.correlation)) - len(blur.correlation) // 2
    shared = blur.correlation * np.maximum(1.0 - np.abs(lag) / subset_px, 0.0)
    size = (subset_px, subset_px)

    def mean(values: Float32) -> Float32:
        return np.asarray(cv2.boxFilter(values, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101))

    def under_noise(values: Float32) -> Float32:
        out = np.empty(values.shape, np.float32)
        correlate(values, shared, shared, out)
        return out

    gx, gy = gradients
    nx, ny = under_noise(gx), under_noise(gy)
    # a fit is free in the grey levels' mean, so that only the gradients' deviations from their own mean count
    ax, ay, bx, by = mean(gx), mean(gy), mean(nx), mean(ny)
    max_ratio = np.float32(shared.sum() ** 2)
    xx, yy, xy = mean(gx * gx) - ax * ax, mean(gy * gy) - ay * ay, mean(gx * gy) - ax * ay
    kxx = mean(gx * nx) - 2.0 * ax * bx + max_ratio * ax * ax
    kyy = mean(gy * ny) - 2.0 * ay * by + max_ratio * ay * ay
    kxy = mean(gx * ny) - ax * by - ay * bx + max_ratio * ax * ay
    det, trace = xx * yy - xy * xy, xx + yy
    # the adjugate of G is (yy, xx, -xy); its square
    coloured = (yy * yy + xy * xy) * kxx + (xx * xx + xy * xy) * kyy - 2.0 * xy * trace * kxy
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = coloured / (trace * det)
    # without texture, as for an even slope
    return np.asarray(np.clip(np.where(np.isfinite(ratio), ratio, max_ratio), 0.02, max_ratio), dtype=np.float32)


def fitted_share(
    blur: Blur, pixels: Float32, gradients: tuple[Float32, Float32], subset_px: int, degree: int, spread: Float32
) -> float:
    """Return the factor on a spread for a patch that is fitted with more unknowns than its displacement.

    For a few dozen subsets the gradients are projected off the fit's other unknowns (contrast and offset, the patch's
    slopes, and for curved patches its second order), and their spread is summed exactly. The mean of the ratio counts.

    Parameters
    ----------
    blur
        The blur.
    pixels, gradients
        (rows, cols) of the blurred reference image.
    subset_px, degree
        Width of the subset, and degree of the patch: 1 plane, 2 curved.
    spread
        Result of :func:`spread_of`.
    """
    rows, cols = pixels.shape
    half = subset_px // 2
    lag = np.arange(subset_px)
    C = blur.correlation_at(lag[:, None] - lag[None, :])
    coordinate = np.linspace(-1.0, 1.0, subset_px)
    x, y = np.meshgrid(coordinate, coordinate)
    terms = [x, y] if degree == 1 else [x, y, x * x, x * y, y * y]
    middle_x, middle_y = (np.unique(np.linspace(half, last - 1 - half, _SAMPLES).astype(int)) for last in (cols, rows))
    exact, mapped = [], []
    for r in middle_y[middle_y >= half]:
        for c in middle_x[middle_x >= half]:
            here = slice(r - half, r + half + 1), slice(c - half, c + half + 1)
            gx, gy, grey = (a[here].astype(np.float64) for a in (*gradients, pixels))
            taken = np.stack([np.ones_like(gx), grey, *(t * g for g in (gx, gy) for t in terms)]).reshape(-1, gx.size)
            own = np.stack([gx, gy]).reshape(2, -1)
            scale = np.sqrt((taken**2).sum(axis=1))
            if not scale.all():
                continue
            taken /= scale[:, None]
            free = own - np.linalg.lstsq(taken.T, own.T, rcond=1e-9)[0].T @ taken
            G = free @ free.T
            if not np.linalg.det(G) > _BARE * np.trace(G) * np.trace(own @ own.T):
                continue
            squares = free.reshape(2, subset_px, subset_px)
            K = np.einsum("aij,bij->ab", squares, C @ squares @ C)
            inverse = np.linalg.inv(G)
            exact.append(np.trace(inverse @ K @ inverse) / np.trace(inverse))
            mapped.append(spread[r, c])
    return float(np.mean(exact) / np.mean(mapped)) if exact else 1.0
