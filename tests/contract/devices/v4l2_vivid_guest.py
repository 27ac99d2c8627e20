"""The V4L2 driver against the kernel's simulated webcams and HDMI input; runs in the guest of `test_v4l2_in_qemu`.

What vivid draws is known (its test patterns), and v4l2-ctl, the kernel's own tool, says what a device holds: neither
shares a line with the driver.
"""

from __future__ import annotations

import os
import re
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.acquisition.frame_counter import SequenceReader
from stereorig.drivers.acquisition.reader import CameraReader
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, Frame, FrameGrabber, FrameStatus
from stereorig.drivers.cameras.v4l2 import discover, make
from tests.support.camera_bench import frames_of
from tests.support.v4l2_bench import calm, controls_of, put
from tests.support.v4l2_pixels import BYTES, packed

WEBCAM, PLANAR, HDMI = "/dev/video0", "/dev/video1", "/dev/video2"
SMALL = (0, 0, 320, 180)


@pytest.fixture(autouse=True)
def _calm() -> Iterator[None]:
    yield
    for node in (WEBCAM, PLANAR):
        calm(node)


@contextmanager
def camera(node: str, **settings: object) -> Iterator[FrameGrabber]:
    """A camera opened and configured."""
    grabber = make(CameraOptions(device=node))
    grabber.open()
    try:
        grabber.configure(CameraSettings(**settings))
        yield grabber
    finally:
        grabber.close()


def picture(grabber: FrameGrabber) -> Frame:
    """The third frame of a new stream: the first ones may have been drawn before the last setting."""
    grabber.arm()
    try:
        return frames_of(grabber, 3, 20.0)[-1]
    finally:
        grabber.disarm()


def ctl(node: str, *arguments: str) -> str:
    """Output of the kernel's own tool."""
    return subprocess.run(["v4l2-ctl", "-d", node, *arguments], check=True, capture_output=True, text=True).stdout


def refused(grabber: FrameGrabber, **settings: object) -> CameraError:
    with pytest.raises(CameraError) as caught:
        grabber.configure(CameraSettings(**settings))
    assert caught.value.remedy
    return caught.value


# -- pixels ----------------------------------------------------------------------------------------------------------


def _gray_formats() -> list[tuple[str, str]]:
    gray = ["GREY", "Y10 ", "Y12 ", "Y16 ", "Y16 -BE", "NV12", "NV21", "NV16", "NV61", "YUYV", "YVYU", "UYVY", "VYUY"]
    planar = ["GREY", "Y12 ", "YUYV", "NV12", "NM12", "NM61"]  # the last two keep their colour in a plane of its own
    return [(WEBCAM, name) for name in gray] + [(PLANAR, name) for name in planar]


