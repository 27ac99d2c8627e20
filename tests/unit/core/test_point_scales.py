"""Compiled scales and checks of single points beside plain numpy that maps points through the cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import LensModel, OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.scales import (
    MAX_SHEAR,
    MIN_COSINE,
    depth_per_px,
    far_from_start,
    plausible,
    px_per_ray,
)
from tests.support.field_bench import grid, pair

XY = grid().xy_px.reshape(-1, 2)
N = len(XY)
F = 12000.0
LENSES: list[LensModel | None] = [
    None,
    OpenCVLens(F, 0.96 * F, 140.0, 110.0, 2.0, k1=-0.3, k2=40.0, p1=2e-3, p2=-1e-3, k3=1e3),
    OpenCVLens(F, F, 120.0, 100.0, k1=8.0, k2=-3.0, p1=1e-3, k4=7.9, k5=2.0, k6=0.1),
]


def seen(camera: Camera, points: np.ndarray) -> np.ndarray:
    return camera.lens.image_from_normalised(points[:, :2] / points[:, 2:]).xy


@pytest.fixture(params=LENSES, ids=["seidel", "opencv", "rational"])
def cameras(request: pytest.FixtureRequest) -> StereoPair:
    made = pair()
    if request.param is None:
        return made
    return StereoPair(replace(made.cam1, lens=request.param), replace(made.cam2, lens=request.param))


def patches(cameras: StereoPair, terms: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays, w and G of patches tilted up to and beyond what faces the cameras, moved, turned and sheared likewise."""
    rng = np.random.default_rng(3)
    rays = cameras.cam1.rays_cam(XY).xyz_mm
    normal = rng.standard_normal((N, 3)) * (1.0, 1.0, 0.3) + (0.0, 0.0, 0.7)
    depth = 400.0 * np.exp(0.3 * rng.standard_normal(N)) * np.where(rng.random(N) < 0.05, -1.0, 1.0)
    plane = normal / ((rays * normal).sum(1) * depth)[:, None]
    w = np.zeros((N, terms))
    w[:, 0], w[:, 1:3] = (rays * plane).sum(1), plane[:, :2]
    G = np.zeros((N, 3, terms))
    affine = np.eye(3) + 0.8 * rng.standard_normal((N, 3, 3))
    basis = np.zeros((N, 3, 3))
    basis[:, :, 0], basis[:, 0, 1], basis[:, 1, 2] = rays, 1.0, 1.0
    G[:, :, :3] = affine @ basis
    w[:5, 0], G[5:10, 2, 0] = np.nan, np.nan
    return rays, w, G


def test_a_pixel_of_depth_is_what_the_lens_shows(cameras: StereoPair) -> None:
    rays, w, _ = patches(cameras, 3)
    good = w[:, 0] > 0.0
    got = depth_per_px(cameras, rays, w[:, 0])
    step = 0.01 * got[good]
    there, back = (
        seen(cameras.cam2, cameras.cam2_from_cam1.apply(rays[good] / (w[good, 0] + sign * step)[:, None]))
        for sign in (1.0, -1.0)
    )
    known = np.isfinite(there).all(axis=1) & np.isfinite(back).all(axis=1)
    assert known.mean() > 0.5
    # central differences of a fiftieth of a pixel
    np.testing.assert_allclose(np.linalg.norm(there - back, axis=1)[known], 0.02, rtol=1e-5)
    assert np.isnan(depth_per_px(cameras, rays, np.full(N, np.nan))).all()


def test_a_unit_of_a_ray_is_what_the_lens_shows(cameras: StereoPair) -> None:
    rays, _, _ = patches(cameras, 3)
    step = 0.01 / F
    columns = np.stack(
        [
            (seen(cameras.cam1, rays + step * axis) - seen(cameras.cam1, rays - step * axis)) / (2.0 * step)
            for axis in np.eye(3)[:2]
        ],
        axis=2,
    )
    root = np.sqrt(np.abs(columns[:, 0, 0] * columns[:, 1, 1] - columns[:, 0, 1] * columns[:, 1, 0]))
    expected = np.column_stack([root, np.hypot(*columns[:, :, 0].T), np.hypot(*columns[:, :, 1].T)])
    np.testing.assert_allclose(px_per_ray(cameras, rays), expected, rtol=1e-6)


