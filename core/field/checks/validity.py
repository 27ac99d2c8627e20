"""Validity checks: every point is compared with the statistics of its own field.

Four checks: correlation in each comparison, epipolar offset, agreement with the neighbours' patches, and the size of
the cluster that a point belongs to. Limits are multiples of the field's own robust standard deviations, so they follow
noise, texture and lens; the floors keep the second-best points of a nearly perfect field.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.field.checks.epipolar_mismatch import EpipolarLimits, epipolar_mismatches
from core.field.checks.groups import connected, neighbour_pairs
from core.field.points.fitter import PointFits
from core.field.points.starts import depth_per_px
from core.field.region.neighbours import N_QUANTITIES, compare_with_neighbours, sorting_network
from core.field.region.trend import smooth_terms
from core.field.region.visibility import Visibility
from core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight, spread_indices
from core.status import PointStatus
from core.threads import run_ranges

_FEW = 12
_NETWORK = sorting_network(24)
_ROWS_AT_ONCE = 4
_SETTLED = 0.01  # of the standard deviation: a robust fit that moves less has converged
_TREND_POINTS = 3000  # for a trend of seven terms: its standard deviation is then a twentieth of the points' own


@dataclass(frozen=True, kw_only=True)
class ValidityOptions:
    """Limits of the validity checks.

    Attributes
    ----------
    epipolar_sigmas
        Allowed distance from the field's smooth epipolar offset, in its robust standard deviations.
    epipolar_floor_px
        Added to it, so that a noise-free field keeps its second-best points.
    correlation_sigmas
        Allowed excess of log(1 - zncc) over its trend with texture and position, in robust standard deviations.
    correlation_min_factor, correlation_max_factor
        1 - zncc up to the first times its expectation is never rejected; above the second always.
    neighbour_sigmas
        Allowed disagreement with the neighbours' patches, in robust standard deviations.
    neighbour_floor_px
        Added to it, as a distance in the images: curvature between neighbouring points must fit in.
    min_cluster
        Groups of fewer connected points are rejected.
    max_sigma_px
        Standard deviation of a point's position in camera 1, px, from its residuals, beyond which a point whose
        residuals are not noise is rejected: five times as much is half a pixel.
    max_depth_sigma_px
        The same of its position in camera 2, which determines the depth and counts several times there.
    """

    epipolar_sigmas: float = 5.0
    epipolar_floor_px: float = 0.005
    correlation_sigmas: float = 6.0
    correlation_min_factor: float = 1.35
    correlation_max_factor: float = 12.0
    neighbour_sigmas: float = 6.0
    neighbour_floor_px: float = 0.05
    min_cluster: int = 4
    max_sigma_px: float = 0.1
    max_depth_sigma_px: float = 0.05


def apply_validity_checks(
    points: PointFits,
    *,
    pair: StereoPair,
    shape: tuple[int, int],
    xy_px: Float,
    rays: Float,
    texture: Float,
    subset_px: int,
    options: ValidityOptions,
    visibility: Visibility | None = None,
) -> int:
    """Apply all checks, rejecting points in place.

    Parameters
    ----------
    points
        n = rows x columns points of the grid, row by row.
    pair
        The calibrated cameras.
    shape
        Rows and columns of the grid.
    xy_px, rays
        (n, 2) px and (n, 3) normalised, of the points.
    texture
        (n,) grey-level variance of camera 1's subset.
    subset_px
        Width of the subset.
    options
        Limits.
    visibility
        Which points are neighbours across cuts and mask; None: all.

    Returns
    -------
    int
        Number of points rejected.
    """
    before = int(points.ok.sum())
    few = before < _FEW
    terms = smooth_terms(xy_px)
    if not few:
        _check_correlation(points, terms, texture, options)
    for _ in range(2):
        if _check_neighbours(points, pair, shape, rays, options, visibility, few=few) == 0:
            break
    if not few:
        _check_epipolar(points, shape, xy_px, subset_px, options, visibility)
        _check_clusters(points, shape, options, visibility)
    return before - int(points.ok.sum())


def _check_correlation(points: PointFits, terms: Float, texture: Float, options: ValidityOptions) -> None:
    ok = np.flatnonzero(points.ok)
    if len(ok) < _FEW:
        return
    trend = np.column_stack([_at_points(terms, ok), np.log(np.maximum(texture[ok], 1e-6))])
    worst = np.full(len(ok), -np.inf)
    for k in range(points.zncc.shape[1]):
        y = np.log(np.maximum(1.0 - points.zncc[ok, k], 1e-7))
        r, sigma = _robust_residual(trend, y)
        limit = np.clip(
            options.correlation_sigmas * sigma,
            np.log(options.correlation_min_factor),
            np.log(options.correlation_max_factor),
        )
        worst = np.maximum(worst, r - limit)
    points.reject(_at(points, ok[worst > 0.0]), PointStatus.LOW_CORRELATION)


def _check_epipolar(
    points: PointFits,
    shape: tuple[int, int],
    xy_px: Float,
    subset_px: int,
    options: ValidityOptions,
    visibility: Visibility | None,
) -> None:
    off = epipolar_mismatches(
        points.epipolar_px,
        points.epipolar_sigma_px,
        points.ok,
        xy_px=xy_px,
        shape=shape,
        subset_px=subset_px,
        limits=EpipolarLimits(options.epipolar_sigmas, options.epipolar_floor_px),
        visibility=visibility,
    )
    points.reject(off, PointStatus.EPIPOLAR_MISMATCH)


def neighbour_disagreement(
    points: PointFits, pair: StereoPair, shape: tuple[int, int], rays: Float, visibility: Visibility | None = None
) -> tuple[Float, Float, NDArray[np.int32]]:
    """Return (n, 4) disagreement with the neighbours and its local spread in px, and the number of neighbours compared.

    The four are depth, by its effect in camera 2's image, and displacement along x, y and depth, likewise.
    """
    rows, cols = shape
    n = rows * cols
    difference = np.full((rows, cols, N_QUANTITIES), np.nan)
    spread = np.full((rows, cols, N_QUANTITIES), np.nan)
    count = np.zeros((rows, cols), np.int32)
    motion = points.zncc.shape[1] == 3
    separated = np.zeros((0, 0), np.uint32) if visibility is None else visibility.separated
    arrays = (
        _NETWORK,
        points.ok.reshape(shape),
        separated,
        np.ascontiguousarray(rays.reshape(rows, cols, 3)),
        np.ascontiguousarray(points.w.reshape(rows, cols, -1)),
        np.ascontiguousarray(points.G.reshape(rows, cols, 3, -1)),
        motion,
        difference,
        spread,
        count,
    )
    run_ranges(lambda first, last: compare_with_neighbours(first, last, *arrays), rows, _ROWS_AT_ONCE)
    scale = np.full((n, N_QUANTITIES), np.nan)
    ok = np.flatnonzero(points.ok)
    if len(ok):
        w0 = points.w[ok, 0]
        scale[ok, 0] = scale[ok, 3] = w0 / depth_per_px(pair, rays[ok], w0)
        J = pair.cam1.lens.image_jacobian(rays[ok, :2])
        scale[ok, 1], scale[ok, 2] = np.linalg.norm(J[:, :, 0], axis=1), np.linalg.norm(J[:, :, 1], axis=1)
    return difference.reshape(scale.shape) * scale, spread.reshape(scale.shape) * scale, count.reshape(n)


def _check_neighbours(
    points: PointFits,
    pair: StereoPair,
    shape: tuple[int, int],
    rays: Float,
    options: ValidityOptions,
    visibility: Visibility | None,
    *,
    few: bool,
) -> int:
    difference, spread, count = neighbour_disagreement(points, pair, shape, rays, visibility)
    ok = points.ok
    bad = np.zeros(len(ok), bool)
    used = ok & (count >= 2)
    for q in range(N_QUANTITIES if points.zncc.shape[1] == 3 else 1):
        d = np.abs(difference[used, q])
        if len(d) == 0:
            continue
        sigma = MAD_TO_SIGMA * float(np.median(d))
        limit = options.neighbour_sigmas * np.hypot(sigma, MAD_TO_SIGMA * spread[used, q]) + options.neighbour_floor_px
        bad[np.flatnonzero(used)[d > limit]] = True
    if not few:
        bad |= ok & (count < 2)  # isolated points fail the check
    points.reject(bad, PointStatus.NEIGHBOUR_MISMATCH)
    return int(bad.sum())


def _check_clusters(
    points: PointFits, shape: tuple[int, int], options: ValidityOptions, visibility: Visibility | None
) -> None:
    if visibility is not None:
        group = connected(len(points.ok), *neighbour_pairs(points.ok, shape, visibility))
        points.reject(points.ok & (np.bincount(group)[group] < options.min_cluster), PointStatus.NEIGHBOUR_MISMATCH)
        return
    n, labels, stats, _ = cv2.connectedComponentsWithStats(points.ok.reshape(shape).astype(np.uint8), connectivity=8)
    if n < 2:
        return
    size = stats[:, cv2.CC_STAT_AREA].copy()
    size[0] = options.min_cluster
    points.reject((size[labels] < options.min_cluster).ravel(), PointStatus.NEIGHBOUR_MISMATCH)


def _at_points(terms: Float, ok: NDArray[np.intp]) -> Float:
    return terms[ok] if len(ok) > 60 else terms[ok, :1]


def _robust_residual(design: Float, values: Float) -> tuple[Float, float]:
    """Return residuals about a robust linear fit (Tukey's biweight) and their robust standard deviation.

    Of many points a few thousand are fitted, spread over all of them by multiples of the golden section.
    """
    n = len(values)
    some = slice(None) if n <= _TREND_POINTS else np.sort(spread_indices(n, _TREND_POINTS))
    terms, wanted = design[some], values[some]
    part = wanted - np.median(wanted)
    for _ in range(6):
        sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(part - np.median(part)))), 1e-12)
        weighted = terms * biweight((part / (BIWEIGHT_REACH * sigma)) ** 2)[:, None]
        solution = np.linalg.lstsq(weighted.T @ terms, weighted.T @ wanted, rcond=1e-9)[0]
        last, part = part, wanted - terms @ solution
        if np.abs(part - last).max() < _SETTLED * sigma:
            break
    residual = values - design @ solution
    sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), 1e-12)
    return residual, sigma


def _at(points: PointFits, index: NDArray[np.intp]) -> Bool:
    mask = np.zeros(len(points.status), bool)
    mask[index] = True
    return mask
