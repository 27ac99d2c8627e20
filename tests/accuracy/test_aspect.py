"""The aspect ratio against cameras whose ratio is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereorig.core.calibration.aspect import block_ratios, measure_aspect
from stereorig.core.calibration.aspect_images import measure_aspect_normal
from stereorig.core.errors import CalibrationInputError
from stereorig.core.grid import GridView, detect_grid
from tests.support.grid_images import PAPER_TARGET, grid_image, paper_camera, truth_px

TRUE_ASPECT = 0.9617


def _view_at_truth(camera: Any, sigma_px: float, seed: int) -> GridView:
    """A detection made of the true intersections and Gaussian noise; for tests of the arithmetic over many images."""
    xy = truth_px(camera, PAPER_TARGET)
    xy = xy + np.random.default_rng(seed).normal(0.0, sigma_px, xy.shape)
    return GridView(
        target=PAPER_TARGET,
        xy_px=xy,
        covariance_px2=np.broadcast_to(np.eye(2) * sigma_px**2, (*xy.shape[:2], 2, 2)),
        localiser="profile",
        line_model="straight",
        image_size_px=(512, 480),
        noise=2.0,
        contrast=160.0,
        background=200.0,
        blur_px=0.55,
        line_width_px=0.9,
        pitch_px=30.0,
        threshold=20.0,
        rotation_rad=0.785,
        fit_rms_px=0.006,
        pieces_px=np.zeros((0, 2, 2)),
        pieces_used=np.zeros(0, dtype=bool),
    )


@pytest.mark.parametrize("alpha_deg", [38.0, 45.0, 51.0])
def test_diagonals_give_lambda_for_any_rotation_in_the_plane(alpha_deg: float) -> None:
    xy = truth_px(paper_camera(0.0, alpha_deg=alpha_deg, kappa_per_px2=0.0), PAPER_TARGET)
    ratios = block_ratios(xy)
    assert ratios.shape == (5, 5)
    np.testing.assert_allclose(ratios, TRUE_ASPECT, rtol=1e-12)


def test_tilt_moves_the_first_estimate_by_half_its_square_and_the_refined_one_not() -> None:
    tilt = np.radians(1.5)
    positions = [0.0, 4.0, 8.0, 12.0, 16.0]
    cameras = [paper_camera(0.0, beta_deg=1.5).moved(z) for z in positions]
    views = [_view_at_truth(c, 0.002, k) for k, c in enumerate(cameras)]
    result = measure_aspect(views, dz_mm=positions)
    assert result.first_estimate / TRUE_ASPECT - 1.0 == pytest.approx(-(tilt**2) / 2.0, rel=0.15)
    assert result.refined is not None
    assert result.refined == pytest.approx(TRUE_ASPECT, abs=3e-5)
    assert result.refined_sigma is not None
    assert abs(result.refined - TRUE_ASPECT) < 4.0 * result.refined_sigma
    assert result.tilt_rad is not None
    assert result.tilt_rad[0] == pytest.approx(tilt, abs=2e-3)


def test_sigma_of_the_refined_value_matches_its_scatter() -> None:
    positions = [0.0, 5.0, 10.0, 15.0]
    cameras = [paper_camera(0.5, beta_deg=-0.7).moved(z) for z in positions]
    errors, sigmas = [], []
    for trial in range(12):
        views = [_view_at_truth(c, 0.003, 100 * trial + k) for k, c in enumerate(cameras)]
        result = measure_aspect(views, dz_mm=positions)
        errors.append(result.aspect - TRUE_ASPECT)
        sigmas.append(result.sigma)
    # twelve trials know their scatter to 21 %
    assert 0.4 < np.std(errors) / np.mean(sigmas) < 1.7
    assert abs(np.mean(errors)) < 2.0 * np.mean(sigmas)


def test_lambda_from_rendered_images_of_a_slightly_tilted_grid() -> None:
    positions = [0.0, 6.0, 12.0, 18.0]
    cameras = [paper_camera(0.4, beta_deg=-0.5, alpha_deg=44.2).moved(z) for z in positions]
    views = [detect_grid(grid_image(c, seed=k), PAPER_TARGET) for k, c in enumerate(cameras)]
    result = measure_aspect(views, dz_mm=positions)
    assert result.aspect == pytest.approx(TRUE_ASPECT, abs=1e-4)
    assert result.per_image.shape == (4,)


def test_unusable_views_are_refused() -> None:
    view = _view_at_truth(paper_camera(0.0), 0.002, 0)
    for views, dz in (
        ([], None),
        ([view], [0.0, 1.0]),
        ([view, view], [3.0, 3.0]),
        ([view, view], [0.0, float("nan")]),
    ):
        with pytest.raises(CalibrationInputError) as error:
            measure_aspect(views, dz_mm=dz)
        assert error.value.code == "aspect_views"
    near, far = _view_at_truth(paper_camera(0.0), 0.002, 0), _view_at_truth(paper_camera(0.0).moved(5.0), 0.002, 0)
    with pytest.raises(CalibrationInputError, match="shrink"):
        measure_aspect([near, far], dz_mm=[5.0, 0.0])  # the sign of dZ exchanged


def test_images_moved_about_without_known_travel_average_the_noise_and_the_distortion() -> None:
    rng = np.random.default_rng(5)
    views = []
    for k in range(20):
        camera = paper_camera(
            rng.uniform(-0.3, 0.3),
            beta_deg=rng.uniform(-0.3, 0.3),
            alpha_deg=rng.uniform(44.0, 46.0),
            kappa_per_px2=1.3e-8,
            offset_mm=(rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8)),
        )
        views.append(_view_at_truth(camera, 0.002, k))
    result = measure_aspect(views)
    assert result.aspect == pytest.approx(TRUE_ASPECT, abs=3e-5)  # half of 0.3 degrees squared is 1.4e-5
    assert result.first_estimate == pytest.approx(TRUE_ASPECT, abs=1e-4)
    assert result.tilt_rad is None


@pytest.fixture(scope="module")
def along_the_normal() -> list[GridView]:
    cameras = [
        paper_camera(0.2, beta_deg=0.2, alpha_deg=a, offset_mm=(0.3 * k, 0.0)) for k, a in enumerate((44, 45, 46))
    ]
    return [detect_grid(grid_image(c, seed=k), PAPER_TARGET) for k, c in enumerate(cameras)]


@pytest.mark.parametrize("standoff_mm", [400.0, None])
def test_images_along_the_normal_give_lambda_and_its_doubt(
    along_the_normal: list[GridView], standoff_mm: float | None
) -> None:
    found = measure_aspect_normal(along_the_normal, standoff_mm=standoff_mm)
    assert found.images == 3
    assert found.standoff_known is (standoff_mm is not None)
    # the noise, and what the grid's tilt of 0.28 degrees may do
    assert found.aspect == pytest.approx(TRUE_ASPECT, abs=4.0 * found.sigma + found.tilt_effect)
    assert found.tilt_effect < 1e-4


@pytest.mark.parametrize("axis", ["beta_deg", "gamma_deg"])
def test_a_tilted_grid_is_refused_by_its_perspective(axis: str) -> None:
    camera = paper_camera(**{"gamma_deg": 0.0, "beta_deg": 0.0, axis: 3.0})
    view = detect_grid(grid_image(camera, seed=3), PAPER_TARGET)
    with pytest.raises(CalibrationInputError, match=r"grid tilted by [23]\.\d") as caught:
        measure_aspect_normal([view], standoff_mm=400.0)
    assert caught.value.code == "aspect_not_normal"
    with pytest.raises(CalibrationInputError, match="longest lens in use"):
        measure_aspect_normal([view])


def test_the_tilt_of_a_grid_is_found_to_its_uncertainty() -> None:
    errors = []
    for seed in range(8):
        view = _view_at_truth(paper_camera(0.0, beta_deg=0.8), 0.004, seed)
        found = measure_aspect_normal([view], standoff_mm=400.0)
        errors.append((found.tilt_rad - np.radians(0.8)) / found.tilt_sigma_rad)
    # the views' noise is each point's own, the uncertainty that of whole lines, twice as large
    assert np.sqrt(np.mean(np.square(errors))) < 1.5


def test_an_upright_grid_is_refused() -> None:
    view = _view_at_truth(paper_camera(0.0), 0.002, 0)
    with pytest.raises(CalibrationInputError, match="45 degrees") as caught:
        measure_aspect_normal([replace(view, rotation_rad=0.1)])
    assert caught.value.code == "aspect_not_diagonal"
