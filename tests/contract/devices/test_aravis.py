"""What is Aravis' own: ids, packet size, clocks, features by name, statistics, losses that take long.

Against the fake GigE cameras of aravis-tools, each in a network namespace of its own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, Frame, FrameGrabber, FrameStatus
from stereorig.drivers.registry import discover_cameras, make_camera
from tests.support.fake_gige import FakeCamera, small_sensor_xml, strict_xml, what_is_missing
from tests.support.patience import Deadline, busy
from tests.support.requirements import missing

RETURN_S = 3.0


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FakeCamera, FakeCamera]]:
    """An ordinary fake camera and a strict one."""
    lacking = what_is_missing()
    if lacking is not None:
        missing(lacking)
    folder = tmp_path_factory.mktemp("gige")
    made: list[FakeCamera] = []
    try:
        made.append(FakeCamera("p", small_sensor_xml(), folder))
        made.append(FakeCamera("q", strict_xml(), folder))
        yield made[0], made[1]
    finally:
        for camera in made:
            camera.end()


@pytest.fixture
def plain(cameras: tuple[FakeCamera, FakeCamera]) -> Iterator[FakeCamera]:
    yield cameras[0]
    _refresh(cameras[0])


@pytest.fixture
def strict(cameras: tuple[FakeCamera, FakeCamera]) -> Iterator[FakeCamera]:
    yield cameras[1]
    _refresh(cameras[1])


def _refresh(camera: FakeCamera) -> None:
    camera.plug()
    camera.unmute()
    camera.widen()
    camera.kill()
    camera.start()


@pytest.fixture
def make() -> Iterator[Callable[..., FrameGrabber]]:
    """Makes grabbers and closes them."""
    made: list[FrameGrabber] = []

    def _make(camera: FakeCamera | str, *, opened: bool = True, **options: object) -> FrameGrabber:
        device = camera if isinstance(camera, str) else camera.device
        grabber = make_camera("aravis", CameraOptions(**{"device": device, "trigger_source": "Line0", **options}))  # type: ignore[arg-type]
        made.append(grabber)
        if opened:
            grabber.open()
        return grabber

    yield _make
    for grabber in made:
        grabber.close()


Make = Callable[..., FrameGrabber]


def _refused(call: Callable[[], object]) -> CameraError:
    with pytest.raises(CameraError) as caught:
        call()
    assert caught.value.cause
    assert caught.value.remedy
    return caught.value


def _code_of(call: Callable[[], object]) -> str | None:
    try:
        call()
    except CameraError as error:
        return error.code
    return None


def _frames(grabber: FrameGrabber, count: int, timeout_s: float = 5.0) -> list[Frame]:
    frames: list[Frame] = []
    deadline = Deadline(timeout_s)
    while len(frames) < count:
        assert deadline.left, f"{len(frames)} of {count} frames in {timeout_s} s"
        frame = grabber.next_frame(0.2)
        if frame is not None:
            frames.append(frame)
    return frames


# ---- finding and opening


def test_discovery_lists_both_with_model_serial_address_and_what_is_wrong(
    cameras: tuple[FakeCamera, FakeCamera], make: Make
) -> None:
    held, free = cameras
    make(held)
    found = {one.serial: one for one in discover_cameras("aravis")}
    for camera in cameras:
        one = found[camera.serial]
        assert (one.kind, one.driver, one.device) == ("camera", "aravis", camera.device)
        assert (one.model, one.address) == ("Fake", camera.address)
        assert one.extra["protocol"] == "GigEVision"
    assert found[free.serial].problem is None
    problem = found[held.serial].problem
    assert problem is not None
    assert "uses it" in problem


def test_a_camera_that_is_switched_off_is_not_listed(plain: FakeCamera) -> None:
    plain.kill()
    assert plain.serial not in {one.serial for one in discover_cameras("aravis")}


@pytest.mark.parametrize("by", ["device", "serial", "address"])
def test_it_opens_by_id_serial_number_and_address(plain: FakeCamera, make: Make, by: str) -> None:
    grabber = make(getattr(plain, by))
    here = grabber.describe()
    assert here.serial == plain.serial
    assert here.extra["address"] == plain.address
    assert here.model == "Fake"
    assert here.firmware


@pytest.mark.parametrize("device", ["Nobody-Such-1", "", "10.0.0.0.1"])
def test_a_camera_that_is_not_there_is_lost_not_another_one(plain: FakeCamera, make: Make, device: str) -> None:
    grabber = make(device, opened=False)
    assert _refused(grabber.open).code == "camera_lost"
    assert _refused(grabber.describe).code == "camera_lost"
    assert grabber.statistics() == {}


def test_an_address_where_nobody_answers_fails_soon(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain.address.removesuffix(".2") + ".77", opened=False)
    begin = time.monotonic()
    assert _refused(grabber.open).code == "camera_lost"
    assert time.monotonic() - begin < 2.0 * busy()


@pytest.mark.fault(21)
def test_a_held_camera_is_busy_at_once_and_free_after_its_holder(plain: FakeCamera, make: Make) -> None:
    holder = make(plain)
    second = make(plain, opened=False)
    begin = time.monotonic()
    error = _refused(second.open)
    assert error.code == "camera_busy"
    assert "controls" in error.cause
    assert time.monotonic() - begin < 1.0 * busy()
    holder.close()
    second.open()
    assert second.describe().serial == plain.serial


# ---- settings


def test_packet_size_is_read_back_and_refused_out_of_range(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain, packet_size_bytes=1000)
    assert grabber.describe().extra["packet_size_bytes"] == "1000"
    grabber.configure(CameraSettings(trigger="free"))
    grabber.arm()
    _frames(grabber, 3)
    sent = grabber.statistics()
    # 512 x 512 bytes in packets that hold 1000 less the headers of IP, UDP and GVSP (20 + 8 + 8)
    assert sent["received_packets"] >= 3 * (512 * 512 // 964)
    grabber.close()
    for size in (50, 1504, 20000, 1001):
        error = _refused(make(plain, opened=False, packet_size_bytes=size).open)
        assert error.code == "out_of_range"
        assert str(size) in error.cause
    # it was not left under control
    assert make(plain).describe().extra["packet_size_bytes"] == "1000"


def test_packets_that_the_network_would_divide_are_not_used(plain: FakeCamera, make: Make) -> None:
    plain.jumbo()
    grabber = make(plain, packet_size_bytes=8192)
    grabber.configure(CameraSettings(trigger="free", bit_depth=16))
    grabber.arm()
    frames = _frames(grabber, 5)
    assert {frame.status for frame in frames} == {FrameStatus.OK}
    # 512 x 512 x 2 bytes in packets of 8156, and a header and a trailer
    assert grabber.statistics()["received_packets"] / grabber.statistics()["completed_buffers"] < 70
    # on an armed camera it shows as incomplete frames, never as good ones
    plain.widen()
    deadline = Deadline(5.0)  # frames that are under way still come whole
    while _frames(grabber, 1)[0].status is not FrameStatus.INCOMPLETE:
        assert deadline.left
    assert {frame.status for frame in _frames(grabber, 3)} == {FrameStatus.INCOMPLETE}
    grabber.close()
    # its own size is too large now: it is made to fit
    small = make(plain)
    assert small.describe().extra["packet_size_bytes"] == "1500"
    small.configure(CameraSettings(trigger="free"))
    small.arm()
    assert {frame.status for frame in _frames(small, 3)} == {FrameStatus.OK}


def test_a_camera_without_ptp_is_refused_when_it_is_asked_for(plain: FakeCamera, make: Make) -> None:
    error = _refused(make(plain, opened=False, ptp=True).open)
    assert error.code == "ptp_unsupported"
    assert make(plain).describe().clock == ""


def test_the_clock_is_named_only_while_the_camera_follows_a_master(strict: FakeCamera, make: Make) -> None:
    grabber = make(strict, ptp=True)
    grabber.configure(CameraSettings(features={"PtpStatus": "Listening"}))
    assert grabber.describe().clock == ""
    assert grabber.describe().extra["ptp_status"] == "Listening"
    grabber.configure(CameraSettings(features={"PtpStatus": "Slave"}))
    assert grabber.describe().clock == "ptp:123456789abcdef0"
    grabber.configure(CameraSettings(features={"PtpEnable": False}))
    assert grabber.describe().clock == ""


@pytest.mark.fault(18)
def test_steps_are_named_when_a_value_lies_between_them(strict: FakeCamera, make: Make) -> None:
    grabber = make(strict)
    before = grabber.configure(CameraSettings())
    for settings, step in (
        (CameraSettings(region_px=(0, 0, 250, 100)), "16"),
        (CameraSettings(region_px=(6, 0, 256, 100)), "4"),
        (CameraSettings(features={"Stepped": 12}), "8"),
        (CameraSettings(features={"Stepped": 88}), "8"),
    ):
        error = _refused(lambda settings=settings: grabber.configure(settings))  # type: ignore[misc]
        assert error.code == "out_of_range"
        assert f"steps of {step}" in error.cause
    assert grabber.configure(CameraSettings()) == before
    taken = grabber.configure(CameraSettings(region_px=(8, 3, 256, 101), features={"Stepped": 16}))
    assert taken.region_px == (8, 3, 256, 101)
    assert taken.features == {"Stepped": 16}


@pytest.mark.fault(18)
def test_what_the_camera_rounds_comes_back_as_it_is(strict: FakeCamera, make: Make) -> None:
    grabber = make(strict)
    assert grabber.describe().gain_range_db == (0.0, 24.0)
    taken = grabber.configure(CameraSettings(gain_db=3.14, exposure_ms=1.0004, frame_rate_hz=30.0))
    assert taken.gain_db in (3.1, 3.2)
    assert taken.exposure_ms == 1.0
    assert taken.frame_rate_hz == pytest.approx(30.0, rel=1e-4)
    # what was read back can be set again, after a reconnect for instance, and comes back the same
    assert grabber.configure(taken) == taken


@pytest.mark.fault(18)
def test_raw_gain_is_no_gain_in_decibels(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    assert grabber.describe().gain_range_db is None
    error = _refused(lambda: grabber.configure(CameraSettings(gain_db=3.0)))
    assert error.code == "unknown_feature"
    assert "GainRaw" in error.cause
    assert grabber.configure(CameraSettings(features={"GainRaw": 3})).features == {"GainRaw": 3}


@pytest.mark.fault(18)
def test_all_or_none_also_when_ranges_would_do_at_first(strict: FakeCamera, make: Make) -> None:
    grabber = make(strict)
    before = grabber.configure(CameraSettings(features={"Stepped": 24, "ExposureAuto": "Continuous"}, exposure_ms=None))
    for bad in (
        CameraSettings(features={"Stepped": 32, "GainRaw": 99}),
        CameraSettings(features={"Stepped": 32}, exposure_ms=20.0, gain_db=25.0),
        CameraSettings(region_px=(8, 8, 64, 64), exposure_ms=1e9),
        CameraSettings(exposure_ms=20.0, trigger="software", bit_depth=10),
    ):
        assert _refused(lambda bad=bad: grabber.configure(bad)).code == "out_of_range"  # type: ignore[misc]
        assert grabber.configure(CameraSettings()) == before
    # an exposure that is set is not left to the camera
    taken = grabber.configure(CameraSettings(exposure_ms=20.0))
    assert taken.exposure_ms == 20.0
    assert taken.features == {"Stepped": 24, "ExposureAuto": "Off"}


def test_features_by_name_take_their_own_kinds_only(strict: FakeCamera, make: Make) -> None:
    grabber = make(strict)
    names = grabber.describe().feature_names
    assert {"Width", "TestBoolean", "GainRaw", "Stepped", "DeviceReset"} <= set(names)
    taken = grabber.configure(
        CameraSettings(features={"TestBoolean": True, "BinningVertical": 2, "GainAuto": "Once", "DeviceReset": True})
    )
    assert taken.features == {"TestBoolean": True, "BinningVertical": 2, "GainAuto": "Once"}
    for name, value, code in (
        ("TestBoolean", "yes", "out_of_range"),
        ("Stepped", 8.5, "out_of_range"),
        ("Stepped", "eight", "out_of_range"),
        ("GainAuto", "Sometimes", "out_of_range"),
        ("GainAuto", 1, "out_of_range"),
        ("ExposureTimeAbs", float("nan"), "out_of_range"),
        ("DeviceReset", 1, "out_of_range"),
        ("DeviceVersion", "2", "unknown_feature"),  # can only be read
        ("PayloadSize", 4, "unknown_feature"),
        ("width", 64, "unknown_feature"),
        ("WidthRegister", 64, "unknown_feature"),  # the way around the range
    ):
        error = _refused(lambda name=name, value=value: grabber.configure(CameraSettings(features={name: value})))  # type: ignore[misc]
        assert error.code == code, name
        assert name in error.cause


def test_what_sizes_frames_cannot_change_while_they_come(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    settings = grabber.configure(CameraSettings(trigger="free", frame_rate_hz=50.0))
    grabber.arm()
    for bad in (
        CameraSettings(region_px=(0, 0, 64, 64)),
        CameraSettings(bit_depth=16),
        CameraSettings(trigger="software"),
        CameraSettings(features={"Width": 64}),
        CameraSettings(features={"BinningHorizontal": 2}),
    ):
        assert _refused(lambda bad=bad: grabber.configure(bad)).code == "armed"  # type: ignore[misc]
    taken = grabber.configure(CameraSettings(exposure_ms=3.0, trigger="free", bit_depth=8))
    assert taken.exposure_ms == 3.0
    assert taken.region_px == settings.region_px
    assert _frames(grabber, 2)[-1].pixels.shape == (512, 512)


@pytest.mark.parametrize(("name", "bits"), [("Mono12Packed", 12), ("Mono12p", 12), ("Mono12", 12), ("Mono16", 16)])
def test_formats_above_eight_bit_come_right_aligned(strict: FakeCamera, make: Make, name: str, bits: int) -> None:
    # the fake camera sends as many bytes as the format needs; pictures it makes for Mono16 only
    grabber = make(strict)
    taken = grabber.configure(CameraSettings(pixel_format=name, trigger="free", region_px=(0, 0, 240, 101)))
    assert (taken.pixel_format, taken.bit_depth) == (name, bits)
    grabber.arm()
    frame = next(one for one in _frames(grabber, 3) if one.status is FrameStatus.OK)
    assert frame.pixels.shape == (101, 240)
    assert frame.pixels.dtype == np.uint16
    assert frame.bit_depth == bits
    if name == "Mono16":
        # a ramp along the diagonal over all sixteen bits; in the wrong order its bytes would rise one by one
        assert np.median(np.diff(frame.pixels[0].astype(int))) > 64
        np.testing.assert_array_equal(frame.pixels[0, 1:], frame.pixels[1, :-1])


def test_bit_depth_takes_the_plainest_format(strict: FakeCamera, make: Make) -> None:
    grabber = make(strict)
    assert grabber.describe().bit_depths == (8, 12, 16)
    assert grabber.configure(CameraSettings(bit_depth=12)).pixel_format == "Mono12"
    for bad in (
        CameraSettings(bit_depth=10),
        CameraSettings(pixel_format="BayerRG8"),
        CameraSettings(pixel_format="Mono12p", bit_depth=8),
    ):
        error = _refused(lambda bad=bad: grabber.configure(bad))  # type: ignore[misc]
        assert error.code == "out_of_range"
        assert "Mono12p (12 bit)" in error.cause


def test_a_camera_left_in_a_colour_format_is_refused_before_it_streams(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    taken = grabber.configure(CameraSettings(features={"PixelFormat": "RGB8"}))
    assert (taken.pixel_format, taken.bit_depth) == ("RGB8", None)
    assert _refused(grabber.arm).code == "frame_format"
    grabber.configure(CameraSettings(bit_depth=8))
    grabber.arm()
    assert _frames(grabber, 1)


# ---- triggers


def test_a_hardware_trigger_delivers_nothing_without_a_pulse(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    assert grabber.configure(CameraSettings(trigger="hardware")).trigger == "hardware"
    grabber.arm()
    assert grabber.next_frame(0.7) is None
    assert _refused(grabber.trigger).code == "wrong_trigger"
    # the socket also sees messages of a new network
    sent = grabber.statistics()
    assert sent["transferred_bytes"] == sent["completed_buffers"] == sent["failed_buffers"] == 0


def test_a_line_or_edge_that_the_camera_lacks_is_refused(plain: FakeCamera, make: Make) -> None:
    for options, named in (({"trigger_source": "Line7"}, "Line0"), ({"trigger_edge": "falling"}, "RisingEdge")):
        grabber = make(plain, **options)
        before = grabber.configure(CameraSettings())
        error = _refused(lambda grabber=grabber: grabber.configure(CameraSettings(trigger="hardware")))  # type: ignore[misc]
        assert error.code == "out_of_range"
        assert named in error.cause
        assert grabber.configure(CameraSettings()) == before
        grabber.close()


def test_a_trigger_mode_may_be_spelt_out_in_features(strict: FakeCamera, make: Make) -> None:
    spelt = {
        "hardware": {"TestBoolean": True, "TriggerMode": "On"},
        "free": {"TestBoolean": False, "TriggerMode": "Off"},
    }
    grabber = make(strict, trigger_features=spelt)
    assert grabber.configure(CameraSettings(trigger="free")).trigger == "free"
    taken = grabber.configure(CameraSettings(trigger="hardware", features={"TriggerSource": "Line0"}))
    assert taken.trigger == "hardware"
    grabber.arm()
    assert grabber.next_frame(0.3) is None
    grabber.disarm()
    grabber.configure(CameraSettings(trigger="free"))
    grabber.arm()
    assert _frames(grabber, 1)


@pytest.mark.fault(15)
def test_a_trigger_whose_frame_is_damaged_does_not_shift_the_numbers(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    grabber.configure(CameraSettings(trigger="software"))
    grabber.arm()
    seen = []
    for round_ in range(5):
        if round_ == 2:
            plain.narrow()
        number = grabber.trigger()
        frame = _frames(grabber, 1)[0]
        seen.append((frame.trigger == number, frame.status))
        if round_ == 2:
            plain.widen()
            assert not frame.pixels.any(), "pixels that never came"
            assert frame.pixels.shape == (512, 512)
    ok, bad = (True, FrameStatus.OK), (True, FrameStatus.INCOMPLETE)
    assert seen == [ok, ok, bad, ok, ok]
    assert grabber.statistics()["missing_packets"] > 100


@pytest.mark.fault(13)
def test_a_trigger_whose_frame_never_comes_does_not_shift_the_numbers(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    grabber.configure(CameraSettings(trigger="software"))
    grabber.arm()
    plain.mute()
    grabber.trigger()
    assert grabber.next_frame(1.0) is None
    plain.unmute()
    for _ in range(3):
        number = grabber.trigger()
        frame = _frames(grabber, 1)[0]
        assert frame.trigger == number
        assert frame.status is FrameStatus.OK


# ---- frames and counts


def test_statistics_tell_what_became_of_the_buffers(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain, buffers=3)
    assert set(grabber.statistics().values()) <= {0}
    grabber.configure(CameraSettings(trigger="free", frame_rate_hz=50.0))
    grabber.arm()
    first = _frames(grabber, 5)
    count = grabber.statistics()
    assert count["completed_buffers"] >= 5
    assert count["free_buffers"] + count["waiting_frames"] in (2, 3)  # one may be being filled
    assert count["transferred_bytes"] >= 5 * 512 * 512
    # frames are not taken: three wait, the others find no buffer and are lost, which the numbers show
    deadline = Deadline(5.0)
    while (starved := grabber.statistics())["underruns"] < count["underruns"] + 10:
        assert deadline.left
        time.sleep(0.02)
    assert starved["waiting_frames"] == 3
    later = _frames(grabber, 6)
    steps = np.diff([frame.sequence for frame in (*first, *later)])
    steps = steps[steps > -60000]  # the counter may wrap meanwhile
    assert (steps > 1).any()
    grabber.disarm()
    # counts go on through arming again
    done = grabber.statistics()["completed_buffers"]
    assert "free_buffers" not in grabber.statistics()
    grabber.arm()
    _frames(grabber, 2)
    assert grabber.statistics()["completed_buffers"] > done


def test_waiting_for_a_frame_does_not_hold_up_other_threads(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    grabber.configure(CameraSettings(trigger="hardware"))
    grabber.arm()
    thread = threading.Thread(target=_code_of, args=(lambda: grabber.next_frame(2.0),))
    thread.start()
    begin = time.monotonic()
    for _ in range(100):
        time.sleep(0.001)  # each must get the interpreter back from the waiting thread, which checks every 20 ms
    assert time.monotonic() - begin < 1.0 * busy()
    grabber.close()
    thread.join(2.0)
    assert not thread.is_alive()


def test_arrival_is_by_the_monotonic_clock_and_the_cameras_clock_goes_its_own_way(
    plain: FakeCamera, make: Make
) -> None:
    grabber = make(plain)
    grabber.configure(CameraSettings(trigger="software"))
    grabber.arm()
    for _ in range(3):
        begin = time.monotonic_ns()
        grabber.trigger()
        frame = _frames(grabber, 1)[0]
        assert begin <= frame.host_ns <= time.monotonic_ns()
        assert frame.device_ns != frame.host_ns


# ---- losing cameras


@pytest.mark.fault(11)
@pytest.mark.parametrize("how", ["kill", "stop", "unplug"])
def test_a_camera_that_waits_for_a_trigger_is_missed_within_a_second(plain: FakeCamera, make: Make, how: str) -> None:
    grabber = make(plain)
    grabber.configure(CameraSettings(trigger="software"))
    grabber.arm()
    assert grabber.next_frame(0.3) is None
    getattr(plain, how)()
    lost = time.monotonic()
    error = _refused(lambda: _frames(grabber, 1, timeout_s=5.0))
    seconds = time.monotonic() - lost
    print(f"{how}: idle camera missed after {seconds * 1e3:.0f} ms")
    assert error.code == "camera_lost"
    assert seconds < 1.0 * busy()
    # nothing that the service calls often waits for it
    begin = time.monotonic()
    grabber.statistics()
    grabber.describe()
    grabber.close()
    assert time.monotonic() - begin < 0.7 * busy()


@pytest.mark.fault(11)
def test_disarming_does_not_wait_for_a_camera_that_is_gone(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    grabber.configure(CameraSettings(trigger="software"))
    grabber.arm()
    plain.kill()
    begin = time.monotonic()
    grabber.disarm()
    assert _refused(lambda: grabber.next_frame(0.1)).code == "camera_lost"
    grabber.close()
    assert time.monotonic() - begin < 1.5 * busy()


@pytest.mark.fault(11)
def test_a_camera_that_was_switched_off_and_on_is_lost_although_it_answers(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain)
    grabber.configure(CameraSettings(trigger="software"))
    grabber.arm()
    plain.kill()
    plain.start()
    assert _refused(lambda: _frames(grabber, 1, timeout_s=5.0)).code == "camera_lost"
    grabber.close()
    grabber.open()
    grabber.configure(CameraSettings(trigger="free"))
    grabber.arm()
    assert _frames(grabber, 1)


@pytest.mark.fault(11)
@pytest.mark.parametrize(("how", "back"), [("kill", "start"), ("stop", "resume"), ("unplug", "plug")])
def test_it_works_again_soon_after_a_long_absence(plain: FakeCamera, make: Make, how: str, back: str) -> None:
    grabber = make(plain)
    wanted = grabber.configure(CameraSettings(trigger="free", exposure_ms=4.0, frame_rate_hz=20.0))
    grabber.arm()
    _frames(grabber, 2)
    getattr(plain, how)()
    # a caller keeps the error, and with it everything that its traceback holds
    kept = _refused(lambda: grabber.configure(CameraSettings(exposure_ms=5.0)))
    assert kept.code == "camera_lost"
    begin = time.monotonic()
    grabber.close()
    assert time.monotonic() - begin < 0.7 * busy()
    end = begin + 4.0
    while time.monotonic() < end:  # as the service does: it tries all the time
        assert _refused(grabber.open).code == "camera_lost"
    getattr(plain, back)()
    plain.await_answer()
    returned = time.monotonic()
    while True:
        assert time.monotonic() - returned < RETURN_S
        code = _code_of(grabber.open)
        if code is None:
            break
        assert code in ("camera_lost", "camera_busy")
    assert grabber.configure(wanted) == wanted
    grabber.arm()
    frame = _frames(grabber, 1)[0]
    seconds = time.monotonic() - returned
    print(f"{how}: working {seconds * 1e3:.0f} ms after the return")
    assert frame.status is FrameStatus.OK
    assert seconds < RETURN_S


def test_closing_while_it_is_being_opened_leaves_it_closed_and_free(plain: FakeCamera, make: Make) -> None:
    grabber = make(plain, opened=False)
    ended: list[str] = []

    def open_it() -> None:
        try:
            grabber.open()
            ended.append("open")
        except CameraError as error:
            ended.append(error.code)

    plain.stop()  # opening takes its time
    thread = threading.Thread(target=open_it)
    thread.start()
    time.sleep(0.1)
    begin = time.monotonic()
    grabber.close()
    assert time.monotonic() - begin < 0.7 * busy()
    plain.resume()
    thread.join(10.0)
    assert ended == ["camera_lost"]
    make(plain)
