"""Residual test: comparison of a field's covariances with the residuals of its points.

The matching assumes that residuals are white noise. If the surface or the view changed they are not, and the standard
deviation of a match is several times the reported one. On a sample of the field the reported variances are compared
with cluster-robust ones; if they disagree, the field's covariances are scaled by the ratio. Points with larger
residuals than the rest of the field, and all points if the variances of the sample disagree among themselves, are
tested one by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.block_median import block_medians, reach_of, spacing_of
from stereorig.core.field.checks.stationary_noise import line_factor, noise_factor, shows_lines
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.observed_scatter import bring_to_observed, can_be_observed, shape_over_reported
from stereorig.core.field.points.result import Unsure
from stereorig.core.field.points.scales import depth_per_px, px_per_ray
from stereorig.core.matching.cluster_robust import cluster_robust_covariances
from stereorig.core.progress import CancelToken, raise_if_cancelled
from stereorig.core.robust import median, spread_indices
from stereorig.core.settings import single_sigma_px
from stereorig.core.status import PointStatus

_SAMPLE = 256
_FIRST = 4  # every fourth point of the sample tells noise from the rest where it is noise
_MIN_POINTS = 30  # size of a sample that represents a field
_MEDIAN_OF_MEAN = 0.95  # ratio for a variance estimated from some twenty independent blocks
AS_NOISE = (0.8, 1.25)  # ratio of a sample's variance to the reported one: within, nothing is corrected
_SURELY_NOISE = (0.84, 1.2)  # the same from every fourth point, whose median is known to 5 %
_MAX_DISAGREEMENT = 2.2  # 90 % quantile over median of white noise's own estimates is 1.5 (33 px) to 1.8 (15 px)
_UNUSUAL = 1.5  # residual energy over the field's median
_MOSTLY_NOT_NOISE = 2.0  # ratio of a sample's variance to the reported one: more than half of it is not noise
_TRIMMED = 0.1
_SHRUNK = 0.5
_ALIKE = float(np.log(2.0))  # variances within a factor of two are one kind's: their own uncertainty is a quarter
_TINY = 1e-9
_UNCORRELATED = (0.65, 1.5)  # variances with correlated blocks over those with independent ones: within, they are
_MOST_RAISED = 2.0
_KIND_UNCERTAINTY = 1.25  # factor of a kind's standard deviation, from few blocks
_MANY = 0.05  # share rejected, above which the rest is a selection
OF_USUAL = 2.5  # times the standard deviation of the field's usual point: up to that a point is one of its kind
# times the points about a point, whose usual standard deviation counts: an error at a few points does not make a kind
_WIDER = 3
_ONE_KIND = 0.6  # least share: patterns over parts of the subsets leave a tenth at 0.1 to 0.3, noise and blur at 0.9
_ALL_ALIKE = 0.75  # share of the usual standard deviation: a tenth of one kind's own estimates is below
_IN_DEPTH = 0.8  # of a motion's usual point, share of its sd along the depth: half a pixel is four of it
_OF_A_KIND = 0.9  # the same in the plane, where points are of one kind: at 0.12 px 2 in 1,000 were half a pixel off
_SCATTERS = (1 / 1.4, 1.4)  # a scatter's variance is known to a fifth from 40 neighbouring subsets
_AT_ONCE = 4096


@dataclass(frozen=True)
class TestedResiduals:
    """Outcome of the residual test of a field.

    Attributes
    ----------
    factor
        (2,) or (5,) ratios of the sample's cluster-robust variances of (w0, offset) or (w0, G00, G10, G20, offset) to
        the reported ones; NaN if there were too few points.
    one_by_one
        Number of points tested by their own residuals.
    rejected
        Number of points rejected because their standard deviation is too large.
    limit_px
        (n,) largest standard deviation that was allowed.
    unsure
        The usual point's standard deviation and its limit; None if it is within the limit.
    """

    factor: Float
    one_by_one: int
    rejected: int
    limit_px: Float
    unsure: Unsure | None = None


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
        Largest standard deviation of a match, in camera 1's current image or along the depth in camera 2's; above it
        the point is rejected. A point that is less sure than the field's usual one is rejected from
        :func:`stereorig.core.settings.single_sigma_px` on.
    shape
        Rows and columns of the n points. If residuals are not noise, the standard deviations of a motion, and those in
        a shape that is unsure, follow the points' scatter. None: the points are no grid, and each is judged by itself.
    cancel
        Stops the work.

    Returns
    -------
    TestedResiduals
        Factors and counts.
    """
    q = points.covariance.shape[-1]
    nothing = np.full(q, np.nan)
    limits = _Limits(fitter, points, xy_px, shape, max_sigma_px)
    ok = np.flatnonzero(points.ok)
    if len(ok) == 0:
        return limits.outcome(nothing, 0)
    energy = (1.0 - points.zncc[ok]) * texture[ok, None]
    usual_energy = np.median(energy, axis=0)
    unusual: Bool = np.asarray((energy > _UNUSUAL * usual_energy).any(axis=1))
    usual = ok[~unusual]
    # the scatter of a larger motion's points shows their noise
    few = shape is None or not can_be_observed(xy_px.reshape(*shape, 2), ok, fitter.options.subset_px)
    sampled = usual[np.unique(spread_indices(len(usual), _SAMPLE))]
    sample = _robust(fitter, points, sampled[:: 1 if few or fitter.comparisons == 1 else _FIRST], xy_px)
    if len(sample.known) < len(sampled) and not _surely_noise(sample.ratio):
        sample = _robust(fitter, points, sampled, xy_px)
    own = sample.ratio
    factor, one_by_one = nothing, unusual.copy()
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
    noise = None
    testable = fitter.ref1.blur is None and len(own) >= _MIN_POINTS
    if testable and fitter.comparisons == 3:
        if few and shows_lines(fitter, points, xy_px):
            noise = line_factor(fitter, points, sample.points, xy_px)
    # blocks show that residuals are no white noise, or the images do
    elif testable and (unusual.all() or (correction != 1.0).any() or shows_lines(fitter, points, xy_px)):
        noise = noise_factor(fitter, points, sample.points, xy_px, factor)
        if noise is not None and not few and not shows_lines(fitter, points, xy_px):
            # subsets that share no pixel scatter as noise makes them, not as blur that looks like noise
            off = limits.seen_of_shape(ok[~one_by_one])[1] ** 2 / noise[1]
            noise = noise if _SCATTERS[0] < off < _SCATTERS[1] else None
    if noise is not None:
        factor, unusual = noise, one_by_one
    usual, alone = ok[~unusual], ok[unusual]
    if noise is not None:
        _scale(points, ok, np.broadcast_to(noise, (len(ok), q)))
        limits.follow()
        limits.reject_far(usual)
    elif (correction != 1.0).any():
        seen, ratio = None, correction
        if fitter.comparisons == 3 and (few or (correction[:-1] <= 1.0).all()):
            # four images, one of which is noisier: smaller increases of a variance count, too
            seen, ratio = sample, np.where(correction == 1.0, np.maximum(factor, 1.0), correction)
        _scale(points, usual, ratio / np.where(ratio > 1.0, _shared_texture(points, usual), 1.0), seen)
    if noise is None and len(usual):
        estimated = bool((correction[:-1] > 1.0).any())
        # below the reported ones in a motion: the fit took for noise what blur of one image changed, and blocks count
        # part of that, too
        if estimated or (fitter.comparisons == 3 and (correction[:-1] < 1.0).any()):
            limits.as_observed(usual)
        limits.follow(estimated=estimated)
        limits.reject_far(usual, estimated=estimated)
    if len(alone) == 0:
        return limits.outcome(factor, 0)
    # noise alone, if there are points that show nothing else
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
    kind *= limits.as_observed(alone)
    limits.follow()
    limits.reject_far(alone)
    left = points.ok[alone] & np.isfinite(kind).all(axis=1)
    limits.reject_far(alone[left], np.sqrt(kind[left]))
    # those left are the ones whose own estimate happens to be small
    if shape is not None and fitter.comparisons == 3 and limits.rejected > _MANY * len(alone):
        left = alone[points.ok[alone]]
        limits.as_observed(left)
        limits.reject_far(left)
    return limits.outcome(factor, len(alone))


