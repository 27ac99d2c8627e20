"""A part that pulls a match makes its point more uncertain, and the limit on that uncertainty still holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.field.parts.straddling import reject_straddling
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.matching import MatchOptions, prepare
from stereorig.core.status import PointStatus
from tests.support.matching_scene import Plane, Texture, digitise, paper_pair, render, true_w

SUBSET_PX, SPACING_PX = 21, 3.0
PAIR = paper_pair()
X, Y = np.meshgrid(np.arange(40.0, 121.0, SPACING_PX), np.arange(40.0, 121.0, SPACING_PX))
XY = np.stack([X.ravel(), Y.ravel()], axis=-1)
RAYS = PAIR.cam1.rays_cam(XY).xyz_mm


@pytest.fixture(scope="module")
def fitted() -> tuple[Fitter, PointFits]:
    """A plane, of which camera 2 sees the right half nearly a pixel further on."""
    rng, texture = np.random.default_rng(2), Texture(blob_mm=0.06)
    first = render(PAIR.cam1, Plane(), texture)
    left, right = (render(PAIR.cam2, Plane(np.array([x_mm, 0.0, 0.0])), texture) for x_mm in (0.0, 0.03))
    second = np.where(np.arange(left.shape[1]) < left.shape[1] // 2, left, right)
    images = [prepare(digitise(image, noise=4.0, rng=rng)) for image in (first, second)]
    fitter = Fitter(PAIR, images[0], images[1], None, None, MatchOptions(subset_px=SUBSET_PX), min_zncc=0.6)
    return fitter, fitter.fit(XY, true_w(PAIR.cam1, Plane(), XY), None)


def without_pulled(fitter: Fitter, points: PointFits, max_sigma_px: float) -> PointFits:
    left = points.take(np.arange(len(XY)))
    limited = replace(fitter, options=replace(fitter.options, max_sigma_px=max_sigma_px))
    texture = np.full(len(XY), fitter.ref1.pixels.var())
    reject_straddling(limited, left, shape=X.shape, xy_px=XY, rays=RAYS, texture=texture, spacing_px=SPACING_PX)
    return left


def sigma_px(points: PointFits) -> NDArray[np.float64]:
    """Standard deviation of the depth, as px that camera 2 sees it move by."""
    sd = np.sqrt(points.covariance[:, 0, 0])
    seen = [PAIR.cam2_from_cam1.apply(RAYS / (points.w[:, :1] + k * sd[:, None])) for k in (-0.5, 0.5)]
    near, far = (PAIR.cam2.lens.image_from_normalised(p[:, :2] / p[:, 2:]).xy for p in seen)
    return np.asarray(np.linalg.norm(far - near, axis=1))


def depth_px(points: PointFits) -> NDArray[np.float64]:
    """Depth beyond the plane's, as px that camera 2 sees it move by."""
    off = points.w[:, 0] - true_w(PAIR.cam1, Plane(), XY)[:, 0]
    return np.asarray(off * sigma_px(points) / np.sqrt(points.covariance[:, 0, 0]))


def test_a_point_that_a_part_makes_more_uncertain_than_asked_is_measured_without_it_or_rejected(
    fitted: tuple[Fitter, PointFits],
) -> None:
    fitter, before = fitted
    free = without_pulled(fitter, before, 10.0)
    most = 1.001 * np.nanmax(sigma_px(before))  # each match alone is within the limit
    beyond = free.ok & (sigma_px(free) > most)
    assert beyond.sum() >= 5
    limited = without_pulled(fitter, before, most)
    kept = beyond & limited.ok
    assert kept.any()
    assert (limited.status[beyond & ~kept] == PointStatus.NEIGHBOUR_MISMATCH).all()
    # no other point is lost
    np.testing.assert_array_equal(limited.ok, (free.ok & ~beyond) | kept)
    # what is measured again is that of one half, not of both
    assert np.nanmax(sigma_px(limited)) <= most
    halves = [np.median(depth_px(before)[side]) for side in (XY[:, 0] < 60.0, XY[:, 0] > 100.0)]
    off = np.abs(depth_px(limited)[kept, None] - halves).min(axis=1)
    assert (off < 4.0 * sigma_px(limited)[kept]).all()
