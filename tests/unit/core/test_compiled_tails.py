"""Compiled sums and estimators after the matching, beside plain numpy twins."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import polar
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from stereorig.core.common.derivatives import WEIGHTS, Estimator
from stereorig.core.common.estimates import new_noise
from stereorig.core.field.region.window import window_offsets
from stereorig.core.matching.geometry import covariance_xyzuvw, motion_geometry, shape_geometry, tangent_frames
from stereorig.core.matching.image import PAD, prepare
from stereorig.core.strain.reduced import window_sums
from stereorig.core.systematic.sampled import residual_shifts
from tests.support.matching_scene import opencv_pair, paper_pair, rational_pair


@pytest.mark.parametrize("make", [paper_pair, opencv_pair, rational_pair])
def test_the_estimator_solves_the_weighted_normal_equations(make):
    pair = make()
    rng = np.random.default_rng(2)
    rays = pair.cam1.rays_cam(rng.uniform(40.0, 120.0, (50, 2))).xyz_mm
    points = pair.cam1.sys_from_cam.apply(rays * 400.0 * rng.uniform(0.98, 1.02, (50, 1)))
    now = points + rng.normal(0.0, 0.5, points.shape)
    found = Estimator.at(pair, points, now)
    # unknowns depth along camera 1's ray, offset, current X Y Z; comparisons camera 2 at t0, camera 1 and 2 at t
    seen = found.reference
    A = np.zeros((50, 6, 5))
    A[:, :2, 0], A[:, :2, 1] = seen.along * seen.px_per_mm[:, None], seen.across
    A[:, 2:4, 2:], A[:, 4:, 2:] = pair.cam1.point_jacobian(now), pair.cam2.point_jacobian(now)
    A[:, 4:, 1] = seen.carried(now)
    At = np.swapaxes(A, 1, 2) @ np.kron(WEIGHTS, np.eye(2))
    gain = np.linalg.solve(At @ A, At)
    by_match = gain[:, 2:] - seen.ray[..., None] * gain[:, :1]
    np.testing.assert_allclose(found.by_match, by_match, atol=1e-9 * np.abs(by_match).max())
    whole = np.zeros((50, 6, 8))
    whole[:, :3, :4] = seen.by_image
    whole[:, 3:, :4] = -by_match[:, :, :2] @ seen.seen
    whole[:, 3:, :2] -= seen.off_ray
    whole[:, 3:, 4:] = -by_match[:, :, 2:]
    np.testing.assert_allclose(found.by_image, whole, atol=1e-9 * np.abs(whole).max())
    # and by the images themselves: a point that moves with what the cameras see of it is found where it is
    step = 1e-4
    for axis in range(3):
        moved = points.copy()
        moved[:, axis] += step
        at = [np.concatenate([c.project(p).xy for c in (pair.cam1, pair.cam2)], axis=1) for p in (points, moved)]
        # the predicted images are the cameras'; what is measured goes against them
        shift = -np.concatenate([at[1] - at[0], np.zeros((50, 4))], axis=1)
        expected = np.zeros((50, 6))
        expected[:, axis], expected[:, 3 + axis] = step, -step
        np.testing.assert_allclose((found.by_image @ shift[..., None])[..., 0], expected, atol=1e-3 * step)


@pytest.mark.parametrize("from_centre", [False, True])
def test_sums_over_reduced_windows_look_at_no_point_without_a_weight(from_centre):
    rng = np.random.default_rng(3)
    half = 2
    offsets, _ = window_offsets(half)
    values = rng.normal(size=(9, 8, 3))
    values[rng.random((9, 8)) < 0.2] = np.nan
    rows, cols = np.nonzero(np.isfinite(values[..., 0]))
    weights = rng.normal(size=(len(rows), 2, len(offsets)))
    expected = np.zeros((len(rows), 2, 3))
    for m, (r, c) in enumerate(zip(rows, cols, strict=True)):
        for p, (dr, dc) in enumerate(offsets):
            inside = 0 <= r + dr < 9 and 0 <= c + dc < 8
            if not inside or not np.isfinite(values[r + dr, c + dc, 0]):
                weights[m, :, p] = 0.0
                continue
            centre = values[r, c] if from_centre else 0.0
            expected[m] += weights[m, :, p, None] * (values[r + dr, c + dc] - centre)
    order = rng.permutation(len(rows))
    found = window_sums(values, rows, cols, np.argsort(order), weights[order], half, from_centre=from_centre)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize(("kind", "order"), [("cubic", 3), ("quintic", 5)])
def test_residual_shifts_are_those_of_sampled_subsets(kind, order):
    rng = np.random.default_rng(4)
    prepared, other = (prepare(rng.normal(100.0, 20.0, (60, 70)).astype(np.float32), kind) for _ in range(2))
    half, n = 4, 40
    centres = rng.uniform([0.0, 0.0], [69.0, 59.0], (n, 2))
    maps = np.eye(2) + rng.normal(0.0, 0.05, (n, 2, 2))
    images = centres + rng.normal(0.0, 2.0, (n, 2))
    smooth = tuple(rng.normal(size=(n, 2 * half + 1, 2 * half + 1)).astype(np.float32) for _ in range(2))
    found = residual_shifts(
        prepared.pixels, prepared.gradients, smooth, other.coefficients, order, centres, images, maps, 2 * half + 1
    )
    side = np.arange(-half, half + 1)
    dx, dy = np.meshgrid(side, side)
    seen = 0
    for k in range(n):
        x0, y0 = (int(v) for v in np.rint(centres[k]))
        start = images[k] + maps[k] @ (np.array([x0, y0]) - centres[k])
        at = start[:, None, None] + maps[k, :, 0, None, None] * dx + maps[k, :, 1, None, None] * dy + PAD
        lead = order // 2
        rows, cols = other.coefficients.shape
        tapped = (np.floor(at) >= lead).all() and (np.floor(at[0]) + lead + 1 < cols).all()
        tapped &= (np.floor(at[1]) + lead + 1 < rows).all()
        whole = half <= x0 < 70 - half and half <= y0 < 60 - half
        assert np.isnan(found[k]).all() == (not (tapped and whole))
        if not (tapped and whole):
            continue
        seen += 1
        c = map_coordinates(other.coefficients.astype(float), at[::-1], order=order, prefilter=False)
        part = slice(y0 - half, y0 + half + 1), slice(x0 - half, x0 + half + 1)
        f, (gx, gy) = prepared.pixels[part].astype(float), (g[part].astype(float) for g in prepared.gradients)
        c, f = c - c.mean(), f - f.mean()
        rest = (c * f).sum() / (c * c).sum() * c - f
        for first, (u, v) in ((0, (gx, gy)), (2, (smooth[0][k], smooth[1][k]))):
            A = np.array([[(u * gx).sum(), (u * gy).sum()], [(v * gx).sum(), (v * gy).sum()]])
            shift = -np.linalg.solve(A, [(u * rest).sum(), (v * rest).sum()])
            np.testing.assert_allclose(found[k, first : first + 2], shift, rtol=1e-4, atol=1e-6)
    assert seen > 10


def _patches(pair, *, size: float = 0.05, n: int = 60):
    """Positions, planes and motions of patches that turn and stretch by about ``size``."""
    rng = np.random.default_rng(9)
    xy = rng.uniform(40.0, 120.0, (n, 2))
    ray = pair.cam1.rays_cam(xy).xyz_mm
    w = np.column_stack([rng.normal(1.0, 0.02, n), rng.normal(0.0, 0.1, (n, 2))]) / 400.0
    G = np.concatenate([ray[:, :, None], np.tile(np.eye(3, 2), (n, 1, 1))], axis=2)
    return xy, ray, w, G + size * rng.normal(size=G.shape)


@pytest.mark.parametrize("make", [paper_pair, opencv_pair])
def test_a_patch_turns_and_stretches_as_its_polar_decomposition_states(make):
    pair = make()
    xy, ray, w, G = _patches(pair)
    found, normals = motion_geometry(pair, xy, w, G), shape_geometry(pair, xy, w).normal_sys
    to_system = pair.cam1.cam_from_sys.rotation.T
    for k in range(len(xy)):
        # the point at (x, y) off the middle is ray / w there; by differences, in the system frame
        step = 1e-6
        before, after = np.empty((3, 2)), np.empty((3, 2))
        for j in range(2):
            at = np.zeros(2)
            at[j] = step
            for out, of in ((before, np.column_stack([ray[k], np.eye(3, 2)])), (after, G[k])):
                ends = [(of[:, 0] + of[:, 1:] @ (s * at)) / (w[k, 0] + w[k, 1:] @ (s * at)) for s in (-1.0, 1.0)]
                out[:, j] = to_system @ (ends[1] - ends[0]) / (2.0 * step)
        frame = tangent_frames(normals[k])
        gradient = after @ np.linalg.inv(frame[:, :2].T @ before)
        turned, right = polar(gradient)
        assert found.stretch[k] == pytest.approx([right[0, 0] - 1.0, right[1, 1] - 1.0, right[0, 1]], abs=1e-8)
        rotation = Rotation.from_rotvec(found.rotation_rad[k]).as_matrix()
        assert rotation @ frame[:, :2] == pytest.approx(turned, abs=1e-8)


def test_the_covariance_of_a_position_and_its_motion_follows_from_their_derivatives():
    pair = paper_pair()
    xy, _, w, G = _patches(pair)
    root = np.random.default_rng(10).normal(size=(len(xy), 5, 5))
    given = root @ np.swapaxes(root, 1, 2)

    def both(w0, g):
        moved, there = G.copy(), w.copy()
        moved[:, :, 0], there[:, 0] = g, w0
        return np.concatenate(
            [shape_geometry(pair, xy, there).xyz_mm, motion_geometry(pair, xy, there, moved).uvw_mm], 1
        )

    J = np.empty((len(xy), 6, 4))
    for j, step in enumerate((1e-8, 1e-5, 1e-5, 1e-5)):
        off = np.zeros(4)
        off[j] = step
        ends = [both(w[:, 0] + s * off[0], G[:, :, 0] + s * off[1:]) for s in (-1.0, 1.0)]
        J[:, :, j] = (ends[1] - ends[0]) / (2.0 * step)
    wanted = J @ given[:, :4, :4] @ np.swapaxes(J, 1, 2)
    found = covariance_xyzuvw(pair, xy, w, G, given)
    np.testing.assert_allclose(found, wanted, atol=1e-6 * np.abs(wanted).max())


def test_the_new_part_of_a_displacements_noise_is_that_of_the_current_images_shifts():
    """The plain twin takes the root of the whole noise off by LAPACK; the reference's two shifts are left out."""
    rng = np.random.default_rng(11)
    by_match, root = rng.normal(size=(30, 3, 6)), np.linalg.cholesky(3.0 * np.eye(3) + np.ones((30, 3, 3)))
    found = new_noise(by_match, root)
    noise = np.kron(np.eye(3) + 1.0, np.eye(2))
    for k in range(30):
        L = np.linalg.cholesky(by_match[k] @ noise @ by_match[k].T)
        new = root[k] @ np.linalg.inv(L) @ by_match[k][:, 2:]
        assert found[k] == pytest.approx(new @ new.T, rel=1e-10, abs=1e-12)
