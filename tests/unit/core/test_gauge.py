"""Gauges on fields whose answer is known; their uncertainties against the scatter over noisy copies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, MeasurementError, RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.gauge.align import Alignment, align_3_2_1, align_plane, aligned
from stereorig.core.gauge.area import area_statistics, points_within
from stereorig.core.gauge.extensometer import Extensometer, extensometer
from stereorig.core.gauge.locate import positions_from_mm
from stereorig.core.gauge.reading import Reading
from stereorig.core.gauge.rigid import rigid_motion, without_rigid_motion
from stereorig.core.gauge.sampling import positions_along, sample
from tests.support.gauge_field import STEP, SUBSET, make_field, pixel_noise, surface

SHARED = SharedPixels(SUBSET)
TURN = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
SHIFT = np.array([4.0, -2.0, 9.0])
COPIES = 1000


def rigid(x: Float) -> Float:
    return x @ TURN.T + SHIFT


def noisy(field: Field, errors: Float) -> Field:
    assert field.uvw_mm is not None
    return replace(field, xyz_mm=field.xyz_mm + errors[..., :3], uvw_mm=field.uvw_mm + errors[..., 3:])


def over_copies(field: Field, read: Callable[[Field], Float], copies: int = COPIES) -> Float:
    rng = np.random.default_rng(11)
    return np.array([read(noisy(field, e)) for e in pixel_noise(rng, field, copies)])


def assert_covariance(stated: Float, drawn: Float, tolerance: float) -> None:
    """Compare in the stated covariance's own axes: every ratio of scatters must be 1 (chance: 3 % in 500 copies)."""
    found = np.cov(drawn.T).reshape(stated.shape)
    d = np.sqrt(np.diag(stated))
    values, axes = np.linalg.eigh(stated / np.outer(d, d))
    seen = np.einsum("ik,ij,jk->k", axes, found / np.outer(d, d), axes)
    ratio = np.sqrt(seen / values)
    assert np.all(np.abs(ratio - 1.0) < tolerance), ratio


# correlation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("curved", [False, True], ids=["plane", "quadratic"])
def test_correlation_is_that_of_least_squares_fits_to_white_pixels(curved: bool) -> None:
    half = 30
    u = np.arange(-half, half + 1) / half
    x, y = np.meshgrid(u, u)
    terms = [np.ones_like(x), x, y] + ([x * x, x * y, y * y] if curved else [])
    A = np.stack([t.ravel() for t in terms], axis=1)
    kernel = np.linalg.pinv(A)[0].reshape(x.shape)  # what each pixel adds to the value at the centre
    shared = SharedPixels(2 * half + 1, curved)
    for dx, dy in [(0, 0), (7, 0), (0, 25), (20, 33), (58, 3), (80, 0)]:
        moved = np.zeros_like(kernel)
        if dx < len(u) and dy < len(u):
            moved[dy:, dx:] = kernel[: len(u) - dy, : len(u) - dx]
        truth = np.sum(kernel * moved) / np.sum(kernel**2)
        assert shared.correlation(-dx, dy) == pytest.approx(truth, abs=0.02)


def test_sums_over_neighbours_are_the_double_sum() -> None:
    field = make_field(rigid, rows=5, cols=9)
    values = np.random.default_rng(1).normal(size=(5, 9, 2))
    xy = np.stack([field.x_px.ravel(), field.y_px.ravel()], axis=1)
    for shared in (SHARED, SharedPixels(SUBSET, curved=True), SharedPixels(500)):
        r = shared.correlation(xy[:, None, 0] - xy[None, :, 0], xy[:, None, 1] - xy[None, :, 1])
        expected = (r @ values.reshape(45, 2)).reshape(5, 9, 2)
        assert shared.summed(field, values) == pytest.approx(expected, abs=1e-12)


# positions between points ------------------------------------------------------------------------------------------


