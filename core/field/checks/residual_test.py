"""Residual test: the covariances of a field compared with what the residuals of its points show.

The matching assumes that residuals are white noise. Where the surface or the view changed they are not, and the
standard deviation of a match is several times the reported one. On a sample of the field the reported variances are
compared with cluster-robust ones; where they disagree, the field's covariances are scaled by the ratio. Points whose
residuals are larger than those of the rest of the field, and all points if the variances of the sample disagree among
themselves, are tested one by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.field.points.fitter import Fitter, PointFits
from core.field.points.observed_scatter import bring_to_observed
from core.field.points.scales import depth_per_px, px_per_ray
from core.matching.cluster_robust import cluster_robust_covariances
from core.progress import CancelToken, raise_if_cancelled
from core.robust import spread_indices
from core.status import PointStatus

_SAMPLE = 256
_MIN_POINTS = 30  # of a sample that stands for a field
_MEDIAN_OF_MEAN = 0.95  # of a variance estimated from some twenty independent blocks
AS_NOISE = (0.8, 1.25)  # ratio of a sample's variance to the reported one: within, nothing is corrected
_MAX_DISAGREEMENT = 2.2  # 90 % quantile over median of white noise's own estimates is 1.5 (33 px) to 1.8 (15 px)
_UNUSUAL = 1.5  # residual energy over the field's median
_MOSTLY_NOT_NOISE = 2.0  # ratio of a sample's variance to the reported one: more than half of it is not noise
_TRIMMED = 0.1
_SHRUNK = 0.5
_ALIKE = float(np.log(2.0))  # variances within a factor of two are one kind's: their own uncertainty is a quarter
_TINY = 1e-9
_UNCORRELATED = (0.65, 1.5)  # variances with correlated blocks over those with independent ones: within, they are
_KIND_UNCERTAINTY = 1.25  # of a kind's standard deviation, from few blocks
_MANY = 0.05  # share rejected, beyond which what is left is a selection
_NEARLY_ALL = 0.99
_AT_ONCE = 4096


@dataclass(frozen=True, kw_only=True)
class TestedResiduals:
    """Outcome of the residual test of a field.

    Attributes
    ----------
    factor
        (2,) or (5,) ratios of the sample's cluster-robust variances of (w0, offset) or (w0, G00, G10, G20, offset) to
        the reported ones; NaN where there were too few points.
    one_by_one
        Number of points tested by their own residuals.
    rejected
        Number of points rejected because their standard deviation is too large.
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
    max_sigma_px: float,
    shape: tuple[int, int] | None = None,
    cancel: CancelToken | None = None,
) -> TestedResiduals:
    """Scale the covariances of points in place and reject points whose standard deviation is too large.

    Parameters
    ----------
    fitter, points
        The matcher, and its (n,) points with their results.
    xy_px
        (n, 2) px of camera 1.
    texture
        (n,) grey-level variance of camera 1's subset.
    max_sigma_px
        Standard deviation of a match, in camera 1's current image or of what determines the depth in camera 2's, beyond
        which a point with residuals that are not noise is rejected.
    shape
        Rows and columns of the n points: where residuals are not noise, a motion's standard deviations follow how its
        points scatter. None: the points are no grid.
    cancel
        Stops the work.

    Returns
    -------
    TestedResiduals
        Factors and counts.
    """
    q = points.covariance.shape[-1]
    nothing = TestedResiduals(factor=np.full(q, np.nan), one_by_one=0, rejected=0)
    ok = np.flatnonzero(points.ok)
    if len(ok) == 0:
        return nothing
    energy = (1.0 - points.zncc[ok]) * texture[ok, None]
    usual_energy = np.median(energy, axis=0)
    unusual: Bool = np.asarray((energy > _UNUSUAL * usual_energy).any(axis=1))
    usual = ok[~unusual]
    sample = _robust(fitter, points, usual[np.unique(spread_indices(len(usual), _SAMPLE))], xy_px)
    own = sample.ratio
    factor = nothing.factor
    correction = np.ones(q)
    if len(own) >= _MIN_POINTS:
        factor = np.median(own, axis=0) / _MEDIAN_OF_MEAN
        correction = np.where((factor > AS_NOISE[0]) & (factor < AS_NOISE[1]), 1.0, factor)
        if fitter.ref1.blur is not None:  # its noise is correlated over more than a block
            correction = np.maximum(correction, 1.0)
        # variances below the reported ones in all points, as of a shape from less noisy images, are no disagreement
        agreed = (np.quantile(own, 0.9, axis=0) < _MAX_DISAGREEMENT * np.maximum(np.median(own, axis=0), 1.0)).all()
        # interpolation and images of unequal noise raise the last, the offset's, which therefore does not count
        if not agreed or (correction[:-1] > _MOSTLY_NOT_NOISE).any():
            unusual[:] = True
    else:
        unusual[:] = True
    usual, alone = ok[~unusual], ok[unusual]
    if (correction != 1.0).any():
        _scale(points, usual, correction / np.where(correction > 1.0, _shared_texture(points, usual), 1.0))
    rejected = 0
    if (correction[:-1] > 1.0).any():
        _as_observed(fitter, points, usual, xy_px, shape)
        rejected = _reject_far(fitter, points, usual, xy_px, max_sigma_px)
    if len(alone) == 0:
        return TestedResiduals(factor=factor, one_by_one=0, rejected=rejected)
    # noise alone, where there are points that show nothing else
    most = np.maximum(energy[unusual], usual_energy)
    # a comparison without any residual, as of an image with itself, is as quiet as usual
    share = np.divide(usual_energy, most, out=np.ones_like(most), where=most > 0)
    quiet = share.min(axis=1) * (len(usual) > 0)
    alike = _robust(fitter, points, alone[np.unique(spread_indices(len(alone), _SAMPLE))], xy_px)
    structure = _Structure.of(alike) if len(alike.independent) >= _MIN_POINTS else None
    kind = np.full((len(alone), q), np.nan)
    for first in range(0, len(alone), _AT_ONCE):
        raise_if_cancelled(cancel)
        part = slice(first, first + _AT_ONCE)
        found = _robust(fitter, points, alone[part], xy_px)
        kind[part][found.known] = _replace(points, found, structure, quiet[part][found.known])
    kind *= _as_observed(fitter, points, alone, xy_px, shape)
    rejected += _reject_far(fitter, points, alone, xy_px, max_sigma_px)
    left = points.ok[alone] & np.isfinite(kind).all(axis=1)
    sd = _KIND_UNCERTAINTY * np.sqrt(kind[left])
    rejected += _reject_far(fitter, points, alone[left], xy_px, max_sigma_px, sd)
    # those left are the ones whose own estimate happens to be small
    if shape is not None and fitter.comparisons == 3 and rejected > _MANY * len(alone):
        left = alone[points.ok[alone]]
        _as_observed(fitter, points, left, xy_px, shape)
        # of a whole field that scatters too far, the last hundredth is within the limit by chance
        few = len(alone) == len(ok) and rejected > _NEARLY_ALL * len(alone)
        rejected += _reject_far(fitter, points, left, xy_px, 0.0 if few else max_sigma_px)
    return TestedResiduals(factor=factor, one_by_one=len(alone), rejected=rejected)


