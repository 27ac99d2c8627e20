"""Points whose epipolar offset differs from their neighbours': wrong matches.

A lens that is modelled a little wrong, or cameras that moved, put all points off their epipolar lines, by offsets of
any smooth shape. So a point is compared only with the points about it, and only a change that a lens cannot cause
counts: an offset that jumps from one point to the next. Right points of two parts, on both sides of a crack or behind
an edge, may differ by the change of the misfit from one place in an image to another. Wrong matches that agree with one
another share their pixels: their group is smaller than a subset, and is compared with its surroundings.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.block_median import block_medians, reach_of, spacing_of
from stereorig.core.field.checks.local_surface import SurfacePrediction, predict_from_neighbours
from stereorig.core.field.region.visibility import Visibility
from stereorig.core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight, median

STEEPEST = 0.003
"""px of offset a px of the image that a misfit changes by: a pixel at the corner of a lens of 5th degree."""
_BENDING_PX = 100.0  # px of the image over which a misfit may become so steep
_STEP_PX = 0.1  # between parts of a field at different depths: a lens misfit at two places in camera 2's image
_SMALL_STEP_PX = 0.02  # for a group smaller than a subset, which is one match that many points share
_ROUNDS = 4
_SWEEPS = 4  # of the robust fit's weights
_FEW = 12
_SUPPORT = 1.0  # variance of a prediction over a point's own, up to which it is a test
_NOISIER = 3.0  # multiple of the field's scatter: with a larger one, the points about a point are not used to judge it
# least part that is a side of a step: share of the points about a point, and width in subsets
_SIDE, _SIDE_SUBSETS = 0.25, 1.5
_MOST_PX = 0.5
_TINY_PX = 1e-6


class EpipolarLimits(NamedTuple):
    """Allowed difference from the neighbours' offset: so many standard deviations, and a floor, px."""

    sigmas: float
    floor_px: float


def epipolar_mismatches(
    offset_px: Float,
    sigma_px: Float,
    ok: Bool,
    *,
    xy_px: Float,
    shape: tuple[int, int],
    subset_px: int,
    limits: EpipolarLimits,
    visibility: Visibility | None = None,
) -> Bool:
    """Return (n,) True for valid points whose epipolar offset differs from their neighbours'.

    Parameters
    ----------
    offset_px, sigma_px
        (n,) offset across the epipolar line and its reported standard deviation, of points row by row.
    ok
        (n,) True for valid points.
    xy_px
        (n, 2) their positions in camera 1.
    shape
        Rows and columns.
    subset_px
        Width of the subset: points that are nearer to one another share pixels.
    limits
        Allowed distance.
    visibility
        Which points are neighbours across cuts and mask; None: all.
    """
    left = ok.copy()
    for _ in range(_ROUNDS):
        if left.sum() < _FEW:
            break
        bad = _off(offset_px, sigma_px, left, xy_px, shape, subset_px, limits, visibility)
        if not bad.any():
            break
        left &= ~bad
    return np.asarray(ok & ~left)