def test_values_between_points_are_exact_for_what_is_linear_in_a_cell() -> None:
    field = make_field(rigid)
    rng = np.random.default_rng(2)
    xy = np.column_stack([rng.uniform(40, 152, 50), rng.uniform(60, 151, 50)])
    values = 3.0 + 2.0 * field.x_px - 0.5 * field.y_px
    got = sample(field, xy).of(values)
    assert got == pytest.approx(3.0 + 2.0 * xy[:, 0] - 0.5 * xy[:, 1], abs=1e-10)


def test_a_bent_surface_is_read_on_the_surface_and_not_on_its_chords() -> None:
    failed = np.zeros((14, 17), bool)
    failed[3, 4] = True  # at 68, 81
    field = make_field(rigid, failed=failed)

    def bent(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(1.0 + 0.3 * x - 0.002 * x**2 + 0.001 * x * y - 0.003 * y**2)

    rng = np.random.default_rng(2)
    inside = np.column_stack([rng.uniform(90, 145, 50), rng.uniform(95, 144, 50)])
    values = bent(field.x_px, field.y_px)
    assert sample(field, inside).of(values) == pytest.approx(bent(*inside.T), abs=1e-9)
    # beside the failed point and at the grid's edge the cell's corners serve alone: off by f'' step^2 / 8 each way
    beside = np.array([(40.0 + 2.5 * STEP, 60.0 + 4.5 * STEP), (40.0 + 10.5 * STEP, 60.0 + 0.5 * STEP)])
    chords = 0.5 * (0.004 + 0.006) * (0.5 * STEP) ** 2
    assert sample(field, beside).of(values) == pytest.approx(bent(*beside.T) - chords, abs=1e-9)


def test_no_value_reaches_over_a_failed_point() -> None:
    failed = np.zeros((14, 17), bool)
    failed[3, 4] = True  # at 68, 81
    field = make_field(rigid, failed=failed)
    positions = sample(
        field, [(68, 81), (68 + 1, 81 + 1), (68 + 6, 81 + 6), (68 + STEP, 81), (68 + 3, 81), (68 + 8, 81)]
    )
    assert positions.missing == ("low_correlation", "low_correlation", "", "", "low_correlation", "")
    values = positions.of(field.x_px * 2.0 + field.y_px)
    assert np.isnan(values[[0, 1, 4]]).all()
    assert values[[2, 3, 5]] == pytest.approx([2 * 74 + 87, 2 * 75 + 81, 2 * 76 + 81])


@pytest.mark.fault(37)
def test_no_value_reaches_over_a_cut_and_a_jump_is_not_smeared() -> None:
    cut = Cuts([[(40.0, 100.0), (160.0, 100.0)]])
    field = make_field(lambda x: x + np.where(x[..., 1:2] > -1.0, 0.5, 0.0) * [0.0, 1.0, 0.0], cuts=cut)
    assert field.uvw_mm is not None
    xy, _ = positions_along(field, [(90.0, 62.0), (90.0, 148.0)], 173)
    v = sample(field, xy).of(field.uvw_mm)[:, 1]
    found = np.isfinite(v)
    assert set(np.round(v[found], 12)) == {0.0, 0.5}
    assert np.all(v[found & (xy[:, 1] < 100.0)] == 0.0)
    assert 0 < np.sum(~found) < 2 * STEP + 2
    gauge = extensometer(field, (90.0, 80.0), (90.0, 120.0), shared=SHARED)
    assert gauge.elongation_mm.value > 0.4  # the opening is what such a gauge is for


@pytest.mark.fault(40)
@pytest.mark.parametrize("xy", [(39.0, 100.0), (153.0, 100.0), (60.0, 59.9), (60.0, 500.0), (-5.0, 0.0)])
def test_a_gauge_outside_the_field_is_refused(xy: tuple[float, float]) -> None:
    field = make_field(rigid)
    with pytest.raises(RegionError, match="outside the field") as caught:
        extensometer(field, xy, (80.0, 80.0), shared=SHARED)
    assert caught.value.code == "gauge_outside"


# extensometer ---------------------------------------------------------------------------------------------------


def test_extensometer_reads_a_homogeneous_stretch_with_a_rigid_motion_on_top() -> None:
    F = TURN @ np.array([[1.08, 0.03, 0.0], [0.0, 0.97, 0.0], [0.0, 0.0, 1.0]])
    field = make_field(lambda x: x @ F.T + SHIFT, shape=lambda x, y: surface(x, y) * [1.0, 1.0, 0.0])
    a, b = np.array([51.3, 66.0]), np.array([140.2, 133.3])
    along = 0.02 * np.append(b - a, 0.0)
    L0, L = np.linalg.norm(along), np.linalg.norm(F @ along)
    got = extensometer(field, a, b, shared=SHARED)
    assert got.length0_mm.value == pytest.approx(L0, rel=1e-12)
    assert got.length_mm.value == pytest.approx(L, rel=1e-12)
    assert got.elongation_mm.value == pytest.approx(L - L0, rel=1e-10)
    assert got.strain.value == pytest.approx(L / L0 - 1.0, rel=1e-10)
    assert got.true_strain.value == pytest.approx(np.log(L / L0), rel=1e-10)


def test_extensometers_state_their_scatter_far_apart_and_with_common_pixels() -> None:
    field = make_field(lambda x: rigid(x * 1.05))
    a = (52.0, 81.3)

    def both(f: Field) -> list[Extensometer]:
        return [extensometer(f, a, b, shared=SHARED) for b in ((128.4, 121.0), (61.0, 84.5))]

    def readings(g: Extensometer) -> list[Reading]:
        return [g.length0_mm, g.length_mm, g.elongation_mm, g.strain, g.true_strain]

    drawn = over_copies(field, lambda f: np.array([[r.value for r in readings(g)] for g in both(f)]))
    stated = np.array([[r.sigma for r in readings(g)] for g in both(field)])
    assert drawn.std(axis=0, ddof=1) / stated == pytest.approx(1.0, abs=0.08)


def test_extensometer_of_a_shape_has_a_length_only_and_missing_ends_say_why() -> None:
    shape = make_field(None)
    got = extensometer(shape, (60.0, 70.0), (100.0, 70.0), shared=SHARED)
    assert got.length_mm == got.length0_mm
    assert np.isnan(got.strain.value)
    failed = np.zeros((14, 17), bool)
    failed[:, :4] = True
    got = extensometer(make_field(rigid, failed=failed), (45.0, 70.0), (100.0, 70.0), shared=SHARED)
    assert got.missing == "end a: low_correlation"
    assert np.isnan(got.length_mm.value)
    with pytest.raises(RegionError, match="Both ends"):
        extensometer(shape, (60.0, 70.0), (60.0, 70.0), shared=SHARED)


# areas, lines ---------------------------------------------------------------------------------------------------


def test_area_statistics_and_the_scatter_of_the_mean() -> None:
    failed = np.zeros((14, 17), bool)
    failed[5:7, 5] = True
    field = make_field(rigid, failed=failed)
    inside = points_within(field, [(54, 74), (124, 74), (124, 130), (54, 130)])
    assert inside.sum() == 11 * 9
    w, sigma = field.xyz_mm[..., 2], field.sigma_mm[..., 2]
    got = area_statistics(field, w, sigma, inside, shared=SHARED)
    chosen = w[inside & field.valid]
    assert (got.count, got.points) == (97, 99)
    assert (got.mean, got.minimum, got.maximum) == (chosen.mean(), chosen.min(), chosen.max())
    assert got.rms == pytest.approx(np.sqrt(np.mean(chosen**2)))
    assert got.sd == pytest.approx(np.std(chosen, ddof=1))

    def mean(f: Field) -> Float:
        return np.array([area_statistics(f, f.xyz_mm[..., 2], None, inside, shared=SHARED).mean])

    drawn = over_copies(field, mean).std(ddof=1)
    assert drawn / got.mean_sigma == pytest.approx(1.0, abs=0.08)
    assert got.mean_sigma > 1.5 * np.sqrt(np.sum(sigma[inside & field.valid] ** 2)) / got.count  # not as if independent


def test_area_without_points_is_refused_and_without_values_is_missing() -> None:
    field = make_field(rigid, failed=np.ones((14, 17), bool))
    for corners in ([(0, 0), (20, 0), (20, 20)], [(41, 61), (46, 61), (46, 66)]):
        with pytest.raises(RegionError, match="No point") as caught:
            points_within(field, corners)
        assert caught.value.code == "gauge_outside"
    got = area_statistics(field, field.x_px, None, points_within(field, None), shared=SHARED)
    assert got.count == 0
    assert np.isnan([got.mean, got.sd, got.rms, got.mean_sigma]).all()


def test_line_places_run_evenly_round_a_corner() -> None:
    field = make_field(rigid)
    xy, at = positions_along(field, [(50.0, 70.0), (80.0, 70.0), (80.0, 110.0)], 8)
    assert at == pytest.approx(np.arange(8) * 10.0)
    assert xy[3] == pytest.approx([80.0, 70.0])
    assert len(positions_along(field, [(50.0, 70.0), (120.0, 70.0)])[1]) == 11
    for line, count in (([(1, 1), (1, 1)], None), ([(1, 1)], None), ([(1, 1), (2, 2)], 1)):
        with pytest.raises(RegionError):
            positions_along(field, line, count)


# millimetres ----------------------------------------------------------------------------------------------------


def test_places_in_mm_are_found_where_the_shape_has_them() -> None:
    failed = np.zeros((14, 17), bool)
    failed[3, 4] = True  # at 68, 81
    field = make_field(rigid, shape=lambda x, y: surface(x, y) @ TURN.T + SHIFT, failed=failed)
    xy = np.array([(40.0, 60.0), (152.0, 151.0), (61.0, 95.0), (100.3, 71.9)])
    on_it = sample(field, xy).of(field.xyz_mm)
    assert positions_from_mm(field, on_it[:, :2]) == pytest.approx(xy, abs=1e-6)
    lost = surface(np.array(70.0), np.array(83.0)) @ TURN.T + SHIFT
    for position in (lost[:2], [500.0, 0.0]):
        with pytest.raises(RegionError) as caught:
            positions_from_mm(field, [position])
        assert caught.value.code == "gauge_outside"


def test_a_place_that_a_folded_surface_has_twice_is_refused() -> None:
    folded = make_field(rigid, shape=lambda x, y: np.stack([abs(x - 93.0), y, x], axis=-1))
    with pytest.raises(RegionError) as caught:
        positions_from_mm(folded, [(20.0, 100.0)])
    assert caught.value.code == "gauge_ambiguous"


# rigid motion ---------------------------------------------------------------------------------------------------


def test_rigid_motion_is_found_and_taken_out() -> None:
    field = make_field(rigid)
    field = replace(field, rotation_rad=np.broadcast_to(Rotation.from_matrix(TURN).as_rotvec(), (14, 17, 3)))
    got = rigid_motion(field, shared=SHARED)
    assert got.rotation == pytest.approx(TURN, abs=1e-12)
    assert got.translation_mm == pytest.approx(rigid(got.centre_mm) - got.centre_mm, abs=1e-11)
    assert got.rotation_vector_rad == pytest.approx([0.3, -0.5, 0.7], abs=1e-12)
    left = without_rigid_motion(field, got, shared=SHARED)
    assert left.uvw_mm is not None
    assert left.rotation_rad is not None
    assert np.abs(left.uvw_mm).max() < 1e-11
    assert np.abs(left.rotation_rad).max() < 1e-12


def test_rigid_motion_states_its_covariance_and_that_of_what_is_left() -> None:
    failed = np.zeros((8, 10), bool)
    failed[3, 2:5] = True
    field = make_field(rigid, rows=8, cols=10, failed=failed)
    stated = rigid_motion(field, shared=SHARED)
    at = (5, 7)

    def read(f: Field) -> Float:
        m = rigid_motion(f, shared=SHARED)
        left = without_rigid_motion(f, m, shared=SHARED)
        assert left.uvw_mm is not None
        # the centre moves with the noise; the motion of one position does not
        fixed = m.translation_mm + m.centre_mm + m.rotation @ (stated.centre_mm - m.centre_mm) - stated.centre_mm
        return np.concatenate([m.rotation_vector_rad, fixed, left.uvw_mm[at]])

    drawn = over_copies(field, read, 500)
    assert_covariance(stated.covariance, drawn[:, :6], 0.12)
    left = without_rigid_motion(field, stated, shared=SHARED)
    assert_covariance(left.covariance[at][3:, 3:], drawn[:, 6:], 0.12)
    ratios = [
        rigid_motion(noisy(field, e), shared=SHARED).noise_ratio
        for e in pixel_noise(np.random.default_rng(3), field, 50)
    ]
    # a quarter of the independent values went into the six parameters and the overlap
    assert 0.85 < np.mean(ratios) < 1.02


@pytest.mark.parametrize("robust", [False, True])
def test_a_body_that_only_stretches_is_not_turned(robust: bool) -> None:
    # a bar in tension: depth is five times as noisy as the plane, so a turn about the bar could pass for contraction
    turn = Rotation.from_rotvec([0.02, -0.01, 0.05]).as_matrix()
    F = turn @ np.diag([1.08, 0.965, 1.0])
    field = make_field(lambda x: x @ F.T + SHIFT, rows=9, cols=40, shape=lambda x, y: surface(x, y) * [1.0, 1.0, 0.02])
    got = rigid_motion(field, shared=SHARED, robust=robust)
    np.testing.assert_allclose(got.rotation_vector_rad, [0.02, -0.01, 0.05], atol=2e-3)
    assert got.noise_ratio > 20.0
    # with noise alone, points still count by their noise
    still = make_field(rigid)
    tight = rigid_motion(noisy(still, pixel_noise(np.random.default_rng(8), still, 1)[0]), shared=SHARED)
    sigma = np.sqrt(np.diag(tight.covariance))[:3]
    assert (np.abs(tight.rotation_vector_rad - Rotation.from_matrix(TURN).as_rotvec()) < 4.0 * sigma).all()


def test_robust_fit_is_not_drawn_by_outliers() -> None:
    field = make_field(rigid)
    rng = np.random.default_rng(4)
    field = noisy(field, pixel_noise(rng, field, 1)[0])
    assert field.uvw_mm is not None
    uvw = field.uvw_mm.copy()
    wrong = rng.random(field.shape) < 0.15
    uvw[wrong] += rng.uniform(0.2, 1.0, (int(wrong.sum()), 3))
    field = replace(field, uvw_mm=uvw)
    truth = Rotation.from_matrix(TURN).as_rotvec()
    plain = rigid_motion(field, shared=SHARED)
    robust = rigid_motion(field, shared=SHARED, robust=True)
    sigma = np.sqrt(np.diag(robust.covariance))
    assert np.all(np.abs(robust.rotation_vector_rad - truth) < 4 * sigma[:3])
    assert np.all(np.abs(robust.translation_mm - (rigid(robust.centre_mm) - robust.centre_mm)) < 4 * sigma[3:])
    assert np.abs(plain.translation_mm - (rigid(plain.centre_mm) - plain.centre_mm)).max() > 20 * sigma[3:].max()
    assert robust.points <= field.valid.sum() - wrong.sum()


def test_rigid_motion_of_too_little_is_refused() -> None:
    field = make_field(rigid, shape=lambda x, y: surface(x, y) * [1.0, 1.0, 0.0])
    line = np.zeros((14, 17), bool)
    line[4] = True
    with pytest.raises(MeasurementError) as caught:
        rigid_motion(field, shared=SHARED, chosen=line)
    assert caught.value.code == "too_few_points"
    with pytest.raises(MeasurementError):
        align_plane(field, shared=SHARED, chosen=line)
    with pytest.raises(InputError) as refused:
        rigid_motion(make_field(None), shared=SHARED)
    assert refused.value.code == "no_displacement"


# alignment ------------------------------------------------------------------------------------------------------


def tilted(x_px: Float, y_px: Float) -> Float:
    flat = 0.02 * np.stack([x_px - 90.0, y_px - 100.0, 0.0 * x_px], axis=-1)
    return flat @ TURN.T + SHIFT


def test_plane_alignment_finds_the_plane_and_turns_everything() -> None:
    field = make_field(rigid, shape=tilted)
    got = align_plane(field, shared=SHARED, x_direction=TURN[:, 0])
    assert got.rotation == pytest.approx(TURN.T, abs=1e-9)
    assert got.residual_rms_mm < 1e-12
    new = aligned(field, got)
    assert new.uvw_mm is not None
    assert field.uvw_mm is not None
    assert np.abs(new.xyz_mm[..., 2]).max() < 1e-12
    assert new.xyz_mm.mean(axis=(0, 1)) == pytest.approx([0, 0, 0], abs=1e-10)
    step = new.xyz_mm[0, 1] - new.xyz_mm[0, 0]
    assert step == pytest.approx([0.02 * STEP, 0, 0], abs=1e-10)
    assert new.uvw_mm == pytest.approx(np.einsum("ji,rcj->rci", TURN, field.uvw_mm), abs=1e-9)
    assert new.normal_sys[3, 3] == pytest.approx(TURN.T @ [0, 0, 1.0], abs=1e-9)
    before = extensometer(field, (50.0, 70.0), (130.0, 120.0), shared=SHARED)
    after = extensometer(new, (50.0, 70.0), (130.0, 120.0), shared=SHARED)
    assert after.strain.value == pytest.approx(before.strain.value, abs=1e-12)
    assert after.elongation_mm.sigma == pytest.approx(before.elongation_mm.sigma, rel=1e-9)


def test_three_two_one_puts_its_places_where_it_says() -> None:
    field = make_field(rigid)
    positions = [(50, 70), (140, 75), (80, 140), (55, 100), (120, 104), (61, 66)]
    new = aligned(field, align_3_2_1(field, positions, shared=SHARED))
    p = sample(new, positions).of(new.xyz_mm)
    assert p[:3, 2] == pytest.approx(0.0, abs=1e-12)
    assert p[3:5, 1] == pytest.approx(0.0, abs=1e-12)
    assert p[4, 0] > p[3, 0]
    assert p[5, 0] == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(RegionError, match="one line"):
        align_3_2_1(make_field(rigid, shape=tilted), [(50, 70), (60, 70), (70, 70), *positions[3:]], shared=SHARED)


@pytest.mark.parametrize("how", ["plane", "3-2-1"])
def test_alignment_states_its_covariance(how: str) -> None:
    field = make_field(rigid, rows=8, cols=10, shape=tilted)
    positions = [(41, 61), (100, 66), (70, 107), (45, 80), (95, 84), (61, 66)]

    def align(f: Field) -> Alignment:
        return (
            align_plane(f, shared=SHARED, x_direction=TURN[:, 0])
            if how == "plane"
            else align_3_2_1(f, positions, shared=SHARED)
        )

    truth = align(field)

    def read(f: Field) -> Float:
        got = align(f)
        turn = truth.rotation @ got.rotation.T
        return np.concatenate(
            [[turn[2, 1], turn[0, 2], turn[1, 0]], truth.rotation @ (got.origin_mm - truth.origin_mm)]
        )

    drawn = over_copies(field, read, 600)
    k = [0, 1, 5] if how == "plane" else list(range(6))
    assert_covariance(truth.covariance[np.ix_(k, k)], drawn[:, k], 0.12)


def test_an_irregular_grid_is_refused() -> None:
    field = make_field(rigid)
    x = field.x_px.copy()
    x[3, 3] += 0.5
    with pytest.raises(InputError) as caught:
        sample(replace(field, x_px=x), [(60.0, 80.0)])
    assert caught.value.code == "grid_irregular"


def test_the_noise_of_these_tests_is_what_the_field_says() -> None:
    field = make_field(rigid, rows=4, cols=4)
    drawn = pixel_noise(np.random.default_rng(8), field, 1500)
    assert drawn.std(axis=0) / field.sigma_mm == pytest.approx(1.0, abs=0.09)
