"""The V4L2 driver over the kernel's own driver of USB webcams (uvcvideo), with a webcam in software at the other end.

Runs in the guest that `test_v4l2_in_qemu` boots. What the driver says is compared with what the camera itself was told.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS
from stereorig.drivers.acquisition.frame_counter import SequenceReader
from stereorig.drivers.acquisition.reader import CameraReader
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FrameGrabber, FrameStatus
from stereorig.drivers.cameras.v4l2 import discover, make
from stereorig.server.config.rig_file import load_config
from stereorig.server.rig import build
from tests.support.camera_bench import frames_of, seconds_until
from tests.support.requirements import ROOT
from tests.support.usb_camera import UsbCamera


@pytest.fixture
def webcam() -> Iterator[tuple[UsbCamera, str]]:
    """A webcam and its node."""
    camera = UsbCamera(0, "SN-0815")
    try:
        yield camera, camera.plug()
    finally:
        camera.unplug()


@contextmanager
def opened(node: str, **settings: object) -> Iterator[FrameGrabber]:
    grabber = make(CameraOptions(device=node))
    grabber.open()
    try:
        grabber.configure(CameraSettings(**settings))
        yield grabber
    finally:
        grabber.close()


def refused(grabber: FrameGrabber, **settings: object) -> CameraError:
    with pytest.raises(CameraError) as caught:
        grabber.configure(CameraSettings(**settings))
    return caught.value


def test_a_webcam_is_known_by_the_serial_number_on_its_label(webcam: tuple[UsbCamera, str]) -> None:
    _, node = webcam
    second = UsbCamera(1, "SN-4711")
    try:
        other = second.plug()
        found = {one.extra["node"]: one for one in discover() if one.model.startswith("Webcam of the tests")}
        # each has a second node, for metadata, which is no camera
        assert {name: one.serial for name, one in found.items()} == {node: "SN-0815", other: "SN-4711"}
        assert found[node].extra["usb_id"] == "1209:0001"
        assert found[node].extra["usb_speed_mbit_s"] == "480"
        assert found[node].address != found[other].address
        with opened(node) as grabber:
            here = grabber.describe()
            assert here.serial == "SN-0815"
            assert here.firmware == "0123"
            assert here.clock == "monotonic"
            assert [name.strip() for name in here.pixel_formats] == ["GREY", "Y16", "YUYV"]
            assert here.exposure_range_ms == (1.0, 500.0)
            assert here.frame_rate_range_hz == pytest.approx((5.0, 30.0), rel=1e-5)
            assert here.extra["image_sizes"] == "320 x 180, 160 x 120"
    finally:
        second.unplug()


@pytest.mark.parametrize(("name", "bits"), [("YUYV", 8), ("GREY", 8), ("Y16 ", 16)])
def test_pixels_are_what_the_camera_sent(webcam: tuple[UsbCamera, str], name: str, bits: int) -> None:
    camera, node = webcam
    with opened(node, pixel_format=name, frame_rate_hz=15.0) as grabber:
        grabber.arm()
        frames = frames_of(grabber, 5, 20.0)
        assert camera.shape == (name, 320, 180)
        firsts = []
        for frame in frames:
            assert frame.status is FrameStatus.OK
            assert frame.bit_depth == bits
            high = (frame.pixels >> bits - 8).astype(np.uint8)
            firsts.append(int(high[0, 0]))
            # the pattern is as bright everywhere as its first pixel, as the camera draws it
            pattern = camera.gray(0)
            np.testing.assert_array_equal(high, pattern - pattern[0, 0] + high[0, 0])
            if bits == 16:
                assert set(np.unique(frame.pixels & 255)) == {0x80}  # what it sends in the low bytes
        # and 7 brighter from picture to picture
        steps = np.diff(firsts) % 256
        np.testing.assert_array_equal(steps, 7 * np.diff([frame.sequence for frame in frames]) % 256)


@pytest.mark.fault(18)
def test_the_exposure_is_set_on_the_camera_after_its_automatic_was_switched_off(webcam: tuple[UsbCamera, str]) -> None:
    camera, node = webcam
    assert camera.mode.value == 8
    with opened(node) as grabber:
        assert grabber.configure(CameraSettings()).exposure_ms is None, "the camera sets it by itself"
        taken = grabber.configure(CameraSettings(exposure_ms=20.0))
        assert taken.exposure_ms == 20.0
        assert (camera.mode.value, camera.exposure.value) == (1, 200)
        # the camera counts in steps of 0.5 ms from 1 ms
        assert grabber.configure(CameraSettings(exposure_ms=20.3)).exposure_ms == 20.5
        assert camera.exposure.value == 205
        for low_high in (1.0, 500.0):
            assert grabber.configure(CameraSettings(exposure_ms=low_high)).exposure_ms == low_high
        writes = list(camera.exposure.writes)
        for beyond in (0.9, 500.1, 0.0, -5.0, float("nan")):
            assert refused(grabber, exposure_ms=beyond).code == "out_of_range"
        assert refused(grabber, exposure_ms=30.0, features={"brightness": 65}).code == "out_of_range"
        assert refused(grabber, exposure_ms=30.0, gain_db=3.0).code == "unknown_feature"
        assert camera.exposure.writes == writes, "nothing was written"
        taken = grabber.configure(CameraSettings(features={"auto_exposure": "Aperture Priority Mode"}))
        assert camera.mode.value == 8
        assert taken.exposure_ms is None
        # a value for what the camera sets by itself would be kept and not used
        error = refused(grabber, features={"exposure_time_absolute": 100})
        assert error.code == "setting_not_taken"


@pytest.mark.fault(18)
def test_a_value_that_the_camera_cuts_off_in_silence_is_refused(webcam: tuple[UsbCamera, str]) -> None:
    camera, node = webcam
    with opened(node) as grabber:
        assert grabber.configure(CameraSettings(features={"gain": 50, "brightness": -3})).features == {
            "gain": 50,
            "brightness": -3,
        }
        assert (camera.gain.value, camera.brightness.value) == (50, -3)
        error = refused(grabber, features={"gain": 80})
        assert camera.gain.writes[-1] == 80
        assert camera.gain.value == 60
        assert error.code == "setting_not_taken"
        assert "80" in error.cause
        assert "60" in error.cause
        # an exposure may be rounded by the camera: the applied value is reported
        camera.exposure.clamp_at = 250
        assert grabber.configure(CameraSettings(exposure_ms=30.0)).exposure_ms == 25.0


def test_rates_are_those_of_the_camera_and_frames_come_at_them(webcam: tuple[UsbCamera, str]) -> None:
    _, node = webcam
    with opened(node, pixel_format="GREY", region_px=(0, 0, 160, 120), frame_rate_hz=20.0) as grabber:
        assert grabber.configure(CameraSettings()).frame_rate_hz == pytest.approx(20.0)
        grabber.arm()
        frames = frames_of(grabber, 12, 20.0)
        assert frames[-1].pixels.shape == (120, 160)
        seconds = (frames[-1].device_ns - frames[1].device_ns) / 1e9
        # never faster; slower only where the machine keeps the camera in software waiting
        assert 10.0 < (frames[-1].sequence - frames[1].sequence) / seconds < 22.0
        late_ms = [(frame.host_ns - frame.device_ns) / 1e6 for frame in frames]
        assert min(late_ms) > -1.0
        print(f"stamps {np.median(late_ms):.1f} ms before the arrival, {grabber.describe().extra['timestamp']}")


@pytest.mark.fault(13)
@pytest.mark.fault(15)
def test_a_picture_cut_short_is_never_delivered_and_leaves_a_gap_or_a_mark(webcam: tuple[UsbCamera, str]) -> None:
    camera, node = webcam
    with opened(node, pixel_format="GREY", frame_rate_hz=20.0) as grabber:
        reader = CameraReader(
            grabber,
            name="cam1",
            period_s=0.05,
            expects_frames=True,
            buffer_frames=100,
            sequence=SequenceReader(0, 2**32 - 1),
        )
        reader.start()
        try:
            assert reader.take(5.0) is not None
            camera.truncate = 2
            seconds_until(lambda: reader.counters.incomplete + reader.counters.dropped >= 2, 10.0)
            while (frame := reader.take(0.3)) is not None and reader.counters.delivered < 12:
                assert frame.status is FrameStatus.OK
            assert reader.fault is None
        finally:
            reader.stop()


@pytest.mark.fault(11)
def test_a_pulled_cable_is_a_fault_at_once_and_the_camera_works_again_after_its_return(
    webcam: tuple[UsbCamera, str],
) -> None:
    camera, node = webcam
    with opened(node, pixel_format="GREY", frame_rate_hz=15.0, exposure_ms=20.0) as grabber:
        wanted = grabber.configure(CameraSettings())
        reader = CameraReader(grabber, name="cam1", period_s=1 / 15, expects_frames=True)
        reader.start()
        assert reader.take(5.0) is not None
        begin = time.monotonic()
        camera.unplug()
        seconds_until(lambda: reader.fault is not None, 1.0)
        noticed_s = time.monotonic() - begin
        assert reader.fault is not None
        assert reader.fault.code == "camera_lost"
        with pytest.raises(CameraError) as caught:
            grabber.configure(CameraSettings(exposure_ms=10.0))
        assert caught.value.code == "camera_lost"
        reader.stop()
        begin = time.monotonic()
        grabber.close()
        closed_s = time.monotonic() - begin
        assert closed_s < 1.0
    # switched off and on again, it has forgotten its settings
    camera.mode.value, camera.exposure.value = 8, 300
    again = camera.plug()
    with opened(again) as grabber:
        begin = time.monotonic()
        assert grabber.configure(wanted) == wanted
        grabber.arm()
        assert frames_of(grabber, 1)[0].status is FrameStatus.OK
        assert (camera.mode.value, camera.exposure.value) == (1, 200)
        print(
            f"fault and node gone {noticed_s * 1e3:.0f} ms after the pull; "
            f"closed in {closed_s * 1e3:.0f} ms, pictures {(time.monotonic() - begin) * 1e3:.0f} ms after opening"
        )


@pytest.mark.fault(12)
def test_a_webcam_that_falls_silent_is_lost_by_the_watchdog_and_closes_quickly(webcam: tuple[UsbCamera, str]) -> None:
    camera, node = webcam
    with opened(node, pixel_format="GREY", frame_rate_hz=15.0) as grabber:
        reader = CameraReader(grabber, name="cam1", period_s=1 / 15, expects_frames=True)
        reader.start()
        assert reader.take(5.0) is not None
        camera.silent = True
        seconds_until(lambda: reader.fault is not None, 1.0)
        assert reader.fault is not None
        assert reader.fault.code == "camera_lost"
        reader.stop()
        begin = time.monotonic()
        grabber.close()
        assert time.monotonic() - begin < 1.0
        camera.silent = False
    with opened(node) as grabber:
        grabber.arm()
        assert frames_of(grabber, 2)


@pytest.mark.fault(11)
def test_the_rig_s_camera_comes_back_with_its_settings_within_three_seconds(tmp_path: Path) -> None:
    camera = fresh = UsbCamera(2, "SN-2000")
    link = tmp_path / "lasting_name"  # udev makes such links, and makes them anew
    link.symlink_to(camera.plug())
    unit = CameraUnit(
        "cam1",
        lambda: make(CameraOptions(device=str(link))),
        trigger="free",
        rate_hz=15.0,
        serial="SN-2000",
        size_px=(160, 120),
    )
    try:
        unit.open(
            CameraSettings(
                exposure_ms=12.0,
                pixel_format="GREY",
                region_px=(0, 0, 160, 120),
                features={"brightness": 7, "gain": 30},
            )
        )
        had = unit.settings
        assert unit.reader.take(5.0) is not None
        camera.unplug()
        seconds_until(lambda: unit.fault is not None, 1.0)
        with pytest.raises(CameraError):
            unit.reconnect()
        # switched on again it has forgotten everything, and the kernel may count on
        fresh = UsbCamera(2, "SN-2000")
        node = fresh.plug()
        link.unlink()
        link.symlink_to(node)
        begin = time.monotonic()
        unit.reconnect()
        unit.resume()
        frame = unit.reader.take(2.5)
        took_s = time.monotonic() - begin
        assert frame is not None
        assert took_s < 3.0
        assert unit.settings == had
        assert fresh.shape == ("GREY", 160, 120)
        dials = [dial.value for dial in (fresh.mode, fresh.exposure, fresh.brightness, fresh.gain)]
        assert dials == [1, 120, 7, 30]
        print(f"a picture {took_s * 1e3:.0f} ms after the camera's return")
        # another camera of the same model in its place is refused
        fresh.unplug()
        seconds_until(lambda: unit.fault is not None, 1.0)
        fresh = UsbCamera(2, "SN-2001")
        node = fresh.plug()
        link.unlink()
        link.symlink_to(node)
        with pytest.raises(CameraError) as caught:
            unit.reconnect()
        assert caught.value.code == "wrong_camera"
    finally:
        unit.release()
        camera.unplug()
        fresh.unplug()


@pytest.mark.fault(62)
def test_both_cameras_of_the_laboratorys_rig_file_take_its_settings() -> None:
    config = load_config(ROOT / "config" / "lab_v4l2_smc100.toml")
    webcams = {cam: UsbCamera(port, cam, sizes=((320, 180), (1280, 960))) for port, cam in enumerate(CAMERAS)}
    try:
        for cam, webcam in webcams.items():
            own = config.model_copy(update={cam: config.camera(cam).model_copy(update={"device": webcam.plug()})})
            unit = build.make_unit(own, cam)
            try:
                unit.open(build.first_settings(own, cam))
                taken = unit.settings
                assert (taken.pixel_format, taken.region_px, taken.exposure_ms) == ("GREY", (0, 0, 1280, 960), 10.0)
                assert taken.frame_rate_hz == pytest.approx(20.0)
                assert webcam.shape == ("GREY", 1280, 960)
                dials = (webcam.mode, webcam.exposure, webcam.gain, webcam.gamma, webcam.sharpness)
                assert [dial.value for dial in dials] == [1, 100, 16, 100, 0]
            finally:
                unit.release()
    finally:
        for webcam in webcams.values():
            webcam.unplug()
