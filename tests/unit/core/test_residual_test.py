"""The residual test: the block sums against a plain twin, and the reported standard uncertainty against the scatter."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from stereorig.core.errors import InputError
from stereorig.core.field.checks import residual_test as tested_module
from stereorig.core.field.checks.residual_test import _Limits, residual_test
from stereorig.core.field.checks.validity import ValidityOptions
from stereorig.core.field.growth.field import fill_field
from stereorig.core.field.growth.seed import seed_shape
from stereorig.core.field.growth.state import begin, prepare
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.observed_scatter import bring_to_observed, observed_over_reported
from stereorig.core.field.points.scales import depth_per_px
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching import MatchOptions, fit_motion, fit_shape
from stereorig.core.matching.cluster_robust import cluster_robust_covariance, cluster_robust_covariances
from stereorig.core.matching.kernels.cluster_robust import blocks_across
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.status import PointStatus
from tests.support import field_bench as bench
from tests.support.matching_scene import Plane, Texture, digitise, paper_pair, render, true_g, true_w
from tests.support.matching_twin import Twin

XY = np.array([[52.0, 61.0], [80.0, 80.0], [103.0, 94.0]])
AFTER = Plane(np.array([0.02, -0.01, 0.015]), np.array([[1.01, 0.02], [-0.015, 0.995], [0.03, -0.02]]))
SUBSET = 25


@pytest.fixture(scope="module")
def images():
    """Four pictures; something else shines through in those at t."""
    pair = paper_pair(kappa=2e-8)
    rng = np.random.default_rng(5)
    own, other = Texture(blob_mm=0.05), Texture(blob_mm=0.05, seed=9)
    out = [
        digitise(render(camera, plane, own), noise=2.0, rng=rng)
        for plane in (Plane(), AFTER)
        for camera in (pair.cam1, pair.cam2)
    ]
    for k in (2, 3):
        through = render((pair.cam1, pair.cam2)[k - 2], Plane(), other)
        out[k] = np.clip(0.85 * out[k] + 0.15 * through, 0, 255).astype(np.uint8)
    return pair, out


def twins_covariance(twin: Twin, p: np.ndarray) -> np.ndarray:
    """Sandwich with clustered errors, pixel by pixel and block by block."""
    count = len(twin.splines) - 1
    terms = twin.terms(p)
    steps = np.array([1e-7, 1e-5, 1e-5, 1e-3, *([1e-6, 1e-5, 1e-5] * 3)])[: len(p)]
    levels = [twin.residual(k, p) for k in range(count)]
    s2 = np.array([c for _, c, _ in levels]) ** 2 * [twin.density(k, p) for k in range(count)]
    W = np.diag(s2) - np.outer(s2, s2) / (1.0 + s2.sum())
    _, N = twin.equations(p, np.eye(len(p)))
    J = [twin.jacobian(k, p, steps) for k in range(count)]
    best = max(zncc for *_, zncc in levels)
    left = [(d + (1.0 - zncc) * twin.f) * best / zncc for d, _, zncc in levels]
    across = blocks_across(SUBSET)
    number = np.zeros((SUBSET, SUBSET), int)
    for a in range(across):
        inside = slice(a * SUBSET // across, (a + 1) * SUBSET // across)
        number[inside] += across * a
        number[:, inside] += a
    assert len(np.unique(number)) == across**2
    weighted = [sum(W[k, o] * J[k] for k in range(count)) * left[o][:, None] for o in range(count)]
    pulls = np.array([sum(part[number.ravel() == b].sum(0) for part in weighted) for b in range(across**2)])
    scale = 1.0 / np.sqrt(np.diag(N))
    z = scale[:, None] * np.linalg.solve(N * np.outer(scale, scale), scale[:, None] * pulls.T)
    texture = (twin.gradient @ np.linalg.inv(twin.to_px)) ** 2
    energy = np.bincount(number.ravel(), texture.sum(1))
    worth = energy.sum() ** 2 / (energy**2).sum()
    covariance = z @ z.T / (1.0 - 3.0 / worth)
    order = [0, terms] if count == 1 else [0, 4, 7, 10, 3]
    return covariance[np.ix_(order, order)]


def assert_alike(robust, theirs):
    """But for one factor: the share of noise in the gradients, which the twin does not know."""
    scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    ratio = np.trace(robust / scale) / len(theirs)
    assert 0.97 < ratio < 1.06
    assert np.abs(robust / scale - ratio * theirs / scale).max() < 0.02


@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 3), ("quintic", 5)])
def test_it_is_the_twins_for_a_motion(images, interpolation, order):
    pair, pictures = images
    options = MatchOptions(subset_px=SUBSET, interpolation=interpolation, tolerance_px=3e-6)
    fit = fit_motion(
        pair, *pictures, XY, true_w(pair.cam1, Plane(), XY), true_g(pair.cam1, Plane(), AFTER, XY), options
    )
    assert (fit.status == 0).all()
    robust, known = cluster_robust_covariance(pair, pictures, XY, fit.w, fit.G, fit.epipolar_px, options)
    assert known.all()
    for i, xy in enumerate(XY):
        twin = Twin(pair, pictures, xy, subset=SUBSET, order=order)
        theirs = twins_covariance(twin, np.array([*fit.w[i], fit.epipolar_px[i], *fit.G[i].ravel()]))
        assert_alike(robust[i], theirs)


def test_it_is_the_twins_for_a_shape(images):
    pair, pictures = images
    options = MatchOptions(subset_px=SUBSET, tolerance_px=3e-6)
    fit = fit_shape(pair, *pictures[:2], XY, true_w(pair.cam1, Plane(), XY), options)
    robust, _ = cluster_robust_covariance(pair, pictures[:2], XY, fit.w, None, fit.epipolar_px, options)
    for i, xy in enumerate(XY):
        twin = Twin(pair, pictures[:2], xy, subset=SUBSET, order=5)
        theirs = twins_covariance(twin, np.array([*fit.w[i], fit.epipolar_px[i]]))
        assert_alike(robust[i], theirs)


def test_points_outside_have_none_and_unknowns_must_fit(images):
    pair, pictures = images
    w = true_w(pair.cam1, Plane(), XY)
    far = XY.copy()
    far[1] = (5.0, 5.0)
    _, known = cluster_robust_covariance(pair, pictures[:2], far, w, None, np.zeros(3), MatchOptions(subset_px=SUBSET))
    assert known.tolist() == [True, False, True]
    with pytest.raises(InputError):
        cluster_robust_covariance(pair, pictures[:2], XY, w, np.zeros((3, 3, 3)), np.zeros(3))


# fields

MOTION = (0.02, -0.013, 0.03, 0.0006, -0.0004, 0.001)
OPTIONS = MeasureOptions(subset_px=21, patch="affine")


def pictures(*, noise=2.0, seed=0):
    return bench.take("block", 0.0, MOTION, seed=seed), bench.take("block", 1.0, MOTION, seed=seed + 1, noise=noise)


def through(image, share, where=None):
    """The picture, and another speckle pattern (its own, turned) over it."""
    mixed = np.rint((1.0 - share) * image + share * image[::-1, ::-1])
    return np.where(True if where is None else where, mixed, image).astype(np.uint8)


def measured(reference, now, options=OPTIONS):
    grid = bench.grid(spacing_px=6.0)
    field = ReferencePair(bench.pair(), *reference).motion(*now, grid, options)
    true = bench.truth(grid, bench.scene("block", 0.0, MOTION), bench.scene("block", 1.0, MOTION))
    return field, field.uvw_mm - true.uvw_mm


def reported_over_true(field, error):
    """Of u, v and w, rms over the valid points."""
    v = field.valid
    return np.sqrt((field.sigma_mm[v][:, 3:] ** 2).mean(0) / (error[v] ** 2).mean(0))


def test_noise_alone_is_told_as_it_is():
    reference, now = pictures()
    field, error = measured(reference, now)
    assert field.valid.all()
    factor = observed_factor(reference, now, field)
    assert np.all(np.abs(factor[:4] - 1.0) < 0.2), factor
    assert 0.9 < factor[4] < 1.5  # across the epipolar line the interpolation's own error shows, too
    assert np.all(np.abs(reported_over_true(field, error) - 1.0) < 0.15)


@pytest.mark.parametrize("share", [0.0, 0.15])
def test_only_a_motion_whose_first_points_show_noise_alone_is_judged_from_these(share, monkeypatch):
    """With another pattern shining through all are looked at; the variances are the whole sample's."""
    # with less noise the interpolation's own error shows in the offsets
    reference, clean = (bench.take("block", load, MOTION, seed=int(load), noise=6.0) for load in (0.0, 1.0))
    now = tuple(through(image, share) for image in clean)
    examined = []

    def counted(*given):
        if len(given[1]) == 4:  # no shape
            examined.append(len(given[2]))
        return cluster_robust_covariances(*given)

    monkeypatch.setattr(tested_module, "cluster_robust_covariances", counted)
    field = measured(reference, now)[0]
    first, *rest = examined
    assert first < 70
    assert max(rest, default=0) < 70 if share == 0.0 else max(rest) > 200
    monkeypatch.setattr(tested_module, "_FIRST", 1)
    whole = measured(reference, now)[0]
    np.testing.assert_array_equal(field.covariance, whole.covariance)
    np.testing.assert_array_equal(field.status, whole.status)