def residual_factors(fitter: Fitter, points: PointFits, xy_px: Float) -> Float:
    """Return (q,) the usual ratio of the variances that residuals show to the reported ones; NaN of too few points.

    Parameters
    ----------
    fitter, points
        The matcher, and a sample of (n,) valid points.
    xy_px
        (n, 2) px of camera 1.
    """
    own = _robust(fitter, points, np.arange(len(xy_px)), xy_px).ratio
    if len(own) < _MIN_POINTS:
        return np.full(points.covariance.shape[-1], np.nan)
    return np.asarray(np.median(own, axis=0) / _MEDIAN_OF_MEAN)


class _Robust(NamedTuple):
    """Cluster-robust covariances (m, q, q) of the field's ``points``, in units of the reported one's ``root``.

    ``known`` (k,) True for those of the points asked for that have one; ``ratio`` (m, q) of the variances.
    """

    points: NDArray[np.intp]
    known: Bool
    ratio: Float
    root: Float
    independent: Float
    correlated: Float


class _Structure(NamedTuple):
    """How points of a kind differ from independent blocks: the map (q, q) of the one mean covariance to the other."""

    change: Float
    independent: Float
    correlated: Float

    @staticmethod
    def of(found: _Robust) -> _Structure:
        trace = np.trace(found.independent, axis1=1, axis2=2)
        usual = trace <= np.quantile(trace, 1.0 - _TRIMMED)
        one, two = found.independent[usual].mean(axis=0), found.correlated[usual].mean(axis=0)
        ratio = np.linalg.eigvals(np.linalg.solve(one, two)).real
        if ratio.min() > _UNCORRELATED[0] and ratio.max() < _UNCORRELATED[1]:
            return _Structure(np.eye(len(one)), one, one)
        return _Structure(_root(two) @ np.linalg.inv(_root(one)), one, two)


def _robust(fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float) -> _Robust:
    q = points.covariance.shape[-1]
    if len(index) == 0:
        nothing = np.zeros((0, q, q))
        return _Robust(index, np.zeros(0, bool), np.zeros((0, q)), nothing, nothing, nothing)
    images = [fitter.ref1, fitter.ref2]
    if fitter.cur1 is not None and fitter.cur2 is not None:
        images += [fitter.cur1, fitter.cur2]
    independent, correlated, _ = cluster_robust_covariances(
        fitter.pair,
        images,
        xy_px[index],
        points.w[index],
        points.G[index] if len(images) == 4 else None,
        points.epipolar_px[index],
        fitter.options,
        fitter.visible(xy_px[index]),
    )
    reported = points.covariance[index]
    known: Bool = np.asarray((_diagonal(reported) > 0.0).all(axis=1) & np.isfinite(independent).all(axis=(1, 2)))
    root = _root(reported[known])
    inverse = np.linalg.inv(root)
    across = np.swapaxes(inverse, 1, 2)
    return _Robust(
        points=index[known],
        known=known,
        ratio=_diagonal(independent[known]) / _diagonal(reported[known]),
        root=root,
        independent=inverse @ independent[known] @ across,
        correlated=inverse @ correlated[known] @ across,
    )


