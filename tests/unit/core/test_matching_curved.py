"""Curved patches: bent surfaces that move, against the surfaces' own formulas and against the numpy twin."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from stereorig.core.matching import MatchOptions, fit_motion, fit_shape
from tests.support.matching_scene import (
    Bent,
    Texture,
    digitise,
    grid,
    opencv_pair,
    paper_pair,
    render,
    true_g6,
    true_w6,
)
from tests.support.matching_twin import Twin, pack

XY = np.array([[52.0, 61.0], [80.0, 80.0], [103.0, 94.0]])
# radii near 30 mm; at t the curvatures differ, and the middle moved, turned, stretched
BEFORE = Bent((1 / 30, 0.004, 1 / 40))
AFTER = Bent(
    (1 / 25, -0.003, 1 / 60), np.array([0.02, -0.01, 0.015]), np.array([[1.01, 0.02], [-0.015, 0.995], [0.03, -0.02]])
)


@lru_cache(maxsize=2)
def scene(kind):
    pair = paper_pair(kappa=2e-8) if kind == "seidel" else opencv_pair()
    texture = Texture(blob_mm=0.05 if kind == "seidel" else 0.11)
    images = [render(camera, s, texture) for s in (BEFORE, AFTER) for camera in (pair.cam1, pair.cam2)]
    return pair, images, true_w6(pair.cam1, BEFORE, XY), true_g6(pair.cam1, BEFORE, AFTER, XY)


def noisy(images):
    rng = np.random.default_rng(5)
    images = [digitise(image, noise=2.0, rng=rng) for image in images]
    images[3] = np.clip(0.8 * images[3] + 20.0, 0, 255).astype(np.uint8)
    return images


def displacement(pair, w, G):
    """(n, 3) mm, camera 1's frame."""
    return (G[..., :, 0] - pair.cam1.rays_cam(XY).xyz_mm) / w[..., :1]


@pytest.mark.parametrize("kind", ["seidel", "opencv"])
def test_the_twin_itself_finds_a_bent_surface_that_bends_on(kind):
    pair, images, w, G = scene(kind)
    # interpolation error and third order; the wide angle of the first rig resolves depth much better than the second's
    depth_um, moved_um = (0.05, 0.05) if kind == "seidel" else (0.6, 0.3)
    for i, xy in enumerate(XY):
        twin = Twin(pair, images, xy, subset=25, order=5)
        p = twin.solve(pack(w[i], 0.0, G[i]))
        assert abs(p[0] / w[i, 0] - 1) * 400e3 < depth_um
        assert abs(p[6]) < 3e-3
        here = (p[7:].reshape(3, 6)[:, 0] - twin.centre) / p[0]
        there = (G[i, :, 0] - twin.centre) / w[i, 0]
        assert np.abs(here - there).max() * 1e3 < moved_um
        flat = twin.solve(pack(w[i, :3], 0.0, G[i, :, :3]))
        assert abs(flat[0] / w[i, 0] - 1) * 400e3 > 2.0  # what the curved patch is there for


@pytest.mark.parametrize("kind", ["seidel", "opencv"])
@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 3), ("quintic", 5)])
@pytest.mark.parametrize("noise", [False, True], ids=["noise-free", "noisy"])
def test_the_solution_is_the_twins(kind, interpolation, order, noise):
    pair, images, w, G = scene(kind)
    if noise:
        images = noisy(images)
    # Jacobians need not be the same to the last digit: they weigh the noise, which moves corners by 0.05 px here
    limit = 1e-3 if noise else 1e-4
    options = MatchOptions(subset_px=25, patch="quadratic", interpolation=interpolation, tolerance_px=3e-6)
    shape = fit_shape(pair, *images[:2], XY, w, options)
    motion = fit_motion(pair, *images, XY, w, G, options)
    assert (shape.status == 0).all()
    assert (motion.status == 0).all()
    for i, xy in enumerate(XY):
        for twin, mine, zncc in (
            (Twin(pair, images[:2], xy, subset=25, order=order), pack(shape.w[i], shape.epipolar_px[i]), shape.zncc[i]),
            (
                Twin(pair, images, xy, subset=25, order=order),
                pack(motion.w[i], motion.epipolar_px[i], motion.G[i]),
                motion.zncc[i],
            ),
        ):
            p = twin.solve(mine)
            for k, correlation in enumerate(zncc):
                assert np.abs(twin.position(k, p, twin.XY) - twin.position(k, mine, twin.XY)).max() < limit
                assert abs(correlation - twin.residual(k, p)[2]) < 1e-5


@pytest.mark.parametrize("kind", ["seidel", "opencv"])
def test_bent_surfaces_come_out_without_the_plane_patchs_error(kind):
    pair, images, _, _ = scene(kind)
    xy = grid(count=6, margin=40)
    w, G = true_w6(pair.cam1, BEFORE, xy), true_g6(pair.cam1, BEFORE, AFTER, xy)
    rays = pair.cam1.rays_cam(xy).xyz_mm
    truth = (G[:, :, 0] - rays) / w[:, :1]
    depth, moved = {}, {}
    for patch in ("affine", "quadratic"):
        # from the plane start in both cases: the curvature must be found
        options = MatchOptions(subset_px=25, patch=patch)
        fit = fit_motion(pair, *images, xy, w[:, :3], G[:, :, :3], options)
        shape = fit_shape(pair, *images[:2], xy, w[:, :3], options)
        assert (fit.status == 0).all()
        assert (shape.status == 0).all()
        depth[patch] = max(abs(((1.0 / f.w[:, 0] - 1.0 / w[:, 0]) * 1e3).mean()) for f in (fit, shape))
        moved[patch] = np.abs((((fit.G[:, :, 0] - rays) / fit.w[:, :1] - truth) * 1e3).mean(0)).max()
    assert depth["quadratic"] < (0.05 if kind == "seidel" else 0.2)
    assert moved["quadratic"] < (0.03 if kind == "seidel" else 0.15)
    assert depth["affine"] > 2.0
    assert moved["affine"] > 2.0 * moved["quadratic"]
