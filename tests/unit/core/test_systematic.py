"""Systematic terms that are stated beside the uncertainty, against the errors of independent images and formulas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.patch import PatchChoice
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.seeding.seeds import Seed
from stereorig.core.measure import MeasureOptions, measure_shape
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.core.systematic import interpolation
from stereorig.core.systematic.interpolation import SmoothSlopes, interpolation_term
from stereorig.core.systematic.patch_order import patch_term
from stereorig.core.systematic.strain_window import window_term
from stereorig.core.systematic.term import Term
from tests.support.disc_images import cameras_beside, discs
from tests.support.matching_scene import Bent, Texture, digitise, paper_pair, render
from tests.support.strain_fields import make_field, plane

SIZE = 260
#: camera 2's image is camera 1's, shifted
BESIDE = cameras_beside(SIZE)


def of_discs(seed: int, phase: float, **drawn: float) -> tuple[float, Term]:
    """Return the mean error of Z, mm, over a field whose match lies at a sub-pixel phase, and the estimated term."""
    disparity = 6.0 - phase
    one, two = (MeasureImage(discs(SIZE, seed, shift_px=shift, **drawn)) for shift in (0.0, -disparity))
    grid = PointGrid.rectangle(25, 25, SIZE - 25, SIZE - 25, spacing_px=10)
    seed_px = Seed(xy_px=(125.0, 125.0), xy2_px=(125.0 - disparity, 125.0))
    field = measure_shape(BESIDE, one, two, grid, MeasureOptions(subset_px=21, patch="affine"), seeds=[seed_px])
    images = [image.prepared("quintic") for image in (one, two)]
    term = interpolation_term(field, BESIDE, SmoothSlopes.of(images[0]), images[1:], subset_px=21)
    return float(np.nanmean(field.xyz_mm[..., 2]) + 100.0 - 600.0 / disparity), term


@pytest.mark.parametrize("radius_px", [2.5, pytest.param(1.5, marks=pytest.mark.deep)])
def test_the_bias_of_sharp_discs_is_estimated_from_the_images_themselves(radius_px: float) -> None:
    true, estimated, scatter = [], [], []
    for seed, phase in enumerate((0.2, 0.3, 0.7, 0.8)):
        error, term = of_discs(seed, phase, radius_px=radius_px)
        figure = term.figures["z_um"]
        assert figure.rms is not None, term.text
        assert figure.rms <= figure.largest <= 3.0 * figure.rms  # type: ignore[operator]
        true.append(1e3 * error)
        estimated.append(figure.rms)
        scatter.append(figure.below)
    size = float(np.sqrt(np.mean(np.square(true))))
    # 0.004 px of 6 are 70 um in 100 mm; asked is a factor of 1.5
    assert size > 40.0
    assert np.sqrt(np.mean(np.square(estimated))) == pytest.approx(size, rel=0.33)
    assert np.sqrt(np.mean(np.square(scatter))) > 0.8 * size


def test_a_large_image_is_smoothed_alike_where_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    image = MeasureImage(discs(SIZE, 3, radius_px=2.0)).prepared("quintic")
    whole = SmoothSlopes.of(image)
    monkeypatch.setattr(interpolation, "_LARGE_PIXELS", 100)
    part = SmoothSlopes.of(image)
    centres = np.array([[10.0, 11.0], [120.4, 80.6], [124.0, 82.0], [SIZE - 12.0, SIZE - 11.0], [12.0, 200.0]])
    for found, known in zip(part.about(centres, 10), whole.about(centres, 10), strict=True):
        assert found.shape == (5, 21, 21)
        np.testing.assert_allclose(found, known, atol=1e-5 * np.abs(known).max())
        assert (np.abs(known).max(axis=(1, 2)) > 0.0).all()
    assert part.whole is None


def test_a_soft_image_of_the_same_discs_has_little_of_it() -> None:
    (_, sharp), (_, soft) = of_discs(1, 0.25), of_discs(1, 0.25, aperture_px=2.0)
    assert sharp.figures["match_px"].rms is not None
    assert soft.figures["match_px"].below < 0.6 * sharp.figures["match_px"].rms


def test_without_phases_no_term_is_stated() -> None:
    _, term = of_discs(1, 0.0)
    assert term.figures == {}
    assert term.text.startswith("Not known")


def test_a_sphere_under_plane_patches_is_off_by_what_is_estimated() -> None:
    pair, ball = paper_pair(size=200), Bent(bend=(0.04, 0.0, 0.04))
    rng = np.random.default_rng(1)
    one, two = (
        digitise(render(camera, ball, Texture(blob_mm=0.08), size=200), noise=1.0, rng=rng)
        for camera in (pair.cam1, pair.cam2)
    )
    grid = PointGrid.rectangle(30, 30, 170, 170, spacing_px=8)
    true = ball.position(ball.material(pair.cam1, grid.xy_px.reshape(-1, 2))).reshape(*grid.shape, 3)
    middle = np.array([100.0, 100.0])
    seen = pair.cam2.project(ball.position(ball.material(pair.cam1, middle[None]))).xy[0]
    start = [Seed(xy_px=(100.0, 100.0), xy2_px=(float(seen[0]), float(seen[1])))]

    def measured(patch: str) -> Field:
        options = MeasureOptions(subset_px=31, patch=patch)  # type: ignore[arg-type]
        return measure_shape(pair, one, two, grid, options, seeds=start)

    field = measured("affine")
    term = patch_term(field, pair, subset_px=31)
    off = 1e3 * np.nanmean((field.xyz_mm - true).reshape(-1, 3), axis=0)
    for k, name in enumerate(("x_um", "y_um", "z_um")):
        # the means of some 300 points have a twentieth of the bias as noise
        assert term.figures[name].rms == pytest.approx(abs(off[k]), rel=0.15), name
    assert off[2] > 3.0
    # quadratic patches follow the sphere; what is left is below what can be told
    left = patch_term(measured("quadratic"), pair, subset_px=31).figures["z_um"]
    assert left.below < 0.1 * off[2]


def bending(wave_mm: float, strain: float) -> Callable[[np.ndarray], np.ndarray]:
    """A displacement along X whose exx is a sine of X."""
    k = 2.0 * np.pi / wave_mm

    def motion(points: np.ndarray) -> np.ndarray:
        moved = points.copy()
        moved[..., 0] += strain / k * np.sin(k * points[..., 0])
        return moved

    return motion


def noisy(field: Field, rng: np.random.Generator, sigma_mm: float) -> Field:
    """Return a field with white noise of its stated covariance; subsets of a pixel share none."""
    assert field.uvw_mm is not None
    return replace(field, uvw_mm=field.uvw_mm + rng.normal(0.0, sigma_mm, field.uvw_mm.shape))


@pytest.mark.parametrize("window", [7, 11])
def test_a_steep_strain_is_off_by_what_is_estimated(window: int) -> None:
    sigma = 2e-5
    field = make_field(lambda a, b: np.stack([a, b, 0.0 * a], axis=-1), bending(6.0, 0.01), sigma_mm=(1e-7, sigma))
    field = noisy(field, np.random.default_rng(2), sigma)
    strain = surface_strain(field, StrainOptions(window=window, tensor="infinitesimal"), subset_px=1)
    true = 0.01 * np.cos(2.0 * np.pi / 6.0 * field.xyz_mm[..., 0])
    half = window // 2
    inner = (slice(2 * half, -2 * half), slice(2 * half, -2 * half))
    off = 1e6 * (strain.strain[..., 0] - true)[inner]
    figure = window_term(field, strain, subset_px=1).figures["exx_microstrain"]
    # the next order alone, from a strain that the window has smoothed already: a wave of 18 points under one of 11
    assert figure.rms == pytest.approx(np.sqrt(np.mean(off**2)), rel=0.33)
    assert figure.rms is not None
    assert figure.rms > 100.0


def test_even_strain_and_a_rigid_turn_show_no_term_but_a_bound() -> None:
    rng, sigma = np.random.default_rng(3), 2e-4
    field = make_field(plane, lambda p: p @ np.diag([1.02, 0.99, 1.0]) + 0.5, sigma_mm=(1e-7, sigma))
    field = noisy(field, rng, sigma)
    strain = surface_strain(field, StrainOptions(window=9), subset_px=1)
    for figure in window_term(field, strain, subset_px=1).figures.values():
        assert figure.rms is None
        assert figure.largest is None
        assert 0.0 < figure.below < 100.0  # the strain's own noise is some 170 microstrain


def test_a_plane_that_stretches_shows_no_term_of_its_patches() -> None:
    pair, sigma = paper_pair(), 2e-4
    field = make_field(plane, lambda p: p, sigma_mm=(sigma, sigma))
    seen = pair.cam1.back_project_to_plane(np.stack([field.x_px, field.y_px], axis=-1)).xyz_mm
    moved = seen @ np.array([[0.02, 0.01, 0.0], [0.0, -0.01, 0.05], [0.0, 0.0, 0.0]]) + 0.5
    chosen = PatchChoice(patch="affine", asked="affine", reason="asked for")
    field = noisy(replace(field, xyz_mm=seen, uvw_mm=moved, patch=chosen), np.random.default_rng(4), sigma_mm=sigma)
    for figure in patch_term(field, pair, subset_px=21).figures.values():
        assert figure.rms is None
        assert figure.below < 1e3 * sigma


def test_unknown_terms_are_missing() -> None:
    small = make_field(plane, lambda p: p + 0.1, shape=(5, 5))
    assert patch_term(small, paper_pair(), subset_px=33).figures == {}
    strain = surface_strain(small, StrainOptions(window=9), subset_px=33)
    assert window_term(small, strain, subset_px=33).figures == {}
