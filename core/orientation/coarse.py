"""Coarse relative orientation from feature matches, for points tens of pixels off their epipolar lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import Rays, StereoPair, some_rays
from stereorig.core.errors import CalibrationError
from stereorig.core.field.points.features import Box, detect, match
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.seeding.search_region import scales
from stereorig.core.orientation.change import changed, offset_slopes, plausible_bump
from stereorig.core.orientation.estimate import estimate_change
from stereorig.core.orientation.matched import MatchedPoints

_BUMPS_RAD = (1e-3, 1e-2, 0.05)
_CLEARLY_MORE = 1.1
_TRIES = 1000
_SAMPLE = 6
_FEATURE_SIGMA_PX = 0.7
_WIDE_PX = 6.0
"""Limit for the first inliers: error that remains if a bump of some degrees is taken as linear."""
MIN_MATCHES = 24


def feature_matches(image1: MeasureImage, image2: MeasureImage, box: Box, step: int) -> tuple[MatchedPoints, int]:
    """Return matches between both images, right and wrong ones, and the factor by which the images were reduced."""
    whole2 = (0, 0, image2.shape[1], image2.shape[0])
    scale = scales((box, whole2), (image1.shape, image2.shape))[0]
    one = detect(image1.pixels, box=box, scale=scale)
    two = detect(image2.pixels, scale=scale)
    pairs = match(one, two)
    return MatchedPoints.of(one.xy_px[pairs[:, 0]], two.xy_px[pairs[:, 1]], step), scale


def features_off_px(pair: StereoPair, image1: MeasureImage, image2: MeasureImage) -> float | None:
    """Return the median distance from the epipolar lines, px, of feature matches that agree with one orientation.

    For reduced images it is divided by the factor by which features are located less well. None if no orientation
    agrees with enough of them.
    """
    matches, scale = feature_matches(image1, image2, (0, 0, image1.shape[1], image1.shape[0]), 0)
    try:
        moved = changed(pair, coarse_change(pair, matches, scale=scale))
    except CalibrationError:
        return None
    on_line = np.abs(moved.epipolar_residual_px(matches.xy1_px, matches.xy2_px)) < 3.0 * _FEATURE_SIGMA_PX * scale
    off = np.abs(pair.epipolar_residual_px(matches.xy1_px, matches.xy2_px)[on_line])
    return float(np.median(off)) / max(1.0, scale / 2.0)


def coarse_change(pair: StereoPair, matches: MatchedPoints, *, scale: int = 1) -> Float:
    """Return the change (5,) that most feature matches agree with, within some tenths of a pixel.

    Raises
    ------
    CalibrationError
        ``repair_no_match``.
    """
    finite = np.isfinite(pair.epipolar_residual_px(matches.xy1_px, matches.xy2_px))
    xy1, xy2 = matches.xy1_px[finite], matches.xy2_px[finite]
    sigma = _FEATURE_SIGMA_PX * max(1.0, float(scale))
    if len(xy1) < MIN_MATCHES:
        raise _no_match(len(xy1), 0)
    rays = pair.rays(xy1, xy2)
    best: tuple[Float, Bool] | None = None
    # over a narrow view a wide prior leads to changes far beyond the linear range: the smallest size with enough
    # inliers is taken
    for size in _BUMPS_RAD:
        found = _agreeing(pair, rays, np.linalg.inv(plausible_bump(pair)) / size**2, sigma)
        if best is None or found[1].sum() > _CLEARLY_MORE * best[1].sum():
            best = found
    assert best is not None
    change, inliers = best
    if inliers.sum() < MIN_MATCHES:
        raise _no_match(len(xy1), int(inliers.sum()))
    # wrong matches are on a line by chance: as many as on any other strip of that width
    by_chance = len(xy1) * 6.0 * sigma / max(float(np.ptp(xy2[:, 1])), 1.0)
    if inliers.sum() < 3.0 * by_chance:
        raise _no_match(len(xy1), int(inliers.sum()))
    # components that the matches do not determine are as small as those that they do
    agreeing = MatchedPoints(xy1[inliers], xy2[inliers], matches.step[finite][inliers])
    return estimate_change(pair, agreeing, start=change).change


def _agreeing(pair: StereoPair, rays: Rays, prior: NDArray[np.floating[Any]], sigma: float) -> tuple[Float, Bool]:
    """Change under a prior's inverse covariance, and the matches that agree with it."""
    inliers = _most_agreeing(pair, rays, prior, sigma)
    change = np.zeros(5)
    for limit in (_WIDE_PX, _WIDE_PX, 5.0, 4.0, 3.0, 3.0, 3.0):
        if inliers.sum() < MIN_MATCHES:
            break
        agreeing = some_rays(rays, inliers)
        J = offset_slopes(pair, change, agreeing)
        residual = changed(pair, change).epipolar_residual_of_rays(*agreeing)
        normal = J.T @ J / sigma**2 + prior
        change = change - np.linalg.solve(normal, J.T @ residual / sigma**2 + prior @ change)
        left = np.abs(changed(pair, change).epipolar_residual_of_rays(*rays))
        with np.errstate(invalid="ignore"):
            inliers = np.asarray(left < limit * sigma)
    return change, inliers


def _most_agreeing(pair: StereoPair, rays: Rays, prior: NDArray[np.floating[Any]], sigma: float) -> Bool:
    """Matches that agree with the best of many small samples, the offsets taken as linear in the change."""
    offset, J = pair.epipolar_residual_of_rays(*rays), offset_slopes(pair, np.zeros(5), rays)
    rng = np.random.default_rng(0)  # equal input gives equal output
    index = np.stack([rng.choice(len(offset), _SAMPLE, replace=False) for _ in range(_TRIES)])
    A, b = J[index], offset[index]
    normal = np.swapaxes(A, 1, 2) @ A / sigma**2 + prior
    trial = -np.linalg.solve(normal, (np.swapaxes(A, 1, 2) @ b[..., None]) / sigma**2)[..., 0]
    left = np.abs(offset + trial @ J.T)
    # the tight ones decide among samples that explain equally many
    votes = (left < _WIDE_PX * sigma).sum(axis=1) + (left < 2.0 * sigma).sum(axis=1)
    return np.asarray(left[int(np.argmax(votes))] < _WIDE_PX * sigma)


def _no_match(count: int, agreeing: int) -> CalibrationError:
    return CalibrationError(
        f"Of {count} feature matches between both cameras {agreeing} agree with any orientation of the cameras.",
        code="repair_no_match",
        remedy="Give images that both show the same textured surface, or calibrate again.",
    )
