"""The simulated lenses against OpenCV's projection, which shares nothing with them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereorig.sim.optics.lens import LENS_KEYS, SimLens, core_lens, flat_lens, normalised, warmed
from stereorig.sim.optics.ray import rays

PINHOLE = {"fx_px": 2006.0, "fy_px": 1998.0, "cx_px": 611.3, "cy_px": 517.8}
FIVE = SimLens(**PINHOLE, k1=-0.05, k2=0.02, p1=2e-4, p2=-3e-4, k3=0.01)
EIGHT = SimLens(**PINHOLE, k1=0.31, k2=-0.12, p1=1e-3, p2=-7e-4, k3=0.02, k4=0.36, k5=-0.08, k6=0.015)
WIDE = SimLens(
    fx_px=700.0, fy_px=702.0, cx_px=611.0, cy_px=517.0, k1=0.4, k2=0.05, p1=1e-3, p2=5e-4, k4=0.6, k5=0.05, k6=0.001
)
PRISM = SimLens(**PINHOLE, k1=-0.05, k2=0.02, p1=2e-4, p2=-3e-4, s1=2e-3, s2=-1e-3, s3=-1.5e-3, s4=5e-4)
TILTED = SimLens(**PINHOLE, k1=-0.05, k4=0.02, s1=1e-3, s3=4e-4, tau_x_rad=0.06, tau_y_rad=-0.03)
LENSES = pytest.mark.parametrize(
    "lens", [FIVE, EIGHT, WIDE, PRISM, TILTED], ids=["five", "eight", "wide", "prism", "tilted"]
)


def matrices(lens: SimLens) -> tuple[np.ndarray, np.ndarray]:
    K = np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])
    return K, np.array([getattr(lens, name) for name in LENS_KEYS[4:]])


def opencv_image(lens: SimLens, n: np.ndarray) -> np.ndarray:
    K, distortion = matrices(lens)
    points = np.column_stack([n.reshape(-1, 2), np.ones(n.size // 2)])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(n.shape)


@LENSES
def test_rays_of_a_whole_image_return_to_their_pixels_through_opencv(lens: SimLens) -> None:
    nx, ny = np.empty((2, 260, 320))
    rays(flat_lens(lens), -3.0, -5.0, 4.0, nx, ny)
    px = np.stack(np.meshgrid(-3.0 + 4.0 * np.arange(320), -5.0 + 4.0 * np.arange(260)), axis=-1)
    n = np.stack([nx, ny], axis=-1)
    assert np.isfinite(n).all()
    # 1e-12 of the focal length: what Newton's last step leaves, and rounding
    np.testing.assert_allclose(opencv_image(lens, n), px, atol=1e-8)


@LENSES
def test_single_points_go_both_ways_as_opencv_says(lens: SimLens) -> None:
    px = np.random.default_rng(4).uniform(0.0, [1223.0, 1023.0], (300, 2))
    there = normalised(lens, px)
    assert there.valid.all()
    K, distortion = matrices(lens)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    inverse = cv2.undistortPoints(px.reshape(-1, 1, 2), K, distortion, criteria=criteria)
    # OpenCV's fixed point converges linearly
    np.testing.assert_allclose(there.xy, inverse.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(lens.image_from_normalised(there.xy).xy, opencv_image(lens, there.xy), atol=1e-9)
    # the core's lens of the same numbers has the same rays, where it has all the terms
    core = core_lens(lens)
    np.testing.assert_allclose(normalised(core, px).xy, there.xy, atol=1e-13)
    np.testing.assert_allclose(core.normalised_from_image(px).xy, there.xy, atol=1e-11)


def test_beyond_the_fold_of_a_barrel_lens_there_is_no_ray() -> None:
    lens = SimLens(fx_px=500.0, fy_px=500.0, cx_px=600.0, cy_px=500.0, k1=-0.4)
    # r (1 - 0.4 r^2) grows up to r = 1 / sqrt(1.2), where it is 0.6086
    edge = 500.0 * (1.0 - 0.4 / 1.2) / np.sqrt(1.2)
    x = np.arange(0.0, 1201.0)
    there = normalised(lens, np.column_stack([x, np.full(x.size, 500.0)]))
    np.testing.assert_array_equal(there.valid, np.abs(x - 600.0) < edge)
    nx, ny = np.empty((2, 1001, 1201))
    rays(flat_lens(lens), 0.0, 0.0, 1.0, nx, ny)
    u, v = np.meshgrid(x - 600.0, np.arange(1001.0) - 500.0)
    np.testing.assert_array_equal(np.isfinite(nx), np.hypot(u, v) < edge)
    seen = np.isfinite(nx)
    back = opencv_image(lens, np.stack([nx[seen], ny[seen]], axis=-1))
    np.testing.assert_allclose(back, np.column_stack([u[seen] + 600.0, v[seen] + 500.0]), atol=1e-8)


@LENSES
def test_a_lens_becomes_the_cores(lens: SimLens) -> None:
    np.testing.assert_array_equal(flat_lens(core_lens(lens)), flat_lens(lens))


@LENSES
def test_a_warm_lens_is_longer_and_its_centre_has_moved(lens: SimLens) -> None:
    warm = warmed(core_lens(lens), (0.3, -0.2), 2e-4)
    n = np.random.default_rng(6).uniform(-0.2, 0.2, (20, 2))
    cold, now = lens.image_from_normalised(n).xy, warm.image_from_normalised(n).xy
    centre = np.array([lens.cx_px, lens.cy_px])
    np.testing.assert_allclose(now, centre + [0.3, -0.2] + 1.0002 * (cold - centre), atol=1e-10)