@pytest.mark.parametrize("terms", [3, 6])
@pytest.mark.parametrize("motion", [False, True])
def test_patches_are_plausible_by_their_own_normals_and_maps(cameras: StereoPair, terms: int, motion: bool) -> None:
    rays, w, G = patches(cameras, terms)
    centre2 = cameras.cam2_from_cam1.inverse().translation_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        point = rays / w[:, :1]
        # the normal from three points of the patch
        x, y = (rays + 1e-6 * axis for axis in np.eye(3)[:2])
        beside = [r / (w[:, :1] + 1e-6 * w[:, k : k + 1]) for r, k in ((x, 1), (y, 2))]
        normal = np.cross(beside[0] - point, beside[1] - point)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        views = (point, point - centre2)
        cosines = [(normal * view).sum(1) / np.linalg.norm(view, axis=1) for view in views]
        facing = (w[:, 0] > 0.0) & (np.abs(w[:, 0]) > 0.0)
        near_limit = np.zeros(N, bool)
        for cosine in cosines:
            facing &= cosine > MIN_COSINE
            near_limit |= np.abs(cosine - MIN_COSINE) < 1e-3
        expected = facing
        if motion:
            now = [G[:, :, 0], G[:, :, 0] + 1e-6 * G[:, :, 1], G[:, :, 0] + 1e-6 * G[:, :, 2]]
            image = [p[:, :2] / p[:, 2:] for p in now]
            across = np.stack([image[1] - image[0], image[2] - image[0]], axis=2) / 1e-6
            ratio = np.linalg.svd(np.nan_to_num(across), compute_uv=False)
            size = (ratio**2).sum(1) / 2.0
            det = np.linalg.det(np.nan_to_num(across))
            limits = (det, np.sqrt(size) - MAX_SHEAR, det - size / MAX_SHEAR)
            for limit in limits:
                near_limit |= np.abs(limit) < 1e-3
            expected &= (G[:, 2, 0] / w[:, 0] > 0.0) & (limits[0] > 0.0) & (limits[1] < 0.0) & (limits[2] > 0.0)
    got = plausible(cameras, rays, w, G if motion else None)
    assert 0.05 < got.mean() < 0.95
    np.testing.assert_array_equal(got[~near_limit], expected[~near_limit])


@pytest.mark.parametrize("motion", [False, True])
def test_far_is_as_the_images_show_it(cameras: StereoPair, motion: bool) -> None:
    rays, w, G = patches(cameras, 3)
    rng = np.random.default_rng(4)
    per_px = depth_per_px(cameras, rays, w[:, 0])
    end = w.copy()
    end[:, 0] += per_px * rng.uniform(-4.0, 4.0, N)
    end_G = G.copy()
    end_G[:, :2, 0] += G[:, 2:, 0] * rng.uniform(-4.0, 4.0, (N, 2)) / F
    got = far_from_start(cameras, rays, end, end_G, w, G if motion else None, 3.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        px = np.abs(end[:, 0] - w[:, 0]) / per_px
        if motion:
            shift = end_G[:, :2, 0] / end_G[:, 2:, 0] - G[:, :2, 0] / G[:, 2:, 0]
            J = cameras.cam1.lens.image_jacobian(rays[:, :2])
            moved = np.linalg.norm(shift, axis=1) * np.sqrt(np.abs(np.linalg.det(J)))
            px = np.where(np.isfinite(px) & np.isfinite(moved), np.fmax(px, moved), np.nan)
    np.testing.assert_array_equal(got, ~(px < 3.0))
    assert 0.1 < got.mean() < 0.9


@pytest.mark.parametrize("terms", [3, 6])
def test_no_points_have_no_scales(terms: int) -> None:
    rays, w, G = np.zeros((0, 3)), np.zeros((0, terms)), np.zeros((0, 3, terms))
    assert len(depth_per_px(pair(), rays, w[:, 0])) == 0
    assert px_per_ray(pair(), rays).shape == (0, 3)
    for motion in (None, G):
        assert len(plausible(pair(), rays, w, motion)) == 0
        assert len(far_from_start(pair(), rays, w, G, w, motion, 3.0)) == 0
