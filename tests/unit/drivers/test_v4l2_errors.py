"""The V4L2 driver's errors for paths that are no camera, and its names of controls; needs no device."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import CameraOptions, FrameGrabber
from stereorig.drivers.cameras.v4l2.controls import control_name
from stereorig.drivers.registry import discover_cameras, make_camera
from tests.support.patience import busy


def _refusal(device: str) -> CameraError:
    grabber = make_camera("v4l2", CameraOptions(device=device))
    assert isinstance(grabber, FrameGrabber)
    with pytest.raises(CameraError) as caught:
        grabber.open()
    grabber.close()
    assert caught.value.remedy
    assert device in caught.value.cause
    return caught.value


def test_a_device_that_is_not_there_is_lost() -> None:
    assert _refusal("/dev/video_of_nobody").code == "camera_lost"


def test_other_nodes_and_files_are_no_cameras(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    for device in ("/dev/null", "/dev/zero", str(tmp_path / "file"), str(tmp_path)):
        assert _refusal(device).code == "not_a_camera"


def test_a_camera_that_is_not_open_says_so_at_once() -> None:
    grabber = make_camera("v4l2", CameraOptions(device="/dev/video_of_nobody"))
    for call in (grabber.describe, grabber.arm, grabber.trigger, lambda: grabber.next_frame(5.0)):
        begin = time.monotonic()
        with pytest.raises(CameraError) as caught:
            call()
        assert caught.value.code == "camera_lost"
        assert time.monotonic() - begin < 1.0 * busy()
    grabber.disarm()
    grabber.close()
    assert set(grabber.statistics().values()) == {0}


def test_discovery_finds_only_cameras() -> None:
    for found in discover_cameras("v4l2"):
        assert (found.kind, found.driver) == ("camera", "v4l2")
        assert found.device.startswith("/dev/")


@pytest.mark.parametrize(
    ("title", "name"),
    [
        ("Brightness", "brightness"),
        ("Exposure, Auto", "exposure_auto"),
        ("Exposure Time, Absolute", "exposure_time_absolute"),
        ("White Balance Temperature, Auto", "white_balance_temperature_auto"),
        ("Inject V4L2_BUF_FLAG_ERROR", "inject_v4l2_buf_flag_error"),
        ("Gain (dB) ", "gain_db"),
    ],
)
def test_controls_are_spelled_as_the_kernels_tools_spell_them(title: str, name: str) -> None:
    assert control_name(title) == name
