"""Nodes of a prediction and images warped along it, against the cameras' own projection and a spline by scipy."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from stereorig.core.matching.image import prepare
from stereorig.core.matching.prewarp import NodeLattice, project_nodes, warp_image
from tests.support.matching_scene import opencv_pair

PAIR = opencv_pair(160)
LATTICE = NodeLattice(40.0, 50.0, 8.0, 1)
XY = np.stack(np.meshgrid(40.0 + 8.0 * np.arange(-1, 9), 50.0 + 8.0 * np.arange(-1, 8)), axis=-1)


def state_at(xy_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays, and a curved, moved surface's unknowns (..., 5) at pixels of camera 1; its epipolar offset is zero."""
    rays = PAIR.cam1.rays_cam(xy_px).xyz_mm
    x, y = (rays[..., i] for i in range(2))
    w = (1.0 + 0.2 * x - 0.1 * y + 5.0 * x * y) / 400.0
    now = rays / w[..., None]
    moved = np.array([0.3, -0.2, 0.4]) + 2.0 * (x**2)[..., None] * np.array([0.0, 1.0, 1.0])
    now = now * np.array([1.01, 0.99, 1.0]) + moved
    return rays, np.concatenate([w[..., None], now * w[..., None], np.zeros_like(w)[..., None]], axis=-1)


def seen(xy_px: np.ndarray) -> np.ndarray:
    """Positions (..., 6) in camera 2's reference, camera 1's and camera 2's current image."""
    rays, state = state_at(xy_px)
    before, now = rays / state[..., :1], state[..., 1:4] / state[..., :1]
    to2 = PAIR.cam2_from_cam1.apply
    cameras = (PAIR.cam2, to2(before)), (PAIR.cam1, now), (PAIR.cam2, to2(now))
    return np.concatenate([c.lens.image_from_normalised(p[..., :2] / p[..., 2:]).xy for c, p in cameras], axis=-1)


def less_ray(xy_px: np.ndarray) -> np.ndarray:
    rays, state = state_at(xy_px)
    state[..., 1:4] -= rays
    return state


def slopes(function, xy_px: np.ndarray, h: float) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Value, derivatives along x and y, and mixed derivative, a spacing: (..., 4)."""
    dx, dy = np.array([h, 0.0]), np.array([0.0, h])
    per = LATTICE.spacing / (2.0 * h)
    mixed = (
        function(xy_px + dx + dy) - function(xy_px + dx - dy) - function(xy_px - dx + dy) + function(xy_px - dx - dy)
    )
    along = [(function(xy_px + d) - function(xy_px - d)) * per for d in (dx, dy)]
    return np.stack([function(xy_px), *along, mixed * per**2], axis=-1)


def test_nodes_are_where_the_cameras_see_them() -> None:
    rays, _ = state_at(XY)
    of_state = slopes(less_ray, XY, 0.05)
    nodes, unknowns = project_nodes(PAIR, rays[..., :2], of_state, LATTICE)
    expected = slopes(seen, XY, 0.05)
    np.testing.assert_allclose(nodes[..., 0], expected[..., 0], atol=1e-9)
    np.testing.assert_allclose(nodes[..., 1:3], expected[..., 1:3], atol=1e-5)
    np.testing.assert_allclose(nodes[..., 3], expected[..., 3], atol=2e-3)  # without the lens's own curvature
    # a plane patch's unknowns: values, and slopes over the ray
    h = 1e-5
    for axis in range(2):
        step = np.zeros(3)
        step[axis] = h

        def at(ray: np.ndarray) -> np.ndarray:
            return state_at(PAIR.cam1.lens.image_from_normalised(ray[..., :2]).xy)[1][..., :4]

        slope = (at(rays + step) - at(rays - step)) / (2.0 * h)
        np.testing.assert_allclose(unknowns[..., 1 + axis], slope, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(unknowns[..., 0], state_at(XY)[1][..., :4], rtol=1e-14)


def test_an_image_is_interpolated_at_the_places_between_the_nodes() -> None:
    image = np.random.default_rng(5).uniform(20, 230, (160, 160)).astype(np.float32)
    rays, _ = state_at(XY)
    nodes, _ = project_nodes(PAIR, rays[..., :2], slopes(less_ray, XY, 0.05), LATTICE)
    known = np.ones((XY.shape[0] - 1, XY.shape[1] - 1), bool)
    known[3, 4] = False
    for order, kind, k in ((3, "cubic", 1), (5, "quintic", 2)):
        values, inside = warp_image(prepare(image, kind), image.shape, LATTICE, nodes[:, :, 2 * k : 2 * k + 2], known)  # type: ignore[arg-type]
        rows, cols = np.nonzero(inside)
        assert len(rows) > 1000
        assert not inside[66:73, 64:71].any()
        assert not inside[:41].any()
        x, y = seen(np.stack([cols, rows], axis=-1).astype(float))[:, 2 * k : 2 * k + 2].T
        expected = map_coordinates(image.astype(float), [y, x], order=order, mode="mirror")
        slope = np.abs(np.diff(image, axis=1)).mean()
        assert np.abs(values[rows, cols] - expected).max() < 2e-3 * slope
