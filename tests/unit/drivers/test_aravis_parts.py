"""Parts of the Aravis driver that need no camera: trigger numbers, arrival times, who controls a camera."""

from __future__ import annotations

import itertools
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.library import aravis, repository
from stereorig.drivers.cameras.aravis.stream import ArrivalClock
from stereorig.drivers.cameras.genicam.gvcp import ControlState, control_state
from stereorig.drivers.cameras.genicam.triggers import TriggerNumbers
from stereorig.drivers.cameras.genicam.watch import Watch
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FrameStatus
from stereorig.drivers.registry import discover_cameras, look_at_camera, make_camera
from tests.support.patience import Deadline
from tests.support.requirements import missing

MS = 1_000_000


class _Run:
    """Triggers and frames on a clock of its own."""

    def __init__(self, first: int = 1, last: int = 65535, before: int = 0) -> None:
        self.now = 1000 * MS
        self.numbers = TriggerNumbers(first, last, before=before, clock_ns=lambda: self.now)
        self.numbers.arm()

    def fire(self, after_ms: int = 100) -> int:
        self.now += after_ms * MS
        return self.numbers.fire(lambda: None)

    def frame(self, number: int, after_ms: int = 20, damaged: int = 0) -> int | None:
        self.now += after_ms * MS
        return self.numbers.of_frame(number, self.now, 1.0, damaged)


@pytest.mark.fault(13)
def test_a_lost_frame_does_not_shift_the_numbers() -> None:
    run = _Run()
    seen = []
    for number in range(65530, 65546):
        fired = run.fire()
        raw = number if number <= 65535 else number - 65535  # wraps to 1
        if fired not in (3, 4, 9):
            seen.append((fired, run.frame(raw)))
    assert all(fired == got for fired, got in seen)
    assert len(seen) == 13


def test_frames_may_come_after_several_triggers() -> None:
    run = _Run()
    for _ in range(3):
        run.fire(10)
    assert [run.frame(number) for number in (40, 41, 42)] == [1, 2, 3]
    assert run.frame(43) is None, "nobody fired for it"
    assert run.frame(41) == 2, "a repeat is what it was"


def test_the_first_frames_may_be_lost_where_the_counter_tells() -> None:
    anew = _Run()
    for _ in range(3):
        anew.fire(10)
    assert anew.frame(3) == 3, "a camera that counts from 1 has lost two"
    on = _Run()
    on.fire()
    assert on.frame(500) == 1
    on.numbers.arm()
    for _ in range(3):
        on.fire(10)
    assert on.frame(502) == 3, "501 was for the second trigger"
    damaged = _Run()
    damaged.fire()
    damaged.fire()
    assert damaged.frame(700, damaged=1) == 2


def test_what_comes_long_after_its_trigger_is_of_a_later_one() -> None:
    run = _Run()
    run.fire()
    assert run.frame(10) == 1
    run.fire(1)  # comes while the camera is busy: it is ignored and not counted
    run.fire(3000)
    assert run.frame(11) == 3
    run.fire()
    assert run.frame(12) == 4


def test_numbers_go_on_through_arming_and_connections_and_skip_what_was_not_sent() -> None:
    run = _Run(before=7)
    assert run.fire() == 8
    assert run.frame(1) == 8
    run.numbers.arm()
    assert run.frame(2) is None

    def fail() -> None:
        raise CameraError("It does not answer.", code="camera_lost")

    with pytest.raises(CameraError):
        run.numbers.fire(fail)
    assert run.fire() == 9
    assert run.frame(2) == 9


class _Clocks:
    def __init__(self) -> None:
        self.steady = 50_000 * MS
        self.offset = 1_700_000_000_000 * MS

    def pass_ms(self, ms: float) -> None:
        self.steady += round(ms * MS)

    def made(self) -> ArrivalClock:
        return ArrivalClock(lambda: self.steady + self.offset, lambda: self.steady)