@pytest.mark.parametrize(("node", "name"), _gray_formats())
def test_every_format_is_what_the_kernel_s_tool_records(node: str, name: str, tmp_path: Path) -> None:
    """The bytes that v4l2-ctl wrote to a file are our pixels, put in their places by the documentation's table."""
    with camera(node, pixel_format=name, region_px=SMALL, frame_rate_hz=60.0) as grabber:
        put(node, osd_text_mode="None", test_pattern="Gray Ramp")
        ramp = picture(grabber).pixels
        assert ramp.shape == (180, 320)
        record = tmp_path / "record"
        ctl(node, "--stream-mmap", "--stream-count=1", "--stream-skip=2", f"--stream-to={record}")
        table = BYTES[name]
        recorded = np.frombuffer(record.read_bytes(), np.uint8)
        lines = packed(table, ramp, np.random.default_rng(0))
        lines_there = recorded[: lines.size].reshape(lines.shape)
        gray = np.tile([byte != ["c"] for byte in table], lines.shape[1] // len(table))
        np.testing.assert_array_equal(lines[:, gray], lines_there[:, gray])
        # and the pattern is what it is called
        full_scale = (1 << frames_depth(name)) - 1
        for pattern, low, high in (("100% White", 0.9, 1.0), ("100% Black", 0.0, 0.07)):
            put(node, test_pattern=pattern)
            pixels = picture(grabber).pixels
            assert low * full_scale <= pixels.min() == pixels.max() <= high * full_scale, pattern
        put(node, test_pattern="1x1 Checkers")  # white and black by turns: no pixel in its neighbour's place
        pixels = picture(grabber).pixels
        white = pixels > 0.5 * full_scale
        even = np.indices(pixels.shape).sum(axis=0) % 2 == 0
        assert (white == even).all() or (white == ~even).all()


def frames_depth(name: str) -> int:
    digits = re.match(r"Y(\d\d)", name)
    return int(digits.group(1)) if digits else 8


def test_a_ramp_rises_from_left_to_right() -> None:
    with camera(WEBCAM, pixel_format="Y12", region_px=SMALL, frame_rate_hz=60.0) as grabber:
        put(WEBCAM, osd_text_mode="None", test_pattern="Gray Ramp", quantization="Full Range")
        pixels = picture(grabber).pixels.astype(float)
    assert np.ptp(pixels, axis=0).max() == 0
    line = pixels[0]
    assert (np.diff(line) >= 0).all()
    # 256 levels over the width: 4080 of 12 bits at the right edge, one 8 bit level off a straight line at most
    assert np.abs(line - np.linspace(0, 255 * 16, 320)).max() <= 2 * 16


def test_the_device_s_padding_between_lines_is_left_out() -> None:
    with camera(WEBCAM, pixel_format="Y10", region_px=SMALL, frame_rate_hz=60.0) as grabber:
        put(WEBCAM, osd_text_mode="None", test_pattern="16x16 Checkers")
        plain = picture(grabber).pixels
    ctl(WEBCAM, "--set-fmt-video=width=320,height=180,pixelformat=Y10 ,bytesperline=768")
    assert re.search(r"Bytes per Line\s*: 768", ctl(WEBCAM, "--get-fmt-video"))
    with camera(WEBCAM) as grabber:
        np.testing.assert_array_equal(picture(grabber).pixels, plain)
    squares = plain > 512
    assert (squares[:16, :16] == squares[0, 0]).all(), "the pattern is there"
    assert (squares[:16, 16:32] == ~squares[0, 0]).all()


def test_a_format_that_cannot_be_read_is_left_for_the_plainest_one() -> None:
    ctl(WEBCAM, "--set-fmt-video=width=640,height=360,pixelformat=RGB3")
    with camera(WEBCAM) as grabber:
        assert grabber.configure(CameraSettings()).pixel_format == "GREY"
        assert picture(grabber).pixels.shape == (360, 640)
    ctl(WEBCAM, "--set-fmt-video=width=640,height=360,pixelformat=RGB3")
    grabber = make(CameraOptions(device=WEBCAM))
    grabber.open()
    try:
        assert picture(grabber).pixels.shape == (360, 640)
    finally:
        grabber.close()


# -- who it is -------------------------------------------------------------------------------------------------------


def test_discovery_lists_the_three_with_stable_names() -> None:
    links = Path("/dev/v4l/by-path")
    links.mkdir(parents=True)
    (links / "platform-vivid.0-video-index0").symlink_to("../../video0")
    found = {one.extra["node"]: one for one in discover()}
    assert set(found) == {WEBCAM, PLANAR, HDMI}
    assert found[WEBCAM].device == str(links / "platform-vivid.0-video-index0")
    assert found[PLANAR].device == PLANAR
    assert len({one.serial for one in found.values()}) == 3
    for node, one in found.items():
        assert (one.kind, one.driver, one.problem) == ("camera", "v4l2", None)
        assert f"Card type        : {one.model}\n" in ctl(node, "--info")
        assert f": {one.address}\n" in ctl(node, "--info")
    with camera(found[WEBCAM].device) as grabber:
        assert picture(grabber).status is FrameStatus.OK
        assert grabber.describe().serial == found[WEBCAM].serial


@pytest.mark.fault(21)
def test_another_program_that_streams_is_named() -> None:
    other = subprocess.Popen(
        ["v4l2-ctl", "-d", WEBCAM, "--stream-mmap", "--stream-count=100000"], stderr=subprocess.PIPE
    )
    try:
        assert other.stderr is not None
        other.stderr.read(1)  # it has a frame
        with pytest.raises(CameraError) as caught, camera(WEBCAM):
            pass
        assert caught.value.code == "camera_busy"
        assert f"v4l2-ctl, process {other.pid}" in caught.value.cause
        (found,) = [one for one in discover() if one.extra.get("node") == WEBCAM]
        assert found.problem is not None
        assert f"process {other.pid}" in found.problem
    finally:
        other.kill()
        other.communicate()
    with camera(WEBCAM) as grabber:
        assert picture(grabber).status is FrameStatus.OK


def test_a_user_without_rights_is_told_what_to_do() -> None:
    os.seteuid(65534)
    try:
        with pytest.raises(CameraError) as caught, camera(WEBCAM):
            pass
    finally:
        os.seteuid(0)
    assert caught.value.code == "no_permission"
    assert "video" in caught.value.remedy


def test_interlaced_pictures_are_refused() -> None:
    ctl(HDMI, "--set-input=1")  # television
    try:
        with camera(HDMI) as grabber, pytest.raises(CameraError) as caught:
            grabber.arm()
        assert caught.value.code == "frame_format"
        assert "interlaced" in caught.value.cause
        (found,) = [one for one in discover() if one.device == HDMI]
        assert found.problem is not None
        assert "interlaced" in found.problem
    finally:
        ctl(HDMI, "--set-input=0")


# -- settings --------------------------------------------------------------------------------------------------------


def test_controls_go_by_the_names_of_the_kernel_s_tool() -> None:
    theirs = set(re.findall(r"^\s+(\w+) 0x", ctl(WEBCAM, "--list-ctrls"), re.M))
    with camera(WEBCAM) as grabber:
        ours = set(grabber.describe().feature_names)
    assert len(ours) > 40
    assert ours <= theirs
    # what it lists besides can be read only
    for name in theirs - ours:
        assert re.search(rf"{name} 0x.*flags=.*(read-only|has-payload)", ctl(WEBCAM, "--list-ctrls")), name


@pytest.mark.parametrize(
    ("name", "value", "theirs"),
    [
        ("brightness", 77, "77"),
        ("integer_32_bits", -5, "-5"),
        ("integer_64_bits", -(2**40), str(-(2**40))),
        ("boolean", False, "0"),
        ("boolean", 1, "1"),
        ("menu", "Menu Item 4", "4 (Menu Item 4)"),
        ("menu", 1, "1 (Menu Item 1)"),
        ("integer_menu", 5, "5 (8 0x8)"),
        ("bitmask", 0x80002000, str(0x80002000 - 2**32)),
        ("string", "ab", "'ab'"),
        ("test_pattern", "gray ramp", "20 (Gray Ramp)"),
    ],
)
@pytest.mark.fault(18)
def test_a_control_is_set_and_read_back(name: str, value: object, theirs: str) -> None:
    before = ctl(WEBCAM, f"--get-ctrl={name}").split(": ", 1)[1].strip()
    with camera(WEBCAM) as grabber:
        taken = grabber.configure(CameraSettings(features={name: value}))
        assert taken.features is not None
        got = taken.features[name]
        assert str(got).casefold() == str(bool(value) if name == "boolean" else value).casefold()
        assert ctl(WEBCAM, f"--get-ctrl={name}").strip() == f"{name}: {theirs}"
        # what came back is taken again
        assert grabber.configure(taken) == taken
    raw = before.split(" (")[0].strip("'")
    if raw:
        ctl(WEBCAM, f"--set-ctrl={name}={raw}")


_WRONG: list[tuple[str, object, str]] = [
    ("brightness", 256, "out_of_range"),
    ("brightness", -1, "out_of_range"),
    ("brightness", 1.5, "out_of_range"),
    ("brightness", float("nan"), "out_of_range"),
    ("brightness", float("inf"), "out_of_range"),
    ("brightness", "bright", "out_of_range"),
    ("brightness", True, "out_of_range"),
    ("boolean", 2, "out_of_range"),
    ("menu", 2, "out_of_range"),  # an item that the menu skips
    ("menu", "Menu Item 2", "out_of_range"),
    ("menu", 99, "out_of_range"),
    ("integer_menu", 0, "out_of_range"),
    ("bitmask", 1, "out_of_range"),
    ("integer_64_bits", 2**63, "out_of_range"),
    ("string", "abcde", "out_of_range"),
    ("string", 12, "out_of_range"),
    ("button", False, "out_of_range"),
    ("read_only_integer_32_bits", 1, "read_only"),
    ("Brightness", 1, "unknown_feature"),
]


@pytest.mark.fault(18)
def test_what_a_control_cannot_take_is_refused_before_anything_is_set() -> None:
    ctl(WEBCAM, "--set-ctrl=contrast=100")
    before = _held()
    with camera(WEBCAM) as grabber:
        for name, value, code in _WRONG:
            error = refused(grabber, pixel_format="Y16", features={"contrast": 101, name: value})
            assert (error.code, error.context["setting"]) == (code, name), value
    assert _held() == before
    assert "'GREY'" in ctl(WEBCAM, "--get-fmt-video")


def _held() -> list[str]:
    """All controls but those that vivid changes by itself."""
    lines = ctl(WEBCAM, "--list-ctrls").splitlines()
    return [line for line in lines if not re.match(r"\s*(gain|read_only_integer_32_bits) ", line)]


def test_a_control_that_another_one_overrides_is_no_success() -> None:
    with camera(HDMI) as grabber:
        error = refused(grabber, features={"standard": 1})
        assert error.code == "setting_not_taken"
        assert "without effect" in error.cause


def test_a_value_that_the_device_changes_by_itself_is_reported() -> None:
    with camera(WEBCAM) as grabber:
        taken = grabber.configure(CameraSettings(features={"gain_automatic": False, "gain": 40}))
        assert taken.features == {"gain_automatic": False, "gain": 40}
        assert ctl(WEBCAM, "--get-ctrl=gain").strip() == "gain: 40"
        grabber.configure(CameraSettings(features={"gain_automatic": True}))


def test_settings_without_a_control_are_refused_by_name() -> None:
    with camera(WEBCAM) as grabber:
        here = grabber.describe()
        assert here.exposure_range_ms is None
        assert here.gain_range_db is None
        assert refused(grabber, exposure_ms=5.0).code == "unknown_feature"
        assert refused(grabber, gain_db=0.0).code == "unknown_feature"
    with camera(HDMI) as grabber:
        # the signal sets the rate
        assert refused(grabber, frame_rate_hz=30.0).code == "out_of_range"
        assert grabber.configure(CameraSettings(frame_rate_hz=60.0)).frame_rate_hz == 60.0


def test_the_rate_is_the_nearest_that_the_device_has_and_is_read_back() -> None:
    with camera(WEBCAM) as grabber:
        assert grabber.describe().frame_rate_range_hz == (1.0, 60.0)
        for asked, taken in ((60.0, 60.0), (12.5, 12.5), (14.0, 15.0), (1.0, 1.0)):
            assert grabber.configure(CameraSettings(frame_rate_hz=asked)).frame_rate_hz == pytest.approx(taken)
            assert f"Frames per second: {taken:.3f}" in ctl(WEBCAM, "--get-parm")
        # larger pictures come at fewer rates
        error = refused(grabber, frame_rate_hz=60.0, region_px=(0, 0, 1280, 720))
        assert error.code == "out_of_range"
        assert "Width/Height      : 320/180" in ctl(WEBCAM, "--get-fmt-video")


def test_bit_depth_takes_the_plainest_format() -> None:
    with camera(WEBCAM) as grabber:
        for depth, name in ((10, "Y10 "), (12, "Y12 "), (16, "Y16 "), (8, "GREY")):
            taken = grabber.configure(CameraSettings(bit_depth=depth))
            assert (taken.bit_depth, taken.pixel_format) == (depth, name)
            assert f"'{name}'" in ctl(WEBCAM, "--get-fmt-video")
        assert refused(grabber, bit_depth=8, pixel_format="Y10").code == "out_of_range"
        assert refused(grabber, pixel_format="RGB3").code == "out_of_range"
        # another depth is kept where nothing is asked
        grabber.configure(CameraSettings(pixel_format="YUYV"))
        assert grabber.configure(CameraSettings(bit_depth=8)).pixel_format == "YUYV"


def test_a_whole_image_of_another_size_is_a_region_of_the_webcam() -> None:
    with camera(WEBCAM) as grabber:
        taken = grabber.configure(CameraSettings(region_px=(0, 0, 640, 480)))
        assert taken.region_px == (0, 0, 640, 480)
        assert picture(grabber).pixels.shape == (480, 640)
        error = refused(grabber, region_px=(0, 0, 500, 300))
        assert error.code == "out_of_range"
        assert "1280 x 720" in error.cause
        assert refused(grabber, region_px=(8, 0, 320, 180)).code == "out_of_range"


def test_a_region_is_cut_out_of_the_sensor_s_pixels() -> None:
    with camera(HDMI, pixel_format="GREY") as grabber:
        put(HDMI, osd_text_mode="None", test_pattern="Ten Pixels Wide Cross")
        assert grabber.describe().image_size_px == (1280, 720)
        whole = picture(grabber).pixels
        for x0, y0, width, height in ((600, 340, 160, 90), (0, 0, 320, 200), (960, 520, 320, 200)):
            taken = grabber.configure(CameraSettings(region_px=(x0, y0, width, height)))
            assert taken.region_px == (x0, y0, width, height)
            assert grabber.describe().image_size_px == (1280, 720)
            np.testing.assert_array_equal(picture(grabber).pixels, whole[y0 : y0 + height, x0 : x0 + width])
        for region in ((1200, 0, 100, 100), (0, 700, 100, 100), (-8, 0, 100, 100), (0, 0, 0, 10)):
            assert refused(grabber, region_px=region).code == "out_of_range"
        assert grabber.configure(CameraSettings()).region_px == (960, 520, 320, 200)
        grabber.configure(CameraSettings(region_px=(0, 0, 1280, 720)))
        np.testing.assert_array_equal(picture(grabber).pixels, whole)


def test_what_cannot_change_while_it_streams_is_refused_and_the_rest_is_set() -> None:
    with camera(WEBCAM) as grabber:
        grabber.arm()
        before = grabber.configure(CameraSettings())
        for settings in ({"bit_depth": 12}, {"frame_rate_hz": 30.0}, {"region_px": (0, 0, 640, 360)}):
            assert refused(grabber, **settings).code == "armed"
        # the settings that it has already may be pushed at any time
        again = CameraSettings(bit_depth=8, frame_rate_hz=15.0, region_px=SMALL, features={"brightness": 100})
        assert grabber.configure(again).features == {"brightness": 100}
        assert frames_of(grabber, 2)
        grabber.disarm()
        assert grabber.configure(CameraSettings()).frame_rate_hz == before.frame_rate_hz
        grabber.configure(CameraSettings(features={"brightness": 128}))


def test_trigger_modes_are_what_the_options_name() -> None:
    options = CameraOptions(
        device=WEBCAM,
        trigger_features={
            "free": {"boolean": False},
            "hardware": {"boolean": True, "menu": 1},
            "software": {"boolean": True, "menu": "Menu Item 4", "button": True},
        },
    )
    grabber = make(options)
    grabber.open()
    try:
        assert set(grabber.describe().trigger_modes) == {"free", "hardware", "software"}
        for mode, boolean, menu in (("hardware", 1, 1), ("software", 1, 4), ("hardware", 1, 1)):
            assert grabber.configure(CameraSettings(trigger=mode)).trigger == mode
            output = ctl(WEBCAM, "--get-ctrl=boolean,menu")
            assert f"boolean: {boolean}" in output
            assert f"menu: {menu} " in output
        with pytest.raises(CameraError) as caught:
            grabber.trigger()
        assert caught.value.code == "wrong_trigger"
        grabber.configure(CameraSettings(trigger="software"))
        with pytest.raises(CameraError) as caught:
            grabber.trigger()
        assert caught.value.code == "not_armed"
        # vivid writes "button pressed!" into its pictures for a while, which nothing else makes it do
        put(WEBCAM, test_pattern="100% Black")
        grabber.arm()
        before = frames_of(grabber, 3)[-1].pixels > 128
        grabber.trigger()
        after = frames_of(grabber, 12)[-1].pixels > 128
        assert after.sum() > before.sum() + 200
        assert grabber.configure(CameraSettings(trigger="free")).trigger == "free"
        assert "boolean: 0" in ctl(WEBCAM, "--get-ctrl=boolean")
    finally:
        grabber.close()
    with camera(WEBCAM) as plain:
        assert plain.describe().trigger_modes == ("free",)
        assert refused(plain, trigger="hardware").code == "out_of_range"


# -- frames and faults -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "stamped"), [("End of Frame", "end of frame"), ("Start of Exposure", "start of exposure")]
)
def test_stamps_are_the_monotonic_clock_s(source: str, stamped: str) -> None:
    """Vivid hands a frame over when it begins, and stamps the end of it: nine tenths of a period in the future."""
    put(WEBCAM, timestamp_source=source)
    with camera(WEBCAM, frame_rate_hz=10.0) as grabber:
        assert grabber.describe().clock == "monotonic"
        assert grabber.describe().extra["timestamp"] == stamped
        grabber.arm()
        frames = frames_of(grabber, 8)[2:]
        ahead_ms = [(frame.device_ns - frame.host_ns) / 1e6 for frame in frames]
        print(f"{source}: stamps {np.round(ahead_ms, 1)} ms after the arrival")
        latest = 90.0 if stamped == "end of frame" else 0.0
        assert max(ahead_ms) <= latest + 0.1
        assert min(ahead_ms) > latest - 900.0
        periods_ms = np.diff([frame.device_ns for frame in frames]) / 1e6
        numbers = np.diff([frame.sequence for frame in frames])
        np.testing.assert_allclose(periods_ms / numbers, 100.0, atol=40.0)
        assert grabber.statistics()["odd_stamps"] == 0


