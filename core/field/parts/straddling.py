"""Subsets of which a part lies on another face, moves otherwise or shows something else.

A patch that straddles a step, a ridge or a crack averages both sides, and its correlation need not show it: a part of
the subset pulls the match. Where the shape or the motion bends or jumps between points a subset apart, beside gaps, and
where residuals are larger than about them, the match is compared with what it is without each part of the subset. What
a part changes is the point's error to first order. Of some fifty parts one changes the match by so much by noise alone:
that is taken off, in squares. What is left is added to the point's standard deviation where it is small; a point that
is off by more is rejected.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.field.checks.block_median import SIGMAS_OF_QUARTER, SIGMAS_OF_TENTH, least_about, reach_of
from core.field.parts.beside_edges import beside_edges
from core.field.parts.subset_parts import Pull, pull_of_parts
from core.field.parts.subset_residuals import SubsetResiduals, subset_residuals
from core.field.points.fitter import Fitter, PointFits
from core.field.points.scales import depth_per_px, px_per_ray
from core.progress import CancelToken, raise_if_cancelled
from core.robust import spread_indices
from core.settings import DEFAULT_MAX_SIGMA_PX
from core.status import PointStatus

_FEW = 12
_WIDER = 3
_LOUDER = 4.5  # robust standard deviations of the residuals' energy about a point
_PART_SIGMAS = 5.0  # of the change without a part; some fifty parts are tried
_EDGE_SIGMAS = 4.0  # the same where the shape shows an edge, so that a part's pull is to be expected
_MOST_CORRELATED = 2.0  # variance of a match over that by white residuals, up to which it is no part's doing
_FAR_SIGMAS = 4.0  # a change beyond what correlated residuals are counted as
_OFF_SIGMAS = 3.0  # what a part changes by, over the point's standard deviation, beyond which the point is rejected
# and over px: less than what is delivered by default is no edge of a shape
_OFF_SHAPE_PX, _OFF_MOTION_PX = DEFAULT_MAX_SIGMA_PX, 0.03
_USUAL = 256  # points that tell how much parts change a usual match
_OF_WHITE, _SCATTER_OF_WHITE = 2.0, 0.26  # median of the largest change's significance, its logarithm's scatter
_AT_ONCE = 256
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
    cancel: CancelToken | None = None,
) -> int:
    """Reject points, NEIGHBOUR_MISMATCH, of which a part of the subset is off; return their number.

    Points whose match a part changes by less get that change added to their standard deviation.

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
    cancel
        Stops the work.
    """
    edges = beside_edges(fitter, points, shape, rays, spacing_px)
    index = np.flatnonzero((edges | _suspects(fitter, points, shape, texture, spacing_px)) & points.ok)
    if len(index) == 0:
        return 0
    usual = _Usual(fitter, points, xy_px, max(noise_factor, 1.0))
    bad = np.zeros(len(points.status), bool)
    for start in range(0, len(index), _AT_ONCE):
        raise_if_cancelled(cancel)
        some = index[start : start + _AT_ONCE]
        bad[some] = _pulled(fitter, points, some, xy_px, rays, edges[some], usual)
    points.reject(bad, PointStatus.NEIGHBOUR_MISMATCH)
    return int(bad.sum())


def _suspects(fitter: Fitter, points: PointFits, shape: tuple[int, int], texture: Float, spacing_px: float) -> Bool:
    """Return (n,) True beside gaps, and where residuals are unusual."""
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
    """What parts change at the usual points of a field: measured where a point changes by more than noise can explain.

    Attributes
    ----------
    least
        Variance of a usual point's match over that by white noise, below which no factor lies.
    """

    fitter: Fitter
    points: PointFits
    xy_px: Float
    least: float

    @cached_property
    def factors(self) -> Float:
        """(o, 2) variances over those by white noise, by comparison and direction."""
        return _usual_factors(self.fitter, self.points, self.xy_px, self.least)


def _usual_factors(fitter: Fitter, points: PointFits, xy_px: Float, least: float) -> Float:
    """(1 or 2, 2) variance of what parts change at usual points over that by white noise, by comparison and direction.

    A prefilter, blur at t or paint that changes with the load correlate the residuals of all points, and not all alike:
    a wider scatter of the significance, too, raises what is unusual.
    """
    ok = np.flatnonzero(points.ok)
    found, visible = subset_residuals(fitter, points, ok[spread_indices(len(ok), _USUAL)], xy_px)
    pulls = _pulls(fitter, found, visible)
    # edges pull at many points: those that are changed least are the measure
    quarter, tenth = np.log(np.quantile([pull.significance for pull in pulls], (0.25, 0.1), axis=1))
    scatter = np.maximum((quarter - tenth) / (SIGMAS_OF_TENTH - SIGMAS_OF_QUARTER), _SCATTER_OF_WHITE)
    unusual = (np.log(_PART_SIGMAS) - np.log(_OF_WHITE)) / _SCATTER_OF_WHITE
    level = quarter + SIGMAS_OF_QUARTER * scatter - np.log(_OF_WHITE)
    return np.asarray(np.maximum(np.exp(2.0 * (level + unusual * (scatter - _SCATTER_OF_WHITE))), least))


def _pulled(
    fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float, rays: Float, edges: Bool, usual: _Usual
) -> Bool:
    """Return (m,) True where a part of the subset is off by too much; what others change goes into the covariance."""
    least = np.where(edges, _EDGE_SIGMAS, _PART_SIGMAS)
    # a motion's reference pair was compared in its shape: it counts where something has changed since
    pulls = _pulls(fitter, *subset_residuals(fitter, points, index, xy_px))
    unit = _unit_px(fitter, points, index, rays)
    covariance = points.covariance[index]
    bad = np.zeros(len(index), bool)
    off_px = _OFF_SHAPE_PX if len(pulls) == 1 else _OFF_MOTION_PX
    for unknown, which, direction in _SHAPE if len(pulls) == 1 else _MOTION:
        pull = pulls[which]
        sure = pull.significance[:, direction] / least
        if not (sure > 1.0).any():  # nothing changes, whatever is usual
            continue
        sd = np.sqrt(covariance[:, unknown, unknown]) * unit[:, unknown]
        # residuals that are correlated everywhere, as those of blur, are no single part's
        noise_factor = usual.factors[which, direction]
        most = max(_MOST_CORRELATED, noise_factor)
        correlated = np.clip((sd / pull.sigma_px[:, direction]) ** 2, noise_factor, most)
        shift = np.take_along_axis(pull.shift_px[:, direction], pull.part[:, direction, None], axis=1)[:, 0]
        if len(pulls) == 2 and unknown == 3:  # what camera 2 shows at both times is the shape's
            some = np.flatnonzero(sure > 1.0)
            before = _pulls(fitter, *subset_residuals(fitter, points, index[some], xy_px, slice(1)))[0]
            shift[some] -= before.shift_px[np.arange(len(some)), direction, pull.part[some, direction]]
        far = np.abs(shift) > _FAR_SIGMAS * sd
        shift *= np.sqrt(np.maximum(1.0 - 1.0 / np.maximum(sure, 1.0) ** 2, 0.0))
        counts = (sure > np.sqrt(correlated)) | ((sure > np.sqrt(noise_factor)) & far)
        bad |= counts & (np.abs(shift) > np.maximum(_OFF_SIGMAS * sd, off_px))
        # beside a shape's edge a pull is expected: where all residuals are correlated it is doubtful, and is said
        doubtful = edges & (sure > 1.0) & ~counts & (len(pulls) == 1)
        shift = np.where(counts | doubtful, shift, 0.0)
        if len(pulls) == 2 or unknown == 0:  # a shape's offset is no part of a position
            bad |= (shift != 0.0) & ~(np.hypot(sd, shift) < fitter.options.max_sigma_px)
        points.covariance[index, unknown, unknown] += (shift / unit[:, unknown]) ** 2
    points.epipolar_sigma_px[index] = np.sqrt(points.covariance[index, -1, -1])
    for pull in pulls:
        bad |= pull.centre > 1.0
    return bad


def _pulls(fitter: Fitter, found: list[SubsetResiduals], visible: Bool) -> list[Pull]:
    """What parts do in each comparison; a fold is the shape's, and is looked for where its patch can hide it."""
    curved = fitter.terms == 6
    return [pull_of_parts(one, visible, 2 if curved else 1, folds=curved and fitter.comparisons == 1) for one in found]


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
