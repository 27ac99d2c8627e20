"""Measurement through lenses of OpenCV's eight terms: kernels against OpenCV, images rendered with OpenCV's rays."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numba import njit
from numpy.typing import ArrayLike, NDArray

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import MappedPoints, OpenCVLens
from stereorig.core.cameras.opencv_full import OpenCVFullLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.matching import MatchOptions, fit_motion, fit_shape
from stereorig.core.matching.geometry import motion_geometry, shape_geometry
from stereorig.core.matching.kernels.warp import NODES, lens_jacobian, set_up_nodes, undistort
from stereorig.sim.optics.lens import flat_lens
from stereorig.sim.optics.ray import rays
from tests.support.matching_scene import Plane, Texture, digitise, grid, rational_pair, render, true_g, true_w

LENSES = {
    "levels off": OpenCVLens(820.0, 823.0, 981.0, 610.0, 0.0, 0.62, 0.21, 1e-3, -2e-3, 0.012, 0.94, 0.38, 0.05),
    "pole": OpenCVLens(820.0, 823.0, 981.0, 610.0, 0.0, 0.1, 0.0, 1e-3, -1e-3, 0.0, -0.3, 0.0, 0.0),
    "nearly cancels": OpenCVLens(900.0, 900.0, 981.0, 610.0, 0.0, 9.0, 3.0, 1e-3, -1e-3, 0.1, 9.3, 5.5, 0.6),
    "telephoto": OpenCVLens(6638.0, 6640.0, 981.0, 610.0, 0.0, 0.9, -2.8, 1e-3, -2e-3, 55.9, 0.8, -2.0, 30.0),
}
BENT = {"s1": 4e-3, "s2": -2e-3, "s3": -3e-3, "s4": 1e-3, "tau_x_rad": 0.06, "tau_y_rad": -0.03}
FULL = {
    "five terms": OpenCVFullLens(820.0, 823.0, 981.0, 610.0, 0.0, -0.21, 0.05, 1e-3, -2e-3, **BENT),
    "all terms": OpenCVFullLens(
        820.0, 823.0, 981.0, 610.0, 0.0, 0.62, 0.21, 1e-3, -2e-3, 0.012, 0.94, 0.38, 0.05, **BENT
    ),
    "telephoto": OpenCVFullLens(6638.0, 6640.0, 981.0, 610.0, s1=-0.02, s3=0.03, tau_x_rad=-0.1, tau_y_rad=0.2),
}
AFTER = Plane(np.array([0.02, -0.01, 0.015]), np.array([[1.01, 0.02], [-0.015, 0.995], [0.03, -0.02]]))


@njit
def undistort_all(lens, xy, out):
    for i in range(len(xy)):
        out[i, 0], out[i, 1] = undistort(lens, xy[i, 0], xy[i, 1])


@dataclass(frozen=True)
class OpenCVsOwn:
    """A lens as OpenCV computes it; it shares no line with the lens under test."""

    lens: OpenCVLens

    @property
    def numbers(self) -> tuple[NDArray, NDArray]:
        a = self.lens
        K = np.array([[a.fx_px, 0.0, a.cx_px], [0.0, a.fy_px, a.cy_px], [0.0, 0.0, 1.0]])
        more = list(a.prism.values()) if isinstance(a, OpenCVFullLens) else []
        return K, np.array([a.k1, a.k2, a.p1, a.p2, a.k3, a.k4, a.k5, a.k6, *more])

    def image_from_normalised(self, xy_norm: ArrayLike) -> MappedPoints:
        n = np.asarray(xy_norm, dtype=np.float64)
        points = np.concatenate([n, np.ones((*n.shape[:-1], 1))], -1).reshape(-1, 1, 3)
        xy = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *self.numbers)[0]
        return MappedPoints(xy.reshape(n.shape), np.ones(n.shape[:-1], bool))

    def normalised_from_image(self, xy_px: ArrayLike) -> MappedPoints:
        xy = np.asarray(xy_px, dtype=np.float64)
        settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-13)
        n = cv2.undistortPoints(np.ascontiguousarray(xy.reshape(-1, 1, 2)), *self.numbers, criteria=settled)
        return MappedPoints(n.reshape(xy.shape), np.ones(xy.shape[:-1], bool))


@pytest.mark.parametrize("lens", [*LENSES.values(), *FULL.values()], ids=[*LENSES, *FULL])
def test_kernels_and_simulated_rays_invert_what_opencv_projects(lens: OpenCVLens) -> None:
    reach = 0.13 if lens.fx_px > 5000.0 else 1.1
    x, y = np.meshgrid(np.linspace(-reach, reach, 31), np.linspace(-0.6 * reach, 0.6 * reach, 19))
    n = np.stack([x.ravel(), y.ravel()], -1)
    xy = OpenCVsOwn(lens).image_from_normalised(n).xy
    flat = lens.kernel_parameters()
    back = np.empty_like(n)
    undistort_all(flat, xy, back)
    np.testing.assert_allclose(back, n, atol=1e-12)
    if isinstance(lens, OpenCVFullLens):
        ours = lens.normalised_from_image(xy)
        np.testing.assert_allclose(ours.xy, n, atol=1e-12)
        np.testing.assert_allclose(lens.image_from_normalised(n).xy, xy, atol=1e-9)
        return
    # the simulated rig walks along rows, each ray from its neighbour's
    x0, y0 = xy.min(axis=0)
    nx, ny = np.empty((40, 60)), np.empty((40, 60))
    step = (xy.max(axis=0) - (x0, y0)).min() / 60.0
    rays(flat_lens(lens), x0, y0, step, nx, ny)
    column, row = np.meshgrid(np.arange(60), np.arange(40))
    seen = OpenCVsOwn(lens).image_from_normalised(np.stack([nx, ny], -1)).xy
    ours = lens.normalised_from_image(np.stack([x0 + step * column, y0 + step * row], -1))
    assert (np.isfinite(nx) == ours.valid).all()
    use = ours.valid & (np.hypot(nx, ny) < 1.5 * reach)
    assert use.mean() > 0.9
    np.testing.assert_allclose(seen[use], np.stack([x0 + step * column, y0 + step * row], -1)[use], atol=1e-8)
    np.testing.assert_allclose(np.stack([nx, ny], -1)[use], ours.xy[use], atol=1e-11)


def test_pixels_beyond_a_rational_lens_have_no_ray() -> None:
    lens = OpenCVLens(800.0, 800.0, 0.0, 0.0, k4=1.0)  # r / (1 + r^2) is 0.5 at most, at r = 1
    flat = lens.kernel_parameters()
    xy = np.array([[396.0, 0.0], [0.0, -396.0], [404.0, 0.0], [300.0, 300.0], [-5000.0, 0.0]])
    back = np.empty_like(xy)
    undistort_all(flat, xy, back)
    assert np.isfinite(back).all(axis=1).tolist() == [True, True, False, False, False]
    assert back[0, 0] == pytest.approx((1.0 - np.sqrt(1.0 - 4.0 * 0.495**2)) / (2.0 * 0.495), abs=1e-9)  # the near root
    nx, ny = np.empty((1, 101)), np.empty((1, 101))
    rays(flat_lens(lens), 0.0, 0.0, 7.9, nx, ny)
    assert np.isfinite(nx[0]).tolist() == [7.9 * i < 400.0 for i in range(101)]


@pytest.mark.parametrize("lens", [*LENSES.values(), *FULL.values()], ids=[*LENSES, *FULL])
@pytest.mark.parametrize("half", [10.0, 30.0])
def test_a_subsets_nodes_are_exact_through_a_rational_lens(lens: OpenCVLens, half: float) -> None:
    own, flat = OpenCVsOwn(lens), lens.kernel_parameters()
    reach = 0.1 if lens.fx_px > 5000.0 else 0.9
    for centre in np.random.default_rng(4).uniform(-reach, reach, (20, 2)) * (1.0, 0.6):
        powers = np.empty((3, NODES.shape[1]))
        assert set_up_nodes(flat, 0.3, -0.2, half, *centre, np.empty(25), powers)
        got = own.image_from_normalised(centre + powers[1:].T).xy
        expected = own.image_from_normalised(centre).xy + (0.3, -0.2) + half * NODES.T
        np.testing.assert_allclose(got, expected, atol=1e-8)
        h = 1e-6
        for axis, step in enumerate(np.eye(2) * h):
            difference = own.image_from_normalised(np.stack([centre + step, centre - step])).xy
            slopes = np.reshape(lens_jacobian(flat, *centre), (2, 2))[:, axis]
            np.testing.assert_allclose(slopes, (difference[0] - difference[1]) / (2 * h), rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("bent", [{}, BENT], ids=["eight terms", "prism and tilt"])
def test_shape_and_motion_through_rational_lenses_rendered_with_opencvs_rays(bent: dict[str, float]) -> None:
    pair = rational_pair(**bent)
    own = StereoPair(*(Camera(OpenCVsOwn(c.lens), c.cam_from_sys) for c in (pair.cam1, pair.cam2)))
    texture, rng = Texture(blob_mm=0.11), np.random.default_rng(5)
    images = [
        digitise(render(camera, plane, texture), noise=1.0, rng=rng)
        for plane in (Plane(), AFTER)
        for camera in (own.cam1, own.cam2)
    ]
    xy = grid(count=8)
    w, G = true_w(own.cam1, Plane(), xy), true_g(own.cam1, Plane(), AFTER, xy)
    options = MatchOptions(subset_px=25)
    off = w * (1.0004, 1.0, 1.0)  # 0.16 mm, 0.6 px
    shape = fit_shape(pair, images[0], images[1], xy, off, options)
    motion = fit_motion(pair, *images, xy, shape.w, G, options)
    assert (shape.status == 0).all()
    assert (motion.status == 0).all()
    truth = own.cam1.back_project_to_plane(xy).xyz_mm
    xyz = shape_geometry(pair, xy, shape.w).xyz_mm
    uvw = motion_geometry(pair, xy, motion.w, motion.G).uvw_mm
    moved = AFTER.position(truth[:, :2]) - truth
    # a pixel is 80 um here, and depth has three times the noise of a position. One grey level of noise and the
    # interpolation leave 0.003 px; a lens that is off by 0.02 px would show
    for error in (xyz - truth, uvw - moved):
        assert (np.sqrt((error**2).mean(axis=0)) < (4e-4, 4e-4, 8e-4)).all()
    assert np.abs(shape.epipolar_px).max() < 0.015
    assert np.abs(motion.epipolar_px).max() < 0.015