@pytest.mark.parametrize("wrap", ["64 Bit", "32 Bit"])
def test_stamps_that_are_no_monotonic_time_are_counted(wrap: str) -> None:
    put(WEBCAM, wrap_timestamp=wrap)
    with camera(WEBCAM, frame_rate_hz=60.0) as grabber:
        grabber.arm()
        frames = frames_of(grabber, 10)
        assert [frame.status for frame in frames] == [FrameStatus.OK] * 10
        assert grabber.statistics()["odd_stamps"] == 10


@pytest.mark.fault(15)
def test_a_frame_marked_damaged_is_incomplete_and_counted() -> None:
    with camera(WEBCAM) as grabber:
        grabber.arm()
        frames_of(grabber, 2)
        put(WEBCAM, inject_v4l2_buf_flag_error=True)
        kinds = [frame.status for frame in frames_of(grabber, 8)]
        assert kinds.count(FrameStatus.INCOMPLETE) == 1
        assert grabber.statistics()["errors"] == 1


def test_a_buffer_that_is_not_taken_back_is_given_back_again_later() -> None:
    with camera(WEBCAM) as grabber:
        grabber.arm()
        frames_of(grabber, 2)
        put(WEBCAM, inject_vidioc_qbuf_error=True)
        frames = frames_of(grabber, 40, 20.0)
        assert {frame.status for frame in frames} == {FrameStatus.OK}
        assert list(np.diff([frame.sequence for frame in frames])).count(1) > 30
        assert grabber.statistics()["not_requeued"] == 1


