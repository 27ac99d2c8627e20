"""A field compared with a model: placement, subset filter, covariance of regions, verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.errors import InputError
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.gauge.align import align_3_2_1
from stereorig.core.model.compare import compare_with_model
from stereorig.core.model.filtered import model_at_points
from stereorig.core.model.placement import Placement, place_by_fit, place_by_markers, place_given, place_in_frame
from stereorig.core.model.regions import holm, own_covariance_of_means, tiles_of
from stereorig.core.model.result import CompareOptions
from stereorig.core.model.surface import ModelSurface, surface_of_cloud
from stereorig.core.strain.options import StrainOptions
from tests.support.model_bench import MM_PER_PX, STEP_PX, SUBSET_PX, Bench, bench, clamped_plate, kirsch, mesh
from tests.support.strain_fields import make_field, sphere

SHAPE = (25, 25)
HALF_MM = 5.0
SHARED = SharedPixels(SUBSET_PX)
HERE = np.eye(3), np.zeros(3)
TURN = Rotation.from_rotvec([0.2, -0.1, 0.4]).as_matrix()
SHIFT = np.array([3.0, -2.0, 40.0])


@pytest.fixture(scope="module")
def plate() -> Bench:
    return bench(clamped_plate(), shape=SHAPE)


@pytest.fixture(scope="module")
def right() -> ModelSurface:
    return mesh(clamped_plate(), half_mm=HALF_MM, spacing_mm=0.25)


def given(one: Bench) -> Placement:
    return place_given(*HERE, one.field)


def test_the_nearest_point_of_a_surface_is_that_of_a_search_over_all_triangles() -> None:
    rng = np.random.default_rng(2)
    nodes = rng.normal(size=(60, 3)) * [5.0, 5.0, 1.0]
    triangles = rng.integers(0, 60, size=(80, 3))
    triangles = triangles[[len(set(t)) == 3 for t in triangles.tolist()]]  # of all sizes, crossing one another
    surface = ModelSurface(nodes, np.zeros((60, 3)), triangles)
    points = rng.normal(size=(40, 3)) * 6.0
    feet = surface.feet(points)
    # brute force: a fine net of weights over every triangle
    a, b = np.meshgrid(np.linspace(0, 1, 61), np.linspace(0, 1, 61))
    net = np.column_stack([1 - a.ravel() - b.ravel(), a.ravel(), b.ravel()])
    net = net[net[:, 0] >= -1e-12]
    every = np.einsum("qk,tka->tqa", net, nodes[triangles])
    for point, found in zip(points, feet.distance_mm, strict=True):
        near = float(np.linalg.norm(every - point, axis=-1).min())
        assert found <= near + 1e-12
        assert near - found < 0.3  # of the net's width, at most a step of the largest triangle
    foot = np.einsum("nk,nka->na", feet.weight, surface.corners_mm[feet.triangle])
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), feet.distance_mm, atol=1e-9)


def test_kirsch_s_displacement_has_three_times_the_stress_beside_the_hole() -> None:
    u = kirsch(radius_mm=2.0, stress_mpa=60.0)
    h = 1e-5
    exx = (u(np.array([h, 2.0, 0])) - u(np.array([-h, 2.0, 0])))[0] / (2 * h)
    assert exx == pytest.approx(3.0 * 60.0 / 71.0e3, rel=1e-4)
    far = (u(np.array([200.0 + h, 0, 0])) - u(np.array([200.0 - h, 0, 0])))[0] / (2 * h)
    assert far == pytest.approx(60.0 / 71.0e3, rel=1e-3)


def test_the_model_is_filtered_as_a_subset_sees_it(plate: Bench, right: ModelSurface) -> None:
    # the bench's own displacement is the mean over a subset of the formula, 15 x 15 samples
    found = model_at_points(plate.field, right, subset_px=SUBSET_PX, far_mm=0.1)
    inner = np.zeros(SHAPE, bool)
    inner[2:-2, 2:-2] = True
    assert plate.field.uvw_mm is not None
    assert found.field.uvw_mm is not None
    off = (found.field.uvw_mm - plate.field.uvw_mm)[inner]
    # samples of a bench and the mesh's chords: each below 1e-3 of what the subset takes, w'' h^2 / 12 = 0.5 um
    assert np.abs(off).max() < 3e-5
    point = clamped_plate()(plate.field.xyz_mm)
    assert np.abs((point - plate.field.uvw_mm)[inner][:, 2]).max() > 1e-4


def test_the_covariance_of_regions_is_that_of_drawn_noise(plate: Bench) -> None:
    tiles = tiles_of(plate.field, np.ones(SHAPE, bool), width_px=80.0)
    assert tiles.count == 9
    own = plate.field.covariance[..., 3:, 3:]
    found = own_covariance_of_means(plate.field, tiles, own, SHARED)
    rng = np.random.default_rng(4)
    alone = replace(plate.field, common=np.zeros((*SHAPE, 6, 1)))
    noise_of = Bench(alone, plate.sigma_mm)
    means = []
    for _ in range(600):
        drawn = noise_of.replicate(rng).uvw_mm
        assert drawn is not None
        means.append(tiles.means(drawn - plate.field.uvw_mm).ravel())
    seen = np.cov(np.array(means).T)
    scale = np.sqrt(np.diag(found))
    # 600 draws: a correlation scatters by 0.04, a variance by 6 %
    assert np.abs((seen - found) / np.outer(scale, scale)).max() < 0.25
    assert np.mean(np.diag(seen) / np.diag(found)) == pytest.approx(1.0, abs=0.05)


def test_a_right_model_is_accepted_and_two_per_cent_of_stiffness_refuted(plate: Bench, right: ModelSurface) -> None:
    # 0.3, 0.3, 1 um of noise a point under 58 um of deflection; the long form is in the accuracy pages
    wrong = mesh(clamped_plate(1.02), half_mm=HALF_MM, spacing_mm=0.25)
    rng = np.random.default_rng(11)
    accepted, refuted, z = 0, 0, []
    for _ in range(12):
        field = plate.replicate(rng)
        found = compare_with_model(field, right, given(plate), subset_px=SUBSET_PX)
        accepted += found.accepted
        z.append((found.factor - 1.0) / found.factor_sigma)
        refuted += not compare_with_model(field, wrong, given(plate), subset_px=SUBSET_PX).accepted
    assert accepted >= 8  # 95 % of 12; 7 or fewer come once in 5,000
    assert refuted == 12
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_common_causes_are_not_averaged_away(plate: Bench, right: ModelSurface) -> None:
    # six standard deviations of one cause under a hundredth of the noise: where it is known, 36 bounds the chi-square
    assert plate.field.common is not None
    assert plate.field.uvw_mm is not None
    moved = replace(
        plate.field,
        uvw_mm=plate.field.uvw_mm + 6.0 * plate.field.common[..., 3:, 1],
        covariance=1e-4 * plate.field.covariance,
    )
    known = compare_with_model(moved, right, given(plate), subset_px=SUBSET_PX)
    alone = compare_with_model(replace(moved, common=None), right, given(plate), subset_px=SUBSET_PX)
    assert known.displacement.overall.chi_square == pytest.approx(36.0, rel=0.1)
    assert alone.displacement.overall.chi_square > 5.0 * known.displacement.overall.chi_square


@pytest.mark.parametrize("kind", ["3-2-1", "markers", "best-fit"])
def test_a_model_in_another_frame_is_placed_onto_the_shape(kind: str) -> None:
    motion = np.array([0.01, -0.02, 0.05])
    field = make_field(sphere(12.0), lambda x: x + motion, shape=SHAPE, spacing_px=STEP_PX)
    rng = np.random.default_rng(7)
    a, b = (v.ravel() for v in np.meshgrid(*[np.linspace(-4.6, 4.6, 121)] * 2))
    body = surface_of_cloud(sphere(12.0)(a, b), np.broadcast_to(motion, (a.size, 3)).copy(), np.array([0, 0, 1.0]))
    model = body.moved(TURN.T, -TURN.T @ SHIFT)  # its own frame
    px = np.array([[140.0, 120.0], [300.0, 130.0], [200.0, 280.0], [120.0, 200.0], [320.0, 200.0], [220.0, 110.0]])
    true = sphere(12.0)(*((px - [220.0, 200.0]) * MM_PER_PX).T)
    in_model = (true - SHIFT) @ TURN
    if kind == "3-2-1":
        found = place_in_frame(align_3_2_1(field, px, shared=SHARED), in_model)
    else:
        found = place_by_markers(field, px[:4], in_model[:4], shared=SHARED)
    if kind == "best-fit":
        off = Rotation.from_rotvec([0.01, 0.005, 0.0]).as_matrix()
        field = replace(field, xyz_mm=field.xyz_mm + rng.normal(0.0, 2e-4, field.xyz_mm.shape))
        start = replace(found, rotation=off @ found.rotation, shift_mm=off @ found.shift_mm + [0.05, -0.04, 0.1])
        found = place_by_fit(field, model, start, shared=SHARED)
        assert "shift along Z" not in found.held
    placed = model.moved(found.rotation, found.shift_mm).nodes_mm
    away = placed - body.nodes_mm
    if kind == "best-fit":  # a ball turns in its place unseen: the surface lies right, its points need not
        away = (np.linalg.norm(placed - [0, 0, 12.0], axis=1) - 12.0)[:, None] * np.ones(3)
    assert np.abs(away).max() < 2e-3


def test_a_best_fit_s_uncertainty_is_that_of_drawn_shapes() -> None:
    nodes = mesh(clamped_plate(), half_mm=HALF_MM, spacing_mm=0.5)
    one = bench(clamped_plate(), shape=SHAPE)
    start = place_given(*HERE, one.field)
    rng = np.random.default_rng(3)
    found, said = [], None
    for _ in range(40):
        field = one.replicate(rng)
        place = place_by_fit(field, nodes, start, shared=SHARED)
        turn = Rotation.from_matrix(place.rotation).as_rotvec()
        at_centre = place.rotation @ place.centre_mm + place.shift_mm - place.centre_mm
        found.append([turn[0], turn[1], at_centre[2]])
        said = place.covariance[np.ix_([0, 1, 5], [0, 1, 5])]
        assert place.held == ("turn about Z", "shift along X", "shift along Y")
    assert said is not None
    seen = np.array(found).std(axis=0)
    np.testing.assert_allclose(seen, np.sqrt(np.diag(said)), rtol=0.45)  # 40 draws scatter by 11 %


def test_rigid_motion_of_any_size_is_taken_out(plate: Bench, right: ModelSurface) -> None:
    turn = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix()
    field = plate.replicate(np.random.default_rng(5))
    assert field.uvw_mm is not None
    moved = (plate.field.xyz_mm + field.uvw_mm) @ turn.T + [1.0, -0.5, 0.2]
    carried = replace(field, uvw_mm=moved - plate.field.xyz_mm)
    kept = compare_with_model(carried, right, given(plate), subset_px=SUBSET_PX)
    found = compare_with_model(
        carried, right, given(plate), subset_px=SUBSET_PX, options=CompareOptions(remove_rigid=True)
    )
    assert not kept.accepted
    assert found.accepted
    assert found.rigid is not None
    np.testing.assert_allclose(found.rigid[:3], [0.02, -0.01, 0.03], atol=1e-4)


def test_an_uncertain_load_lets_a_wrong_scale_pass(plate: Bench) -> None:
    wrong = mesh(clamped_plate(1.02), half_mm=HALF_MM, spacing_mm=0.25)
    for share, accepted in ((0.0, False), (0.02, True)):
        found = compare_with_model(
            plate.field, wrong, given(plate), subset_px=SUBSET_PX, options=CompareOptions(load_uncertainty=share)
        )
        assert found.accepted is accepted
        assert found.factor == pytest.approx(1.02, abs=2e-3)


def test_a_local_error_is_named_where_it_is(plate: Bench, right: ModelSurface) -> None:
    assert plate.field.uvw_mm is not None
    bump = plate.field.uvw_mm.copy()
    bump[2:6, 17:21, 0] += 5e-3
    found = compare_with_model(replace(plate.field, uvw_mm=bump), right, given(plate), subset_px=SUBSET_PX)
    assert not found.accepted
    hit = set(np.unique(found.tiles.number[2:6, 17:21]).tolist())
    assert set(np.flatnonzero(found.displacement.refuted).tolist()) <= hit
    assert found.displacement.refuted.any()


def test_strain_is_compared_by_the_same_windows_up_to_a_hole() -> None:
    one = bench(kirsch(), shape=(31, 31), hole_mm=1.2)
    # a hole's formula for another radius: strain beside it differs by a third
    fields = [(kirsch(), 2.0, True), (kirsch(1.5), 2.0, False)]
    clean = replace(one.field, covariance=1e-4 * one.field.covariance, common=1e-2 * np.asarray(one.field.common))
    for formula, hole, right in fields:
        surface = mesh(formula, half_mm=6.0, hole_mm=hole if hole < 1.2 else 1.2)
        found = compare_with_model(clean, surface, given(one), subset_px=SUBSET_PX, strain=StrainOptions(window=5))
        assert found.strain is not None
        assert found.strain.accepted is right


def test_what_lies_elsewhere_is_refused_with_both_sizes(plate: Bench, right: ModelSurface) -> None:
    small = ModelSurface(1e-3 * right.nodes_mm, right.displacement_mm, right.triangles)
    beside = right.moved(np.eye(3), np.array([50.0, 0.0, 0.0]))
    for other in (small, beside):
        with pytest.raises(InputError, match="mm across") as raised:
            compare_with_model(plate.field, other, given(plate), subset_px=SUBSET_PX)
        assert raised.value.code == "model_no_overlap"
    tilted = right.moved(Rotation.from_rotvec([0.6, 0, 0]).as_matrix(), np.array([0, 0, 1.0]))
    with pytest.raises(InputError) as raised:
        compare_with_model(plate.field, tilted, given(plate), subset_px=SUBSET_PX)
    assert raised.value.code == "model_geometry_differs"


def test_points_beyond_the_model_take_no_part(plate: Bench) -> None:
    narrow = mesh(clamped_plate(), half_mm=2.0, spacing_mm=0.25)
    found = compare_with_model(plate.field, narrow, given(plate), subset_px=SUBSET_PX)
    inside = (np.abs(plate.field.xyz_mm[..., :2]) <= 1.7).all(axis=-1)  # a corner holds too little of a subset
    assert np.isfinite(found.displacement.difference[inside]).all()
    reach = 2.0 + 0.25 * SUBSET_PX * MM_PER_PX
    outside = (np.abs(plate.field.xyz_mm[..., :2]) > reach).any(axis=-1)
    assert np.isnan(found.displacement.difference[outside]).all()
    assert (found.status[outside] == 2).all()


def test_nodes_behind_one_another_are_no_surface() -> None:
    x, y = (v.ravel() for v in np.meshgrid(np.arange(10.0), np.arange(10.0)))
    layers = np.concatenate([np.column_stack([x, y, np.full(100, z)]) for z in (0.0, 2.0)])
    with pytest.raises(InputError) as raised:
        surface_of_cloud(layers, np.zeros((200, 3)), np.array([0.0, 0.0, 1.0]))
    assert raised.value.code == "model_not_a_surface"


def test_holm_s_procedure_stops_at_the_first_that_holds() -> None:
    # Holm (1979): 0.01 against 0.05 / 4, 0.013 against 0.05 / 3, 0.03 against 0.05 / 2 ends it
    assert holm(np.array([0.03, 0.01, 0.2, 0.013]), 0.05).tolist() == [False, True, False, True]
    assert not holm(np.array([np.nan, 0.2]), 0.05).any()