def _off(
    offset_px: Float,
    sigma_px: Float,
    ok: Bool,
    xy_px: Float,
    shape: tuple[int, int],
    subset_px: int,
    limits: EpipolarLimits,
    visibility: Visibility | None,
) -> Bool:
    spacing = spacing_of(xy_px, shape)
    width = subset_px / spacing
    reach = reach_of(subset_px, spacing)
    e = np.where(ok, offset_px, 0.0)
    e -= np.where(ok, median(e[ok]), 0.0)
    sigma = np.where(ok, np.maximum(sigma_px, _TINY_PX), 1.0)
    slope_px = STEEPEST * reach * spacing
    bend_px = 0.5 * slope_px * reach * spacing / _BENDING_PX

    def prior(usual_px: float) -> dict[str, float]:
        return {"slope_precision": (usual_px / slope_px) ** 2, "bend_precision": (usual_px / bend_px) ** 2}

    # groups without a jump between neighbours, apart from the slope of the surface through all points
    reported = median(sigma[ok])
    at_first = predict_from_neighbours(
        e.reshape(shape), _precision(sigma, reported, ok).reshape(shape), reach, **prior(reported)
    )
    level = e - at_first.value.ravel()
    first, second = neighbour_pairs(ok, shape, visibility)
    jump, noise = np.abs(level[first] - level[second]), np.hypot(sigma[first], sigma[second])
    noisier = max(1.0, MAD_TO_SIGMA * median(jump / noise)) if len(jump) else 1.0
    sigma, usual = noisier * sigma, noisier * reported
    linked = jump <= limits.sigmas * noisier * noise + limits.floor_px
    group = connected(len(ok), first[linked], second[linked])
    size = np.asarray(np.bincount(group, weights=ok), np.float64)
    large = size >= min(max(width**2, float(_FEW)), size.max())
    precision = _precision(sigma, usual, ok)
    # every point is compared with the nearest large group's surface, points of a large group with their own group's
    predicted, variance = np.zeros(len(ok)), np.full(len(ok), np.inf)
    scatter = np.ones(len(ok))
    for g in np.flatnonzero(large):
        own = group == g
        same = noisier == 1.0 and own[ok].all()  # the fit over all points was made at first
        value, spread = _surface(
            e, sigma, np.where(own, precision, 0.0), shape, reach, usual, prior(usual), at_first if same else None
        )
        judged = ok & (own | (~large[group] & (spread < variance)))
        predicted[judged], variance[judged] = value[judged], spread[judged]
    supported = ok & (variance < _SUPPORT)
    scale = np.hypot(sigma, usual * np.sqrt(np.where(supported, variance, 0.0)))
    residual = e - predicted
    scatter = _local_scatter(residual / scale, supported & large[group], shape, reach)
    limit = np.minimum(limits.sigmas * scatter * scale + limits.floor_px, _MOST_PX)
    bad = supported & (np.abs(residual) > limit)
    near = np.flatnonzero(bad & (np.abs(residual) < limit + _STEP_PX))
    bad[_on_a_side(e, ok, near, limit, shape, reach, width)] = False
    bad |= _level_jumps(e, ok & ~bad, xy_px, group, size, large, supported, limits.sigmas * usual + limits.floor_px)
    return np.asarray(bad)


def _precision(sigma: Float, usual: float, ok: Bool) -> Float:
    return np.where(ok, np.clip((usual / sigma) ** 2, 1e-2, 4.0), 0.0)


def _surface(
    e: Float,
    sigma: Float,
    precision: Float,
    shape: tuple[int, int],
    reach: int,
    usual: float,
    prior: dict[str, float],
    first: SurfacePrediction | None,
) -> tuple[Float, Float]:
    """Robust surface of a group's points: value (n,), and its variance over ``usual`` squared.

    ``first`` is the prediction from all neighbours with full weights, if it is already known.
    """
    weights = precision
    for sweep in range(_SWEEPS):
        if sweep > 0 or first is None:
            found = predict_from_neighbours(e.reshape(shape), weights.reshape(shape), reach, **prior)
        else:
            found = first
        value, variance = found.value.ravel(), found.variance.ravel()
        if sweep == _SWEEPS - 1:
            break
        scale = np.hypot(sigma, usual * np.sqrt(variance))
        if sweep == 0:
            scale *= _local_scatter((e - value) / scale, precision > 0.0, shape, reach)
        settled = biweight(((e - value) / (BIWEIGHT_REACH * scale)) ** 2)
        if sweep == 0 and settled[precision > 0.0].min(initial=1.0) > 0.0:
            break  # no point is off
        weights = precision * settled
    return value, variance


def _local_scatter(scaled: Float, known: Bool, shape: tuple[int, int], reach: int) -> Float:
    """Return (n,) the robust scatter of the points about each, over the expected one; from 1 to three times."""
    middle = block_medians(np.abs(scaled), known, shape, reach, otherwise=1.0)
    return np.clip(MAD_TO_SIGMA * middle, 1.0, _NOISIER)