def _surely_noise(ratio: Float) -> bool:
    """Return True if the variances (m, q) of some points over the reported ones leave no doubt that these hold."""
    if len(ratio) < _MIN_POINTS:
        return False
    usual, most = np.quantile(ratio, (0.5, 0.9), axis=0)
    low, high = np.tile(_MEDIAN_OF_MEAN * np.array(_SURELY_NOISE)[:, None], len(usual))
    high[-1] = _MEDIAN_OF_MEAN * AS_NOISE[1]  # interpolation raises the offset's
    alike = most < 0.9 * _MAX_DISAGREEMENT * np.maximum(usual, 1.0)
    return bool(((usual > low) & (usual < high) & alike).all())


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

    ``known`` (k,) True for the requested points that have one; ``ratio`` (m, q) of the variances.
    """

    points: NDArray[np.intp]
    known: Bool
    ratio: Float
    root: Float
    independent: Float
    correlated: Float


class _Structure(NamedTuple):
    """Difference of a kind's points from independent blocks: the map (q, q) of the one mean covariance to the other."""

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
    independent, correlated = np.empty((len(index), q, q)), np.empty((len(index), q, q))
    for matcher, places in fitter.by_patch(points, index):
        some = index[places]
        independent[places], correlated[places], _ = cluster_robust_covariances(
            fitter.pair,
            images,
            xy_px[some],
            points.w[some, : matcher.terms],
            points.G[some, :, : matcher.terms] if len(images) == 4 else None,
            points.epipolar_px[some],
            matcher.options,
            fitter.visible(xy_px[some]),
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
    """Give points their own residuals' covariance, not below the part by noise alone (``quiet`` of the reported).

    Returns the variances (m, q) of points of their kind.
    """
    if len(found.points) == 0:
        return np.zeros((0, points.covariance.shape[-1]))
    own, kind = found.independent, found.independent
    if structure is not None:
        # a single estimate is uncertain: if it is near its kind's, both count
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


class _Limits:
    """The limits on a field's standard deviations, and the points that they reject.

    A shape may state any standard deviation up to the limit that was asked for: wrong matches have larger ones. A
    motion's usual point must be as sure as a single one, so that half a pixel, which would be taken for one, is five of
    it. Along the depth it is four, since blur of one camera is worst there and wrong matches are off in the plane, too.
    In the plane it is four and a half where all are of one kind, as blur makes them and other patterns do not.
    """

    def __init__(
        self, fitter: Fitter, points: PointFits, xy_px: Float, shape: tuple[int, int] | None, max_sigma_px: float
    ) -> None:
        self._fitter, self._points, self._xy_px, self._shape = fitter, points, xy_px, shape
        self._most, self._single = max_sigma_px, single_sigma_px(max_sigma_px)
        self._px = np.full(len(points.status), self._single)
        self._fitted = _diagonal(points.covariance).copy()
        self._unsure: Unsure | None = None
        self.rejected = 0

    def as_observed(self, index: NDArray[np.intp]) -> Float:
        """Scale covariances to the points' scatter; return the (m, q) ratios of the variances of a point's kind.

        Those have the uncertainty of a kind seen in few blocks, unless a shape's scatter over the field shows its kind.
        """
        points, xy_px, shape, subset_px = self._points, self._xy_px, self._shape, self._fitter.options.subset_px
        before = _diagonal(points.covariance[index])
        of_kind = np.full_like(before, _KIND_UNCERTAINTY**2)
        if shape is None or len(index) == 0:
            return of_kind
        unsure = median(self._sigma_px(index)) >= self._single
        if self._fitter.comparisons == 3:
            seen = bring_to_observed(self._fitter.pair, points, index, xy_px, shape, subset_px)
        else:
            # residuals correlated across the blocks' inner borders are in their variances, and not in the scatter
            over_fitted = self.seen_of_shape(index) ** 2
            seen = bool(np.isfinite(over_fitted).all())
            if seen:
                ratio = over_fitted / np.mean(before / self._fitted[index], axis=0)
                _scale(points, index, np.clip(ratio, _MOST_RAISED**-2, _MOST_RAISED**2)[None])
                of_kind[:] = 1.0
        if unsure and not seen:  # by so few points nothing is tested
            _scale(points, index, np.full((1, before.shape[1]), _KIND_UNCERTAINTY**2))
        with np.errstate(invalid="ignore", divide="ignore"):
            return of_kind * np.where(before > 0.0, _diagonal(points.covariance[index]) / before, 1.0)

    def seen_of_shape(self, index: NDArray[np.intp]) -> Float:
        """(2,) observed standard deviations of a shape's (w0, offset) over those that the fit reported."""
        assert self._shape is not None
        subset_px = self._fitter.options.subset_px
        return shape_over_reported(self._points, index, self._fitted, self._xy_px, self._shape, subset_px)

    def follow(self, *, estimated: bool = True) -> None:
        """Raise the limits as far as the usual points about a point need, up to the one that was asked for.

        ``estimated``: the covariances are the residuals' own estimates, not noise as the fit knows it.
        """
        ok = self._points.ok
        if not ok.any() or not self._px.any():  # all were refused as one kind: those left are of it, too
            return
        sigma = np.where(ok, 1.0, np.nan)
        sigma[ok] = self._sigma_px(np.flatnonzero(ok), estimated=estimated)
        middle = median(sigma[ok])
        motion, counted = self._fitter.comparisons == 3, sigma
        # nine in ten of one kind's own estimates are within its usual one over _ALL_ALIKE
        ceiling = self._single if motion else max(self._single, _ALL_ALIKE * self._most)
        if self._shape is not None and self._most > self._single:
            reach = _WIDER * reach_of(self._fitter.options.subset_px, spacing_of(self._xy_px, self._shape))
            usual = block_medians(sigma, ok, self._shape, reach)
            of_kind, within = usual, usual <= ceiling
            if motion:
                # another pattern over a part of each subset leaves points that have nothing else in common
                least = block_medians(sigma, ok, self._shape, reach, quantile=_TRIMMED)
                of_kind = np.minimum(usual, least / _ONE_KIND)
                if not within[ok].all():
                    counted = sigma.copy()
                    counted[ok] = self._sigma_px(np.flatnonzero(ok), estimated=estimated, in_depth=_IN_DEPTH)
                    counted = np.where(usual <= of_kind, np.minimum(_OF_A_KIND * sigma, counted), counted)
                    within = block_medians(counted, ok, self._shape, reach) <= ceiling
            raised = np.clip(OF_USUAL * of_kind, self._single, self._most)
            self._px = np.where(within, raised, self._single)
        self._unsure = Unsure(middle, ceiling) if median(counted[ok]) > ceiling else None
        if estimated and self._unsure is not None and np.quantile(sigma[ok], _TRIMMED) > _ALL_ALIKE * ceiling:
            self._px[:] = 0.0  # all are of one kind: those within the limit are so by chance

    def reject_far(self, index: NDArray[np.intp], sd: Float | None = None, *, estimated: bool = True) -> None:
        """Reject points with a standard deviation beyond the limit: their own, or ``sd`` (m, q) of the unknowns."""
        far = ~(self._sigma_px(index, sd, estimated=estimated) < self._px[index])
        mask = np.zeros(len(self._points.status), bool)
        mask[index[far]] = True
        self._points.reject(mask, PointStatus.SIGMA_TOO_LARGE)
        self.rejected += int(far.sum())

    def outcome(self, factor: Float, one_by_one: int) -> TestedResiduals:
        """Return the outcome of the test."""
        return TestedResiduals(factor, one_by_one, self.rejected, self._px, self._unsure)

    def _sigma_px(
        self, index: NDArray[np.intp], sd: Float | None = None, *, estimated: bool = True, in_depth: float = 1.0
    ) -> Float:
        plane, depth = sigma_px(self._fitter, self._points, index, self._xy_px, sd, estimated=estimated)
        return np.maximum(plane, in_depth * depth)


def _shared_texture(points: PointFits, index: NDArray[np.intp]) -> Float:
    """(m, 1) share of the squared gradients that the best comparison explains; the rest is in the others' scores."""
    return np.asarray(points.zncc[index].max(axis=1)[:, None] ** 2)


def _scale(points: PointFits, index: NDArray[np.intp], variance_factor: Float, sample: _Robust | None = None) -> None:
    """Scale variances by factors (m, q); correlations become those of a sample.

    Images of unequal noise change both: if camera 2 is noisier, its comparisons share more than the reference.
    """
    root, before = np.sqrt(variance_factor), points.covariance[index]
    points.epipolar_sigma_px[index] *= root[:, -1]
    if sample is not None and (_diagonal(before) > 0.0).all():
        L = _root(before)
        seen = L @ sample.independent.mean(axis=0) @ np.swapaxes(L, 1, 2)
        root = root * np.sqrt(_diagonal(before) / _diagonal(seen))
        before = seen
    points.covariance[index] = before * (root[:, :, None] * root[:, None, :])


def sigma_px(
    fitter: Fitter,
    points: PointFits,
    index: NDArray[np.intp],
    xy_px: Float,
    sd: Float | None = None,
    *,
    estimated: bool = True,
) -> tuple[Float, Float]:
    """(m,) standard deviations, px: of the position in camera 1's current image, and along the depth.

    The latter is in camera 2, along the epipolar line; in a motion it belongs to the displacement's part along the
    depth. The offset across the line is no part of a position, and its scatter is tested against its neighbours.
    Residuals that camera 2 shows at both times do not count in a motion: they are the shape's, which was tested. Of
    noise as the fit knows it, not ``estimated``, the position's along the depth counts, as in the fit.
    """
    rays = fitter.pair.cam1.rays_cam(xy_px[index]).xyz_mm
    w, sd = points.w[index, 0], np.sqrt(_diagonal(points.covariance[index])) if sd is None else sd
    per_px = depth_per_px(fitter.pair, rays, w)
    if sd.shape[1] == 2:
        return np.zeros(len(index)), sd[:, 0] / per_px
    z = points.G[index, 2, 0]  # depth of the current point, times w
    px = px_per_ray(fitter.pair, rays)[:, 0]
    return np.maximum(sd[:, 1], sd[:, 2]) * px / z, (sd[:, 3] * w / z**2 if estimated else sd[:, 0]) / per_px


def _diagonal(covariance: Float) -> Float:
    return np.asarray(np.diagonal(covariance, axis1=-2, axis2=-1))
