"""Point-level matching against closed-form truth: shape, motion, errors, statuses."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.errors import ImageError, InputError
from stereorig.core.matching import MatchOptions, fit_motion, fit_shape, prepare
from stereorig.core.matching.geometry import (
    covariance_xyz,
    covariance_xyzuvw,
    motion_geometry,
    plane_from_angles,
    shape_geometry,
)
from stereorig.core.threads import available_threads, run_ranges, set_threads, threads
from tests.support.matching_scene import Plane, Texture, digitise, grid, paper_pair, render, true_g, true_w

PLANES = {
    "rest": Plane(),
    "moved": Plane(np.array([0.0123, -0.0241, 0.0371])),
    "strained": Plane(np.zeros(3), np.eye(3)[:, :2] @ np.diag([1.05, 0.985])),
    "turned": Plane(np.zeros(3), Rotation.from_euler("z", 25, degrees=True).as_matrix()[:, :2]),
    "tilted": Plane(np.zeros(3), Rotation.from_rotvec([0.26, -0.2, 0.0]).as_matrix()[:, :2]),
}
XY = grid(margin=34)


@cache
def images(name):
    pair, texture = paper_pair(), Texture()
    return tuple(render(camera, PLANES[name], texture) for camera in (pair.cam1, pair.cam2))


def noisy(name, noise, rng):
    return tuple(digitise(image, noise=noise, rng=rng) for image in images(name))


def starts(name):
    pair = paper_pair()
    w, G = true_w(pair.cam1, PLANES["rest"], XY), true_g(pair.cam1, PLANES["rest"], PLANES[name], XY)
    G = G.copy()
    G[:, :2, 0] += np.array([3e-5, -3e-5])  # 0.36 px off
    return w * np.array([1.00003, 1.0, 1.0]), G


def truth(name):
    pair = paper_pair()
    at = pair.cam1.back_project_to_plane(XY).xyz_mm
    return at, PLANES[name].position(at[:, :2]) - at


@pytest.mark.parametrize("off_rad", [0.0, 1e-12, 1e-9, 1e-7, 1e-3, 0.1])
@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.6, -0.48, 0.64)])
def test_half_a_turn_is_reported_as_half_a_turn(axis, off_rad):
    pair = paper_pair()
    w = true_w(pair.cam1, PLANES["rest"], XY)
    true = Rotation.from_rotvec((np.pi - off_rad) * np.array(axis))
    turned = Plane(np.array([1.0, -2.0, 5.0]), true.as_matrix()[:, :2])
    found = motion_geometry(pair, XY, w, true_g(pair.cam1, PLANES["rest"], turned, XY)).rotation_rad
    angle = np.linalg.norm(found, axis=1)
    # G's own rounding, 1e-16 over the rays' differences across a patch of 1e-2, and twice that in a product
    np.testing.assert_allclose(angle, np.pi - off_rad, atol=1e-12)
    error = (Rotation.from_rotvec(found) * true.inv()).magnitude()
    np.testing.assert_allclose(error, 0.0, atol=1e-12)


@pytest.mark.parametrize(("interpolation", "limit_um"), [("cubic", 0.06), ("quintic", 0.03)])
def test_noise_free_shape_is_the_plane(interpolation, limit_um):
    pair = paper_pair()
    w, _ = starts("rest")
    fit = fit_shape(pair, *images("rest"), XY, w, MatchOptions(subset_px=21, interpolation=interpolation))
    assert (fit.status == 0).all()
    shape = shape_geometry(pair, XY, fit.w)
    assert np.sqrt((shape.xyz_mm[:, 2] ** 2).mean()) < limit_um * 1e-3
    np.testing.assert_allclose(shape.normal_sys, [[0, 0, 1]] * len(XY), atol=2e-3)
    assert np.abs(fit.epipolar_px).max() < 0.004


@pytest.mark.parametrize("name", ["moved", "strained", "turned", "tilted"])
@pytest.mark.parametrize("interpolation", ["cubic", "quintic"])
def test_noise_free_motion_of_a_stretch_patch(name, interpolation):
    pair = paper_pair()
    options = MatchOptions(subset_px=21, interpolation=interpolation)
    fit = fit_motion(pair, *images("rest"), *images(name), XY, *starts(name), options)
    assert (fit.status == 0).all()
    motion = motion_geometry(pair, XY, fit.w, fit.G)
    error_um = 1e3 * (motion.uvw_mm - truth(name)[1])
    assert np.sqrt((error_um**2).mean(0)).max() < (0.1 if interpolation == "cubic" else 0.06)


@pytest.mark.parametrize(("interpolation", "patch"), [("quintic", "affine"), ("quintic", "rigid"), ("cubic", "affine")])
@pytest.mark.parametrize("mean", [3e3, 1e5, 3e5])
def test_images_whose_mean_is_thousands_of_times_their_contrast_are_measured(mean, interpolation, patch):
    """The same shape and motion but for the rounding of pixels that high to float32."""
    pair, rng = paper_pair(), np.random.default_rng(3)
    pictures = [image.astype(float) for image in (*noisy("rest", 2.0, rng), *noisy("moved", 2.0, rng))]
    w, G = starts("moved")
    options = MatchOptions(subset_px=21, interpolation=interpolation, patch=patch)
    plain = fit_motion(pair, *pictures, XY, w, G, options)
    raised = [image + mean for image in pictures]
    found = fit_motion(pair, *raised, XY, w, G, options)
    assert (found.status == 0).all()
    shape, flat = fit_shape(pair, *raised[:2], XY, w, options), fit_shape(pair, *pictures[:2], XY, w, options)
    assert (shape.status == 0).all()
    # the last step is smaller than 1e-3 px, a tenth of sigma; a grey level of 3e5 is rounded by 0.02, noise 2
    share = 0.1 + 3e-7 * mean
    for a, b, sigma in (
        (found.w[:, 0], plain.w[:, 0], np.sqrt(plain.covariance[:, 0, 0])),
        (found.G[:, 2, 0], plain.G[:, 2, 0], np.sqrt(plain.covariance[:, 3, 3])),
        (shape.w[:, 0], flat.w[:, 0], np.sqrt(flat.covariance[:, 0, 0])),
    ):
        assert np.abs((a - b) / sigma).max() < share
    np.testing.assert_allclose(found.noise, plain.noise, rtol=0.05)


def test_noise_stays_within_the_study_and_is_reported():
    pair, rng = paper_pair(), np.random.default_rng(1)
    options = MatchOptions(subset_px=21)
    w, G = starts("moved")
    error, xyz_error, variance, offset, offset_variance, z_variance = [], [], [], [], [], []
    for _ in range(6):
        fit = fit_motion(pair, *noisy("rest", 2.0, rng), *noisy("moved", 2.0, rng), XY, w, G, options)
        assert (fit.status == 0).all()
        error.append(1e3 * (motion_geometry(pair, XY, fit.w, fit.G).uvw_mm - truth("moved")[1]))
        xyz_error.append(1e3 * shape_geometry(pair, XY, fit.w).xyz_mm[:, 2])
        covariance = covariance_xyzuvw(pair, XY, fit.w, fit.G, fit.covariance)
        variance.append(1e6 * np.diagonal(covariance, axis1=1, axis2=2)[:, 3:])
        z_variance.append(1e6 * covariance[:, 2, 2])
        offset.append(fit.epipolar_px)
        offset_variance.append(fit.epipolar_sigma_px**2)
    error = np.array(error)
    assert (np.sqrt((error**2).mean((0, 1))) < [0.19, 0.19, 0.29]).all()
    assert abs(error[..., 2].mean()) < 0.06
    empirical = np.sqrt(error.var(axis=0, ddof=1).mean(0))
    ratio = np.sqrt(np.mean(variance, axis=(0, 1))) / empirical
    assert ((ratio > 0.85) & (ratio < 1.15)).all()
    assert 0.85 < np.sqrt(np.mean(z_variance)) / np.sqrt(np.var(xyz_error, axis=0, ddof=1).mean()) < 1.15
    assert 0.85 < np.sqrt(np.mean(offset_variance)) / np.sqrt(np.var(offset, axis=0, ddof=1).mean()) < 1.15


def test_strong_noise_biases_little():
    pair, rng = paper_pair(), np.random.default_rng(6)
    w, G = starts("moved")
    error = []
    for _ in range(20):
        fit = fit_motion(
            pair, *noisy("rest", 6.0, rng), *noisy("moved", 6.0, rng), XY, w, G, MatchOptions(subset_px=21)
        )
        assert (fit.status == 0).all()
        error.append(1e3 * (motion_geometry(pair, XY, fit.w, fit.G).uvw_mm - truth("moved")[1]))
    assert abs(np.mean(error, axis=(0, 1))[2]) < 0.15
    assert abs(np.mean(fit.noise) - 6.0) < 0.6


def test_shape_noise_and_its_covariance():
    pair, rng = paper_pair(), np.random.default_rng(2)
    w, _ = starts("rest")
    for subset, limit_um in ((21, 0.22), (33, 0.14)):
        error, variance = [], []
        for _ in range(8):
            fit = fit_shape(pair, *noisy("rest", 2.0, rng), XY, w, MatchOptions(subset_px=subset))
            error.append(1e3 * shape_geometry(pair, XY, fit.w).xyz_mm[:, 2])
            variance.append(1e6 * covariance_xyz(pair, XY, fit.w, fit.covariance)[:, 2, 2])
        error = np.array(error)
        assert np.sqrt((error**2).mean()) < limit_um
        assert abs(error.mean()) < 0.03
        assert 0.85 < np.sqrt(np.mean(variance) / error.var(axis=0, ddof=1).mean()) < 1.15


def test_a_wrong_cy_shows_as_epipolar_offset_and_not_as_motion():
    true_pair, wrong = paper_pair(), paper_pair(cy2_error=-0.1)
    fit = fit_motion(wrong, *images("rest"), *images("moved"), XY, *starts("moved"), MatchOptions(subset_px=21))
    assert (fit.status == 0).all()
    error_um = 1e3 * (motion_geometry(true_pair, XY, fit.w, fit.G).uvw_mm - truth("moved")[1])
    assert np.abs(error_um.mean(0)).max() < 0.15
    # sign and size by an independent triangulation of the exact image points
    at = true_pair.cam1.back_project_to_plane(XY).xyz_mm
    expected = wrong.epipolar_residual_px(true_pair.cam1.project(at).xy, true_pair.cam2.project(at).xy)
    np.testing.assert_allclose(fit.epipolar_px.mean(), expected.mean(), rtol=0.05)
    assert abs(abs(expected.mean()) - 0.1) < 0.01


def test_rotation_and_stretch_are_reported_in_their_frames():
    pair = paper_pair()
    options = MatchOptions(subset_px=33, interpolation="quintic")
    xy = XY[::7]
    w, G = (array[::7] for array in starts("strained"))
    fit = fit_motion(pair, *images("rest"), *images("strained"), xy, w, G, options)
    motion = motion_geometry(pair, xy, fit.w, fit.G)
    np.testing.assert_allclose(motion.stretch, [[0.05, -0.015, 0.0]] * len(xy), atol=3e-4)
    np.testing.assert_allclose(motion.rotation_rad, 0.0, atol=1e-3)
    w, G = (array[::7] for array in starts("tilted"))
    fit = fit_motion(pair, *images("rest"), *images("tilted"), xy, w, G, options)
    motion = motion_geometry(pair, xy, fit.w, fit.G)
    np.testing.assert_allclose(motion.rotation_rad, [[0.26, -0.2, 0.0]] * len(xy), atol=1.5e-3)
    np.testing.assert_allclose(motion.stretch, 0.0, atol=4e-4)


def test_points_that_cannot_be_matched_say_why():
    pair = paper_pair()
    one, two = images("rest")
    w = true_w(pair.cam1, PLANES["rest"], np.array([[4.0, 80.0], [80.0, 80.0], [80.0, 80.0]]))
    w[2] = np.nan
    xy = np.array([[4.0, 80.0], [80.0, 80.0], [80.0, 80.0]])
    assert list(fit_shape(pair, one, two, xy, w).status) == [3, 0, 1]
    flat = np.full_like(one, 90.0)
    assert fit_shape(pair, flat, two, xy[1:2], w[1:2]).status[0] == 4
    assert fit_shape(pair, one, flat, xy[1:2], w[1:2]).status[0] == 4
    noise = np.random.default_rng(0).normal(100.0, 2.0, one.shape)
    assert fit_shape(pair, noise, two, xy[1:2], w[1:2]).status[0] == 4
    far = fit_shape(pair, one, two, xy[1:2], w[1:2] * [1.5, 1.0, 1.0])
    assert far.status[0] != 0
    assert np.isnan(far.w).all()


@pytest.mark.fault(36)
def test_too_little_texture_is_refused():
    pair, rng = paper_pair(), np.random.default_rng(7)
    w, G = starts("rest")
    plane = PLANES["rest"]
    x, y = np.meshgrid(np.arange(160.0), np.arange(160.0))

    def stripes(camera):
        return 120.0 + 80.0 * np.sin(12.0 * plane.material(camera, np.stack([x, y], -1)) @ [0.707, -0.707])

    for weak in (
        [120.0 + 0.01 * (image - 120.0) for image in images("rest")],  # half a grey level of texture under the noise
        [stripes(pair.cam1), stripes(pair.cam2)],
    ):
        one, two = (digitise(image, noise=2.0, rng=rng) for image in weak)
        one_t, two_t = (digitise(image, noise=2.0, rng=rng) for image in weak)
        shape = fit_shape(pair, one, two, XY, w, MatchOptions(subset_px=21))
        motion = fit_motion(pair, one, two, one_t, two_t, XY, w, G, MatchOptions(subset_px=21))
        for fit in (shape, motion):
            assert (fit.status != 0).all()
            assert (fit.status == 4).mean() > 0.5
            assert np.isnan(fit.w).all()


def test_prepared_and_raw_images_give_the_same():
    pair = paper_pair()
    w, _ = starts("rest")
    raw = fit_shape(pair, *images("rest"), XY, w)
    prepared = fit_shape(pair, *(prepare(image) for image in images("rest")), XY, w)
    np.testing.assert_array_equal(raw.w, prepared.w)


def test_rigid_patch_follows_rotations_but_not_strain():
    pair = paper_pair()
    options = MatchOptions(subset_px=21, patch="rigid")
    for name, low, high in (("turned", 0.0, 0.1), ("tilted", 0.0, 0.1), ("strained", 0.4, 4.0)):
        fit = fit_motion(pair, *images("rest"), *images(name), XY, *starts(name), options)
        assert (fit.status == 0).all()
        motion = motion_geometry(pair, XY, fit.w, fit.G)
        np.testing.assert_allclose(motion.stretch, 0.0, atol=1e-9)  # the constraint holds exactly
        error_um = 1e3 * np.sqrt(((motion.uvw_mm - truth(name)[1]) ** 2).mean(0)).max()
        assert low <= error_um < high  # 0.4 um per percent of strain at the least, as the study found


def test_all_converge_from_a_pixel_off_in_any_direction():
    pair = paper_pair()
    options = MatchOptions(subset_px=21)
    w, G = starts("moved")
    exact = fit_motion(pair, *images("rest"), *images("moved"), XY, w, G, options)
    for angle in np.arange(8) * np.pi / 4:
        start = G.copy()
        start[:, 0, 0] += np.cos(angle) / 12000.0
        start[:, 1, 0] += np.sin(angle) / 12000.0
        fit = fit_motion(pair, *images("rest"), *images("moved"), XY, w * [1.0001, 1.0, 1.0], start, options)
        assert (fit.status == 0).all()
        np.testing.assert_allclose(fit.G[:, :2, 0] * 12000.0, exact.G[:, :2, 0] * 12000.0, atol=2e-3)
        assert fit.iterations.mean() < 7


def test_a_rate_that_is_known_saves_a_step_and_leaves_what_a_full_iteration_finds():
    """Without a rate, a point a hundredth of a pixel off takes a second step that its own noise exceeds many times."""
    rng = np.random.default_rng(11)
    pair, four = paper_pair(), noisy("rest", 2.0, rng) + noisy("moved", 2.0, rng)
    w, G = starts("moved")
    options = MatchOptions(subset_px=33, interpolation="cubic", tolerance_px=1e-3)
    full = fit_motion(pair, *four, XY, w, G, replace(options, tolerance_px=1e-6))
    assert (full.iterations > 2).all()
    assert np.isfinite(full.rate).all()
    # a start as a prediction gives it: off by some hundredth of a pixel
    near = full.G.copy()
    near[:, :2, 0] += 1.2e-2 / 12_000.0 * rng.choice([-1.0, 1.0], (len(XY), 2))
    slow = fit_motion(pair, *four, XY, full.w, near, options)
    fast = fit_motion(pair, *four, XY, full.w, near, replace(options, first_rate=float(np.quantile(full.rate, 0.9))))
    assert slow.iterations.mean() > 1.5
    assert (fast.iterations == 1).mean() > 0.9
    assert np.isnan(fast.rate[fast.iterations == 1]).all()
    assert (fast.status == full.status).all()
    sigma = np.sqrt(np.diagonal(full.covariance, axis1=1, axis2=2)[:, 1:4])
    left = (fast.G - full.G)[..., 0] / sigma
    # the start's 2.5 standard deviations, times the rate
    assert np.sqrt((left**2).mean()) < 0.05
    assert np.abs(left).max() < 0.3


def test_gain_and_offset_of_the_images_change_nothing():
    pair = paper_pair()
    w, G = starts("moved")
    options = MatchOptions(subset_px=21, tolerance_px=1e-5)
    plain = fit_motion(pair, *images("rest"), *images("moved"), XY, w, G, options)
    one, two = images("moved")
    lit = fit_motion(
        pair, images("rest")[0], 40.0 * images("rest")[1], 0.3 * one + 17.0, 2.0 * two - 90.0, XY, w, G, options
    )
    np.testing.assert_allclose(lit.zncc, plain.zncc, atol=2e-6)
    error = 1e3 * (motion_geometry(pair, XY, lit.w, lit.G).uvw_mm - motion_geometry(pair, XY, plain.w, plain.G).uvw_mm)
    assert np.abs(error).max() < 0.05  # the weights change with the contrast, the answer hardly


@pytest.mark.fault(44)
def test_threads_change_no_digit():
    pair, rng = paper_pair(), np.random.default_rng(3)
    before = threads()
    four = [prepare(image) for image in (*noisy("rest", 2.0, rng), *noisy("moved", 2.0, rng))]
    w, G = (np.concatenate([array] * 3) for array in starts("moved"))
    xy = np.concatenate([XY] * 3)
    try:
        fits = []
        for n in sorted({1, available_threads()}):
            set_threads(n)
            fits.append(fit_motion(pair, *four, xy, w, G, MatchOptions(subset_px=21)))
    finally:
        set_threads(before)
    for fit in fits:
        np.testing.assert_array_equal(fit.G, fits[0].G)
        np.testing.assert_array_equal(fit.G[: len(XY)], fit.G[-len(XY) :])
        np.testing.assert_array_equal(fit.covariance, fits[0].covariance)


def test_ranges_cover_everything_once_and_hand_errors_on():
    done = np.zeros(1001, int)

    def count(first, last):
        done[first:last] += 1

    run_ranges(count, 1001, 7)
    assert (done == 1).all()

    nested = np.zeros((40, 50), int)

    def outer(first, last):
        for row in range(first, last):
            run_ranges(lambda a, b, row=row: nested[row].__setitem__(slice(a, b), 1), 50, 3)

    run_ranges(outer, 40, 2)  # a range may itself run ranges
    assert (nested == 1).all()

    def fail(first, last):
        if first >= 500:
            raise ValueError("range")

    with pytest.raises(ValueError, match="range"):
        run_ranges(fail, 1001, 7)
    for n in (0, available_threads() + 1):
        with pytest.raises(InputError) as caught:
            set_threads(n)
        assert caught.value.code == "threads_out_of_range"


def test_the_plane_of_equation_12_comes_back():
    pair = paper_pair()
    theta, phi, zp = np.array([1.2, 1.7]), np.array([1.4, 1.6]), np.array([398.0, 404.0])
    xy = np.array([[30.0, 40.0], [120.0, 90.0]])
    shape = shape_geometry(pair, xy, plane_from_angles(pair, xy, theta, phi, zp))
    np.testing.assert_allclose(shape.theta_rad, theta, rtol=1e-12)
    np.testing.assert_allclose(shape.phi_rad, phi, rtol=1e-12)
    np.testing.assert_allclose(shape.zp_mm, zp, rtol=1e-12)
    # Eq. (12) itself, at the measured points in camera 1's frame
    p = pair.cam1.cam_from_sys.apply(shape.xyz_mm)
    xi = np.sqrt(1 - np.cos(theta) ** 2 - np.cos(phi) ** 2)
    np.testing.assert_allclose(p[:, 0] * np.cos(theta) + p[:, 1] * np.cos(phi) + p[:, 2] * xi, zp * xi, rtol=1e-12)


def test_what_cannot_be_used_is_refused():
    image = images("rest")[0]
    pair = paper_pair()
    with pytest.raises(ImageError):
        prepare(image[0])
    with pytest.raises(ImageError):
        prepare(np.where(image > 100, np.nan, image))
    with pytest.raises(InputError) as caught:
        fit_shape(pair, prepare(image, "cubic"), image, XY, np.zeros((len(XY), 3)))
    assert caught.value.code == "interpolation_mismatch"
    with pytest.raises(InputError):
        fit_shape(pair, image, image, XY, np.zeros((2, 3)))
    with pytest.raises(ImageError) as caught_size:
        fit_motion(pair, image, image, image[1:], image, XY, np.zeros((len(XY), 3)))
    assert caught_size.value.code == "image_size_mismatch"
    for wrong in (
        {"subset_px": 3},
        {"tolerance_px": 0.0},
        {"patch": "bent"},
        {"max_iterations": 0},
        {"first_rate": 0.9},
    ):
        with pytest.raises(InputError):
            MatchOptions(**wrong)
