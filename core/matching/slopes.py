"""Reference gradients that are best under noise: a Wiener derivative for the image's own texture.

The matcher takes the derivatives of all comparisons from the reference's gradients, and their noise costs random error:
a tenth and more in coarse texture. The linear filter nearest to the true derivative, ``i k S / (S + N)`` for a texture
of spectrum S under white noise N, loses least. Its error is uncorrelated with its output, so the sum of its squares is
also the sensitivity of the sums to a shift: no noise has to be subtracted. It is odd, so its noise does not correlate
with a pixel's own noise, and no bias follows.

The interpolation error of the spline, near the highest frequencies, is counted as noise too, and with a larger weight:
it shifts all points by one amount that depends on the sub-pixel phase, and averaging does not remove it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import fft  # scipy's gives the same numbers and is slow to load
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32
from stereorig.core.matching.blur import Blur
from stereorig.core.matching.filters import derivative
from stereorig.core.matching.odd_filters import REACH, filter_both

_TILE = 128
_MAX_TILES = 48
_MIN_POWER = 0.1  # share of a strong tile's grey-level variance: tiles below it show no texture
_RINGS = (0.6, 0.8)  # shares of the Nyquist frequency, both ways: beyond the second, lenses leave little but noise
_FALL = 2.0  # by which the sharpest texture's spectrum falls from one ring to the next
_LEVEL = 1.05  # rings that differ by less show noise alone
_MAX_NOISE = 0.5  # share of the grey levels' variance
_INTERPOLATION_COUNTS = 100.0  # reduces the bias in sharp speckle by a third, for 1 % of random error there
_BLANK = 1e-20  # share of the squared grey levels: rounding
_MIN_NOISE = 1e-6  # share of the texture's variance, so that a noise-free image's equations can be solved


@dataclass(frozen=True, eq=False)
class SlopeFilter:
    """Two odd filters, to be correlated with an image.

    Attributes
    ----------
    along_x, along_y
        (7, 7) taps.
    gain
        Variance of the filtered gradient over the variance of the pixels' noise, mean of both directions.
    share
        Share of noise in the filtered gradient's squares over the image's texture.
    noise_variance
        Noise variance of a pixel, grey levels squared, for which the filter was made.
    """

    along_x: Float
    along_y: Float
    gain: float
    share: float
    noise_variance: float

    def apply(self, image: NDArray[Any]) -> tuple[Float32, Float32]:
        """Gradients along x and y (rows, cols), grey levels per px; the image continues as its mirror."""
        along_x, along_y = filter_both(image, self.along_x, self.along_y)
        return along_x, along_y


def slope_filter(
    image: NDArray[Any],
    order: int,
    noise_variance: float | None = None,
    *,
    blur: Blur | None = None,
    unblurred: NDArray[Any] | None = None,
) -> SlopeFilter | None:
    """Make the filter for an image; None for an image without texture.

    Parameters
    ----------
    image
        (rows, cols) grey levels; tiles of it without texture are left out.
    order
        Order of the spline that interpolates the other images, 3 or 5.
    noise_variance
        Noise variance of a pixel, grey levels squared; from the spectrum's floor when left out. Texture that is sharp
        enough to reach the floor raises it: the gradients are then slightly worse, and the covariance is not too small.
    blur, unblurred
        The image's blur, and the image before it: its noise is no longer white, and its spectrum has no floor.

    Notes
    -----
    The taps h solve the normal equations ``sum_j (R + E)(i - j) h(j) = (d S)(i)``: R the image's autocorrelation, S the
    texture's, E the interpolation error's, d the derivative. The derivative is the quintic spline's: the exact one
    would amplify aliased frequencies. That is the quintic spline's: the exact one would amplify aliased frequencies.
    They are then scaled so that the sum of squares equals the sensitivity.
    """
    spectra, window = _spectra(image)
    if spectra is None:
        return None
    if noise_variance is not None:
        noise = noise_variance
    elif blur is None or unblurred is None:
        noise = _floor(spectra)
    else:
        before = _spectra(unblurred)[0]
        noise = 0.0 if before is None else blur.gain * _floor(before)
    side = 2 * REACH + 1
    W = np.maximum(_lags(np.abs(fft.rfft2(window)) ** 2 / (window**2).sum()), 0.01)
    spectrum = spectra.mean(axis=0)
    S = _lags(spectrum) / W  # index 0 is lag 0, negative lags come from the end
    if not S[0, 0] > 0.0:
        return None
    noise = min(noise, _MAX_NOISE * float(S[0, 0]))
    colour = np.ones_like(spectrum) if blur is None else blur.spectrum(len(spectrum))
    E = _lags(np.maximum(spectrum - noise * colour, 0.0) * _interpolation_error(len(spectrum), order)) / W
    C = _lags(colour)
    N = noise * C
    floor = _MIN_NOISE * float(S[0, 0] - noise)
    S -= N
    offsets = np.arange(-REACH, REACH + 1)
    y, x = (v.ravel() for v in np.meshgrid(offsets, offsets, indexing="ij"))
    lag = y[:, None] - y, x[:, None] - x
    R = S[lag] + N[lag]
    R[np.diag_indices(side**2)] += floor
    slope = derivative(5)
    far = min(len(slope) // 2, len(S) // 2 - 1 - REACH)
    tap = np.arange(-far, far + 1)
    slope = slope[len(slope) // 2 - far : len(slope) // 2 + far + 1]
    wanted = np.stack([S[-y[:, None], tap - x[:, None]] @ slope, S[tap - y[:, None], -x[:, None]] @ slope], axis=-1)
    taps = np.linalg.solve(R + _INTERPOLATION_COUNTS * E[lag], wanted)
    taps = 0.5 * (taps - taps[::-1])  # odd, but for rounding
    power = np.einsum("ik,ij,jk->k", taps, R, taps)
    if not (power > 0.0).all():
        return None
    taps *= np.einsum("ik,ik->k", taps, wanted) / power
    gain = float(np.einsum("ik,ij,jk->", taps, C[lag], taps)) / 2.0
    power = float(np.einsum("ik,ij,jk->", taps, R, taps)) / 2.0
    along_x, along_y = taps.T.reshape(2, side, side)
    return SlopeFilter(along_x, along_y, gain, gain * noise / power, noise)


def _spectra(image: NDArray[Any]) -> tuple[Float | None, Float]:
    """Periodograms (tiles, side, side // 2 + 1) of tiles that show texture, white noise at its variance; the window."""
    rows, cols = image.shape
    side = min(_TILE, rows // 2 * 2, cols // 2 * 2)
    corners = [(y, x) for y in range(0, rows - side + 1, side) for x in range(0, cols - side + 1, side)]
    corners = corners[:: -(-len(corners) // _MAX_TILES)]
    tiles = np.stack([image[y : y + side, x : x + side] for y, x in corners]).astype(np.float64)
    hann = np.hanning(side + 2)[1:-1]
    window = np.outer(hann, hann)
    tiles = (tiles - np.tensordot(tiles, window / window.sum())[:, None, None]) * window
    power = (tiles**2).mean(axis=(1, 2))
    if not power.max() > _BLANK * float(np.abs(image[::8, ::8]).max()) ** 2:
        return None, window
    tiles = tiles[power >= _MIN_POWER * np.quantile(power, 0.9)]
    return np.abs(fft.rfft2(tiles)) ** 2 / (window**2).sum(), window


def _floor(spectra: Float) -> float:
    """Noise variance from the spectrum where both frequencies are highest, median over the tiles.

    White noise is level there, texture still decreases: the decrease between two rings is extrapolated as texture.
    """
    side = spectra.shape[1]
    frequency = np.minimum.outer(np.abs(fft.fftfreq(side)), fft.rfftfreq(side)) * 2.0
    inner = np.median(spectra[:, (frequency > _RINGS[0]) & (frequency <= _RINGS[1])].mean(axis=1))
    outer = np.median(spectra[:, frequency > _RINGS[1]].mean(axis=1))
    return float(max(outer - max(inner - _LEVEL * outer, 0.0) / (_FALL - 1.0), 0.0))


def _interpolation_error(side: int, order: int) -> Float:
    """Return the interpolation error (side, side // 2 + 1) by frequency: share of its power, mean over the phase."""

    def along(w: Float) -> Float:
        if order == 3:
            sampled = (4.0 + 2.0 * np.cos(w)) / 6.0
        else:
            sampled = (66.0 + 52.0 * np.cos(w) + 2.0 * np.cos(2.0 * w)) / 120.0

        def passed(v: Float) -> Float:
            return np.asarray(np.sinc(v / (2.0 * np.pi)) ** (order + 1) / sampled)

        images = [passed(w + 2.0 * np.pi * m) ** 2 for m in (-2, -1, 1, 2)]
        return np.asarray((1.0 - passed(w)) ** 2 + np.sum(images, axis=0))

    k: Float = 2.0 * np.pi * np.asarray(fft.fftfreq(side), dtype=np.float64)
    return np.asarray(along(k)[:, None] + along(np.abs(k[: side // 2 + 1]))[None, :])


def _lags(spectrum: Float) -> Float:
    """Autocorrelation (side, side) of a spectrum over lags, cyclic."""
    side = spectrum.shape[0]
    # divided once, by all pixels: not by the rows and then by the columns, which would round twice
    return np.asarray(fft.irfft2(spectrum, s=(side, side), norm="forward") * (1.0 / side**2))
