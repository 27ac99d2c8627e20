"""Robust weights of offsets, and how many of them are independent: neighbouring subsets share pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.orientation.matched import MatchedPoints
from stereorig.core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight, median, spread_indices

if TYPE_CHECKING:
    from scipy.sparse import csr_array


_BLOCKS = 8
_FLOOR_PX = 1e-6
_PAIRED = 2000  # points among which overlaps are counted: more add no information


def robust_weights(residual_px: Float) -> tuple[Float, float]:
    """Return Tukey's weights (n,) of residuals about zero, and their standard deviation, px."""
    sigma = max(MAD_TO_SIGMA * median(np.abs(residual_px)), _FLOOR_PX)
    return biweight((residual_px / (BIWEIGHT_REACH * sigma)) ** 2), sigma


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """Noise that matched points share with their neighbours.

    Two subsets share the part of their pixels by which they overlap, and as much of their noise. Over a field of many
    subsets, sums over blocks show that and any other structure; if a block is no wider than a subset they do not, and
    only the overlap is used.

    Attributes
    ----------
    blocks
        (n,) number of the block that contains a point: 8 x 8 over each step's points.
    overlap
        (n, n) sparse, share of their pixels by which the subsets of two points overlap; zero on the diagonal.
    one_of
        Number of points that one of the examined points represents.
    """

    blocks: NDArray[np.int64]
    overlap: csr_array
    one_of: float

    @staticmethod
    def of(points: MatchedPoints) -> SharedNoise:
        """Look at points of one or several steps."""
        from scipy.sparse import csr_array  # slow to load, and not every start needs it
        from scipy.spatial import cKDTree  # slow to load, and not every start needs it

        n, width = len(points.xy1_px), points.subset_px
        some = np.arange(n) if n <= _PAIRED else np.unique(spread_indices(n, _PAIRED))
        # subsets of two steps get the distance of two subsets that do not overlap
        at = np.column_stack([points.xy1_px[some], points.step[some] * (2.0 * width)])
        near = cKDTree(at).query_pairs(width, p=np.inf, output_type="ndarray") if width > 0 else np.empty((0, 2), int)
        one, two = some[near].reshape(-1, 2).T
        apart = np.abs(points.xy1_px[one] - points.xy1_px[two])
        share = np.prod(1.0 - np.minimum(apart / max(width, 1), 1.0), axis=1)
        half = csr_array((share, (one, two)), shape=(n, n))
        return SharedNoise(_blocks(points), half + half.T, (n - 1) / max(len(some) - 1, 1))

    def metric(self, basis: Float) -> Float:
        """Return (k, k) B' R B of columns (n, k), with the correlation R that the overlaps give the points' noise."""
        return np.asarray(basis.T @ basis + self.one_of**2 * (basis.T @ (self.overlap @ basis)))

    def degrees(self, spent: float) -> float:
        """Degrees of freedom that a variance from all points has, ``spent`` of their squares taken by a fit."""
        n = len(self.blocks)
        squares = n + self.one_of**2 * float((self.overlap.data**2).sum())
        return max(n - spent, 1.0) ** 2 / squares


def _blocks(points: MatchedPoints) -> NDArray[np.int64]:
    low, high = points.xy1_px.min(axis=0), points.xy1_px.max(axis=0)
    cell = (points.xy1_px - low) / np.maximum(high - low, 1e-9) * _BLOCKS
    cell = np.minimum(cell, _BLOCKS - 1).astype(np.int64)
    number = (points.step.astype(np.int64) * _BLOCKS + cell[:, 0]) * _BLOCKS + cell[:, 1]
    return np.asarray(np.unique(number, return_inverse=True)[1].ravel())


def effective_variance(design: Float, weights: Float, values: Float, shared: SharedNoise) -> float:
    """Return one point's effective variance in a fit, px^2: larger than its own if neighbours are not independent.

    The scores' sums over blocks contain the common errors of neighbouring points, from shared pixels or from a
    structure that the design does not follow: their mean square in the design's own metric replaces the points'
    variance. It is never less than the variance that follows from the overlap of their subsets.

    Parameters
    ----------
    design
        (n, k) derivatives of the values.
    weights, values
        (n,); the part of the values that the design explains is subtracted first.
    shared
        Shared noise of these points.
    """
    root = np.sqrt(weights)
    u, s, _ = np.linalg.svd(design * root[:, None], full_matrices=False)
    basis = u[:, s > 1e-9 * max(float(s[0]), 1e-300)]
    left = root * values
    left = left - basis @ (basis.T @ left)
    k, count = basis.shape[1], int(shared.blocks.max()) + 1
    sums = np.stack(
        [np.bincount(shared.blocks, weights=column, minlength=count) for column in (basis * left[:, None]).T]
    )
    seen = float((sums**2).sum()) / max(k, 1) * count / max(count - k, 1)
    spent = float(np.trace(shared.metric(basis)))
    own = float(left @ left) / max(float(weights.sum()) - spent, 1.0) * spent / max(k, 1)
    return float(max(seen, own, _FLOOR_PX**2))


# Smooth structure in offsets beyond their noise.


def structure_left_px(points: MatchedPoints, offset_px: Float, *, order: int) -> float:
    """Return the root mean square of the polynomial of some order in offsets (n,), less the noise's part.

    Each step has a polynomial of its own: a step's points are at other places and depths.
    """
    square, count = 0.0, 0
    for step in np.unique(points.step):
        of_step = points.step == step
        terms = smooth_terms(points.xy1_px[of_step])
        if order > 2:
            x, y = terms[:, 1], terms[:, 2]
            terms = np.column_stack([terms, x**3, x * x * y, x * y * y, y**3])
        values = offset_px[of_step]
        if len(values) < 4 * terms.shape[1]:
            terms = terms[:, :1]
        weights = np.ones(len(values))
        for _ in range(4):
            smooth = (
                terms @ np.linalg.lstsq(terms * np.sqrt(weights)[:, None], values * np.sqrt(weights), rcond=1e-9)[0]
            )
            weights, _ = robust_weights(values - smooth)
        by_noise = effective_variance(terms, weights, values, SharedNoise.of(points.at(of_step))) * terms.shape[1]
        square += max(float((smooth**2).sum()) - by_noise, 0.0)
        count += len(values)
    return float(np.sqrt(square / max(count, 1)))