@pytest.mark.parametrize("control", ["inject_vidioc_streamon_error", "inject_vidioc_reqbufs_error"])
def test_a_stream_that_does_not_start_is_a_fault_and_starts_the_next_time(control: str) -> None:
    with camera(WEBCAM) as grabber:
        put(WEBCAM, **{control: True})
        with pytest.raises(CameraError) as caught:
            grabber.arm()
        assert caught.value.code == "camera_fault"
        assert "start its stream" in caught.value.cause
        assert picture(grabber).status is FrameStatus.OK


@pytest.mark.fault(11)
@pytest.mark.parametrize(("control", "text"), [("disconnect", "ENODEV"), ("inject_fatal_streaming_error", "EIO")])
def test_unplugged_and_broken_name_the_kernel_s_reason(control: str, text: str) -> None:
    with camera(WEBCAM) as grabber:
        grabber.arm()
        frames_of(grabber, 2)
        put(WEBCAM, **{control: True})
        with pytest.raises(CameraError) as caught:
            frames_of(grabber, 40)
        assert caught.value.code == "camera_lost"
        assert text in caught.value.cause
        if text == "ENODEV":
            with pytest.raises(CameraError) as caught:
                grabber.configure(CameraSettings(features={"brightness": 100}))
            assert caught.value.code == "camera_lost"
            with pytest.raises(CameraError) as caught:
                make(CameraOptions(device=WEBCAM)).open()
            assert caught.value.code == "camera_lost"
    with camera(WEBCAM) as grabber:
        assert picture(grabber).status is FrameStatus.OK


