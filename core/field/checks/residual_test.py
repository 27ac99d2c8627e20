"""Points judged by their residuals: how far they scatter for reasons other than noise, and which are not to be trusted.

The matching takes residuals for white noise. Where the surface or the view changed they are not, and the match scatters
by several times what it says. A sample of the field tells whether its residuals are what the matching takes them for;
where they are not, the field's covariances are corrected by what the sample shows. Points whose residuals are larger
than the field's others, and all points if the sample does not speak with one voice, are judged one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.field.points.fitter import Fitter, PointFits
from core.field.points.starts import depth_per_px
from core.matching.cluster_robust import cluster_robust_covariance
from core.progress import CancelToken, raise_if_cancelled
from core.robust import spread_indices
from core.status import PointStatus

_SAMPLE = 256
_MIN_POINTS = 30  # of a sample, to say something of a field
_MEDIAN_OF_MEAN = 0.95  # of a variance estimated from some twenty independent pulls
_AS_NOISE = (0.8, 1.25)  # a sample's variance over the told one: within, nothing needs to be corrected
_MAX_DISAGREEMENT = 2.2  # 90 % quantile over median of white noise's own estimates is 1.5 (33 px) to 1.8 (15 px)
_UNUSUAL = 1.5  # residual energy over the field's median
_MOSTLY_NOT_NOISE = 2.0  # a sample's variance over the told one: more than half of it is not noise
_AT_ONCE = 4096


@dataclass(frozen=True, kw_only=True)
class SigmaLimits:
    """How far a match may scatter, standard deviation in px.

    Attributes
    ----------
    motion_px
        Of the point's place in camera 1 at t.
    depth_px
        Of what depth is told by, in camera 2 along and across the epipolar line.
    """

    motion_px: float
    depth_px: float


@dataclass(frozen=True, kw_only=True)
class TestedResiduals:
    """What came out.

    Attributes
    ----------
    factor
        (2,) or (5,) what the sample's observed variances of (w0, offset) or (w0, G00, G10, G20, offset) are over the
        told ones; NaN where there were too few points to say.
    one_by_one
        How many points were judged by their own residuals.
    rejected
        How many of them scatter too far.
    """

    factor: Float
    one_by_one: int
    rejected: int


def residual_test(
    fitter: Fitter,
    points: PointFits,
    *,
    xy_px: Float,
    texture: Float,
    limits: SigmaLimits,
    cancel: CancelToken | None = None,
) -> TestedResiduals:
    """Correct the covariances of points in place and refuse those that scatter too far.

    Parameters
    ----------
    fitter, points
        The matcher, and its (n,) points with their results.
    xy_px
        (n, 2) px of camera 1.
    texture
        (n,) grey-level variance of camera 1's subset.
    limits
        Scatter beyond which a point with residuals that are not noise is refused.
    cancel
        Stops the work.
    """
    q = points.covariance.shape[-1]
    nothing = TestedResiduals(factor=np.full(q, np.nan), one_by_one=0, rejected=0)
    ok = np.flatnonzero(points.ok)
    if len(ok) == 0:
        return nothing
    energy = (1.0 - points.zncc[ok]) * texture[ok, None]
    unusual: Bool = np.asarray((energy > _UNUSUAL * np.median(energy, axis=0)).any(axis=1))
    usual = ok[~unusual]
    sample = usual[np.unique(spread_indices(len(usual), _SAMPLE))]
    own = _own_factors(fitter, points, sample, xy_px)
    own = own[np.isfinite(own).all(axis=1)]
    factor = nothing.factor
    told = np.ones(q)  # the offset's, the last, is no witness: interpolation and images of unlike noise raise it
    if len(own) >= _MIN_POINTS:
        factor = np.median(own, axis=0) / _MEDIAN_OF_MEAN
        told = np.where((factor > _AS_NOISE[0]) & (factor < _AS_NOISE[1]), 1.0, factor)
        if fitter.ref1.blur is not None:  # its noise hangs together over more than a block
            told = np.maximum(told, 1.0)
        # what all say is less than noise, as of a shape that less noisy images tell, is no reason to doubt
        one_voice = (np.quantile(own, 0.9, axis=0) < _MAX_DISAGREEMENT * np.maximum(np.median(own, axis=0), 1.0)).all()
        if not one_voice or (told[:-1] > _MOSTLY_NOT_NOISE).any():
            unusual[:] = True
    else:
        unusual[:] = True
    usual, alone = ok[~unusual], ok[unusual]
    _scale(points, usual, told / np.where(told > 1.0, _shared_texture(points, usual), 1.0))
    rejected = 0
    if (told[:-1] > 1.0).any():
        rejected = _reject_far(fitter, points, usual, xy_px, limits)
    for first in range(0, len(alone), _AT_ONCE):
        raise_if_cancelled(cancel)
        index = alone[first : first + _AT_ONCE]
        own = _own_factors(fitter, points, index, xy_px)
        # a single estimate scatters itself: what the field in general shows is the least
        _scale(points, index, np.fmax(own, told) / _shared_texture(points, index))
        rejected += _reject_far(fitter, points, index, xy_px, limits)
    return TestedResiduals(factor=factor, one_by_one=len(alone), rejected=rejected)


def _own_factors(fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float) -> Float:
    """(m, q) observed over told variances; NaN where they are not known, as where a match left nothing at all."""
    q = points.covariance.shape[-1]
    if len(index) == 0:
        return np.zeros((0, q))
    images = [fitter.ref1, fitter.ref2]
    if fitter.cur1 is not None and fitter.cur2 is not None:
        images += [fitter.cur1, fitter.cur2]
    robust, _ = cluster_robust_covariance(
        fitter.pair,
        images,
        xy_px[index],
        points.w[index],
        points.G[index] if len(images) == 4 else None,
        points.epipolar_px[index],
        fitter.options,
        None if fitter.visibility is None else fitter.visibility.at(xy_px[index]),
    )
    told = _diagonal(points.covariance[index])
    factors = np.full(told.shape, np.nan)
    np.divide(_diagonal(robust), told, out=factors, where=told > 0.0)
    return factors


def _shared_texture(points: PointFits, index: NDArray[np.intp]) -> Float:
    """(m, 1) share of the squared gradients that counts; what a comparison lacks beside the best, its pulls hold."""
    return np.asarray(points.zncc[index].max(axis=1)[:, None] ** 2)


def _scale(points: PointFits, index: NDArray[np.intp], variance_factor: Float) -> None:
    root = np.sqrt(variance_factor)
    points.covariance[index] *= root[:, :, None] * root[:, None, :]
    points.epipolar_sigma_px[index] *= root[:, -1]


def _reject_far(fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float, limits: SigmaLimits) -> int:
    motion, depth = _sigma_px(fitter, points, index, xy_px)
    far = ~((motion < limits.motion_px) & (depth < limits.depth_px))
    mask = np.zeros(len(points.status), bool)
    mask[index[far]] = True
    points.reject(mask, PointStatus.LOW_CORRELATION)
    return int(far.sum())


def _sigma_px(fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float) -> tuple[Float, Float]:
    """(m,) standard deviations, px: of the place in camera 1 at t, and the largest of those that depth hangs on."""
    rays = fitter.pair.cam1.rays_cam(xy_px[index]).xyz_mm
    w, sd = points.w[index, 0], np.sqrt(_diagonal(points.covariance[index]))
    per_px = depth_per_px(fitter.pair, rays, w)
    depth = np.maximum(sd[:, 0] / per_px, sd[:, -1])
    if sd.shape[1] == 2:
        return np.zeros(len(index)), depth
    z = points.G[index, 2, 0]  # of the point at t, times w
    px = np.sqrt(np.abs(np.linalg.det(fitter.pair.cam1.lens.image_jacobian(rays[:, :2]))))
    return np.maximum(sd[:, 1], sd[:, 2]) * px / z, np.maximum(depth, sd[:, 3] * w / z**2 / per_px)


def _diagonal(covariance: Float) -> Float:
    return np.asarray(np.diagonal(covariance, axis1=-2, axis2=-1))