def observed_factor(reference, now, field):
    """Mean over points of the observed variances over the fit's own."""
    v = field.valid
    xy = np.stack([field.x_px, field.y_px], -1)[v]
    options = OPTIONS.match_options()
    fit = fit_motion(bench.pair(), *reference, *now, xy, field.starts.w[v], field.starts.G[v], options)
    robust, known = cluster_robust_covariance(
        bench.pair(), [*reference, *now], xy, fit.w, fit.G, fit.epipolar_px, options
    )
    assert known.all()
    reported = np.diagonal(fit.covariance, axis1=1, axis2=2)
    return (np.diagonal(robust, axis1=1, axis2=2) / reported).mean(0)


def test_another_pattern_shining_through_is_told_by_the_residuals_not_by_the_fit():
    reference, clean = pictures()
    now = tuple(through(image, 0.15) for image in clean)
    field, error = measured(reference, now)
    assert field.valid.mean() > 0.95
    factor = observed_factor(reference, now, field)
    assert factor[1:3].min() > 2.5  # the fit alone reports less than half of the variance
    ratio = reported_over_true(field, error)
    assert np.all((ratio > 0.7) & (ratio < 1.5)), ratio


@pytest.mark.parametrize("noise", [25.0, 40.0])
def test_images_much_noisier_than_the_reference_are_told_as_they_are(noise):
    """Their normalised grey levels, and so the residuals, are smaller than their noise by the correlation lost."""
    field, error = measured(*pictures(noise=noise))
    assert field.valid.mean() > (0.99 if noise < 30.0 else 0.8)  # beyond, many scatter by more than 0.1 px
    assert np.all(np.abs(reported_over_true(field, error) - 1.0) < 0.12)