@pytest.mark.fault(13)
def test_a_consumer_that_is_too_slow_loses_frames_and_every_number_is_accounted_for() -> None:
    grabber = make(CameraOptions(device=WEBCAM, buffers=3))
    grabber.open()
    try:
        grabber.configure(CameraSettings(frame_rate_hz=30.0))
        assert grabber.statistics()["buffers"] == 0
        grabber.arm()
        assert grabber.statistics()["buffers"] == 3
        frames_of(grabber, 1)
        time.sleep(1.0)
        numbers = [frame.sequence for frame in frames_of(grabber, 6)]
        # three waited in their buffers, the others were never taken
        assert max(np.diff(numbers)) > 5
        grabber.disarm()
        reader = CameraReader(
            grabber, name="cam1", period_s=1 / 30, expects_frames=True, sequence=SequenceReader(0, 2**32 - 1)
        )
        reader.start()
        assert reader.take(5.0) is not None
        time.sleep(1.0)
        counters = reader.counters
        assert counters.overrun > 0
        assert counters.delivered <= 9
        last = None
        reader.stop()
        while (frame := reader.take(0.0)) is not None:
            last = frame
        assert last is not None
        whole = reader.counters
        known = whole.delivered + whole.overrun + whole.dropped + whole.incomplete
        assert known <= last.sequence + 1
        assert known > last.sequence - 3  # the first ones of a stream may have come before the first that was taken
    finally:
        grabber.close()


