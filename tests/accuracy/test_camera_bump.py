"""A camera bumped between calibration and test: told, repaired from rendered speckle, refused where a lens changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.errors import CalibrationError
from stereorig.core.measure import MeasureOptions
from stereorig.core.orientation import RepairedPair, changes_between, repair_orientation
from tests.support.bumped_rig import (
    CAM1,
    CAM2,
    SUBSET_PX,
    core_pair,
    false_strain,
    grid,
    pose_points,
    repaired,
    seen,
    turned,
)
from tests.support.independent_rig import PlainCamera


def left(repair: RepairedPair, one: PlainCamera, two: PlainCamera) -> tuple[float, float]:
    """Epipolar offset of true points, px rms, and false strain of the specimen at rest, microstrain."""
    xy1 = grid().xy_px.reshape(-1, 2)
    true = pose_points(one, 0, xy1)
    xy2 = two.project(true)
    offset = repair.pair.epipolar_residual_px(xy1, xy2)
    found = repair.pair.triangulate(xy1, xy2).xyz_mm
    return float(np.sqrt(np.mean(offset**2))), 1e6 * float(np.sqrt(np.mean(false_strain(true, found) ** 2)))


@pytest.mark.parametrize(
    ("which", "degrees"),
    [
        (2, (0.0, 0.2, 0.0)),
        pytest.param(1, (2.0, 0.0, 0.0), marks=pytest.mark.deep),
        pytest.param(2, (0.012, -0.012, 0.012), marks=pytest.mark.deep),
        pytest.param(1, (1.2, -1.0, 1.2), marks=pytest.mark.deep),
    ],
)
def test_a_bump_is_repaired(which: int, degrees: tuple[float, float, float]) -> None:
    one, two = (turned(CAM1, degrees), CAM2) if which == 1 else (CAM1, turned(CAM2, degrees))
    repair = repaired(one, two)
    offset, strain = left(repair, one, two)
    assert offset < 0.01  # what the project asks
    assert strain < 20.0  # likewise
    assert strain < 4.0 * repair.consequence.strain_sigma_microstrain
    error = repair.change - changes_between(core_pair(CAM1, CAM2), core_pair(one, two))
    assert error @ np.linalg.solve(repair.estimate.covariance, error) < 25.7  # 1 in 10,000 of five squares
    assert repair.pair.baseline_mm == pytest.approx(core_pair(CAM1, CAM2).baseline_mm, rel=1e-12)


def test_another_focal_length_is_refused() -> None:
    with pytest.raises(CalibrationError) as refused:
        repaired(CAM1, replace(CAM2, phd=1.002 * CAM2.phd), (0,))
    assert refused.value.code == "repair_structure"
    assert "lens" in refused.value.remedy


def test_pictures_of_different_things_are_refused() -> None:
    images = [(seen(CAM1, 0), np.ascontiguousarray(seen(CAM2, 1)[::-1]))]
    options = MeasureOptions(subset_px=SUBSET_PX)
    with pytest.raises(CalibrationError) as refused:
        repair_orientation(core_pair(CAM1, CAM2), images, grid(), options)
    assert refused.value.code == "repair_no_match"
