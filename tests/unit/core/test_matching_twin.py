"""The kernels against their numpy twin: same solution, same correlation, for all lenses and both splines."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.matching import MatchOptions, fit_motion, fit_shape
from stereorig.core.matching.kernels.warp import set_up_nodes, set_up_warp
from tests.support.matching_scene import (
    Plane,
    Texture,
    digitise,
    opencv_pair,
    paper_pair,
    rational_pair,
    render,
    true_g,
    true_w,
)
from tests.support.matching_twin import Twin

PAIRS = {"seidel": lambda: paper_pair(kappa=2e-8), "opencv": opencv_pair, "rational": rational_pair}
XY = np.array([[52.0, 61.0], [80.0, 80.0], [103.0, 94.0]])
AFTER = Plane(np.array([0.02, -0.01, 0.015]), np.array([[1.01, 0.02], [-0.015, 0.995], [0.03, -0.02]]))


def scene(kind):
    pair = PAIRS[kind]()
    texture = Texture(blob_mm=0.05 if kind == "seidel" else 0.11)
    rng = np.random.default_rng(5)
    images = [
        digitise(render(camera, plane, texture), noise=2.0, rng=rng)
        for plane in (Plane(), AFTER)
        for camera in (pair.cam1, pair.cam2)
    ]
    images[3] = np.clip(0.8 * images[3] + 20.0, 0, 255).astype(np.uint8)
    return pair, images


@pytest.mark.parametrize("kind", ["seidel", "opencv", "rational"])
@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 3), ("quintic", 5)])
def test_shape_solution_is_the_twins(kind, interpolation, order):
    pair, images = scene(kind)
    w = true_w(pair.cam1, Plane(), XY)
    options = MatchOptions(subset_px=25, interpolation=interpolation, tolerance_px=3e-6)
    fit = fit_shape(pair, images[0], images[1], XY, w, options)
    assert (fit.status == 0).all()
    for i, xy in enumerate(XY):
        twin = Twin(pair, images[:2], xy, subset=25, order=order)
        p = twin.solve(np.array([*w[i], 0.0]))
        mine = np.array([*fit.w[i], fit.epipolar_px[i]])
        # the kernel's Jacobian has the lens's slopes at the point; in a corner of a wide lens, where they change by
        # percents across the subset, both solutions weigh the noise (0.01 px) differently by a hundredth
        limit = 1e-4 if kind == "rational" else 1e-5
        assert np.abs(twin.position(0, p, twin.XY) - twin.position(0, mine, twin.XY)).max() < limit
        assert abs(fit.zncc[i, 0] - twin.residual(0, p)[2]) < 1e-6


@pytest.mark.parametrize("kind", ["seidel", "opencv", "rational"])
@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 3), ("quintic", 5)])
def test_motion_solution_is_the_twins(kind, interpolation, order):
    pair, images = scene(kind)
    w, G = true_w(pair.cam1, Plane(), XY), true_g(pair.cam1, Plane(), AFTER, XY)
    options = MatchOptions(subset_px=25, interpolation=interpolation, tolerance_px=3e-6)
    first = fit_motion(pair, *images, XY, w, G, options)
    assert (first.status == 0).all()
    # from its own answer, so that the frozen Jacobian belongs to the solution
    fit = fit_motion(pair, *images, XY, first.w, first.G, options)
    for i, xy in enumerate(XY):
        twin = Twin(pair, images, xy, subset=25, order=order)
        mine = np.array([*fit.w[i], fit.epipolar_px[i], *fit.G[i].ravel()])
        p = twin.solve(mine)
        for k in range(3):
            at = twin.position(k, p, twin.XY)
            # the twin's Jacobian is whole, the kernel's leaves out what perspective adds to the columns: at the corners
            # that is a hundredth of what the images' noise does
            assert np.abs(at - twin.position(k, mine, twin.XY)).max() < 5e-4
            before = np.array([*first.w[i], first.epipolar_px[i], *first.G[i].ravel()])
            assert np.abs(at - twin.position(k, before, twin.XY)).max() < 7e-4
            assert abs(fit.zncc[i, k] - twin.residual(k, p)[2]) < 1e-6


@pytest.mark.parametrize("kind", ["seidel", "opencv", "rational"])
@pytest.mark.parametrize("subset", [33, 61])
def test_the_pixel_loops_warp_is_exact_to_a_hundred_thousandth_of_a_pixel(kind, subset):
    pair = PAIRS[kind]()
    xy = np.array([82.3, 77.8])
    lens1, lens2 = (np.array(camera.lens.kernel_parameters()) for camera in (pair.cam1, pair.cam2))
    half = 0.5 * (subset - 1)
    left, top = np.floor(xy - half + 0.5)
    x, y = np.meshgrid(left + np.arange(subset), top + np.arange(subset))
    rays = pair.cam1.rays_cam(np.stack([x.ravel(), y.ravel()], -1)).xyz_mm
    w = true_w(pair.cam1, AFTER, xy[None])[0]
    pose = pair.cam2_from_cam1
    xc, yc, _ = pair.cam1.rays_cam(xy).xyz_mm
    powers = np.empty((3, 16))
    assert set_up_nodes(lens1, left + half - xy[0], top + half - xy[1], half, xc, yc, np.empty(25), powers)
    R, t = pose.rotation, pose.translation_mm
    M = R @ np.array([[xc, 1.0, 0.0], [yc, 0.0, 1.0], [1.0, 0.0, 0.0]]) + t[:, None] * w
    warp = np.zeros(22, np.float32)
    stride = 168
    base = set_up_warp(lens2, M, powers, 160, 160, stride, 1, np.empty(26), warp)
    assert base >= 0
    a, b = ((v.ravel() - v.mean()) / half for v in (x, y))
    columns = np.stack([a**0, a, b, a**2, a * b, b**2, a**3, a**2 * b, a * b**2, b**3], -1)
    got = np.stack([columns @ warp[:10] + base % stride - 3, columns @ warp[10:20] + base // stride - 3], -1)
    depth = 1.0 / (w[0] + (rays[:, :2] - [xc, yc]) @ w[1:])
    expected = pair.image2_at_depth(np.stack([x.ravel(), y.ravel()], -1), depth)
    error = got - expected
    assert np.abs(error).max() < 1.5e-5  # float32's own rounding at 30 px is 4e-6
    assert np.sqrt((error**2).mean()) < 4e-6
