"""How displacements scatter about their neighbours' trend, against the standard deviation that is reported.

What a texture loses to blur at t flows out of a subset through its border alone. A covariance from parts of the subset
counts what flows through inner borders, too, and is up to two times too large. How subsets apart from one another
scatter knows no inner borders: differences of second and third order of displacements that no linear motion explains.
A motion that is rough itself scatters more, so a standard deviation is lowered as far as they say, and raised little.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.field.points.fitter import PointFits
from core.field.points.starts import current_position
from core.matching.geometry import covariance_xyzuvw

_APART_PX = 11.0  # between subsets of one difference: two large speckles, which they do not share
_MIN_INDEPENDENT = 40.0  # subsets beside one another: the standard deviation is then known to some 10 %
_QUANTILES, _OF_NORMAL = (0.8, 0.95, 0.99), (1.2816, 1.96, 2.5758)  # localised strain and wrong matches are beyond 0.8
_UNCERTAINTY = 1.03  # of a standard deviation from so many points
_AS_REPORTED = (0.92, 1.08)  # within, nothing is changed
_MAX_RAISE = 2.0
_FLAT = 1e-2  # extent along the normal, of the largest, that is none
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
        Of the points that are asked for.
    xy_px
        (n, 2) px of camera 1.
    shape
        Rows and columns.
    subset_px
        Subset size.

    Returns
    -------
    Float
        (3,) ratios, system frame; NaN where too few points tell.
    """
    which = np.zeros(len(xy_px), bool)
    which[index] = np.isfinite(points.covariance[index]).all(axis=(1, 2))
    grid = xy_px.reshape(*shape, 2)
    spacing = np.nanmedian(np.linalg.norm(np.diff(grid, axis=1), axis=-1)) if shape[1] > 1 else np.nan
    independent = which.sum() * min(1.0, (spacing / subset_px) ** 2) if spacing > 0.0 else 0.0
    if not independent >= _MIN_INDEPENDENT:
        return np.full(3, np.nan)
    off, variance = np.full((len(xy_px), 3), np.nan), np.full((len(xy_px), 3), np.nan)
    xy, w, G = xy_px[which], points.w[which], points.G[which]
    covariance = covariance_xyzuvw(pair, xy, w, G, points.covariance[which])
    variance[which] = np.diagonal(covariance, axis1=1, axis2=2)[:, 3:]
    here = pair.cam1.rays_cam(xy).xyz_mm / w[:, :1]
    moved = (current_position(w, G) - here) @ pair.cam1.cam_from_sys.rotation
    off[which] = _beyond_linear(here, moved, variance[which])
    lag = int(np.ceil((subset_px + _APART_PX) / spacing))
    area = min(1.0, (spacing / subset_px) ** 2)
    out = np.full((len(_DIFFERENCES), 3), np.nan)
    for i, weights in enumerate(_DIFFERENCES):
        ratio = _differences(off.reshape(*shape, 3), variance.reshape(*shape, 3), lag, np.array(weights))
        if len(ratio) * area >= _MIN_INDEPENDENT:
            scale = np.quantile(np.abs(ratio), _QUANTILES, axis=0) / np.array(_OF_NORMAL)[:, None]
            # points of unlike noise have wide tails: lowered no further than these, raised by the bulk
            out[i] = np.maximum(scale[0], np.minimum(_UNCERTAINTY * scale.max(axis=0), 1.0))
    return np.asarray(np.fmin(out[0], out[1]))


def bring_to_observed(
    pair: StereoPair, points: PointFits, index: NDArray[np.intp], xy_px: Float, shape: tuple[int, int], subset_px: int
) -> None:
    """Bring the covariances of a motion's points in place to what :func:`observed_over_reported` finds."""
    ratio = observed_over_reported(pair, points, index, xy_px, shape, subset_px)
    other = (ratio < _AS_REPORTED[0]) | (ratio > _AS_REPORTED[1])
    if not other.any():
        return
    ratio = np.where(other, np.minimum(ratio, _MAX_RAISE), 1.0)
    R = pair.cam1.cam_from_sys.rotation
    change = np.eye(points.covariance.shape[-1])
    change[1:4, 1:4] = R @ np.diag(ratio) @ R.T
    points.covariance[index] = change @ points.covariance[index] @ change.T


def _beyond_linear(xyz_mm: Float, uvw_mm: Float, variance: Float) -> Float:
    """What of displacements (n, 3) no rigid motion with uniform strain explains."""
    along = xyz_mm - xyz_mm.mean(axis=0)
    # the normal of a plane field holds noise alone, that of the displacements among it
    _, extent, axes = np.linalg.svd(along, full_matrices=False)
    columns = np.ones((len(along), 1))
    for size, axis in zip(extent, axes, strict=True):
        if size > _FLAT * extent[0]:
            columns = np.concatenate([columns, (along @ axis)[:, None] * np.sqrt(len(along)) / size], axis=1)
    weight = 1.0 / np.sqrt(variance.sum(axis=1, keepdims=True))
    fitted, *_ = np.linalg.lstsq(columns * weight, uvw_mm * weight)
    return np.asarray(uvw_mm - columns @ fitted)


def _differences(values: Float, variance: Float, lag: int, weights: Float) -> Float:
    """Differences (m, 3) along rows, columns and diagonals, over their reported standard deviation."""
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
            ratio = np.asarray(total / np.sqrt(noise)).reshape(-1, 3)
        known: Bool = np.asarray(np.isfinite(ratio).all(axis=1))
        out.append(ratio[known])
    return np.concatenate(out) if out else np.zeros((0, 3))
