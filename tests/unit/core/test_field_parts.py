"""The parts of a field alone: local fits, start values, extrapolation, gates, the neighbour kernel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import InputError
from stereorig.core.field.checks.validity import ValidityOptions, apply_validity_checks, neighbour_disagreement
from stereorig.core.field.points.features import detect, match
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.scales import plausible
from stereorig.core.field.points.starts import current_position, move_matrix, move_w
from stereorig.core.field.region.neighbours import compare_with_neighbours, sorting_network
from stereorig.core.field.seeding.epipolar_search import sweep
from stereorig.core.field.seeding.local_fit import consistent, robust_local_fits
from stereorig.core.field.seeding.predicted import predict
from stereorig.core.field.seeding.scattered_matches import combine
from stereorig.core.matching.fit import no_motion
from stereorig.core.measure import MeasureOptions, ReferencePair, measure_shape
from stereorig.core.status import PointStatus
from stereorig.core.threads import available_threads, set_threads
from tests.support.field_bench import grid, pair, scene, take, truth

GRID = grid()
XY = GRID.xy_px.reshape(-1, 2)
RAYS = pair().cam1.rays_cam(XY).xyz_mm


def plane_w(tilt_x: float, tilt_y: float, depth_mm: float = 400.0) -> np.ndarray:
    """Return w at the grid's points on the plane n . P = n . (0, 0, depth), camera 1's frame."""
    n = np.array([np.tan(tilt_x), np.tan(tilt_y), 1.0])
    w0 = RAYS @ n / depth_mm
    return np.column_stack([w0, np.full_like(w0, n[0] / depth_mm), np.full_like(w0, n[1] / depth_mm)])


def rigid(points: np.ndarray, rotvec: np.ndarray, shift: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(rotvec))
    k = rotvec / angle
    return (
        points * np.cos(angle)
        + np.cross(k, points) * np.sin(angle)
        + k * (points @ k)[:, None] * (1.0 - np.cos(angle))
        + shift
    )


def good_points(w: np.ndarray, G: np.ndarray | None, rng: np.random.Generator) -> PointFits:
    n = len(w)
    points = PointFits.empty(n, 1 if G is None else 3)
    points.status[:] = PointStatus.OK
    points.w[:] = w
    if G is not None:
        points.G[:] = G
    points.zncc[:] = 1.0 - 0.01 * np.exp(0.1 * rng.standard_normal(points.zncc.shape))
    points.epipolar_px[:] = 0.05 + 0.01 * rng.standard_normal(n)
    points.epipolar_sigma_px[:] = 0.01
    return points


def apply_checks(points: PointFits) -> None:
    apply_validity_checks(
        points,
        pair=pair(),
        shape=GRID.shape,
        xy_px=XY,
        rays=RAYS,
        texture=np.full(len(XY), 900.0),
        subset_px=33,
        options=ValidityOptions(),
    )


@settings(max_examples=25, deadline=None)
@given(tilt_x=st.floats(-0.6, 0.6), tilt_y=st.floats(-0.6, 0.6), depth=st.floats(100.0, 900.0))
def test_a_patch_extended_to_its_neighbour_is_exact_on_a_plane(tilt_x: float, tilt_y: float, depth: float) -> None:
    w = plane_w(tilt_x, tilt_y, depth)
    offset = RAYS[1:, :2] - RAYS[:-1, :2]
    np.testing.assert_allclose(move_w(w[:-1], offset), w[1:], rtol=1e-12)


def test_start_values_from_an_image_map_put_the_patch_where_a_rigid_motion_puts_it() -> None:
    w = plane_w(0.2, -0.1)
    points = RAYS / w[:, :1]
    rotvec, shift = np.array([0.1, -0.15, 0.5]), np.array([1.0, -2.0, 5.0])
    now = rigid(points - points.mean(0), rotvec, shift + points.mean(0))
    n = rigid(np.array([[np.tan(0.2), np.tan(-0.1), 1.0]]), rotvec, np.zeros(3))[0]
    constant = float(now[0] @ n)
    xy_now = pair().cam1.lens.image_from_normalised(now[:, :2] / now[:, 2:]).xy
    rays_now = now / now[:, 2:]
    w_now = np.column_stack(
        [rays_now @ n / constant, np.full(len(w), n[0] / constant), np.full(len(w), n[1] / constant)]
    )
    # the image map's derivative by differences over material points a hundredth of a pixel apart
    affine = np.empty((len(w), 2, 2))
    for j in range(2):
        beside = XY + 0.01 * np.eye(2)[j]
        ray = pair().cam1.rays_cam(beside).xyz_mm
        other = ray / move_w(w, ray[:, :2] - RAYS[:, :2])[:, :1]
        moved = rigid(other - points.mean(0), rotvec, shift + points.mean(0))
        affine[:, :, j] = (pair().cam1.lens.image_from_normalised(moved[:, :2] / moved[:, 2:]).xy - xy_now) / 0.01
    G = combine(pair(), w, XY, xy_now, affine, w_now)
    np.testing.assert_allclose(current_position(w, G), now, atol=1e-9)
    offset = RAYS[1:, :2] - RAYS[:-1, :2]
    carried = current_position(move_w(w[:-1], offset), move_matrix(G[:-1], offset))
    np.testing.assert_allclose(carried, now[1:], atol=1e-4)


def test_a_patch_seen_from_behind_or_edge_on_is_not_plausible() -> None:
    assert plausible(pair(), RAYS, plane_w(0.0, 0.0), None).all()
    assert not plausible(pair(), RAYS, plane_w(1.45, 0.0), None).any()
    assert not plausible(pair(), RAYS, -plane_w(0.0, 0.0), None).any()


def test_local_fits_ignore_wrong_samples() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 100, (400, 2))
    values = np.column_stack([3.0 + 0.2 * points[:, 0], 1.0 - 0.1 * points[:, 1]])
    wrong = rng.random(400) < 0.25
    values[wrong] += rng.uniform(5, 50, (wrong.sum(), 2))
    positions = rng.uniform(20, 80, (50, 2))
    fits = robust_local_fits(positions, points, values, tolerance=0.5)
    np.testing.assert_allclose(fits.value[:, 0], 3.0 + 0.2 * positions[:, 0], atol=1e-9)
    np.testing.assert_allclose(fits.slope, np.broadcast_to([[0.2, 0.0], [0.0, -0.1]], (50, 2, 2)), atol=1e-9)
    assert (consistent(points, values, tolerance=0.5) == ~wrong).mean() > 0.99
    assert np.isnan(robust_local_fits(positions, points[:3], values[:3], tolerance=0.5).value).all()


def test_features_of_a_shifted_image_match_at_the_shift() -> None:
    first, _ = take("block")
    a, b = detect(first[:, 30:]), detect(first[:, :-30])
    pairs = match(a, b)
    shift = b.xy_px[pairs[:, 1]] - a.xy_px[pairs[:, 0]]
    right = np.linalg.norm(shift - (30.0, 0.0), axis=1) < 1.0
    assert len(pairs) > 100
    assert right.mean() > 0.97


def test_the_depth_search_finds_the_surface_on_the_epipolar_line() -> None:
    first, second = take("block")
    index = GRID.shape[1] * 9 + 11
    w, zncc = sweep(pair(), first, second, XY[index], subset_px=33)
    true = pair().cam1.cam_from_sys.apply(truth(GRID, scene("block")).xyz_mm.reshape(-1, 3)[index])[2]
    assert zncc[0] > 0.7
    assert 1.0 / w[0, 0] == pytest.approx(true, abs=0.1)


@pytest.mark.parametrize("motion", [False, True])
def test_the_neighbour_kernel_agrees_with_numpy(motion: bool) -> None:
    rng = np.random.default_rng(2)
    w = plane_w(0.2, 0.1) * (1.0 + 1e-5 * rng.standard_normal((len(XY), 3)))
    G = no_motion(pair(), XY) * (1.0 + 1e-5 * rng.standard_normal((len(XY), 3, 3)))
    points = good_points(w, G if motion else None, rng)
    points.reject(rng.random(len(XY)) < 0.3, PointStatus.NOT_CONVERGED)
    difference, spread, count = neighbour_disagreement(points, pair(), GRID.shape, RAYS)
    rows, cols = GRID.shape
    J = pair().cam1.lens.image_jacobian(RAYS[:, :2])
    for i in rng.choice(np.flatnonzero(points.ok), 40, replace=False):
        r, c = divmod(int(i), cols)
        near = [
            rr * cols + cc
            for rr in range(max(r - 2, 0), min(r + 3, rows))
            for cc in range(max(c - 2, 0), min(c + 3, cols))
            if (rr, cc) != (r, c) and points.ok[rr * cols + cc]
        ]
        assert count[i] == len(near)
        offset = RAYS[i, :2] - RAYS[near, :2]
        predicted = move_w(points.w[near], offset)[:, 0]
        relative = predicted / points.w[i, 0] - 1.0
        ratio = np.median(np.abs(relative - np.median(relative))) / np.abs(np.median(relative))
        assert spread[i, 0] / np.abs(difference[i, 0]) == pytest.approx(ratio, rel=1e-6)
        assert np.sign(difference[i, 0]) == -np.sign(np.median(relative))
        if motion:
            moved = move_matrix(points.G[near], offset)[:, :, 0]
            u = (moved - RAYS[i]) * (points.w[i, 0] / predicted)[:, None] - (points.G[i, :, 0] - RAYS[i])
            assert difference[i, 1] == pytest.approx(-np.median(u[:, 0]) * np.linalg.norm(J[i, :, 0]), rel=1e-6)


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 24), seed=st.integers(0, 1000))
def test_the_sorting_network_sorts(n: int, seed: int) -> None:
    values = np.random.default_rng(seed).integers(0, 9, n)
    expected = np.sort(values)
    for a, b in sorting_network(n):
        if values[b] < values[a]:
            values[[a, b]] = values[[b, a]]
    np.testing.assert_array_equal(values, expected)


def test_the_neighbour_kernel_knows_no_blocks() -> None:
    # wider than two of the kernel's blocks; no slopes, so a neighbour predicts its own depth
    rng = np.random.default_rng(5)
    rows, cols = 5, 150
    depth = 1.0 + 1e-3 * rng.standard_normal((rows, cols))
    ok = rng.random((rows, cols)) < 0.5
    w = np.zeros((rows, cols, 3))
    w[..., 0] = depth
    difference, spread = np.full((2, rows, cols, 4), np.nan)
    count = np.zeros((rows, cols), np.int32)
    nothing_between = np.zeros((0, 0), np.uint32)
    arrays = (
        nothing_between,
        np.zeros((rows, cols, 3)),
        w,
        np.zeros((rows, cols, 3, 3)),
        False,
        difference,
        spread,
        count,
    )
    for r in range(rows):
        compare_with_neighbours(r, r + 1, sorting_network(24), ok, *arrays)
    for r, c in np.ndindex(rows, cols):
        near = ok.copy()
        near[r, c] = False
        near = near[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3]
        values = depth[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3][near] / depth[r, c] - 1.0
        assert count[r, c] == (len(values) if ok[r, c] else 0)
        if count[r, c]:
            assert difference[r, c, 0] == pytest.approx(-np.median(values), rel=1e-6, abs=1e-9)
            assert spread[r, c, 0] == pytest.approx(np.median(np.abs(values - np.median(values))), rel=1e-5, abs=1e-9)
        else:
            assert np.isnan(difference[r, c, 0])


@pytest.mark.parametrize("motion", [False, True])
def test_gates_let_a_sound_field_pass_and_take_out_what_was_put_in(motion: bool) -> None:
    rng = np.random.default_rng(3)
    w, G = plane_w(0.2, 0.1), no_motion(pair(), XY)
    w[:, 0] *= 1.0 + 2e-7 * rng.standard_normal(len(w))
    sound = good_points(w, G if motion else None, rng)
    apply_checks(sound)
    assert sound.ok.mean() > 0.995
    points = good_points(w, G if motion else None, rng)
    bad = rng.choice(len(XY), 12, replace=False)
    points.w[bad[:4], 0] *= 1.0 + 2e-4  # half a pixel and more of depth
    points.epipolar_px[bad[4:8]] += 0.1
    points.zncc[bad[8:], -1] = 0.9
    apply_checks(points)
    assert not points.ok[bad].any()
    assert np.isnan(points.w[bad]).all()
    assert (points.status[bad[:4]] == PointStatus.NEIGHBOUR_MISMATCH).all()
    assert (points.status[bad[4:8]] == PointStatus.EPIPOLAR_MISMATCH).all()
    assert (points.status[bad[8:]] == PointStatus.LOW_CORRELATION).all()
    assert points.ok.mean() > 0.95


@pytest.mark.fault(44)
@pytest.mark.skipif(available_threads() < 2, reason="one thread only in this process")
def test_the_number_of_threads_does_not_change_a_field() -> None:
    before, after = take("block"), take("block", 0.5)
    fields = []
    try:
        for n in (1, 2):
            set_threads(n)
            reference = ReferencePair(pair(), *before)
            shape = reference.shape(GRID, MeasureOptions())
            fields.append(reference.motion(*after, GRID, MeasureOptions(), shape=shape))
    finally:
        set_threads(available_threads())
    one, two = fields
    np.testing.assert_array_equal(one.status, two.status)
    np.testing.assert_allclose(one.uvw_mm, two.uvw_mm, rtol=1e-9, atol=1e-12)


def test_a_smooth_motion_of_a_sample_is_carried_to_all_points_and_an_erratic_one_is_not() -> None:
    rng = np.random.default_rng(4)
    w, still = plane_w(0.1, 0.05), no_motion(pair(), XY)
    points = RAYS / w[:, :1]
    shift = np.array([0.1, -0.05, 0.2]) + 1e-4 * (points[:, :1] - points[:, :1].mean()) ** 2  # bent: no affine map
    now = still.copy()
    now[:, :, 0] += shift * w[:, :1]
    sample = np.sort(rng.choice(len(XY), 60, replace=False))
    lens = pair().cam1.lens

    def off_px(G: np.ndarray) -> np.ndarray:
        a, b = (lens.image_from_normalised(g[:, :2, 0] / g[:, 2:, 0]).xy for g in (G, now))
        return np.linalg.norm(a - b, axis=1)

    found = now[sample].copy()
    found[:3, :, 0] += 1e-3  # some of the sample went wrong
    predicted = predict(pair(), XY, still, sample, w[sample], found)
    assert np.median(off_px(still)) > 2.0
    assert off_px(predicted).max() < 0.05
    erratic = now[sample].copy()
    erratic[:, :, 0] += 1e-3 * rng.standard_normal((len(sample), 3))
    assert predict(pair(), XY, still, sample, w[sample], erratic) is still
    assert predict(pair(), XY, still, sample[:5], w[sample[:5]], now[sample[:5]]) is still


def test_cameras_in_one_place_are_refused_before_any_search() -> None:
    """Also where composed poses leave a baseline of rounding alone, and whatever the entry."""
    first, image = pair().cam1, np.random.default_rng(1).uniform(0.0, 255.0, (96, 96))
    turn = RigidTransform(Rotation.from_rotvec([0.0, 0.2, 0.1]).as_matrix(), np.zeros(3))
    moved = (turn @ first.cam_from_sys) @ first.cam_from_sys.inverse() @ first.cam_from_sys
    for pose in (first.cam_from_sys, turn @ first.cam_from_sys, moved):
        alike = StereoPair(first, Camera(first.lens, pose))
        for call in (
            lambda p: ReferencePair(p, image, image[::-1]),
            lambda p: measure_shape(p, image, image[::-1], GRID),
        ):
            with pytest.raises(InputError, match="same position") as caught:
                call(alike)
            assert caught.value.code == "baseline_zero"
            assert "calibration" in caught.value.remedy
    pair().require_baseline()
