"""Scatter of displacements about their neighbours' trend, compared with the reported standard deviation.

The change of a texture by blur at t moves grey levels across a subset's border only. A covariance from parts of the
subset also counts the flow across inner borders, and is up to two times too large. The scatter between subsets without
common pixels does not contain inner borders: differences of second and third order of displacements that no linear
motion explains. A rough motion scatters more by itself, so a standard deviation is lowered to the observed scatter, but
raised little.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.starts import current_position
from stereorig.core.matching.geometry import covariance_xyzuvw

_APART_PX = 11.0  # between subsets of one difference: two large speckles, which they do not share
_MIN_INDEPENDENT = 40.0  # neighbouring subsets without common pixels: the standard deviation is then known to some 10 %
_FEW_INDEPENDENT, _CLEARLY_LESS = 10.0, 0.75  # sufficient for a direction that scatters less, and its ratio
_QUANTILES, _OF_NORMAL = (0.8, 0.95, 0.99), (1.2816, 1.96, 2.5758)  # localised strain and wrong matches are beyond 0.8
_UNCERTAINTY = 1.03  # relative uncertainty of a standard deviation from so many points
_AS_REPORTED = (0.92, 1.08)  # within, nothing is changed
_MAX_RAISE = 2.0
_CALM, _OF_NORMAL_CALM = 0.25, 0.3186  # quantile that strain in half of the field leaves alone
_SURELY_CALM = 3.6  # two standard deviations of that quantile over its value, of one difference
_FLAT = 1e-2  # extent along the normal, of the largest, that is none
_NEAR_PX = 5.5  # between subsets of a difference of sixth order: a good speckle, so that the motion has little room
_BENDS = 1.25  # ratio of scatters with and without bends: for subsets this near the common part of the noise is smaller
_DROPS = 2.0  # the same ratio, from ten differences on: the quantile of so few is known to a quarter
_DIFFERENCES = ((1.0, -2.0, 1.0), (1.0, -3.0, 3.0, -1.0))


def observed_over_reported(
    pair: StereoPair, points: PointFits, index: NDArray[np.intp], xy_px: Float, shape: tuple[int, int], subset_px: int
) -> Float:
    """Return the observed over the reported standard deviation of u, v, w of a motion's points.

    Parameters
    ----------
    pair, points
        The cameras, and (n,) points, n = rows x columns, with their covariances.
    index
        Indices of the points used.
    xy_px
        (n, 2) px of camera 1.
    shape
        Rows and columns.
    subset_px
        Subset size.

    Returns
    -------
    Float
        (3,) ratios, system frame; NaN if too few points are usable.
    """
    which = _known(points, index)
    spacing = _spacing(xy_px.reshape(*shape, 2))
    if not can_be_observed(xy_px.reshape(*shape, 2), np.flatnonzero(which), subset_px):
        return np.full(3, np.nan)
    off, variance = _off_linear(pair, points, which, xy_px, shape)
    area = min(1.0, (spacing / subset_px) ** 2)
    out = np.full((len(_DIFFERENCES), 3), np.nan)
    least, at_most = np.full(3, np.inf), np.full(3, np.inf)
    for i, weights in enumerate(_DIFFERENCES):
        by_direction = _differences(off, variance, int(np.ceil((subset_px + _APART_PX) / spacing)), np.array(weights))
        ratio = np.concatenate([np.zeros((0, 3)), *by_direction])
        if len(ratio) * area >= _MIN_INDEPENDENT:
            scale = np.quantile(np.abs(ratio), _QUANTILES, axis=0) / np.array(_OF_NORMAL)[:, None]
            # points of unlike noise have wide tails: lowered no further than these, raised by the bulk
            out[i] = np.maximum(scale[0], np.minimum(_UNCERTAINTY * scale.max(axis=0), 1.0))
        for one in by_direction:
            if len(one) * area >= _FEW_INDEPENDENT:
                calm = _UNCERTAINTY * np.quantile(np.abs(one), _CALM, axis=0) / _OF_NORMAL_CALM
                least = np.minimum(least, calm)
                at_most = np.minimum(at_most, (1.0 + _SURELY_CALM / np.sqrt(len(one) * area)) * calm)
    found = np.fmin(out[0], out[1])
    # noise scatters alike in all directions and nearly everywhere, localised strain does not: that raises nothing
    found = np.where((found > 1.0) & (at_most < _CLEARLY_LESS * found), np.maximum(least, 1.0), found)
    moves = np.zeros(3, bool)
    if (found > _AS_REPORTED[1]).any():
        # a bending motion is no scatter: in the sixth order little of it remains
        if which.sum() < points.ok.sum():  # a difference has sixteen points: of a part of them there are few
            off, variance = _off_linear(pair, points, points.ok, xy_px, shape)
        for weights in reversed(_DIFFERENCES):  # a field with gaps has more places for nine points than for sixteen
            ratio = _mixed_differences(off, variance, int(np.ceil((subset_px + _NEAR_PX) / spacing)), np.array(weights))
            if len(ratio) * area < _FEW_INDEPENDENT:
                continue
            left = np.maximum(np.quantile(np.abs(ratio), _QUANTILES[0], axis=0) / _OF_NORMAL[0], 1.0)
            moves |= (found > _MAX_RAISE) & (found > _DROPS * left)
            if len(ratio) * area >= _MIN_INDEPENDENT:
                found = np.where(found > _BENDS * left, left, found)
                break
    # no noise scatters more over a longer distance: directions that move evenly show how much it does
    even = found <= _MAX_RAISE
    if even.any():
        found[moves & ~even] = max(1.0, found[even].max())
    return np.asarray(found)


def _off_linear(
    pair: StereoPair, points: PointFits, which: Bool, xy_px: Float, shape: tuple[int, int]
) -> tuple[Float, Float]:
    """Displacements less the linear motion, and their variances, (r, c, 3); NaN outside the points ``which`` (n,)."""
    off, variance = np.full((len(xy_px), 3), np.nan), np.full((len(xy_px), 3), np.nan)
    xy, w, G = xy_px[which], points.w[which], points.G[which]
    covariance = covariance_xyzuvw(pair, xy, w, G, points.covariance[which])
    variance[which] = np.diagonal(covariance, axis1=1, axis2=2)[:, 3:]
    here = pair.cam1.rays_cam(xy).xyz_mm / w[:, :1]
    moved = (current_position(w, G) - here) @ pair.cam1.cam_from_sys.rotation
    off[which] = _beyond_linear(here, moved, variance[which])
    return off.reshape(*shape, 3), variance.reshape(*shape, 3)


def shape_over_reported(
    points: PointFits, index: NDArray[np.intp], variance: Float, xy_px: Float, shape: tuple[int, int], subset_px: int
) -> Float:
    """Return (2,) the observed standard deviations of a shape's (w0, offset) over those in ``variance`` (n, 2).

    The offset's true value is smooth for any surface, and the texture scatters the depth as much as the offset. The
    depth's own scatter, which a surface's form only increases, is used if it is smaller. NaN for few points. Other
    parameters are as in :func:`observed_over_reported`.
    """
    which = _known(points, index)
    spacing = _spacing(xy_px.reshape(*shape, 2))
    if not can_be_observed(xy_px.reshape(*shape, 2), np.flatnonzero(which), subset_px):
        return np.full(2, np.nan)
    values = np.stack([points.w[:, 0], points.epipolar_px], axis=-1)
    off, known = (np.where(which[:, None], v, np.nan).reshape(*shape, 2) for v in (values, variance))
    lag = int(np.ceil((subset_px + _APART_PX) / spacing))
    by_order = [_differences(off, known, lag, np.array(weights)) for weights in _DIFFERENCES]
    found = [np.concatenate([np.zeros((0, 2)), *one]) ** 2 for one in by_order]
    if sum(map(len, found)) < _MIN_INDEPENDENT:
        return np.full(2, np.nan)
    offset = np.concatenate(found)[:, 1].mean()
    depth = min(offset, *(one[:, 0].mean() for one in found if len(one) >= _MIN_INDEPENDENT))
    return np.sqrt([depth, offset])


def _known(points: PointFits, index: NDArray[np.intp]) -> Bool:
    """Return (n,) True for points ``index`` that have a covariance."""
    which = np.zeros(len(points.status), bool)
    which[index] = np.isfinite(points.covariance[index]).all(axis=(1, 2))
    return which


def can_be_observed(grid: Float, index: NDArray[np.intp], subset_px: int) -> bool:
    """Return True if points ``index`` of a grid (r, c, 2) px have enough neighbouring subsets without common pixels."""
    spacing = _spacing(grid)
    independent = len(index) * min(1.0, (spacing / subset_px) ** 2) if spacing > 0.0 else 0.0
    return bool(independent >= _MIN_INDEPENDENT)


def _spacing(grid: Float) -> float:
    return float(np.nanmedian(np.linalg.norm(np.diff(grid, axis=1), axis=-1))) if grid.shape[1] > 1 else float("nan")


def bring_to_observed(
    pair: StereoPair, points: PointFits, index: NDArray[np.intp], xy_px: Float, shape: tuple[int, int], subset_px: int
) -> bool:
    """Scale the covariances of a motion's points in place by the ratio of :func:`observed_over_reported`.

    Returns False if too few points are usable.
    """
    ratio = observed_over_reported(pair, points, index, xy_px, shape, subset_px)
    other = (ratio < _AS_REPORTED[0]) | (ratio > _AS_REPORTED[1])
    if not other.any():
        return bool(np.isfinite(ratio).all())
    ratio = np.where(other, np.minimum(ratio, _MAX_RAISE), 1.0)
    R = pair.cam1.cam_from_sys.rotation
    change = np.eye(points.covariance.shape[-1])
    change[1:4, 1:4] = R @ np.diag(ratio) @ R.T
    points.covariance[index] = change @ points.covariance[index] @ change.T
    return True


def _beyond_linear(xyz_mm: Float, uvw_mm: Float, variance: Float) -> Float:
    """Part of displacements (n, 3) that no rigid motion with uniform strain explains."""
    along = xyz_mm - xyz_mm.mean(axis=0)
    # the normal of a plane field contains only noise, also the displacements' noise
    _, extent, axes = np.linalg.svd(along, full_matrices=False)
    columns = np.ones((len(along), 1))
    for size, axis in zip(extent, axes, strict=True):
        if size > _FLAT * extent[0]:
            columns = np.concatenate([columns, (along @ axis)[:, None] * np.sqrt(len(along)) / size], axis=1)
    weight = 1.0 / np.sqrt(variance.sum(axis=1, keepdims=True))
    fitted, *_ = np.linalg.lstsq(columns * weight, uvw_mm * weight)
    return np.asarray(uvw_mm - columns @ fitted)


def _differences(values: Float, variance: Float, lag: int, weights: Float) -> list[Float]:
    """Differences (m, k) along rows, columns and each diagonal, over their reported standard deviation."""
    rows, cols, _ = values.shape
    reach = lag * (len(weights) - 1)
    out = []
    for down, right in product((0, 1), (-1, 0, 1)):
        if (down, right) in ((0, 0), (0, -1)) or rows <= down * reach or cols <= abs(right) * reach:
            continue
        total, noise = 0.0, 0.0
        for k, weight in enumerate(weights):
            top, left = down * lag * k, lag * (right * k if right >= 0 else len(weights) - 1 - k)
            part = np.s_[top : top + rows - down * reach, left : left + cols - abs(right) * reach]
            total = total + weight * values[part]
            noise = noise + weight**2 * variance[part]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.asarray(total / np.sqrt(noise)).reshape(-1, values.shape[2])
        known: Bool = np.asarray(np.isfinite(ratio).all(axis=1))
        out.append(ratio[known])
    return out


def _mixed_differences(values: Float, variance: Float, lag: int, weights: Float) -> Float:
    """Differences along rows of those along columns (m, k), over their reported standard deviation."""
    rows, cols = (size - lag * (len(weights) - 1) for size in values.shape[:2])
    if min(rows, cols) < 1:
        return np.zeros((0, values.shape[2]))
    total, noise = 0.0, 0.0
    for i, j in product(range(len(weights)), repeat=2):
        part, weight = np.s_[lag * i : lag * i + rows, lag * j : lag * j + cols], weights[i] * weights[j]
        total = total + weight * values[part]
        noise = noise + weight**2 * variance[part]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.asarray(total / np.sqrt(noise)).reshape(-1, values.shape[2])
    return np.asarray(ratio[np.isfinite(ratio).all(axis=1)])
