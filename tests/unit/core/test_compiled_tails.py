"""Compiled sums and estimators after the matching, beside plain numpy twins."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from stereorig.core.common.derivatives import WEIGHTS, Estimator
from stereorig.core.field.region.window import window_offsets
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