def _root(covariance: Float) -> Float:
    """Lower triangular square roots (..., q, q) of covariances in any units."""
    sd = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    correlation = covariance / (sd[..., :, None] * sd[..., None, :])
    return np.asarray(sd[..., :, None] * np.linalg.cholesky(correlation + _TINY * np.eye(covariance.shape[-1])))


def _replace(points: PointFits, found: _Robust, structure: _Structure | None, quiet: Float) -> Float:
    """Give points their own residuals' covariance, not below what noise alone makes (``quiet`` of the reported).

    Returns the variances (m, q) of points of their kind.
    """
    if len(found.points) == 0:
        return np.zeros((0, points.covariance.shape[-1]))
    own, kind = found.independent, found.independent
    if structure is not None:
        # a single estimate is uncertain: where it is about its kind's, both count
        relative = np.linalg.solve(structure.independent, own)
        size = np.trace(relative, axis1=1, axis2=2) / own.shape[1]
        share = _SHRUNK * np.clip(2.0 - size, 0.0, 1.0)[:, None, None]
        own = structure.change @ own @ structure.change.T
        own = (1.0 - share) * own + share * structure.correlated
        kind = np.where((np.abs(np.log(size)) < _ALIKE)[:, None, None], structure.correlated, own)
    shared = _shared_texture(points, found.points)[:, :, None]
    covariance = found.root @ own @ np.swapaxes(found.root, 1, 2) / shared
    least = quiet[:, None] * _diagonal(points.covariance[found.points])
    root = np.sqrt(np.maximum(least / _diagonal(covariance), 1.0))
    covariance *= root[:, :, None] * root[:, None, :]
    points.covariance[found.points] = covariance
    points.epipolar_sigma_px[found.points] = np.sqrt(covariance[:, -1, -1])
    # where a kind scatters too far, those that are within the limit are so by chance
    return np.asarray(_diagonal(found.root @ kind @ np.swapaxes(found.root, 1, 2) / shared))


def _as_observed(
    fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float, shape: tuple[int, int] | None
) -> Float:
    """Bring covariances to what the points' scatter shows; returns the variances' (m, q) ratios."""
    if shape is None or fitter.comparisons != 3:
        return np.ones((len(index), points.covariance.shape[-1]))
    before = _diagonal(points.covariance[index])
    bring_to_observed(fitter.pair, points, index, xy_px, shape, fitter.options.subset_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(before > 0.0, _diagonal(points.covariance[index]) / before, 1.0)


def _shared_texture(points: PointFits, index: NDArray[np.intp]) -> Float:
    """(m, 1) share of the squared gradients that the best comparison explains; the rest is in the others' scores."""
    return np.asarray(points.zncc[index].max(axis=1)[:, None] ** 2)


def _scale(points: PointFits, index: NDArray[np.intp], variance_factor: Float) -> None:
    root = np.sqrt(variance_factor)
    points.covariance[index] *= root[:, :, None] * root[:, None, :]
    points.epipolar_sigma_px[index] *= root[:, -1]


def _reject_far(
    fitter: Fitter,
    points: PointFits,
    index: NDArray[np.intp],
    xy_px: Float,
    max_sigma_px: float,
    sd: Float | None = None,
) -> int:
    """Reject points with a standard deviation beyond the limit: their own, or ``sd`` (m, q) of the unknowns."""
    motion, depth = _sigma_px(fitter, points, index, xy_px, sd)
    far = ~((motion < max_sigma_px) & (depth < max_sigma_px))
    mask = np.zeros(len(points.status), bool)
    mask[index[far]] = True
    points.reject(mask, PointStatus.LOW_CORRELATION)
    return int(far.sum())


def _sigma_px(
    fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float, sd: Float | None
) -> tuple[Float, Float]:
    """(m,) standard deviations, px: of the position in camera 1's current image, and of what determines the depth.

    The latter, in camera 2, along the epipolar line; of a motion that of its part along the depth. The offset across
    the line is no part of a position, and how it scatters is tested against its neighbours. Residuals that camera 2
    shows at both times do not count in a motion: they are the shape's, which was tested.
    """
    rays = fitter.pair.cam1.rays_cam(xy_px[index]).xyz_mm
    w, sd = points.w[index, 0], np.sqrt(_diagonal(points.covariance[index])) if sd is None else sd
    per_px = depth_per_px(fitter.pair, rays, w)
    if sd.shape[1] == 2:
        return np.zeros(len(index)), sd[:, 0] / per_px
    z = points.G[index, 2, 0]  # of the current point, times w
    px = px_per_ray(fitter.pair, rays)[:, 0]
    return np.maximum(sd[:, 1], sd[:, 2]) * px / z, sd[:, 3] * w / z**2 / per_px


def _diagonal(covariance: Float) -> Float:
    return np.asarray(np.diagonal(covariance, axis1=-2, axis2=-1))