@pytest.mark.parametrize("noises", [(8.0, 2.0), (2.0, 8.0)])
def test_a_motion_seen_by_one_noisier_camera_is_reported_as_it_scatters(noises):
    """Too few subsets for their scatter to show it; squares over the variances along, across and towards camera 1."""
    squares = []
    for seed in range(6):
        reference, now = (
            [bench.take("block", load, MOTION, seed=2 * seed, noise=noise)[c] for c, noise in enumerate(noises)]
            for load in (0.0, 1.0)
        )
        grid = bench.grid(spacing_px=10.0, margin_px=62.0)
        field = ReferencePair(bench.pair(), *reference).motion(*now, grid, OPTIONS)
        true = bench.truth(grid, bench.scene("block", 0.0, MOTION), bench.scene("block", 1.0, MOTION))
        assert field.valid.all()
        error = field.uvw_mm - true.uvw_mm
        whole = np.linalg.solve(field.covariance[..., 3:, 3:], error[..., None])[..., 0]
        each = (error / field.sigma_mm[..., 3:]) ** 2
        squares.append(np.stack([*np.moveaxis(each, -1, 0), (error * whole).mean(axis=-1)], axis=-1).reshape(-1, 4))
    ratio = np.sqrt(np.concatenate(squares).mean(axis=0))
    # some 200 subsets beside one another: one standard deviation is 0.05
    assert np.all(np.abs(ratio - 1.0) < 0.15), ratio


def test_noise_at_t_alone_does_not_touch_the_shape():
    reference, now = pictures(noise=15.0)
    field, error = measured(reference, now)
    shape = ReferencePair(bench.pair(), *reference).shape(bench.grid(spacing_px=6.0), OPTIONS)
    v = field.valid
    assert v.mean() > 0.99
    np.testing.assert_allclose(field.sigma_mm[v][:, :3], shape.sigma_mm[v], rtol=0.5)
    ratio = reported_over_true(field, error)
    assert np.all((ratio > 0.8) & (ratio < 1.25)), ratio


