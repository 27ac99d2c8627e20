"""The real specimen: a field compared with the geometry and with the specimen's flatness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import ImageError
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.server.formats.calibrations.recognise import parse_calibration
from stereorig.server.formats.images import read_image

pytestmark = pytest.mark.specimen

RECTANGLE = (340, 430, 1560, 690)  # lies wholly on the specimen


@pytest.fixture(scope="module")
def pair(specimen_dir: Path) -> StereoPair:
    path = specimen_dir / "calibration_dice.xml"
    return parse_calibration(path.read_bytes(), name=path.name).pair


@pytest.fixture(scope="module")
def reference(specimen_dir: Path, pair: StereoPair) -> ReferencePair:
    return ReferencePair(pair, *(read_image(specimen_dir / f"0000_{k}.tif") for k in (0, 1)))


@pytest.fixture(scope="module")
def grid() -> PointGrid:
    return PointGrid.rectangle(*RECTANGLE, spacing_px=10)


@pytest.fixture(scope="module")
def shape(reference: ReferencePair, grid: PointGrid) -> Field:
    return reference.shape(grid)


def plane_residual_mm(xyz: np.ndarray) -> np.ndarray:
    centred = xyz - xyz.mean(axis=0)
    return np.asarray(centred @ np.linalg.svd(centred, full_matrices=False)[2][2])


def no_point_off_its_line(field: Field) -> None:
    e = field.epipolar_px[field.valid]
    assert np.abs(e - np.median(e)).max() < 5.0 * e.std() + 1e-3


def test_nearly_every_point_is_measured_and_the_face_is_flat(shape: Field) -> None:
    assert shape.valid.mean() >= 0.97
    assert plane_residual_mm(shape.xyz_mm[shape.valid]).std() <= 0.015
    assert np.linalg.norm(shape.normal_sys[shape.valid], axis=1) == pytest.approx(1.0)
    no_point_off_its_line(shape)


def test_a_tensile_step_is_followed_from_where_the_specimen_stood(
    reference: ReferencePair, specimen_dir: Path, grid: PointGrid, shape: Field
) -> None:
    current = [read_image(specimen_dir / f"0002_{k}.tif") for k in (0, 1)]
    field = reference.motion(*current, grid, MeasureOptions(), shape=shape)
    assert field.valid.mean() >= 0.97
    assert field.uvw_mm is not None
    no_point_off_its_line(field)
    both = field.valid & shape.valid
    np.testing.assert_array_equal(field.xyz_mm[both], shape.xyz_mm[both])
    # the face stays flat where it went; a wrong match would stick out of it
    moved = plane_residual_mm((field.xyz_mm + field.uvw_mm)[field.valid])
    assert moved.std() <= 0.020
    assert np.abs(moved).max() <= 0.12


@pytest.mark.fault(17)
def test_swapped_cameras_are_refused(reference: ReferencePair, grid: PointGrid) -> None:
    swapped = ReferencePair(reference.pair, reference.image2, reference.image1)
    with pytest.raises(ImageError) as error:
        swapped.shape(grid)
    assert error.value.code == "cameras_swapped"
