"""Validity checks: every point is compared with the points about it.

Four checks: correlation in each comparison, epipolar offset, agreement with the neighbours' patches, and the size of
the cluster that a point belongs to. Limits are multiples of robust standard deviations, so they follow noise, texture
and lens; the floors keep the second-best points of a nearly perfect field.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.checks.epipolar_mismatch import (
    EpipolarLimits,
    connected,
    epipolar_mismatches,
    neighbour_pairs,
)
from stereorig.core.field.checks.lost_correlation import CorrelationLimits, lost_correlation
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.scales import depth_per_px, px_per_ray
from stereorig.core.field.region.neighbours import N_QUANTITIES, compare_with_neighbours, sorting_network
from stereorig.core.field.region.visibility import Visibility
from stereorig.core.robust import MAD_TO_SIGMA, median
from stereorig.core.settings import DEFAULT_MAX_SIGMA_PX
from stereorig.core.status import PointStatus
from stereorig.core.threads import run_ranges

_FEW = 12
_NETWORK = sorting_network(24)
_ROWS_AT_ONCE = 4


@dataclass(frozen=True, kw_only=True)
class ValidityOptions:
    """Limits of the validity checks.

    Attributes
    ----------
    epipolar_sigmas
        Allowed distance from the epipolar offset that the neighbours show, in standard deviations.
    epipolar_floor_px
        Added to it, so that a noise-free field keeps its second-best points.
    correlation_sigmas
        Allowed excess of log(1 - zncc) over the loss of the points about a point, at its own texture, in robust
        standard deviations.
    correlation_min_factor, correlation_max_factor
        1 - zncc up to the first times that is never rejected; above the second always, apart from the loss by the view.
    neighbour_sigmas
        Allowed disagreement with the neighbours' patches, in robust standard deviations.
    neighbour_floor_px
        Added to it, as a distance in the images: curvature between neighbouring points must fit in.
    min_cluster
        Groups of fewer connected points are rejected.
    max_sigma_px
        Standard deviation of a point's match in any image, in depth too, beyond which a point whose residuals are not
        noise is rejected.
    """

    epipolar_sigmas: float = 5.0
    epipolar_floor_px: float = 0.005
    correlation_sigmas: float = 6.0
    correlation_min_factor: float = 2.0
    correlation_max_factor: float = 6.0
    neighbour_sigmas: float = 6.0
    neighbour_floor_px: float = 0.05
    min_cluster: int = 4
    max_sigma_px: float = DEFAULT_MAX_SIGMA_PX


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
    if not few:
        lost = lost_correlation(
            points,
            pair=pair,
            shape=shape,
            xy_px=xy_px,
            rays=rays,
            texture=texture,
            subset_px=subset_px,
            limits=CorrelationLimits(
                options.correlation_sigmas, options.correlation_min_factor, options.correlation_max_factor
            ),
        )
        points.reject(lost, PointStatus.LOW_CORRELATION)
    for _ in range(2):
        if _check_neighbours(points, pair, shape, rays, options, visibility, few=few) == 0:
            break
    if not few:
        _check_epipolar(points, shape, xy_px, subset_px, options, visibility)
        _check_clusters(points, shape, options, visibility)
    return before - int(points.ok.sum())


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
    points: PointFits,
    pair: StereoPair,
    shape: tuple[int, int],
    rays: Float,
    visibility: Visibility | None = None,
    scale: Float | None = None,
) -> tuple[Float, Float, NDArray[np.int32]]:
    """Return (n, 4) disagreement with the neighbours and its local spread in px, and the number of neighbours compared.

    The four are depth, by its effect in camera 2's image, and displacement along x, y and depth, likewise. ``scale`` is
    :func:`disagreement_scale` of the points, if it is known already.
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
    if scale is None:
        scale = disagreement_scale(pair, rays, np.where(points.ok, points.w[:, 0], np.nan))
    return difference.reshape(scale.shape) * scale, spread.reshape(scale.shape) * scale, count.reshape(n)


def disagreement_scale(pair: StereoPair, rays: Float, w0: Float) -> Float:
    """Return (n, 4) px per unit of the quantities compared between neighbours, at inverse depths (n,); NaN at NaN."""
    scale = np.full((len(w0), N_QUANTITIES), np.nan)
    ok = np.flatnonzero(np.isfinite(w0))
    if len(ok):
        scale[ok, 0] = scale[ok, 3] = w0[ok] / depth_per_px(pair, rays[ok], w0[ok])
        scale[ok, 1:3] = px_per_ray(pair, rays[ok])[:, 1:]
    return scale


def check_neighbours(
    points: PointFits,
    pair: StereoPair,
    shape: tuple[int, int],
    rays: Float,
    options: ValidityOptions,
    visibility: Visibility | None,
    scale: Float | None = None,
) -> int:
    """Reject points that disagree with their neighbours' patches; return their number.

    Parameters
    ----------
    points, pair, shape, rays, options, visibility
        As in :func:`apply_validity_checks`, of which this is one check.
    scale
        As in :func:`neighbour_disagreement`.
    """
    few = int(points.ok.sum()) < _FEW
    return _check_neighbours(points, pair, shape, rays, options, visibility, few=few, scale=scale)


def _check_neighbours(
    points: PointFits,
    pair: StereoPair,
    shape: tuple[int, int],
    rays: Float,
    options: ValidityOptions,
    visibility: Visibility | None,
    *,
    few: bool,
    scale: Float | None = None,
) -> int:
    difference, spread, count = neighbour_disagreement(points, pair, shape, rays, visibility, scale)
    ok = points.ok
    bad = np.zeros(len(ok), bool)
    used = ok & (count >= 2)
    for q in range(N_QUANTITIES if points.zncc.shape[1] == 3 else 1):
        d = np.abs(difference[used, q])
        if len(d) == 0:
            continue
        sigma = MAD_TO_SIGMA * median(d)
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