def test_only_points_that_scatter_too_far_are_refused():
    reference, clean = pictures()
    changed = np.zeros(clean[0].shape, bool)
    changed[:, 160:] = True
    now = tuple(through(image, 0.2, changed) for image in clean)
    # the comparison of correlations alone would be quicker to refuse
    wide = ValidityOptions(correlation_min_factor=1e3, correlation_max_factor=2e3)
    statuses = {}
    for limit_px in (0.02, 1.0):
        validity = replace(wide, max_sigma_px=limit_px)
        field, error = measured(reference, now, replace(OPTIONS, validity=validity))
        assert (field.status[field.x_px < 160 - 21] == PointStatus.OK).mean() > 0.99
        assert np.abs(error / field.sigma_mm[..., 3:])[field.valid].max() < 6.0
        statuses[limit_px] = field.status[field.x_px > 160 + 21]
    assert (statuses[0.02] == PointStatus.OK).mean() < 0.02
    assert (statuses[1.0] == PointStatus.OK).mean() > 0.4


@pytest.mark.parametrize(("over", "kept"), [(0.75, 0.0), (1.5, 1.0)])
@pytest.mark.parametrize(("depth_factor", "offset_factor"), [(1.0, 1.0), (1.0, 1.5), (1.5, 1.0)])
def test_depth_is_limited_by_what_residuals_show_whatever_the_fit_reports(depth_factor, offset_factor, over, kept):
    """Residuals show this many times the variances that the fit reports, by noise of one amount."""
    reference, _ = pictures()
    inputs = prepare(bench.pair(), reference, None, bench.grid(spacing_px=6.0), OPTIONS)
    state = fill_field(inputs, seed_shape(inputs, begin(inputs), None))
    points, count = state.points, int(state.points.ok.sum())
    sd = np.sqrt(np.diagonal(points.covariance[points.ok], axis1=1, axis2=2)).mean(0)
    limit = over * (sd[0] / depth_per_px(inputs.pair, inputs.rays, points.w[:, 0])).mean()
    factors = np.array([depth_factor, offset_factor])
    points.covariance /= np.sqrt(factors[:, None] * factors)
    tested = residual_test(state.fitter, points, xy_px=inputs.xy_px, texture=inputs.texture, max_sigma_px=limit)
    assert tested.factor == pytest.approx(factors, rel=0.25)
    assert points.ok.sum() / count == pytest.approx(kept, abs=0.05)


def test_matches_without_any_residual_stay_as_they_are():
    reference, _ = pictures()
    inputs = prepare(bench.pair(), reference, None, bench.grid(spacing_px=12.0), OPTIONS)
    state = fill_field(inputs, seed_shape(inputs, begin(inputs), None))
    points = state.points
    points.covariance[:2] = 0.0
    before = points.covariance.copy()
    limit = 0.1
    tested = residual_test(state.fitter, points, xy_px=inputs.xy_px, texture=inputs.texture, max_sigma_px=limit)
    assert tested.rejected == 0
    assert np.isfinite(tested.factor).all()
    np.testing.assert_array_equal(points.covariance[:2], before[:2])
    assert np.isfinite(points.covariance[points.ok]).all()
    points.covariance[:] = 0.0
    assert (
        residual_test(state.fitter, points, xy_px=inputs.xy_px, texture=inputs.texture, max_sigma_px=limit).rejected
        == 0
    )
    assert not points.covariance.any()


@pytest.mark.parametrize("blur_px", [0.5, 1.2])
def test_blur_at_t_is_told_as_it_is(blur_px):
    """Blocks of the subset alone told it 1.4 to 1.6 times too large in the plane."""
    rng = np.random.default_rng(7)
    reference = pictures()[0]
    clean = bench.take("block", 1.0, MOTION, noise=0.0)
    now = [cv2.GaussianBlur(image.astype(np.float64), (0, 0), blur_px) for image in clean]
    now = [np.clip(np.rint(image + rng.normal(0.0, 2.0, image.shape)), 0, 255).astype(np.uint8) for image in now]
    field, error = measured(reference, now)
    assert field.valid.mean() > 0.95
    assert np.abs(error / field.sigma_mm[..., 3:])[field.valid].max() < 6.0
    ratio = 1.0 / reported_over_true(field, error)
    # the field has some 70 subsets beside one another: their scatter is known to 9 %
    assert np.all((ratio > 0.85) & (ratio < 1.2)), ratio


