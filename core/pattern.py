"""Speckle size of a surface's pattern in an image: the width of its autocorrelation's peak.

White noise adds to the autocorrelation at zero only, so the peak's height is extrapolated from its neighbours as a
Gaussian's; noise does not reduce the measured size. Variations over more than a tile (light, vignetting) are removed by
a quadratic fitted to each tile.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from stereorig.core.arrays import Bool, Float

_TILE_PX = 256
_MAX_TILES = 64
_MIN_SHARE = 0.5  # share of a tile that must be in the region
_MIN_PX = 16


@dataclass(frozen=True)
class PatternSize:
    """Size of a pattern's features.

    Attributes
    ----------
    feature_px
        Full width of the autocorrelation's peak at half of its height, geometric mean of both directions.
    width_x_px, width_y_px
        Along the rows and down the columns.
    contrast_grey
        Standard deviation of the pattern's grey levels, without noise.
    tiles
        Tiles that were averaged.
    """

    feature_px: float
    width_x_px: float
    width_y_px: float
    contrast_grey: float
    tiles: int


def pattern_size(image: NDArray[np.generic], inside: Bool | None = None) -> PatternSize | None:
    """Measure a pattern.

    Parameters
    ----------
    image
        (rows, cols) grey levels.
    inside
        (rows, cols) True where the pattern is; the whole image if left out.

    Returns
    -------
    PatternSize or None
        None for a region below 16 px, without contrast, or for a peak wider than half a tile.
    """
    grey = np.asarray(image)
    chosen = np.ones(grey.shape, dtype=bool) if inside is None else np.asarray(inside, dtype=bool)
    if not chosen.any():
        return None
    rows, cols = np.flatnonzero(chosen.any(axis=1)), np.flatnonzero(chosen.any(axis=0))
    box = (slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))
    grey, chosen = grey[box], chosen[box]
    if min(grey.shape) < _MIN_PX:
        return None
    covariance, count, tiles = _covariance(grey, chosen)
    if tiles == 0:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = covariance / count
    along_x, along_y = _even(mean[0, :]), _even(mean[:, 0])
    height = 0.5 * (_at_zero(along_x) + _at_zero(along_y))
    if not np.isfinite(height) or height <= 0.0:
        return None
    width_x, width_y = 2.0 * _half_at(along_x, height), 2.0 * _half_at(along_y, height)
    if not (np.isfinite(width_x) and np.isfinite(width_y)):
        return None
    return PatternSize(float(np.sqrt(width_x * width_y)), width_x, width_y, float(np.sqrt(height)), tiles)


def _covariance(grey: NDArray[np.generic], chosen: Bool) -> tuple[Float, Float, int]:
    """Sums of products at each shift and their counts, over tiles that are mostly in the region."""
    starts = [_starts(n) for n in grey.shape]
    corners = [(r, c) for r in starts[0] for c in starts[1]]
    if len(corners) > _MAX_TILES:
        corners = [corners[int(k)] for k in np.linspace(0, len(corners) - 1, _MAX_TILES)]
    height, width = (min(n, _TILE_PX) for n in grey.shape)
    padded = (fft.next_fast_len(2 * height, real=True), fft.next_fast_len(2 * width, real=True))
    total, count = np.zeros(padded), np.zeros(padded)
    tiles = 0
    # a region that fills no tile is better than none
    shares = [float(chosen[r : r + height, c : c + width].mean()) for r, c in corners]
    min_share = min(_MIN_SHARE, max(shares))
    for (r, c), share in zip(corners, shares, strict=True):
        if share < min_share or share == 0.0:
            continue
        weight = chosen[r : r + height, c : c + width].astype(np.float64)
        values = _flattened(grey[r : r + height, c : c + width].astype(np.float64), weight)
        for target, part in ((total, values), (count, weight)):
            spectrum = fft.rfft2(part, padded)
            target += fft.irfft2(np.abs(spectrum) ** 2, padded)
        tiles += 1
    return total, np.maximum(np.round(count), 0.0), tiles


def _starts(size: int) -> list[int]:
    if size <= _TILE_PX:
        return [0]
    n = size // _TILE_PX
    return (
        [int(v) for v in np.linspace(0, size - _TILE_PX, n + 1)]
        if size % _TILE_PX
        else [k * _TILE_PX for k in range(n)]
    )


def _flattened(values: Float, weight: Float) -> Float:
    """Values less their quadratic over the tile, zero outside the region."""
    y, x = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in values.shape), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    inside = weight.ravel() > 0.0
    found = np.linalg.lstsq(terms[inside], values.ravel()[inside], rcond=None)[0]
    return np.asarray((values - (terms @ found).reshape(values.shape)) * weight)


def _even(line: Float) -> Float:
    """One half of a periodic, even line: the shifts 0, 1, 2 ..."""
    return line[: len(line) // 4]


def _at_zero(line: Float) -> float:
    """Height of the peak without the noise: of the Gaussian through shifts 1 and 2."""
    one, two = float(line[1]), float(line[2])
    return one * (one / two) ** (1.0 / 3.0) if one > two > 0.0 else float("nan")


def _half_at(line: Float, height: float) -> float:
    """Shift at which the peak has come down to half of its height; NaN if it does not within the line."""
    profile = np.concatenate([[height], line[1:]])
    below = np.flatnonzero(profile <= 0.5 * height)
    if not len(below) or not np.isfinite(profile[: below[0] + 1]).all():
        return float("nan")
    k = int(below[0])
    a, b = profile[k - 1], profile[k]
    return float(k - 1 + (a - 0.5 * height) / (a - b))