def test_arrival_is_moved_to_the_monotonic_clock() -> None:
    clocks = _Clocks()
    clock = clocks.made()
    arrived = clocks.steady + clocks.offset
    clocks.pass_ms(12)
    assert clock.monotonic_ns(arrived, 0) == 50_000 * MS
    assert clock.monotonic_ns(clocks.steady + clocks.offset + 5 * MS, 0) == clocks.steady, "nothing comes from later"


@pytest.mark.fault(7)
@pytest.mark.parametrize("step_ms", [-3_600_000, -500, 700, 86_400_000])
def test_a_step_of_the_wall_clock_moves_no_arrival(step_ms: int) -> None:
    clocks = _Clocks()
    clock = clocks.made()
    before = [clocks.steady + clocks.offset]
    clocks.pass_ms(5)
    before.append(clocks.steady + clocks.offset)
    clocks.pass_ms(5)
    clocks.offset += step_ms * MS
    clocks.pass_ms(10)
    for waiting, wall in ((1, before[0]), (0, before[1])):
        got = clock.monotonic_ns(wall, waiting)
        assert abs(got - clocks.steady) <= 20 * MS
    clocks.pass_ms(100)
    clock.watch()
    arrived = clocks.steady
    wall = clocks.steady + clocks.offset
    clocks.pass_ms(15)
    assert clock.monotonic_ns(wall, 0) == arrived, "the next ones are exact again"


_COUNT = itertools.count()


class _Register:
    """Answers reads of the control register; bytes by the GigE Vision control protocol."""

    def __init__(self, answer: bytes | None, *, answers_until: int | None = None) -> None:
        self.asked: list[bytes] = []
        self.answers_until = answers_until
        self._answer = answer
        self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # an address of its own on the loopback network, since the port is fixed
        self.address = f"127.{os.getpid() % 200 + 20}.{time.monotonic_ns() // 1000 % 250}.{next(_COUNT) % 250 + 1}"
        self._line.bind((self.address, 3956))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                question, sender = self._line.recvfrom(64)
                self.asked.append(question)
                if self._answer is not None and len(self.asked) <= (self.answers_until or 10**6):
                    self._line.sendto(self._answer[:6] + question[6:8] + self._answer[8:], sender)
            except OSError:  # closed meanwhile
                return

    def close(self) -> None:
        self._line.close()


@pytest.mark.parametrize(
    ("answer", "state"),
    [
        (struct.pack(">HHHHI", 0, 0x0081, 4, 0, 0), ControlState.FREE),
        (struct.pack(">HHHHI", 0, 0x0081, 4, 0, 1), ControlState.HELD),  # exclusive access
        (struct.pack(">HHHHI", 0, 0x0081, 4, 0, 2), ControlState.HELD),  # control access
        (struct.pack(">HHHH", 0x8006, 0x0081, 0, 0), ControlState.HELD),  # access denied
        (struct.pack(">HHHH", 0x8002, 0x0081, 0, 0), ControlState.FREE),  # it answers, but not that
        (struct.pack(">HHHHI", 0, 0x0083, 4, 0, 2), ControlState.SILENT),  # an answer to something else
        (b"\0", ControlState.SILENT),
        (None, ControlState.SILENT),
    ],
)
def test_who_controls_a_camera(answer: bytes | None, state: ControlState) -> None:
    camera = _Register(answer)
    try:
        assert control_state(camera.address, timeout_s=0.2, attempts=2) is state
    finally:
        camera.close()
    # READREG_CMD with its key, the wish for an answer, four bytes, and the address of the control register
    assert camera.asked[0][:6] == bytes.fromhex("42 01 0080 0004")
    assert camera.asked[0][8:] == bytes.fromhex("00000a00")
    if state is ControlState.SILENT:
        assert len(camera.asked) == 2


@pytest.fixture
def fake_inside() -> Iterator[str]:
    """The camera that Aravis simulates within the program: no network, and so none of what is GigE's own."""
    try:
        library = aravis()
    except CameraError as error:
        missing(f"Aravis ({error.remedy})")
    library.enable_interface("Fake")
    yield "Fake_1"
    library.disable_interface("Fake")


