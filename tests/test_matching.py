"""Point-level matching against closed-form truth: shape, motion, errors, statuses."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from matching_scene import Plane, Texture, digitise, grid, paper_pair, render, true_g, true_w
from scipy.spatial.transform import Rotation

from core.matching import MatchOptions, fit_motion, fit_shape, prepare
from core.matching.geometry import covariance_xyz, covariance_xyzuvw, motion_geometry, shape_geometry

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
    return at, PLANES[name].place(at[:, :2]) - at


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
    # what an independent triangulation of the exact image points says about the sign and size
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


def test_prepared_and_raw_images_give_the_same():
    pair = paper_pair()
    w, _ = starts("rest")
    raw = fit_shape(pair, *images("rest"), XY, w)
    prepared = fit_shape(pair, *(prepare(image) for image in images("rest")), XY, w)
    np.testing.assert_array_equal(raw.w, prepared.w)