def test_closing_is_quick_and_leaves_nothing_behind() -> None:
    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    def mapped() -> int:
        return Path("/proc/self/maps").read_text().count("/dev/video")

    before = open_files()
    for _ in range(10):
        grabber = make(CameraOptions(device=PLANAR))
        grabber.open()
        grabber.arm()
        waiting = threading.Thread(target=lambda one=grabber: _drain(one))
        waiting.start()
        time.sleep(0.02)
        assert mapped() > 0
        begin = time.monotonic()
        closers = [threading.Thread(target=grabber.close) for _ in range(3)]
        for thread in closers:
            thread.start()
        for thread in (*closers, waiting):
            thread.join(3.0)
            assert not thread.is_alive()
        assert time.monotonic() - begin < 1.0
        with pytest.raises(CameraError) as caught:
            grabber.next_frame(0.0)
        assert caught.value.code == "camera_lost"
    assert open_files() == before
    assert mapped() == 0
    grabber.open()  # a grabber that was closed opens again
    assert picture(grabber).status is FrameStatus.OK
    grabber.close()


def _drain(grabber: FrameGrabber) -> None:
    try:
        while True:
            grabber.next_frame(5.0)
    except CameraError:
        return


def test_the_ring_is_given_back_so_that_others_may_stream() -> None:
    with camera(WEBCAM) as grabber:
        assert picture(grabber).status is FrameStatus.OK
        output = subprocess.run(
            ["v4l2-ctl", "-d", WEBCAM, "--stream-mmap", "--stream-count=2"], capture_output=True, text=True, timeout=60
        )
        assert output.returncode == 0, output.stderr


def test_the_guest_has_what_these_tests_rely_on() -> None:
    with controls_of(WEBCAM) as controls:
        assert {"disconnect", "inject_fatal_streaming_error", "wrap_sequence_number"} <= set(controls.settable_names)