def test_a_camera_that_is_not_gige_goes_the_same_way(fake_inside: str) -> None:
    grabber = make_camera("aravis", CameraOptions(device=fake_inside, buffers=4, trigger_source="Line0"))
    grabber.open()
    try:
        here = grabber.describe()
        assert here.counter_range == (0, 2**64 - 1)
        assert here.latency_s == 0.0
        assert "packet_size_bytes" not in here.extra
        asked = CameraSettings(
            trigger="free", frame_rate_hz=50.0, region_px=(8, 4, 256, 128), exposure_ms=2.0, bit_depth=16
        )
        taken = grabber.configure(asked)
        assert (taken.region_px, taken.exposure_ms, taken.pixel_format) == ((8, 4, 256, 128), 2.0, "Mono16")
        grabber.arm()
        frames = []
        deadline = Deadline(5.0)
        while len(frames) < 6:
            assert deadline.left
            frame = grabber.next_frame(0.2)
            frames += [] if frame is None else [frame]
        assert all(frame.pixels.shape == (128, 256) and frame.status is FrameStatus.OK for frame in frames)
        assert all(later.sequence == one.sequence + 1 for one, later in pairwise(frames[1:]))
        assert grabber.statistics()["completed_buffers"] >= 6
        grabber.disarm()
    finally:
        grabber.close()
    with pytest.raises(CameraError) as caught:
        grabber.next_frame(0.1)
    assert caught.value.code == "camera_lost"


def test_a_cameras_features_and_description_are_read_and_it_is_free_again(fake_inside: str) -> None:
    for _ in range(2):
        about, rows = look_at_camera(fake_inside)
        assert (about["vendor"], about["model"]) == ("Aravis", "Fake")
        assert about["description"].startswith("<?xml")
        width = next(row for row in rows if row.name == "Width")
        assert (width.kind, width.access, width.value, width.setting) == ("integer", "read and write", 512, "region_px")


def test_without_pygobject_the_remedy_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    repository.cache_clear()
    monkeypatch.setitem(sys.modules, "gi", None)  # as if it were not installed
    try:
        for call in (lambda: make_camera("aravis", CameraOptions(device="any")), lambda: discover_cameras("aravis")):
            with pytest.raises(CameraError) as caught:
                call()
            assert caught.value.code == "driver_missing"
            assert "gir1.2-aravis-0.8" in caught.value.remedy
            assert "stereorig[aravis]" in caught.value.remedy
    finally:
        repository.cache_clear()


@pytest.mark.fault(11)
def test_the_watch_tells_why_a_camera_is_lost() -> None:
    def lost(camera: _Register, *, ours: bool = True, frames: bool = False, limit_s: float = 2.0) -> list[str]:
        messages: list[str] = []
        began = time.monotonic()
        watch = Watch(camera.address, lambda: time.monotonic() if frames else 0.0, lambda: ours, messages.append)
        watch.start()
        if camera.answers_until is not None:
            camera.answers_until = 1  # the question of `start`
        while not messages and time.monotonic() - began < limit_s:
            time.sleep(0.01)
        watch.end()
        camera.close()
        return messages

    held = struct.pack(">HHHHI", 0, 0x0081, 4, 0, 2)
    free = struct.pack(">HHHHI", 0, 0x0081, 4, 0, 0)
    assert lost(_Register(held), limit_s=0.8) == []
    assert "switched off and on" in lost(_Register(free))[0]
    assert "control" in lost(_Register(held), ours=False)[0]
    assert "does not answer" in lost(_Register(held, answers_until=99))[0]
    # frames are signs of life too, and a camera that never answered cannot fall silent
    assert lost(_Register(held, answers_until=99), frames=True, limit_s=1.2) == []
    assert lost(_Register(None), limit_s=1.5) == []
    assert "control" in lost(_Register(None), ours=False)[0]
