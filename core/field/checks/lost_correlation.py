"""Points whose correlation is too low: a part of the subset shows something else.

A right match loses correlation by noise, the more the less texture its subset has; by the view, as a surface that turns
away from one camera is blurred over more of its texture; and by effects that all points about it have, such as defocus.
A point within these limits is kept, even if it is much worse than the best ones; its standard deviation contains the
effect of its residuals (:mod:`stereorig.core.field.checks.residual_test`). Far above the limits it is no match of one
surface.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.checks.block_median import block_medians, least_about, reach_of, spacing_of
from stereorig.core.field.checks.local_surface import predict_from_neighbours
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.starts import view_cosines
from stereorig.core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight
from stereorig.core.status import PointStatus

_LOST_TO_VIEW = 0.015
"""1 - zncc over the squared excess of the blur's variance, relative to one camera's own: three times the loss of real
speckle on faces of 45 degrees.
"""
_MOST_EXCESS = 3.0  # a surface that is seen at half the width
_LEAST_IN_TIME = 0.675  # share of the bound if the view may have changed
_FINE = 2.0
_SHAPE_FACTOR, _SHAPE_LOSS = 12.0, 0.04
_WIDER = 3  # so far about a point that a crack is in a small part of it
_SWEEPS = 4  # of the robust smooth course
_FEW = 12
_LEAST = 1e-7
_LOST = 0.25  # share of the points about a point from which on the others are no measure
_UNTRIED = (PointStatus.MASKED, PointStatus.OUTSIDE_IMAGE, PointStatus.LOW_TEXTURE)


class CorrelationLimits(NamedTuple):
    """Limit of 1 - zncc over the loss of the points about a point: standard deviations of its logarithm, and bounds."""

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
    """Return (n,) True for valid points that have lost more correlation than the limits allow.

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
        Allowed loss over the loss of the points about a point, at its own texture.
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
        if points.zncc.shape[1] == 1:  # a smaller loss in a shape is found in the parts of its subset
            allowed = np.maximum(allowed, np.minimum(_SHAPE_FACTOR, _SHAPE_LOSS / level))
        if k == 1:
            best, strict = _of_the_best(loss, texture, ok, shape, _WIDER * reach, limits)
            # a face that loses much between the cameras before anything moves is a fine texture: it loses in time, too
            first = np.where(ok, np.maximum(1.0 - points.zncc[:, 0], _LEAST), 1.0)
            fine = first > _FINE * _of_the_best(first, texture, ok, shape, _WIDER * reach, limits)[0]
            level, allowed = np.where(fine, level, best), np.where(fine, allowed, strict)
        if k == 2:  # camera 2's loss at the reference is not counted again
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
        # the loss of the points about a point already contains their loss by the view
        about = [block_medians(v, ok, shape, reach) for v in view.T]
        lost = _LOST_TO_VIEW * np.maximum(view - np.stack(about, axis=1), 0.0)
        bad[suspect] = (1.0 - points.zncc[suspect] > expected[suspect] + lost[suspect]).any(axis=1)
    if bad.any() and points.zncc.shape[1] > 1:
        bad &= ~_loses_as_smoothly(points, shape, reach, texture, limits)
    return bad


def _loses_as_smoothly(
    points: PointFits, shape: tuple[int, int], reach: int, texture: Float, limits: CorrelationLimits
) -> Bool:
    """(n,) True at points whose loss follows a smooth course through the points about it, as defocus by height.

    A crack or a flake is narrow compared with the points that the course is fitted to: its points are off the course,
    and no point next to them counts as smooth.
    """
    ok = points.ok
    smooth = ok.copy()
    for k in range(1, points.zncc.shape[1]):
        values = np.log(np.where(ok, np.maximum(1.0 - points.zncc[:, k], _LEAST), 1.0) * texture)
        values -= np.median(values[ok])
        weights = ok.astype(float)
        for _ in range(_SWEEPS):
            course = predict_from_neighbours(
                values.reshape(shape), weights.reshape(shape), _WIDER * reach, slope_precision=1e-3, bend_precision=1e-3
            ).value.ravel()
            scatter = MAD_TO_SIGMA * float(np.median(np.abs(values - course)[ok]))
            weights = ok * biweight(((values - course) / max(BIWEIGHT_REACH * scatter, 1e-9)) ** 2)
        if limits.sigmas * scatter > np.log(limits.max_factor):  # about such a course as much is allowed as anywhere
            return np.zeros_like(ok)
        off = ok & (values > course + max(limits.sigmas * scatter, np.log(limits.min_factor)))
        width = 2 * reach + 1
        smooth &= cv2.dilate(off.astype(np.uint8).reshape(shape), np.ones((width, width), np.uint8)).ravel() == 0
    many = _where_many_are_lost(points, shape, reach, texture, limits)
    return smooth & (1.0 - points.zncc[:, 1:] <= many).all(axis=1)


def _where_many_are_lost(
    points: PointFits, shape: tuple[int, int], reach: int, texture: Float, limits: CorrelationLimits
) -> Float:
    """(n, k - 1) largest loss in time where many points are lost; inf elsewhere.

    In a part that shows something else, the few points left are not typical: the limit comes from parts that kept most
    of their points, and from the point's own loss between the cameras at the reference.
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
    """Excess of the wider view's blur, on the scale of the finer view: either camera may be the one turned away."""
    return np.minimum(np.maximum(width, 1.0 / width) ** 2 - 1.0, _MOST_EXCESS)
