"""Points outside the calibrated volume: distinguished by geometry, their uncertainty against drawn calibrations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from stereorig.core.calibration.volume import CalibratedVolume, calibrated_volume
from stereorig.core.field.checks.unreached import mark_extrapolated
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, measure_motion
from stereorig.core.status import PointStatus
from stereorig.core.target import GridTarget
from stereorig.server.cli import main
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.calibrations.volume import volume_of
from stereorig.server.formats.images import write_image
from tests.support.calibrated_volume import POSITIONS, TARGET, content
from tests.support.field_bench import SIZE, pair, take


def volume(size: tuple[int, int] = SIZE, **more: Any) -> CalibratedVolume:
    found = calibrated_volume(
        pair(), TARGET.all_points_mm(), (size, size), (POSITIONS, POSITIONS), pitch_mm=TARGET.pitch_mm, **more
    )
    assert found is not None
    return found


def test_the_volume_is_what_both_cameras_saw_and_a_little_more() -> None:
    where = volume()
    nodes = TARGET.all_points_mm().reshape(-1, 2)
    assert where.contains(np.column_stack([nodes, np.zeros(len(nodes))])).all()
    # between the cameras' axes depth and image coordinates change together
    assert where.contains(np.array([[0.0, 0.0, -4.0], [0.0, 0.0, 4.0]])).all()
    assert not where.contains(np.array([[0.0, 0.0, -8.0], [0.0, 0.0, 8.0]])).any()
    along = pair().cam1.cam_from_sys.rotation[2]  # camera 1's optical axis in the system frame
    alone = CalibratedVolume(where.pair, np.full(2, 0.1), where.depth_mm)
    assert alone.contains(np.outer([-4.5, 4.5], along)).all()
    assert not alone.contains(np.outer([-7.5, 12.5], along)).any()  # behind the travel and as much again
    assert not where.contains(np.array([[6.0, 0.0, 0.0], [0.0, -7.0, 0.0], [np.nan, 0.0, 0.0]])).any()


def test_one_distance_spans_no_volume() -> None:
    nodes = TARGET.all_points_mm()
    assert calibrated_volume(pair(), nodes, (SIZE, SIZE), ((0.0, 0.0), POSITIONS), pitch_mm=0.5) is None
    assert calibrated_volume(pair(), nodes, ((9, 9), SIZE), (POSITIONS, POSITIONS), pitch_mm=0.5) is None


@pytest.mark.fault(41)
def test_points_outside_are_flagged_and_less_certain() -> None:
    first, current = take("block"), take("block", 1.0)
    grid = PointGrid.rectangle(30, 30, SIZE[0] - 31, SIZE[1] - 31, spacing_px=16)
    field = measure_motion(pair(), *first, *current, grid, MeasureOptions(subset_px=25))
    # a target that covered the middle only
    small = GridTarget(pitch_mm=0.25, lines=(7, 7), line_width_mm=0.02)
    where = calibrated_volume(pair(), small.all_points_mm(), (SIZE, SIZE), (POSITIONS, POSITIONS), pitch_mm=0.25)
    marked = mark_extrapolated(field, where)
    flagged = marked.status == PointStatus.EXTRAPOLATED
    radius = np.hypot(*np.moveaxis(field.xyz_mm[..., :2], -1, 0))
    assert flagged[field.valid & (radius > 2.0)].all()
    assert not flagged[field.valid & (radius < 0.8)].any()
    assert flagged.any()
    assert (marked.valid == field.valid).all()
    np.testing.assert_array_equal(marked.uvw_mm, field.uvw_mm)
    np.testing.assert_array_equal(marked.covariance, field.covariance)
    assert mark_extrapolated(field, None) is field


@pytest.mark.fault(41)
def test_the_command_line_flags_them(tmp_path: Path) -> None:
    for n, load in enumerate((0.0, 1.0)):
        for name, image in zip(("cam1", "cam2"), take("block", load), strict=True):
            write_image(tmp_path / f"{name}_{n}.tif", image)
    document = content()
    document["target"] |= {"pitch_mm": 0.25}
    (tmp_path / "calibration.json").write_text(json.dumps(document))
    arguments = [
        "measure",
        "--cam1",
        str(tmp_path / "cam1_*.tif"),
        "--cam2",
        str(tmp_path / "cam2_*.tif"),
        "--subset",
        "25",
        "--calibration",
        str(tmp_path / "calibration.json"),
        "--roi",
        "30,30,233,194",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(arguments) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    for step in summary["steps"]:
        assert step["status"]["extrapolated"] > 0
        assert step["valid"] == step["status"]["ok"] + step["status"]["extrapolated"]
    with xr.open_dataset(tmp_path / "out" / "step_0001.nc") as data:
        flagged = data.status.values == PointStatus.EXTRAPOLATED
        assert np.isfinite(data.u_mm.values[flagged]).all()
        # the calibration's part, by its covariance, is in every point, inside and outside
        known = np.isin(data.status.values, (PointStatus.OK, PointStatus.EXTRAPOLATED))
        part = np.linalg.norm(data.common_factor.values[known][:, 2], axis=-1)
        assert (part > 0.02).all()
        assert (data.sigma_z_mm.values[known] > part).all()


def test_a_file_that_says_nothing_of_its_views_flags_nothing(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content()))
    full = volume_of(load_calibration(path))
    assert full is not None
    np.testing.assert_allclose(full.depth_mm, volume().depth_mm)  # the held-out view is no part of it
    path.write_text(json.dumps({name: content()[name] for name in ("cam1", "cam2")}))
    assert volume_of(load_calibration(path)) is None
