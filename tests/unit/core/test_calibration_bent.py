"""Calibration through lenses with a thin prism or a tilted sensor, from points that OpenCV projected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.calibration import CalibrationOptions, CalibrationView, calibrate
from stereorig.core.calibration.checks.agreement import lens_faults
from stereorig.core.calibration.guide.estimate import Estimate, estimate
from stereorig.core.cameras.opencv_full import OpenCVFullLens
from tests.support.board_points import CHECKERBOARD, SIZE_PX, free_views, nominal_pair, shape_error_um, true_pair
from tests.support.calibration_rigs import aligned_rms_um
from tests.unit.core.test_calibration_motion import GRID, staged_views

ROUND = (-0.2, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
PRISM = (*ROUND, 2e-3, 0.0, -1.5e-3, 0.0)
TILTED = (*ROUND, 0.0, 0.0, 0.0, 0.0, 0.06, -0.03)
BOTH = (*ROUND, 2e-3, 0.0, -1.5e-3, 0.0, 0.04, 0.03)


@pytest.mark.parametrize(
    ("lens", "noise_px", "model"),
    [
        (PRISM, 0.02, "opencv5_prism"),
        (TILTED, 0.02, "opencv5_tilted"),
        pytest.param(PRISM, 0.0, "opencv5_prism", marks=pytest.mark.deep),
        pytest.param(TILTED, 0.0, "opencv5_tilted", marks=pytest.mark.deep),
        pytest.param(BOTH, 0.0, "opencv5_prism_tilted", marks=pytest.mark.deep),
    ],
)
def test_free_poses_show_a_prism_or_a_tilt_and_blame_no_board(
    lens: tuple[float, ...], noise_px: float, model: str
) -> None:
    one, two = true_pair()
    cameras = replace(one, distortion=lens), replace(two, distortion=lens)
    drawn = free_views(cameras, count=10, noise_px=noise_px, seed=1)
    result = calibrate(drawn.views, CHECKERBOARD, nominal_pair(None), CalibrationOptions(moves="free"))
    assert result.lens.model == model, result.lens.reasons
    assert result.verdict.level == "good", result.verdict.reasons
    assert result.lens.structure == ()
    # a length of two normal coordinates is 1.25 of one
    assert result.fitted.mean.rbe_px == pytest.approx(1.25 * noise_px, rel=0.1, abs=1e-4)
    true_um = shape_error_um(result.pair, cameras, drawn.points_mm.reshape(-1, 3))
    assert true_um < 1e3 * result.uncertainty.shape_rms_mm
    found = result.pair.cam1.lens
    assert isinstance(found, OpenCVFullLens)
    if not noise_px:
        np.testing.assert_allclose(list(found.prism.values()), [*lens[8:], 0.0, 0.0][:6], atol=2e-5)


@pytest.mark.parametrize(("lens", "model"), [(PRISM, "opencv5_prism"), (TILTED, "opencv5_tilted")])
def test_a_guided_acquisition_finds_a_prism_or_a_tilt_and_keeps_it(lens: tuple[float, ...], model: str) -> None:
    one, two = true_pair()
    cameras = replace(one, distortion=lens), replace(two, distortion=lens)
    drawn = free_views(cameras, count=12, noise_px=0.02, seed=1)
    found: Estimate | None = None
    models = []
    for count in (9, 10, 11, 12):
        views = [v for v in drawn.views if v.frame is not None and v.frame < count]
        found = estimate(views, CHECKERBOARD, nominal_pair(None), CalibrationOptions(moves="free"), found)
        models.append(found.layout.form.model)
    assert models[-2:] == [model, model]  # further terms are asked for with every second view
    assert found is not None
    assert not found.dropped
    np.testing.assert_allclose(found.noise_px, 0.02, rtol=0.15)


def test_a_stage_shows_a_tilted_sensor() -> None:
    one, two = true_pair(roll_deg=45.0)
    cameras = replace(one, distortion=TILTED), replace(two, distortion=TILTED)
    options = CalibrationOptions(held_out_mm=(10.0,), stage_scale_sigma=0.0)
    result = calibrate(staged_views(cameras), GRID, nominal_pair(), options)
    assert result.lens.model == "opencv5_tilted", result.lens.reasons
    assert result.verdict.level == "good", result.verdict.reasons
    true_um = shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
    assert true_um < 2.0 * 1e3 * result.uncertainty.shape_rms_mm  # one draw; 6 um without the tilt


@pytest.mark.parametrize("tolerance_mm", [0.0, 0.03])
def test_structure_warns_by_what_it_moves_points_by_against_the_reported_error(tolerance_mm: float) -> None:
    """A field over the image of camera 1 that no lens has, 0.0035 px rms: more than half the noise."""
    errors = np.random.default_rng(3).uniform(-tolerance_mm, tolerance_mm, (9, 7, 3))
    drawn = free_views(true_pair(), count=12, noise_px=0.006, seed=3, errors_mm=errors)

    def seen(views: list[CalibrationView]) -> list[CalibrationView]:
        out = []
        for v in views:
            x, y = np.moveaxis(np.pi * v.xy_px / SIZE_PX, -1, 0)
            field = 0.007 * np.stack([np.sin(2.0 * x) * np.cos(2.0 * y), np.cos(3.0 * x)], axis=-1)
            out.append(replace(v, xy_px=v.xy_px + field) if v.camera == "cam1" else v)
        return out

    board = replace(CHECKERBOARD, node_tolerance_mm=tolerance_mm)
    options = CalibrationOptions(moves="free", lens="paper")
    with_field, without = (calibrate(v, board, nominal_pair(None), options) for v in (seen(drawn.views), drawn.views))
    points = drawn.points_mm[:, ::5].reshape(-1, 3)
    # the images that are measured show the field, too, and points found with and without it differ by its consequence
    images = [camera.image(points) for camera in drawn.cameras]
    views = [CalibrationView("cam1", None, images[0][None]), CalibrationView("cam2", None, images[1][None])]
    shown = [v.xy_px[0] for v in seen(views)]
    moved_um = aligned_rms_um(with_field.pair.triangulate(*shown).xyz_mm, without.pair.triangulate(*images).xyz_mm)
    assert with_field.lens.structure
    reported_um = 1e3 * with_field.uncertainty.shape_rms_mm
    reasons = [r for r in with_field.verdict.reasons if "hold structure" in r]
    assert (moved_um > reported_um) == (tolerance_mm == 0.0)
    assert with_field.verdict.level == ("warning" if moved_um > reported_um else "good")
    assert bool(reasons) == (moved_um > reported_um)
    for reason in reasons:
        stated_um = float(reason.split("off by ")[1].split(" um")[0])
        assert stated_um == pytest.approx(moved_um, rel=0.3)


@pytest.mark.parametrize(
    ("tau_rad", "declared_rad", "lens", "level", "words"),
    [
        (0.006, 1e-3, "auto", "warning", "mrad"),
        (0.015, 0.1, "auto", "good", "within"),
        (0.015, 0.1, "opencv5", "warning", "move the shape by 1"),
    ],
)
def test_a_small_tilt_that_a_stage_off_its_axis_would_show_as_well_is_reported_or_named(
    tau_rad: float, declared_rad: float, lens: str, level: str, words: str
) -> None:
    one, two = true_pair(roll_deg=45.0)
    tilted = (*ROUND, 0.0, 0.0, 0.0, 0.0, tau_rad, -0.5 * tau_rad)
    cameras = replace(one, distortion=tilted), replace(two, distortion=tilted)
    options = CalibrationOptions(stage_scale_sigma=0.0, axis_tilt_sigma_rad=declared_rad, lens=lens)  # type: ignore[arg-type]
    result = calibrate(staged_views(cameras), GRID, nominal_pair(), options)
    assert result.verdict.level == level, result.verdict.reasons
    assert any(words in reason for reason in result.verdict.reasons)
    if lens == "auto":  # 1.7 and 10.7 um where the axis takes it up, 0.4 um reported
        true_um = shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
        assert true_um < 2.0 * 1e3 * result.uncertainty.shape_rms_mm < 10.0


def test_a_tilt_of_a_milliradian_that_looks_like_another_millimetre_is_named_beside_it() -> None:
    rng = np.random.default_rng(903)
    rng.normal(size=(2, 2))
    tilts_rad = 1e-3 * rng.normal(size=(2, 2))
    pair = true_pair(roll_deg=45.0)
    cameras = [
        replace(c, distortion=(-0.2, 0.05, *np.zeros(10), *tilt)) for c, tilt in zip(pair, tilts_rad, strict=True)
    ]
    result = calibrate(staged_views(cameras), GRID, nominal_pair(), CalibrationOptions())
    assert result.verdict.level == "failed"
    assert any("disagree by" in r and "Sensors tilted by" in r for r in result.verdict.reasons), result.verdict.reasons


@pytest.mark.parametrize(
    ("terms", "fault"), [({"s1": 0.15}, "thin prism"), ({"tau_x_rad": 0.5}, "tilted by 29"), ({"tau_y_rad": 0.2}, None)]
)
def test_prisms_and_tilts_that_no_lens_has_are_named(terms: dict[str, float], fault: str | None) -> None:
    faults, folded = lens_faults(OpenCVFullLens(700.0, 700.0, 319.5, 239.5, **terms), (640, 480))
    assert not folded
    assert (not faults) if fault is None else fault in faults[-1]
