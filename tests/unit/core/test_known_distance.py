"""A second target of known size, measured by a calibration; images by an independent projection."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from stereorig.core.boards import BoardTarget
from stereorig.core.calibration import CalibrationResult, calibrate
from stereorig.core.calibration.checks.distance import DistanceCheck, check_target_scale
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationInputError
from tests.support.calibration_truth import HELD, NOMINAL, PAPER, Array, Grid, make_views, project

# corners of a board of 7 x 5, 1.2 mm apart, tilted by 0.2 rad about Y and 0.6 mm behind the grid's plane
NOMINAL_MM = np.stack(np.meshgrid(np.arange(-3.0, 4.0), np.arange(-2.0, 3.0), indexing="ij"), axis=-1) * 1.2
SIGMA_PX = 0.01


@pytest.fixture(scope="module")
def calibrated() -> CalibrationResult:
    return calibrate(make_views(), Grid(), NOMINAL, HELD)


def seen(scale: float = 1.0, seed: int = 0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    x, y = scale * NOMINAL_MM[..., 0], scale * NOMINAL_MM[..., 1]
    X, Z = np.cos(0.2) * x, 0.6 - np.sin(0.2) * x
    one, two = (project(c, X, y, 0.0, Z) for c in PAPER)
    return one + SIGMA_PX * rng.standard_normal(one.shape), two + SIGMA_PX * rng.standard_normal(two.shape)


def checked(result: CalibrationResult, one: Array, two: Array, **more: Any) -> DistanceCheck:
    sigma = np.full(NOMINAL_MM.shape[:2], SIGMA_PX)
    return check_target_scale(
        result.pair,
        one,
        two,
        NOMINAL_MM,
        covariance=result.covariance,
        names=result.names,
        sigmas_px=(sigma, sigma),
        **more,
    )


def test_a_board_of_known_size_agrees_and_its_ratio_is_one(calibrated: CalibrationResult) -> None:
    found = checked(calibrated, *seen())
    assert found.agrees
    assert found.points == 35
    assert found.known_mm == pytest.approx(np.hypot(6 * 1.2, 4 * 1.2))
    assert found.ratio == pytest.approx(1.0, abs=4.0 * found.sigma_mm / found.known_mm)
    assert found.residual_mm is not None
    # 0.01 px of 33 um, in depth across 60 degrees
    assert found.residual_mm < 1e-3


def test_a_board_of_another_size_is_beyond_three_sigma(calibrated: CalibrationResult) -> None:
    found = checked(calibrated, *seen(scale=1.004))
    assert not found.agrees
    assert found.ratio == pytest.approx(1.004, abs=4.0 * found.sigma_mm / found.known_mm)
    assert "pitch" in found.text


def test_its_uncertainty_is_the_scatter_over_calibrations_and_images() -> None:
    errors, sigmas = [], []
    for seed in range(16):
        result = calibrate(make_views(seed=50 + seed), Grid(), NOMINAL, HELD)
        found = checked(result, *seen(seed=seed))
        errors.append(found.measured_mm - found.known_mm)
        sigmas.append(found.sigma_mm)
    # sixteen know their rms to 18 %; the prior of 1 mrad on the stage's axis, which these views lack, makes it smaller
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas) < 1.6


def test_points_that_one_camera_does_not_see_are_left_out(calibrated: CalibrationResult) -> None:
    one, two = seen()
    one[0, 0], two[6, 4] = np.nan, np.nan
    found = checked(calibrated, one, two)
    assert found.points == 33
    assert found.agrees


def test_the_maker_s_tolerance_and_the_known_value_widen_the_uncertainty(calibrated: CalibrationResult) -> None:
    plain = checked(calibrated, *seen()).sigma_mm
    assert checked(calibrated, *seen(), node_tolerance_mm=0.02).sigma_mm > 1.5 * plain
    assert checked(calibrated, *seen(), distance_sigma_mm=0.01).sigma_mm == pytest.approx(np.hypot(plain, 0.01))


@pytest.mark.parametrize("turn", ["exchanged", "half_turned"])
def test_indices_that_do_not_belong_together_are_no_measurement(calibrated: CalibrationResult, turn: str) -> None:
    one, two = seen()
    with pytest.raises(CalibrationInputError) as caught:
        checked(calibrated, *((two, one) if turn == "exchanged" else (one, two[::-1, ::-1])))
    assert caught.value.code in ("known_distance_mismatch", "known_distance_unusable")


def test_too_few_common_points_are_refused(calibrated: CalibrationResult) -> None:
    one, two = seen()
    two[1:] = np.nan
    with pytest.raises(CalibrationInputError) as caught:
        checked(calibrated, one, two)
    assert caught.value.code == "known_distance_unusable"


def test_dots_are_corrected_for_perspective() -> None:
    """Large dots near wide lenses: OpenCV projects their rims, the centroid of the rim is what a localiser finds."""
    board = BoardTarget(kind="circles", size=(7, 5), pitch_mm=20.0)
    lens = OpenCVLens(1200.0, 1200.0, 640.0, 480.0)
    K = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 480.0], [0.0, 0.0, 1.0]])
    poses = []
    for angle, shift in ((0.35, -80.0), (-0.35, 80.0)):
        R = cv2.Rodrigues(np.array([0.05, angle, 0.02]))[0]
        poses.append((R, np.array([shift * 0.1, 3.0, 260.0])))
    ring = 7.0 * np.stack([np.cos(np.arange(720) * np.pi / 360), np.sin(np.arange(720) * np.pi / 360)], axis=-1)
    views = []
    for R, t in poses:
        centres = []
        for centre in board.points_mm().reshape(-1, 2):
            rim = np.column_stack([centre + ring, np.zeros(720)]) @ R.T + t
            image = cv2.projectPoints(rim, np.zeros(3), np.zeros(3), K, np.zeros(5))[0].reshape(-1, 1, 2)
            moments = cv2.moments(image.astype(np.float32))
            centres.append([moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]])
        views.append(np.array(centres))
    cameras = [Camera(lens, RigidTransform(R, t)) for R, t in poses]
    pair = StereoPair(cameras[0], cameras[1])
    plain = check_target_scale(pair, views[0], views[1], board.points_mm())
    right = check_target_scale(pair, views[0], views[1], board.points_mm(), dot_radius_mm=7.0)
    assert plain.residual_mm is not None
    assert right.residual_mm is not None
    # single precision of OpenCV's moments leaves 1e-5 px of 5 px a mm
    assert right.residual_mm < 0.05 * plain.residual_mm
    assert abs(right.ratio - 1.0) < 2e-5
    assert abs(right.ratio - 1.0) < abs(plain.ratio - 1.0)
