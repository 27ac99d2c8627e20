"""Images of other cameras than the calibration's are refused, over HTTP and on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stereorig.core.errors import CameraError
from stereorig.server.workflows.camera_identity import check_same_cameras

ONE = {"cam1": {"model": "A", "serial": "11"}, "cam2": {"model": "A", "serial": "22"}}


def calibration(folder: Path, cameras: object) -> Path:
    path = folder / "calibration.json"
    provenance = {} if cameras is None else {"cameras": cameras}
    path.write_text(json.dumps({"provenance": provenance}), encoding="utf-8")
    return path


def test_the_same_cameras_and_unknown_ones_pass(tmp_path: Path) -> None:
    check_same_cameras(calibration(tmp_path, ONE), ONE, "Step 0")
    check_same_cameras(calibration(tmp_path, ONE), None, "Step 0")
    check_same_cameras(calibration(tmp_path, ONE), {"cam1": {"model": "A"}}, "Step 0")
    check_same_cameras(calibration(tmp_path, None), ONE, "Step 0")
    check_same_cameras(calibration(tmp_path, "nonsense"), ONE, "Step 0")


@pytest.mark.fault(17)
def test_another_camera_is_named_with_both_serials(tmp_path: Path) -> None:
    now = {**ONE, "cam2": {"model": "A", "serial": "33"}}
    with pytest.raises(CameraError) as caught:
        check_same_cameras(calibration(tmp_path, ONE), now, "Step 4")
    assert caught.value.code == "wrong_camera"
    assert "cam2 is 33, calibrated was 22" in caught.value.cause
    assert "exchanged" not in caught.value.cause


@pytest.mark.fault(17)
def test_exchanged_cameras_are_called_so(tmp_path: Path) -> None:
    with pytest.raises(CameraError) as caught:
        check_same_cameras(calibration(tmp_path, ONE), {"cam1": ONE["cam2"], "cam2": ONE["cam1"]}, "Step 4")
    assert "exchanged" in caught.value.cause
