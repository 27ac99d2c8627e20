"""Subsets with a part on another face, with another motion or with something else in front.

A patch that straddles a step, a ridge or a crack averages both sides, and its correlation need not show it: a part of
the subset pulls the match. If the shape or the motion bends or jumps between points a subset apart, next to gaps, and
if residuals are larger than around them, the match is compared with the match without each part of the subset. The
change by a part is the point's error to first order. The largest change among some fifty parts by noise alone is
subtracted, in squares. A small remainder is added to the point's standard deviation; a point with a larger one is
measured again without the part, unless the part holds its centre, and a plane patch as a curved one: it is rejected if
parts still pull.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.block_median import SIGMAS_OF_QUARTER, SIGMAS_OF_TENTH, least_about, reach_of
from stereorig.core.field.parts.near_edges import near_edges
from stereorig.core.field.parts.subset_parts import Pull, outside_centre, pixels_without, pull_of_parts
from stereorig.core.field.points.fitter import NOT_KEPT, Fitter, PointFits
from stereorig.core.field.points.scales import depth_per_px, px_per_ray
from stereorig.core.field.points.subset_residuals import SubsetResiduals, subset_residuals, subset_visible
from stereorig.core.field.region.visibility import MIN_SHARE, Visibility
from stereorig.core.matching.arguments import VisiblePixels
from stereorig.core.progress import CancelToken, raise_if_cancelled
from stereorig.core.robust import spread_indices
from stereorig.core.settings import SINGLE_MAX_SIGMA_PX
from stereorig.core.status import PointStatus

_FEW = 12
_WIDER = 3
_LOUDER = 4.5  # robust standard deviations of the residuals' energy about a point
_PART_SIGMAS = 5.0  # of the change without a part; some fifty parts are tried
_EDGE_SIGMAS = 4.0  # the same where the shape shows an edge, so that a part's pull is to be expected
_MOST_CORRELATED = 2.0  # variance of a match over that by white residuals, up to which it is no part's doing
_FAR_SIGMAS = 4.0  # a change farther than correlated residuals explain
_OFF_SIGMAS = 3.0  # change by a part, over the point's standard deviation, above which the point is rejected
# and in px: a smaller change than the default limit of results is no edge of a shape
_OFF_SHAPE_PX, _OFF_MOTION_PX = SINGLE_MAX_SIGMA_PX, 0.03
_USUAL = 256  # points from which the usual change by parts is estimated
_OF_WHITE, _SCATTER_OF_WHITE = 2.0, 0.26  # median of the largest change's significance, its logarithm's scatter
_AT_ONCE = 256
_OF_USUAL_CENTRE = 4.0  # times the loss of the centre at the field's usual points: blur takes as much from all
_FAR_PX = 1.0  # no part that is left out was seen to pull by half of it: another match
# share of the change without a part: its border is not the edge's, and a remainder above this still pulls
_BORDER = 0.2
# unknown, comparison counted from the last, direction in it
_SHAPE, _MOTION = ((0, -1, 0), (1, -1, 1)), ((1, -2, 0), (2, -2, 1), (3, -1, 0))


def reject_straddling(
    fitter: Fitter,
    points: PointFits,
    *,
    shape: tuple[int, int],
    xy_px: Float,
    rays: Float,
    texture: Float,
    spacing_px: float,
    noise_factor: float = 1.0,
    limit_px: Float | None = None,
    cancel: CancelToken | None = None,
) -> int:
    """Reject points, NEIGHBOUR_MISMATCH, whose match a part of the subset pulls too far; return their number.

    Points whose match a part changes by less get that change added to their standard deviation. Points of a shape are
    measured again before they are rejected, and may stay.

    Parameters
    ----------
    fitter, points
        The matcher, and n = rows x columns points with their tested covariances, changed in place.
    shape
        Rows and columns.
    xy_px, rays
        (n, 2) px of camera 1, and (n, 3) normalised.
    texture
        (n,) grey-level variance of camera 1's subset.
    spacing_px
        Distance of neighbouring points.
    noise_factor
        Variance of a usual point's match over that by white noise.
    limit_px
        (n,) largest standard deviation allowed; None: the fitter's.
    cancel
        Stops the work.
    """
    edges = near_edges(fitter, points, shape, rays, spacing_px)
    index = np.flatnonzero((edges | _suspects(fitter, points, shape, texture, spacing_px)) & points.ok)
    if len(index) == 0:
        return 0
    usual = _Usual(fitter, points, xy_px, max(noise_factor, 1.0))
    allowed = np.full(len(points.status), fitter.options.max_sigma_px) if limit_px is None else limit_px
    bad, part = np.zeros(len(points.status), bool), np.full(len(points.status), -1)
    for start in range(0, len(index), _AT_ONCE):
        raise_if_cancelled(cancel)
        some = index[start : start + _AT_ONCE]
        bad[some], part[some] = _pulled(fitter, points, some, xy_px, rays, edges[some], usual, allowed[some])
    pulled = int(bad.sum())
    if fitter.comparisons == 1 and pulled:
        if fitter.terms == 3:
            _measure_again(fitter.curved(), points, np.flatnonzero(bad), bad, xy_px, rays, usual, allowed, 0.0)
        rest, index = _without_parts(fitter, bad, part, shape, xy_px, spacing_px)
        _measure_again(rest, points, index, bad, xy_px, rays, usual, allowed, _BORDER)
    points.reject(bad, PointStatus.NEIGHBOUR_MISMATCH)
    return pulled


def _without_parts(
    fitter: Fitter, bad: Bool, part: NDArray[np.intp], shape: tuple[int, int], xy_px: Float, spacing_px: float
) -> tuple[Fitter, NDArray[np.intp]]:
    """Return a matcher that leaves the parts (n,) out of the subsets of ``bad`` points, and (m,) at which it can."""
    index = np.flatnonzero(bad & (part >= 0))
    seen = subset_visible(fitter, xy_px[index]) & pixels_without(part[index], fitter.options.subset_px)
    share, of_point = np.ones(len(bad)), np.full(len(bad), -1, np.int32)
    share[index], of_point[index] = seen.mean(axis=(1, 2)), np.arange(len(index))
    nothing = np.zeros((0, 4)), np.zeros((0, 0), np.uint8)
    rest = VisiblePixels(seen.astype(np.uint8), of_point)
    visibility = Visibility(xy_px, shape, spacing_px, *nothing, rest, share, np.zeros((0, 0), np.uint32))
    return replace(fitter, visibility=visibility), index[share[index] >= MIN_SHARE]


def _measure_again(
    fitter: Fitter,
    points: PointFits,
    which: NDArray[np.intp],
    bad: Bool,
    xy_px: Float,
    rays: Float,
    usual: _Usual,
    allowed_px: Float,
    unsure: float,
) -> None:
    """Measure points of a shape with another matcher; those without a part that pulls are ``bad`` no longer.

    The share ``unsure`` of the change that this makes goes into the covariance.
    """
    terms = points.w.shape[1]
    for index in (which[start : start + _AT_ONCE] for start in range(0, len(which), _AT_ONCE)):
        xy, ray, w, limit = xy_px[index], rays[index], points.w[index], allowed_px[index]
        fits = fitter.fit(xy, w, None)
        far = fitter.far_from_start(xy, fits, w, None, _FAR_PX)
        fits.covariance *= usual.least
        fits.covariance[:, 0, 0] += (unsure * (fits.w[:, 0] - w[:, 0])) ** 2
        fits.epipolar_sigma_px *= np.sqrt(usual.least)
        ok = np.flatnonzero(fits.ok & ~far)
        if len(ok) == 0:
            continue
        off, _ = _pulled(fitter, fits, ok, xy, ray, np.ones(len(ok), bool), usual, limit[ok])
        sd = np.sqrt(fits.covariance[ok, 0, 0]) * _unit_px(fitter, fits, ok, ray)[:, 0]
        kept = ok[~off & (sd < limit[ok])]
        found = fits.take(kept)
        points.put(index[kept], replace(found, w=found.w[:, :terms], G=found.G[..., :terms], **NOT_KEPT))
        bad[index[kept]] = False


def _suspects(fitter: Fitter, points: PointFits, shape: tuple[int, int], texture: Float, spacing_px: float) -> Bool:
    """Return (n,) True next to gaps, and for unusual residuals."""
    ok = points.ok
    if ok.sum() < _FEW:
        return ok
    subset = fitter.options.subset_px
    about = np.ones((2 * int(np.ceil(0.5 * subset / spacing_px)) + 3,) * 2, np.uint8)
    # a gap of a single point is noise's
    gaps = cv2.morphologyEx((~ok).astype(np.uint8).reshape(shape), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    out = cv2.dilate(gaps, about).ravel() > 0
    reach = _WIDER * reach_of(subset, spacing_px)
    for k in range(points.zncc.shape[1]):
        energy = np.log(np.where(ok, np.maximum((1.0 - points.zncc[:, k]) * texture, 1e-9), 1.0))
        level, scatter = least_about(energy, ok, shape, reach, every=2)
        out |= energy - level > _LOUDER * scatter
    return np.asarray(out)


@dataclass(frozen=True, eq=False)
class _Usual:
    """Changes by parts at a field's usual points: measured if a point changes by more than noise can explain.

    Attributes
    ----------
    least
        Lower limit of the factor: variance of a usual point's match over the one by white noise.
    """

    fitter: Fitter
    points: PointFits
    xy_px: Float
    least: float

    @cached_property
    def pulls(self) -> list[Pull]:
        """Effect of the parts in each comparison at a sample of the field."""
        ok = np.flatnonzero(self.points.ok)
        index = ok[spread_indices(len(ok), _USUAL)]
        found, visible = subset_residuals(self.fitter, self.points, index, self.xy_px)
        return _pulls(self.fitter, self.points.plane[index], found, visible)

    @cached_property
    def factors(self) -> Float:
        """(o, 2) variances over those by white noise, by comparison and direction."""
        return _usual_factors(self.pulls, self.least)

    def most_of_centre(self, which: int) -> float:
        """Return the centre's largest loss in a comparison that is not another surface's."""
        return max(1.0, _OF_USUAL_CENTRE * float(np.quantile(self.pulls[which].centre, 0.25)))


def _usual_factors(pulls: list[Pull], least: float) -> Float:
    """(1 or 2, 2) variance of the change by parts at usual points over white noise's, by comparison and direction.

    A prefilter, blur at t or paint that changes with the load correlate the residuals of all points, and not all alike:
    a wider scatter of the significance raises the limit of unusual changes, too.
    """
    # edges pull at many points: those that are changed least are the measure
    quarter, tenth = np.log(np.quantile([pull.significance for pull in pulls], (0.25, 0.1), axis=1))
    scatter = np.maximum((quarter - tenth) / (SIGMAS_OF_TENTH - SIGMAS_OF_QUARTER), _SCATTER_OF_WHITE)
    unusual = (np.log(_PART_SIGMAS) - np.log(_OF_WHITE)) / _SCATTER_OF_WHITE
    level = quarter + SIGMAS_OF_QUARTER * scatter - np.log(_OF_WHITE)
    return np.asarray(np.maximum(np.exp(2.0 * (level + unusual * (scatter - _SCATTER_OF_WHITE))), least))


def _pulled(
    fitter: Fitter,
    points: PointFits,
    index: NDArray[np.intp],
    xy_px: Float,
    rays: Float,
    edges: Bool,
    usual: _Usual,
    allowed_px: Float,
) -> tuple[Bool, NDArray[np.intp]]:
    """Return (m,) True where a part of the subset is off by too much, and (m,) which; others change the covariance.

    The part is -1 if it holds the centre, or if the centre shows something else.
    """
    least = np.where(edges, _EDGE_SIGMAS, _PART_SIGMAS)
    # a motion's reference pair was compared in its shape: it counts where something has changed since
    plane = points.plane[index]
    pulls = _pulls(fitter, plane, *subset_residuals(fitter, points, index, xy_px))
    unit = _unit_px(fitter, points, index, rays)
    covariance = points.covariance[index]
    bad = np.zeros(len(index), bool)
    off_px = _OFF_SHAPE_PX if len(pulls) == 1 else _OFF_MOTION_PX
    for unknown, which, direction in _SHAPE if len(pulls) == 1 else _MOTION:
        pull = pulls[which]
        sure = pull.significance[:, direction] / least
        if not (sure > 1.0).any():  # no significant change, whatever the usual one
            continue
        sd = np.sqrt(covariance[:, unknown, unknown]) * unit[:, unknown]
        # residuals that are correlated everywhere, as those from blur, are not the effect of a single part
        noise_factor = usual.factors[which, direction]
        most = max(_MOST_CORRELATED, noise_factor)
        correlated = np.clip((sd / pull.sigma_px[:, direction]) ** 2, noise_factor, most)
        shift = np.take_along_axis(pull.shift_px[:, direction], pull.part[:, direction, None], axis=1)[:, 0]
        if len(pulls) == 2 and unknown == 3:  # a change in camera 2 at both times belongs to the shape
            some = np.flatnonzero(sure > 1.0)
            shown = subset_residuals(fitter, points, index[some], xy_px, slice(1))
            before = _pulls(fitter, plane[some], *shown)[0]
            shift[some] -= before.shift_px[np.arange(len(some)), direction, pull.part[some, direction]]
        far = np.abs(shift) > _FAR_SIGMAS * sd
        shift *= np.sqrt(np.maximum(1.0 - 1.0 / np.maximum(sure, 1.0) ** 2, 0.0))
        counts = (sure > np.sqrt(correlated)) | ((sure > np.sqrt(noise_factor)) & far)
        bad |= counts & (np.abs(shift) > np.maximum(_OFF_SIGMAS * sd, off_px))
        # next to a shape's edge a pull is expected: if all residuals are correlated it is doubtful, and is added to the
        # variance
        doubtful = edges & (sure > 1.0) & ~counts & (len(pulls) == 1)
        shift = np.where(counts | doubtful, shift, 0.0)
        if len(pulls) == 2 or unknown == 0:  # a shape's offset is no part of a position
            bad |= (shift != 0.0) & ~(np.hypot(sd, shift) < allowed_px)
        points.covariance[index, unknown, unknown] += (shift / unit[:, unknown]) ** 2
    points.epipolar_sigma_px[index] = np.sqrt(points.covariance[index, -1, -1])
    part = np.where(outside_centre()[pulls[0].part[:, 0]], pulls[0].part[:, 0], -1)
    for which, pull in enumerate(pulls):
        lost = pull.centre > 1.0
        if lost.any():
            lost = pull.centre > usual.most_of_centre(which)
        bad |= lost
        part[lost] = -1
    return bad, part


def _pulls(fitter: Fitter, plane: Bool, found: list[SubsetResiduals], visible: Bool) -> list[Pull]:
    """Effect of the parts in each comparison, ``plane`` (m,) True for plane patches; a fold hides in curved ones."""
    curved, motion = fitter.terms == 6 and not plane.all(), fitter.comparisons == 3
    if not curved or not plane.any():
        folds = (0, 1)[: 2 if motion else 1] if curved else ()
        return [pull_of_parts(one, visible, 2 if curved else 1, folds=folds) for one in found]
    out = []
    for one in found:
        flat, bent = (
            pull_of_parts(SubsetResiduals(*(a[kind] for a in one)), visible[kind], degree, folds=folds)
            for kind, degree, folds in ((plane, 1, ()), (~plane, 2, (0, 1)))
        )
        both = [np.zeros((len(plane), *a.shape[1:]), a.dtype) for a in bent]
        for a, of_flat, of_bent in zip(both, flat, bent, strict=True):
            a[~plane] = of_bent
            if of_flat.shape[1:] == a.shape[1:]:
                a[plane] = of_flat
            else:  # shifts: a plane patch has no folds
                a[plane, :, : of_flat.shape[2]] = of_flat
        out.append(Pull(*both))
    return out


def _unit_px(fitter: Fitter, points: PointFits, index: NDArray[np.intp], rays: Float) -> Float:
    """(m, q) px that a unit of each unknown moves an image by."""
    w0 = points.w[index, 0]
    per_px = depth_per_px(fitter.pair, rays[index], w0)
    out = np.ones((len(index), points.covariance.shape[-1]))
    out[:, 0] = 1.0 / per_px
    if fitter.comparisons == 3:
        z = points.G[index, 2, 0]
        out[:, 1] = out[:, 2] = px_per_ray(fitter.pair, rays[index])[:, 0] / z
        out[:, 3] = w0 / z**2 / per_px
    return out
