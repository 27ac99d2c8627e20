"""The choice between plane and curved patches, and what a curved patch predicts of its surroundings."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from stereorig.core.errors import InputError
from stereorig.core.field.checks.patch_choice import decide
from stereorig.core.field.points.patch import PatchChoice, asked_for
from stereorig.core.field.points.starts import move_matrix, move_w
from stereorig.core.matching.geometry import principal_curvatures
from stereorig.core.measure import MeasureOptions
from tests.support.matching_scene import Bent, opencv_pair, paper_pair, true_g6, true_w6

PLANE_UM, CURVED_UM = 0.2, 0.38


def sample(bias_um: float, *, n: int = 250, wrong: int = 0, seed: int = 3) -> PatchChoice:
    """Differences as an efficient plane patch with a bias and an unbiased curved one make them."""
    rng = np.random.default_rng(seed)
    extra = np.sqrt((CURVED_UM**2 - PLANE_UM**2) / 3.0)
    difference = rng.normal(0.0, extra, (n, 3)) + bias_um * np.array([0.6, 0.0, 0.8])
    difference[:wrong] += 40.0
    variance = [np.full(n, (1e-3 * um) ** 2) for um in (PLANE_UM, CURVED_UM)]
    return decide(1e-3 * difference, *variance, plane="affine")


@pytest.mark.parametrize("bias_um", [0.8, 1.8, 6.0])
def test_a_bias_above_the_cost_in_noise_makes_it_curved(bias_um: float) -> None:
    choice = sample(bias_um)
    assert choice.patch == "quadratic"
    assert choice.plane_error_mm is not None
    assert abs(1e3 * choice.plane_error_mm / bias_um - 1.0) < 0.1
    assert choice.reason.startswith("quadratic: plane patches have a bias of ")
    assert "0.38 um of noise" in choice.reason
    assert choice.sample >= 240


@pytest.mark.parametrize("bias_um", [0.0, 0.1, 0.25])
def test_a_bias_below_it_leaves_it_plane(bias_um: float) -> None:
    for seed in range(20):
        choice = sample(bias_um, seed=seed)
        assert choice.patch == "affine"
        assert choice.reason.startswith("affine: plane patches have a bias of ")
    if bias_um == 0.0:
        assert "less than 0." in choice.reason


def test_a_few_wrong_fits_do_not_decide() -> None:
    assert sample(0.0, wrong=4).patch == "affine"
    assert sample(0.0, wrong=40).patch == "quadratic"  # 16 % are no exceptions any more


def test_a_choice_survives_its_file_and_is_kept_by_the_steps_after() -> None:
    choice = sample(1.8)
    back = PatchChoice.from_document(json.loads(json.dumps(choice.document() | {"of a later version": 1})))
    assert back == choice
    kept = choice.for_next_step()
    assert kept.kept
    assert kept.reason.endswith(choice.reason)
    assert kept.for_next_step() == kept
    assert dataclasses.replace(kept, kept=False, reason=choice.reason) == choice
    assert asked_for("rigid", "rigid").reason == "rigid: asked for"


@pytest.mark.parametrize("patch", ["bent", "", "plane"])
def test_unknown_patches_are_refused(patch: str) -> None:
    with pytest.raises(InputError, match="patch is"):
        MeasureOptions(patch=patch)  # type: ignore[arg-type]


@pytest.mark.parametrize("make", [paper_pair, opencv_pair])
def test_curvatures_are_the_surfaces_own(make) -> None:
    camera, xy = make().cam1, np.array([[79.5, 79.5]])
    position = camera.back_project_to_plane(xy, point_sys_mm=np.zeros(3), normal_sys=np.array([0.0, 0.0, 1.0])).xyz_mm[
        0
    ]
    for bend in ((1 / 30, 0.004, 1 / 40), (-1 / 30, 0.004, 1 / 40), (-0.02, 0.0, -0.02)):
        w = true_w6(camera, Bent(bend, origin=position), xy)
        a, b, c = bend
        expected = np.linalg.eigvalsh([[a, b], [b, c]])[::-1]
        np.testing.assert_allclose(principal_curvatures(make(), xy, w)[0], expected, rtol=1e-4, atol=1e-6)


def test_a_curved_patch_extended_to_its_neighbour_is_good_to_third_order() -> None:
    camera, xy = paper_pair().cam1, np.array([[70.0, 80.0], [82.0, 74.0]])
    before, after = Bent((1 / 30, 0.004, 1 / 40)), Bent((1 / 20, -0.01, 0.0), origin=np.array([0.1, 0.0, 0.2]))
    w, G = true_w6(camera, before, xy), true_g6(camera, before, after, xy)
    offset = (camera.rays_cam(xy[1:]).xyz_mm - camera.rays_cam(xy[:1]).xyz_mm)[:, :2]
    # 13 px, 0.45 mm: of the change between the points a hundredth and less is left
    for moved, there, here in ((move_w(w[:1], offset), w[1:], w[:1]), (move_matrix(G[:1], offset), G[1:], G[:1])):
        assert np.abs(moved - there)[..., 0].max() < 1e-3 * np.abs(there - here)[..., 0].max()
        assert np.abs(moved - there)[..., 1:3].max() < 0.03 * np.abs(there - here)[..., 1:3].max()
