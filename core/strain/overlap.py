"""How the errors of neighbouring points go together, because their subsets share pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def neighbour_correlation(dx_px: Float, dy_px: Float, subset_px: int, *, curved: bool = False) -> Float:
    """Correlation of the errors of two points whose subsets lie so far apart.

    A match is a weighted mean of its pixels' noise: with plane patches all pixels of the subset weigh alike and the
    correlation is the share of common pixels; with curved patches the second-order terms make the weight in the middle
    of the subset larger and at its border negative, and the correlation is that of these weights.

    Parameters
    ----------
    dx_px, dy_px
        Distances, any shape; rounded to whole pixels.
    subset_px
        Width of the subset.
    curved
        True for second-order patches.
    """
    x = (np.arange(subset_px) - subset_px // 2) / (0.5 * subset_px)
    bulge = 0.5 * (3.0 * x**2 - 1.0)  # the second Legendre polynomial, -1/2 in the middle
    weight = 1.0 - (2.5 * (bulge[:, None] + bulge[None, :]) if curved else np.zeros((subset_px, subset_px)))
    size = 2 * subset_px
    power = np.abs(np.fft.fft2(weight, (size, size))) ** 2
    shared = np.fft.ifft2(power).real / float((weight**2).sum())
    kx, ky = (np.abs(np.rint(d)).astype(np.int64) for d in (dx_px, dy_px))
    apart = (kx >= subset_px) | (ky >= subset_px)
    return np.where(apart, 0.0, shared[np.where(apart, 0, ky), np.where(apart, 0, kx)])
