"""A plane model, which has no displacement along its normal, is compared in its plane and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.model.compare import compare_with_model
from stereorig.core.model.placement import place_by_fit, place_given
from stereorig.core.model.result import CompareOptions, ModelComparison
from stereorig.core.model.surface import ModelSurface
from stereorig.core.strain.options import StrainOptions
from tests.support.model_bench import SUBSET_PX, Array, Bench, bench, mesh

SHAPE = (25, 25)


def stretched(stiffness: float = 1.0, bulge_mm: float = 0.0) -> Callable[[Array], Array]:
    """A band bent in its plane, at most 10 um; its middle may bulge towards the cameras, which no plane model has."""

    def displacement(x: Array) -> Array:
        a, b = x[..., 0] / 5.0, x[..., 1] / 5.0
        u, v = 0.008 * a + 0.004 * a * b, -0.003 * b - 0.002 * a**2
        return np.stack([u / stiffness, v / stiffness, bulge_mm * (1.0 - 0.5 * (a**2 + b**2))], axis=-1)

    return displacement


@pytest.fixture(scope="module")
def bulged() -> Bench:
    return bench(stretched(bulge_mm=0.02), shape=SHAPE)


def plane(stiffness: float = 1.0) -> ModelSurface:
    return replace(mesh(stretched(stiffness), half_mm=5.0, spacing_mm=0.5), plane=True)


def compared(field: Field, model: ModelSurface, **options: object) -> ModelComparison:
    chosen = CompareOptions(**options)  # type: ignore[arg-type]
    return compare_with_model(
        field, model, place_given(np.eye(3), np.zeros(3), field), subset_px=SUBSET_PX, options=chosen
    )


def test_what_leaves_the_plane_is_in_no_difference_chi_square_or_verdict(bulged: Bench) -> None:
    rng = np.random.default_rng(3)
    model, wrong = plane(), plane(1.15)
    chi, z, accepted = [], [], 0
    for _ in range(20):
        field = bulged.replicate(rng)
        found = compared(field, model, systematic_mm=(1e-5, 1e-5, 1e-5))
        assert found.left_out == 2
        one = found.displacement
        for part in (one.measured, one.model, one.difference, one.sigma, one.z, one.tile_difference, one.tile_sigma):
            assert np.isnan(part[..., 2]).all()
        assert np.isfinite(one.tile_difference[:, :2]).all()
        assert {verdict.degrees for verdict in one.verdicts} == {2}
        assert one.overall.degrees == 2 * found.tiles.count
        chi.append(one.overall.chi_square / one.overall.degrees)
        z.append((found.factor - 1.0) / found.factor_sigma)
        accepted += found.accepted
        assert not compared(field, wrong).accepted
    assert np.mean(chi) == pytest.approx(1.0, abs=0.15)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.45)  # of 20
    assert accepted >= 16  # 95 % of 20; 15 or fewer come once in 400
    shell = replace(model, plane=False)
    assert not compared(bulged.replicate(rng), shell).accepted  # a model that says that w is zero


@pytest.mark.parametrize(("turned", "left_out"), [([0.3, -0.2, 0.5], 2), ([0.1, 1.3, 0.2], 0), ([np.pi, 0.0, 0.3], 2)])
@pytest.mark.parametrize("remove_rigid", [False, True])
def test_the_verdict_is_the_same_in_any_system_frame(
    bulged: Bench, turned: list[float], left_out: int, remove_rigid: bool
) -> None:
    field = bulged.replicate(np.random.default_rng(7))
    R, shift = Rotation.from_rotvec(turned).as_matrix(), np.array([3.0, -2.0, 40.0])
    both = np.kron(np.eye(2), R)
    other = replace(
        field,
        xyz_mm=field.xyz_mm @ R.T + shift,
        uvw_mm=field.uvw_mm @ R.T,  # type: ignore[operator]
        normal_sys=field.normal_sys @ R.T,
        covariance=both @ field.covariance @ both.T,
        common=both @ field.common,  # type: ignore[operator]
    )
    here = compared(field, plane(), remove_rigid=remove_rigid)
    options = CompareOptions(remove_rigid=remove_rigid)
    there = compare_with_model(other, plane(), place_given(R.T, shift, other), subset_px=SUBSET_PX, options=options)
    assert there.left_out == left_out
    a, b = here.displacement, there.displacement
    assert (b.overall.degrees, b.accepted) == (a.overall.degrees, a.accepted)
    np.testing.assert_allclose(b.overall.chi_square, a.overall.chi_square, rtol=1e-6)
    np.testing.assert_allclose([there.factor, there.factor_sigma], [here.factor, here.factor_sigma], rtol=1e-6)
    size = [np.linalg.norm(np.nan_to_num(one.difference), axis=-1) for one in (a, b)]
    np.testing.assert_allclose(size[0], size[1], atol=1e-9)


def test_a_rigid_motion_in_and_out_of_the_plane_is_taken_out(bulged: Bench) -> None:
    field = bulged.replicate(np.random.default_rng(5))
    turn = Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix()
    moved = (field.xyz_mm + np.asarray(field.uvw_mm)) @ turn.T + [1.0, -0.5, 0.2]
    carried = replace(field, uvw_mm=moved - field.xyz_mm)
    assert not compared(carried, plane()).accepted
    found = compared(carried, plane(), remove_rigid=True)
    assert found.accepted
    assert found.displacement.overall.degrees == 2 * found.tiles.count - 3
    assert found.rigid is not None
    np.testing.assert_allclose(found.rigid[:3], [0.01, -0.02, 0.03], atol=3e-3)  # the bulge tilts the fit


def test_strains_are_compared_and_a_best_fit_places_the_plane(bulged: Bench) -> None:
    field = bulged.replicate(np.random.default_rng(9))
    start = place_given(np.eye(3), np.array([0.0, 0.0, 0.01]), field)
    for stiffness, right in ((1.0, True), (1.3, False)):
        model = plane(stiffness)
        placed = place_by_fit(field, model, start, shared=SharedPixels(SUBSET_PX))
        found = compare_with_model(field, model, placed, subset_px=SUBSET_PX, strain=StrainOptions(window=7))
        assert found.strain is not None
        assert (found.strain.accepted, found.accepted, found.left_out) == (right, right, 2)
        assert np.isfinite(found.strain.tile_difference).all()
