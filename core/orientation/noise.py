"""Robust weights of offsets, and how many of them are independent: neighbouring subsets share pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight, median

_BLOCKS = 8
_FLOOR_PX = 1e-6


def robust_weights(residual_px: Float) -> tuple[Float, float]:
    """Return Tukey's weights (n,) of residuals about zero, and their standard deviation, px."""
    sigma = max(MAD_TO_SIGMA * median(np.abs(residual_px)), _FLOOR_PX)
    return biweight((residual_px / (BIWEIGHT_REACH * sigma)) ** 2), sigma


def blocks_of(xy_px: Float, step: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return (n,) the number of the block that a point lies in: 8 x 8 over each step's points."""
    low, high = xy_px.min(axis=0), xy_px.max(axis=0)
    cell = np.minimum((xy_px - low) / np.maximum(high - low, 1e-9) * _BLOCKS, _BLOCKS - 1).astype(np.int64)
    _, number = np.unique((step.astype(np.int64) * _BLOCKS + cell[:, 0]) * _BLOCKS + cell[:, 1], return_inverse=True)
    return np.asarray(number.ravel())


def effective_variance(design: Float, weights: Float, values: Float, blocks: NDArray[np.int64]) -> float:
    """Return the variance that one point has in a fit, px^2: larger than its own where neighbours are not independent.

    The scores' sums over blocks hold what neighbouring points have in common, from shared pixels or from a structure
    that the design does not follow: their mean square in the design's own metric replaces the points' variance.

    Parameters
    ----------
    design
        (n, k) derivatives of the values.
    weights, values, blocks
        (n,); what the design explains of the values is taken out first.
    """
    root = np.sqrt(weights)
    u, s, _ = np.linalg.svd(design * root[:, None], full_matrices=False)
    basis = u[:, s > 1e-9 * max(float(s[0]), 1e-300)]
    left = root * values
    left = left - basis @ (basis.T @ left)
    k, count = basis.shape[1], int(blocks.max()) + 1
    sums = np.stack([np.bincount(blocks, weights=column, minlength=count) for column in (basis * left[:, None]).T])
    shared = float((sums**2).sum()) / max(k, 1) * count / max(count - k, 1)
    own = float(left @ left) / max(float(weights.sum()) - k, 1.0)
    return float(max(shared, own, _FLOOR_PX**2))
