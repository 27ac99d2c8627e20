"""Two calibrations of one rig compared in space, on views made by an independent projection."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.calibration import CalibrationOptions, CalibrationResult, calibrate
from stereorig.core.calibration.checks.compare import (
    CalibrationComparison,
    UncertainPair,
    common_points_mm,
    compare_calibrations,
    volume_grid_mm,
)
from stereorig.core.calibration.volume import CalibratedVolume, calibrated_volume
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationInputError
from tests.support.calibration_truth import NOMINAL, PAPER, Grid, make_views

SIZES = ((512, 480), (512, 480))
POSITIONS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
# the views are made with axes and aspect ratios that are exact: a prior would predict more than is there
OPTIONS = CalibrationOptions(lens="paper", axis_tilt_sigma_rad=0.0, aspect_sigma=0.0)


def made(seed: int, declared: Grid | None = None, **how: Any) -> CalibrationResult:
    return calibrate(make_views(POSITIONS, seed=seed, **how), declared or Grid(), NOMINAL, OPTIONS)


def volume(result: CalibrationResult) -> CalibratedVolume:
    x = np.arange(-5.0, 6.0)
    nodes = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)
    found = calibrated_volume(result.pair, nodes, SIZES, [POSITIONS, POSITIONS], pitch_mm=1.0)
    assert found is not None
    return found


def known(result: CalibrationResult) -> UncertainPair:
    return UncertainPair(result.pair, result.names, result.covariance)


def compared(a: CalibrationResult, b: CalibrationResult) -> CalibrationComparison:
    grid = volume_grid_mm(volume(a), SIZES[0])
    points = common_points_mm(grid, a.pair, b.pair, SIZES, volume_a=volume(a), volume_b=volume(b))
    return compare_calibrations(known(a), known(b), points)


def check_pairs(pairs: int) -> None:
    found = [compared(made(100 + 2 * k), made(101 + 2 * k)) for k in range(pairs)]
    # twenty parameters less the six of the frame
    assert {c.degrees for c in found} == {14}
    reduced = [c.chi_square / 14.0 for c in found if c.chi_square is not None]
    assert len(reduced) == pairs
    # the mean of n has a standard deviation of sqrt(2 / 14 / n); the noise itself is estimated, worth 5 % more
    assert np.mean(reduced) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 14.0 / pairs) + 0.05)
    for name in ("shape_rms_mm", "epipolar_rms_px", "scale"):
        ratios = [getattr(c, name).ratio for c in found]
        # a few parameters carry each, the scale one: its mean square has a relative standard deviation of sqrt(2 / n)
        assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / pairs)), name
    # by chance 2.7 in a thousand differ
    assert sum(not c.agrees for c in found) <= 1 + pairs // 50
    # nothing but the parameters' own space is left, to second order of their errors
    assert max(c.unexplained_px for c in found) < 1e-5


def test_calibrations_of_one_rig_differ_by_what_their_covariances_predict() -> None:
    check_pairs(8)


@pytest.mark.deep
@pytest.mark.timeout(1200)
def test_two_hundred_pairs_of_calibrations_have_a_chi_square_of_one_a_degree_of_freedom() -> None:
    check_pairs(200)


def moved(**changes: float) -> list[dict[str, float]]:
    return [dict(PAPER[0]), {**PAPER[1], **{name: PAPER[1][name] + by for name, by in changes.items()}}]


@pytest.mark.parametrize("degrees", [0.01, 0.1, 1.0])
def test_a_camera_that_was_turned_is_named_with_its_angle(degrees: float) -> None:
    found = compared(made(1), made(2, cameras=moved(beta=math.radians(degrees))))
    assert found.agrees is False
    assert found.changes.explained
    assert found.changes.explanations[0].cause == "camera_moved"
    turn = next(n for n in found.changes.numbers if n.name == "relative_orientation_deg")
    assert turn.sigma is not None
    # a length adds its random parts across the turn: two of them beside it
    assert turn.value == pytest.approx(degrees, abs=5.0 * turn.sigma)
    assert "a camera that moved" in found.text


def test_another_focal_length_is_named_with_its_camera() -> None:
    found = compared(made(1), made(2, cameras=moved(phd=60.0)))
    first = found.changes.explanations[0]
    assert (found.agrees, first.cause, first.camera) == (False, "focal_length", "cam2")
    change = next(n for n in found.changes.numbers if n.name == "cam2.phd_px")
    assert change.sigma is not None
    assert change.value == pytest.approx(60.0, abs=4.0 * change.sigma)


def test_another_pitch_is_named_as_a_scale() -> None:
    found = compared(made(1), made(2, declared=Grid(pitch_mm=1.001)))
    assert (found.agrees, found.changes.explanations[0].cause) == (False, "scale")
    assert found.scale.sigma is not None
    # the epipolar lines know no scale
    assert found.epipolar_rms_px.ratio is not None
    assert found.epipolar_rms_px.ratio < 3.0
    assert found.scale.value == pytest.approx(1e-3, abs=4.0 * found.scale.sigma)


def test_a_frame_that_lies_elsewhere_is_no_difference() -> None:
    a = made(1)
    from_other = RigidTransform(Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix(), np.array([3.0, -2.0, 5.0]))
    cameras = [Camera(c.lens, c.cam_from_sys @ from_other) for c in (a.pair.cam1, a.pair.cam2)]
    points = volume_grid_mm(volume(a), SIZES[0])
    other = StereoPair(cameras[0], cameras[1])
    points = common_points_mm(points, a.pair, other, SIZES, volume_a=volume(a), volume_b=None)
    found = compare_calibrations(known(a), UncertainPair(other), points)
    # rounding of coordinates of 400 mm
    assert found.shape_max_mm.value < 1e-8
    assert found.unexplained_px < 1e-8


def test_without_a_covariance_differences_are_stated_and_nothing_is_concluded() -> None:
    a, b = made(1), made(2)
    points = volume_grid_mm(volume(a), SIZES[0])
    points = common_points_mm(points, a.pair, b.pair, SIZES, volume_a=volume(a), volume_b=None)
    found = compare_calibrations(known(a), replace(known(b), covariance=None), points)
    assert found.agrees is None
    assert found.chi_square is None
    assert found.shape_rms_mm.sigma is None
    assert found.shape_rms_mm.value > 0.0
    assert "nothing is concluded" in found.text


def test_calibrations_without_a_common_volume_are_refused() -> None:
    a = made(1)
    far = volume_grid_mm(volume(a), SIZES[0]) + np.array([0.0, 0.0, 500.0])
    with pytest.raises(CalibrationInputError) as caught:
        common_points_mm(far, a.pair, a.pair, SIZES, volume_a=volume(a), volume_b=None)
    assert caught.value.code == "calibrations_apart"
