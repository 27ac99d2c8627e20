"""Robust local linear fits to scattered matches, about many positions at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.region.neighbours import least_median
from stereorig.core.threads import run_ranges

_TRIPLETS = 48
_FLAT = 1e-2
_AT_ONCE = 256
_WIDER = 4  # times the number of neighbours is searched for those not separated from a position
_ENOUGH = 0.7  # share of the neighbours wanted

AreSeparated = Callable[[Float, Float], Bool]


class LocalFits(NamedTuple):
    """Linear maps about M positions.

    Attributes
    ----------
    value
        (M, d) the map at the position itself.
    slope
        (M, d, 2) its derivatives over x and y.
    spread
        (M,) median residual of the neighbours used, in units of the values; inf if no fit was possible.
    inliers
        (M,) number of neighbours that agree.
    distance
        (M,) distance of the farthest neighbour, px.
    """

    value: Float
    slope: Float
    spread: Float
    inliers: Float
    distance: Float


def robust_local_fits(
    centres: Float,
    points: Float,
    values: Float,
    *,
    neighbours: int = 14,
    tolerance: float,
    seed: int = 0,
    are_separated: AreSeparated | None = None,
) -> LocalFits:
    """Fit value = a + B (x - centre) to the nearest points by least median of squares, then least squares on inliers.

    Parameters
    ----------
    centres
        (M, 2) positions of the fits.
    points, values
        (N, 2) and (N, d) scattered samples, some of them wrong.
    neighbours
        Number of nearest points that take part.
    tolerance
        Residual up to which a neighbour counts as an inlier, in the values' unit.
    seed
        Seed of the random triplets: equal input gives equal output.
    are_separated
        Function of positions (n, 2) and (n, 2) that returns (n,) True for pairs with a cut between; samples across one
        do not take part.
    """
    m, d = len(centres), values.shape[1]
    k = min(neighbours, len(points))
    empty = LocalFits(np.full((m, d), np.nan), np.full((m, d, 2), np.nan), np.full(m, np.inf), np.zeros(m), np.zeros(m))
    if k < 4 or m == 0:
        return empty
    wide = k if are_separated is None else min(_WIDER * k, len(points))
    found, index = cKDTree(points).query(centres, k=wide)
    distance, seen = np.asarray(found), np.ones(m, bool)
    if are_separated is not None:
        over = are_separated(np.repeat(centres, wide, axis=0), points[index.ravel()]).reshape(m, wide)
        nearest = np.argsort(over, axis=1, kind="stable")[:, :k]
        distance, index, over = (np.take_along_axis(a, nearest, axis=1) for a in (distance, index, over))
        seen = (~over).sum(axis=1) >= _ENOUGH * k
        # the missing ones are replaced by the nearest one, which adds no information
        distance, index = np.where(over, distance[:, :1], distance), np.where(over, index[:, :1], index)
    x = points[index] - centres[:, None, :]  # (M, K, 2)
    v = values[index]
    scale = np.maximum(distance.max(axis=1), 1e-12)
    A = np.concatenate([np.ones((m, k, 1)), x / scale[:, None, None]], axis=2)

    rng = np.random.default_rng(seed)
    triplets = np.argsort(rng.random((_TRIPLETS, k)), axis=1)[:, :3]
    r, median = np.empty((m, k)), np.empty(m)
    arrays = (np.ascontiguousarray(A[:, :, 1:]), np.ascontiguousarray(v), triplets, _FLAT, r, median)
    run_ranges(lambda first, last: least_median(first, last, *arrays), m, _AT_ONCE)
    for _ in range(2):
        weight = (r < tolerance).astype(float)
        normal = np.einsum("mki,mk,mkj->mij", A, weight, A)
        enough = (weight.sum(axis=1) >= 4) & (np.abs(np.linalg.det(normal)) > 1e-3) & np.isfinite(median) & seen
        normal = np.where(enough[:, None, None], normal, np.eye(3))
        solution = np.linalg.solve(normal, np.einsum("mki,mk,mkd->mid", A, weight, v))
        r = np.linalg.norm(np.einsum("mki,mid->mkd", A, solution) - v, axis=2)
    spread = np.where(enough, np.median(np.where(weight > 0, r, np.nan_to_num(r.max())), axis=1), np.inf)
    solution = np.where(enough[:, None, None], solution, np.nan)
    slope = np.swapaxes(solution[:, 1:], 1, 2) / scale[:, None, None]
    return LocalFits(solution[:, 0], slope, spread, np.where(enough, weight.sum(axis=1), 0.0), distance.max(axis=1))


def consistent(points: Float, values: Float, *, tolerance: float, neighbours: int = 14) -> np.ndarray:
    """Return (N,) True for the samples that agree with the robust fit of their own neighbourhood."""
    if len(points) < 8:
        return np.zeros(len(points), bool)
    fits = robust_local_fits(points, points, values, neighbours=neighbours, tolerance=tolerance)
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(fits.value - values, axis=1) < tolerance
    return np.asarray(near & (fits.inliers >= 0.5 * min(neighbours, len(points))))