def test_scatter_is_told_by_what_no_linear_motion_explains():
    """Errors of 1.4, 0.5 and 1.02 times the reported ones on a plate that is turned and strained."""
    rng = np.random.default_rng(3)
    grid = PointGrid.rectangle(40.0, 40.0, 600.0, 480.0, spacing_px=20.0)
    rig, xy = paper_pair(), grid.xy_px.reshape(-1, 2)
    rays = rig.cam1.rays_cam(xy).xyz_mm
    depth = 300.0 + 0.3 * rays[:, 0] * 300.0
    points = PointFits.empty(len(xy), 3)
    points.w[:] = 0.0
    points.w[:, 0] = 1.0 / depth
    turn = np.array([[1.0, -0.02, 0.01], [0.02, 1.001, 0.0], [-0.01, 0.0, 1.0]])
    R, sd = rig.cam1.cam_from_sys.rotation, np.array([1.0, 2.0, 5.0]) * 1e-3
    factor = np.array([1.4, 0.5, 1.02])
    error = rng.normal(size=(len(xy), 3)) * sd * factor
    points.G[:] = 0.0
    points.G[:, :, 0] = ((rays * depth[:, None]) @ turn.T + error @ R.T + 0.4) / depth[:, None]
    points.covariance[:] = np.diag([1e-18, 0.0, 0.0, 0.0, 1.0])
    points.covariance[:, 1:4, 1:4] = (R @ np.diag(sd**2) @ R.T) / depth[:, None, None] ** 2
    points.status[:] = PointStatus.OK
    every, shape = np.arange(len(xy)), grid.shape
    found = observed_over_reported(rig, points, every, xy, shape, 15)
    assert found == pytest.approx(factor, rel=0.1)
    before = points.covariance.copy()
    bring_to_observed(rig, points, every, xy, shape, 15)
    size = np.diagonal(R.T @ points.covariance[:, 1:4, 1:4] @ R, axis1=1, axis2=2) * depth[:, None] ** 2 / sd**2
    assert np.sqrt(size) == pytest.approx(np.tile([found[0], found[1], 1.0], (len(xy), 1)), rel=1e-6)
    np.testing.assert_array_equal(points.covariance[:, 0, 0], before[:, 0, 0])
    torn = replace(points, G=points.G.copy(), covariance=before)
    torn.G[xy[:, 0] > 560.0, :, 0] += 0.5 / depth[xy[:, 0] > 560.0, None]
    found = observed_over_reported(rig, torn, every, xy, shape, 15)
    assert np.all((found > factor) & (found < np.maximum(1.3 * factor, 1.0 + 1e-9))), found  # nothing is lowered there
    few = observed_over_reported(rig, points, every, xy, shape, 201)  # subsets of 201 px: some five beside one another
    assert np.isnan(few).all()


@pytest.mark.fault(37)
@pytest.mark.parametrize(
    ("middle", "scatter", "depth", "most"),
    [
        (0.09, 0.05, False, 0.25),
        (0.09, 1.2, False, 0.1),
        (0.11, 0.5, False, 0.1),
        (0.107, 0.1, False, 0.25),  # of one kind, as camera 1 blurred by 2 px
        (0.115, 0.1, True, 0.25),  # along the depth, of camera 2 blurred by 2 px
        (0.15, 0.6, True, 0.1),
    ],
)
def test_limits_of_a_motion_rise_for_one_kind_of_points_alone(middle, scatter, depth, most):
    """Another pattern in parts of the subsets: its points are unsure each by another amount, and one was 0.7 px off."""

    class Known(_Limits):
        def _sigma_px(self, index, sd=None, *, estimated=True, in_depth=1.0):
            return (in_depth if depth else 1.0) * sigma[index]

    shape = (30, 30)
    xy = np.stack(np.meshgrid(10.0 * np.arange(30), 10.0 * np.arange(30)), axis=-1).reshape(-1, 2)
    sigma = middle * np.exp(scatter * np.random.default_rng(0).standard_normal(len(xy)))
    points = PointFits.empty(len(xy), 3)
    points.status[:] = PointStatus.OK
    limits = Known(SimpleNamespace(comparisons=3, options=SimpleNamespace(subset_px=21)), points, xy, shape, 0.25)
    limits.follow()
    limits.reject_far(np.arange(len(xy)))
    assert sigma[points.ok].max() < most
    assert points.ok.mean() == pytest.approx((sigma < most).mean(), abs=0.05)