def _on_a_side(
    e: Float, ok: Bool, index: Indices, limit: Float, shape: tuple[int, int], reach: int, width: float
) -> Indices:
    """Return the points that agree with more of the points about them than a single wrong match could cover.

    Next to a step that is hardly larger than the noise, the surface through all points follows the larger side.
    """
    if len(index) == 0:
        return index
    cols = shape[1]
    padded = np.pad(np.where(ok, e, np.nan).reshape(shape), reach, constant_values=np.nan)
    r, c = np.divmod(index, cols)
    steps = np.arange(2 * reach + 1)
    agree = np.empty(len(index), bool)
    at_once = max(1, 1_000_000 // len(steps) ** 2)
    for first in range(0, len(index), at_once):
        part = slice(first, first + at_once)
        about = padded[r[part, None, None] + steps[:, None], c[part, None, None] + steps]
        # the misfit's own slope: a median, which neither a step nor wrong points move
        along, down = _middle(np.diff(about, axis=2)), _middle(np.diff(about, axis=1))
        flat = about - along[:, None, None] * (steps - reach) - down[:, None, None] * (steps[:, None] - reach)
        near = np.abs(flat - e[index[part], None, None]) < limit[index[part], None, None]
        count = near.sum(axis=(1, 2)) - 1
        agree[part] = count >= np.maximum(_SIDE * np.isfinite(about).sum(axis=(1, 2)), _SIDE_SUBSETS * width**2)
    return index[agree]


def _middle(differences: Float) -> Float:
    """Median (m,) over windows, zero for windows without known values."""
    flat = np.sort(differences.reshape(len(differences), -1), axis=1)  # unknown values are sorted to the end
    known = np.isfinite(flat).sum(axis=1)
    return np.where(known > 0, flat[np.arange(len(flat)), known // 2 - (known > 0) * (known % 2 == 0)], 0.0)


def _level_jumps(
    e: Float,
    ok: Bool,
    xy_px: Float,
    group: NDArray[np.int32],
    size: Float,
    large: Bool,
    supported: Bool,
    noise_px: float,
) -> Bool:
    """Return (n,) True for groups that differ from the points nearest to them by more than any misfit changes."""
    bad = np.zeros(len(ok), bool)
    order = np.argsort(-size, kind="stable")
    accepted: Indices = np.flatnonzero(ok & (group == order[0]))
    small = np.flatnonzero(ok & ~large[group] & ~supported)
    if len(accepted) == 0:
        return bad
    for g in order[1 : int(large.sum())]:
        members = np.flatnonzero(ok & (group == g))
        if len(members) == 0:
            continue
        jump, apart = _nearest_jumps(e, xy_px, members, accepted)
        near = apart <= np.quantile(apart, 0.25)
        if abs(np.median(jump[near])) > noise_px + _STEP_PX + STEEPEST * float(np.median(apart[near])):
            bad[members] = True
        else:
            accepted = np.concatenate([accepted, members])
    if len(small):
        jump, apart = _nearest_jumps(e, xy_px, small, accepted)
        bad[small] = np.abs(jump) > noise_px + _SMALL_STEP_PX + STEEPEST * apart
    return bad


def _nearest_jumps(e: Float, xy_px: Float, members: Indices, accepted: Indices) -> tuple[Float, Float]:
    """Offset of each member less the median of the accepted points nearest to it, px, and their distance, px."""
    count = min(9, len(accepted))
    distance, nearest = cKDTree(xy_px[accepted]).query(xy_px[members], k=count)
    distance, nearest = np.reshape(distance, (len(members), count)), np.reshape(nearest, (len(members), count))
    return e[members] - np.median(e[accepted[nearest]], axis=1), np.asarray(distance.mean(axis=1))


# Groups of points of a grid that are connected through neighbours, none across a cut.

Indices = NDArray[np.intp]


def neighbour_pairs(ok: Bool, shape: tuple[int, int], visibility: Visibility | None) -> tuple[Indices, Indices]:
    """Return the indices (m,), (m,) of the pairs of neighbouring points of which both are ``ok`` and see each other."""
    rows, cols = shape
    index = np.arange(rows * cols).reshape(shape)
    first, second = [], []
    for dr, dc in ((0, 1), (1, -1), (1, 0), (1, 1)):
        here = index[: rows - dr, max(-dc, 0) : cols - max(dc, 0)].ravel()
        there = here + dr * cols + dc
        together = ok[here] & ok[there]
        if visibility is not None:
            together &= ~visibility.separated_at(dr, dc)[here]
        first.append(here[together])
        second.append(there[together])
    return np.concatenate(first), np.concatenate(second)


def connected(n: int, first: Indices, second: Indices) -> NDArray[np.int32]:
    """Label (n,) the groups of points that pairs connect; a point in no pair is a group of its own."""
    graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int32)
