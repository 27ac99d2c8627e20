"""Points that correlate less than they must: something else is seen in a part of the subset.

A right match loses correlation to noise, the more the less texture its subset has; to the view, as a surface that turns
away from one camera is blurred over more of its texture; and to what all points about it lose, such as defocus. A point
within these is kept, however much worse than the best ones it is, and what its residuals do to it is in its standard
deviation (:mod:`core.field.checks.residual_test`). Far beyond, it is no match of one surface.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.field.checks.block_median import block_medians, least_about, reach_of, spacing_of
from core.field.points.fitter import PointFits
from core.field.points.starts import view_cosines
from core.robust import MAD_TO_SIGMA
from core.status import PointStatus

_LOST_TO_VIEW = 0.015
"""1 - zncc over the squared excess of the blur's variance, relative to one camera's own: three times what real speckle
loses on faces of 45 degrees."""
_MOST_EXCESS = 3.0  # a surface that is seen at half the width
_LEAST_IN_TIME = 0.675  # of the bound where something may have changed the view
_FINE = 2.0
_SHAPE_FACTOR, _SHAPE_LOSS = 12.0, 0.04
_WIDER = 3  # so far about a point that a crack is in a small part of it
_FEW = 12
_LEAST = 1e-7
_LOST = 0.25  # share of the points about a point from which on the others are no measure
_UNTRIED = (PointStatus.MASKED, PointStatus.OUTSIDE_IMAGE, PointStatus.LOW_TEXTURE)


class CorrelationLimits(NamedTuple):
    """Limit of 1 - zncc over what the points about a point lose: standard deviations of its logarithm, and bounds."""

    sigmas: float
    min_factor: float
    max_factor: float


def lost_correlation(
    points: PointFits,
    *,
    pair: StereoPair,
    shape: tuple[int, int],
    xy_px: Float,
    rays: Float,
    texture: Float,
    subset_px: int,
    limits: CorrelationLimits,
) -> Bool:
    """Return (n,) True for valid points that have lost more correlation than they must.

    Parameters
    ----------
    points
        n = rows x columns points, row by row.
    pair
        The calibrated cameras.
    shape
        Rows and columns.
    xy_px, rays
        (n, 2) px and (n, 3) normalised.
    texture
        (n,) grey-level variance of camera 1's subset.
    subset_px
        Width of the subset.
    limits
        Allowed loss over that of the points about a point, at its own texture.
    """
    ok = points.ok
    bad = np.zeros(len(ok), bool)
    if ok.sum() < _FEW:
        return bad
    reach = reach_of(subset_px, spacing_of(xy_px, shape))
    texture = np.maximum(texture, 1e-6)
    # in a motion both cameras at the reference do not count: the shape was measured with them, and checked
    expected = np.full_like(points.zncc, np.inf)
    counted = range(1) if points.zncc.shape[1] == 1 else range(1, points.zncc.shape[1])
    for k in counted:
        loss = np.where(ok, np.maximum(1.0 - points.zncc[:, k], _LEAST), 1.0)
        alike = block_medians(loss, ok, shape, reach)
        energy = loss * texture
        noise = block_medians(energy, ok, shape, reach)
        level = np.maximum(alike, noise / texture)
        excess = np.log(loss / level)
        scatter = MAD_TO_SIGMA * block_medians(np.abs(excess), ok, shape, reach, otherwise=np.inf)
        allowed = np.clip(np.exp(limits.sigmas * scatter), limits.min_factor, limits.max_factor)
        if points.zncc.shape[1] == 1:  # what takes less than this from a shape is found in the parts of its subset
            allowed = np.maximum(allowed, np.minimum(_SHAPE_FACTOR, _SHAPE_LOSS / level))
        if k == 1:
            best, strict = _of_the_best(loss, texture, ok, shape, _WIDER * reach, limits)
            # a face that loses much between the cameras before anything moves is a fine texture: it loses in time, too
            first = np.where(ok, np.maximum(1.0 - points.zncc[:, 0], _LEAST), 1.0)
            fine = first > _FINE * _of_the_best(first, texture, ok, shape, _WIDER * reach, limits)[0]
            level, allowed = np.where(fine, level, best), np.where(fine, allowed, strict)
        if k == 2:  # of camera 2 nothing but what is new
            level = np.maximum(level, 1.0 - points.zncc[:, 0])
        expected[:, k] = level * allowed
    if points.zncc.shape[1] > 1:
        expected[:, 1:] = np.minimum(expected[:, 1:], _where_many_are_lost(points, shape, reach, texture, limits))
    with np.errstate(invalid="ignore"):
        suspect = np.flatnonzero(ok & (1.0 - points.zncc > expected).any(axis=1))
    if len(suspect):
        valid = np.flatnonzero(ok)
        view = np.zeros_like(points.zncc)
        view[valid] = _excess_blur(points, pair, rays, valid) ** 2
        # what the points about a point lose to the view is in what they lose
        about = [block_medians(v, ok, shape, reach) for v in view.T]
        lost = _LOST_TO_VIEW * np.maximum(view - np.stack(about, axis=1), 0.0)
        bad[suspect] = (1.0 - points.zncc[suspect] > expected[suspect] + lost[suspect]).any(axis=1)
    return bad


def _where_many_are_lost(
    points: PointFits, shape: tuple[int, int], reach: int, texture: Float, limits: CorrelationLimits
) -> Float:
    """(n, k - 1) largest loss in time where many points are lost; inf elsewhere.

    What is left of a part that something else is seen in is no measure of what is usual there: the parts that kept most
    of their points are, and what the point lost between the cameras before anything happened.
    """
    ok = points.ok
    tried = ~np.isin(points.status, _UNTRIED)
    kept = block_medians(ok.astype(float), tried, shape, reach, otherwise=1.0, quantile=_LOST) > 0.5
    late = np.where(ok[:, None], np.maximum(1.0 - points.zncc, _LEAST), 1.0)
    level = np.repeat(late[:, :1], late.shape[1] - 1, axis=1)
    sound = ok & kept
    if sound.sum() >= _FEW:
        usual = np.median(late[sound, 1:] * texture[sound, None], axis=0)
        level = np.maximum(level, usual / texture[:, None])
    return np.where(kept[:, None], np.inf, limits.max_factor * level)


def _of_the_best(
    loss: Float, texture: Float, ok: Bool, shape: tuple[int, int], reach: int, limits: CorrelationLimits
) -> tuple[Float, Float]:
    """Level and allowed factor of camera 1 in time, from the points about a point that lose least.

    View and lens are the same in both images, so that all points of a texture lose alike but for noise. An open crack
    takes more from half of the points about it, whose median is then no measure.
    """
    level, scatter = least_about(np.log(loss * texture), ok, shape, reach)
    least = max(_LEAST_IN_TIME * limits.min_factor, 1.0)
    return np.exp(level) / texture, np.clip(np.exp(limits.sigmas * scatter), least, limits.max_factor)


def _excess_blur(points: PointFits, pair: StereoPair, rays: Float, index: np.ndarray) -> Float:
    """(m, k) variance of the blur across a comparison's image, on the reference's scale, less the reference's own."""
    own, other = view_cosines(pair, rays[index], points.w[index])
    seen = np.maximum(other / np.maximum(own, 1e-6), 1e-6)  # width in camera 2 over that in camera 1
    if points.zncc.shape[1] == 1:
        return _excess(seen[:, None])
    G = points.G[index]
    depth = G[:, 2, 0, None, None]
    affine = (G[:, :2, 1:3] - G[:, :2, :1] * (G[:, 2:, 1:3] / depth)) / depth
    turned = np.maximum(_narrower(affine), 1e-6)
    return _excess(np.stack([seen, turned, seen * turned], axis=1))


def _narrower(m: Float) -> Float:
    """Return the smaller singular value (m,) of matrices (m, 2, 2)."""
    square = (m**2).sum(axis=(1, 2))
    det = np.abs(m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0])
    return np.asarray(det / np.sqrt(0.5 * (square + np.sqrt(np.maximum(square**2 - 4.0 * det**2, 0.0)))))


def _excess(width: Float) -> Float:
    """Of the wider view's blur, on the scale of the finer one: either of the two may be the one that is turned away."""
    return np.minimum(np.maximum(width, 1.0 / width) ** 2 - 1.0, _MOST_EXCESS)
