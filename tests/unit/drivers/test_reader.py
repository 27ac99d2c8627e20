"""The camera reader counts every frame's fate, refuses what is no measurement image and notices silence."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.acquisition.frame_counter import SequenceReader
from stereorig.drivers.acquisition.reader import CameraReader
from stereorig.drivers.cameras.protocol import CameraDescription, CameraSettings, Frame, FrameStatus
from stereorig.sim.grabber import SimFrameGrabber
from tests.support.patience import Deadline, busy


class ScriptedGrabber:
    """Delivers what a test puts in, an exception included."""

    def __init__(self) -> None:
        self.items: queue.Queue[Frame | Exception] = queue.Queue()
        self.armed = False
        self.fired = 0

    def open(self) -> None: ...

    def describe(self) -> CameraDescription:
        return CameraDescription("scripted", "1", (4, 3), (8,), ("free",), (0, 1), (0, 1), (1, 10), "test")

    def configure(self, settings: CameraSettings) -> CameraSettings:
        return settings

    def arm(self) -> None:
        self.armed = True

    def disarm(self) -> None:
        self.armed = False

    def trigger(self) -> int | None:
        self.fired += 1
        return self.fired

    def next_frame(self, timeout_s: float) -> Frame | None:
        try:
            item = self.items.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            raise item
        return item

    def close(self) -> None: ...

    def send(self, sequence: int, *, device_ns: int | None = None, incomplete: bool = False, grey: int = 0) -> None:
        status = FrameStatus.INCOMPLETE if incomplete else FrameStatus.OK
        pixels = np.full((3, 4), grey or sequence % 256, np.uint8)
        at = sequence * 1000 + 5 if device_ns is None else device_ns
        self.items.put(Frame(pixels, 8, sequence, at, time.monotonic_ns(), status))


def started(grabber: ScriptedGrabber, **options: object) -> CameraReader:
    reader = CameraReader(
        grabber,
        name="cam1",
        **{"period_s": 60.0, "expects_frames": True, **options},  # type: ignore[arg-type]
    )
    reader.start()
    return reader


def wait_until(condition: Callable[[], bool], seconds: float = 5.0) -> None:
    deadline = Deadline(seconds)
    while not condition():
        assert deadline.left, "waited in vain"
        time.sleep(0.002)


def taken(reader: CameraReader, count: int) -> list[int]:
    frames = [reader.take(2.0) for _ in range(count)]
    return [frame.sequence for frame in frames if frame is not None]


def test_numbers_are_unwrapped_and_gaps_repeats_and_late_frames_counted() -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber)
    for sequence in (65534, 65535, 65535, 2, 0, 3):  # a repeat, a gap of 0 and 1 across the wrap, then 0 late
        grabber.send(sequence)
    assert taken(reader, 4) == [65534, 65535, 65538, 65539]
    wait_until(lambda: reader.counters.out_of_order == 1)
    count = reader.counters
    assert (count.delivered, count.dropped, count.duplicates, count.out_of_order) == (4, 2, 1, 1)
    assert count.delivered + count.overrun + count.dropped + count.incomplete == 65539 - 65534 + 1
    reader.stop()
    assert not grabber.armed


def test_a_counter_without_zero_is_read_as_told() -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber, sequence=SequenceReader(first=1))
    for sequence in (65535, 1):
        grabber.send(sequence)
    assert taken(reader, 2) == [65535, 65536]
    assert reader.counters.dropped == 0
    reader.stop()


@pytest.mark.fault(63)
@pytest.mark.parametrize("stamps", [(5, 7, 9), (0, 0, 0)])
def test_frames_of_a_driver_that_neither_counts_nor_stamps_are_counted_here(stamps: tuple[int, ...]) -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber)
    for stamp in stamps:
        grabber.send(0, device_ns=stamp, grey=stamp + 1)
    assert taken(reader, 3) == [0, 1, 2]
    assert reader.counters.duplicates == 0
    assert ("timestamp" in reader.notes, "frame_counter" in reader.notes) == (stamps[0] == 0, True)
    reader.stop()


def test_an_incomplete_frame_is_counted_and_never_delivered() -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber)
    grabber.send(0)
    grabber.send(1, incomplete=True)
    grabber.send(2)
    assert taken(reader, 2) == [0, 2]
    assert reader.counters.incomplete == 1
    assert reader.take(0.05) is None
    reader.stop()


def test_a_stale_buffer_is_refused_by_number_by_device_time_and_by_its_pixels() -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber, compare_pixels=True)
    grabber.send(0, grey=10)
    grabber.send(0, grey=10)  # the same number again
    grabber.send(1, device_ns=5, grey=11)  # a new number on the old exposure
    grabber.send(2, grey=10)  # new number, new time, old picture
    grabber.send(3, grey=12)
    assert taken(reader, 2) == [0, 3]
    assert reader.counters.duplicates == 3
    assert reader.counters.dropped == 2
    reader.stop()


def test_a_slow_consumer_loses_the_oldest_and_it_is_counted() -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber, buffer_frames=3)
    for sequence in range(10):
        grabber.send(sequence)
    wait_until(lambda: reader.counters.overrun == 7)
    assert taken(reader, 3) == [7, 8, 9]
    assert reader.counters.delivered == 3
    reader.stop()


def test_a_camera_that_says_it_is_gone_is_a_fault_for_every_caller() -> None:
    grabber = ScriptedGrabber()
    faults: list[CameraError] = []
    reader = started(grabber, on_fault=faults.append)
    grabber.send(0)
    grabber.items.put(CameraError("The cable is out.", code="camera_lost"))
    assert taken(reader, 1) == [0]  # what arrived before is not lost
    for call in (lambda: reader.take(2.0), reader.trigger):
        with pytest.raises(CameraError, match="cable") as caught:
            call()
        assert caught.value.code == "camera_lost"
    assert len(faults) == 1
    reader.stop()


def test_an_unforeseen_error_in_a_driver_is_a_fault_too() -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber)
    grabber.items.put(OSError(5, "Input/output error"))
    with pytest.raises(CameraError, match="Input/output error"):
        reader.take(2.0)
    reader.stop()


def test_silence_in_free_run_is_noticed_after_three_periods() -> None:
    grabber = ScriptedGrabber()
    faults: list[CameraError] = []
    reader = started(grabber, period_s=0.1, on_fault=faults.append)
    start = time.monotonic()
    for sequence in range(3):
        grabber.send(sequence)
    assert taken(reader, 3) == [0, 1, 2]
    with pytest.raises(CameraError, match="silent") as caught:
        reader.take(5.0)
    assert caught.value.code == "camera_lost"
    assert 0.29 < time.monotonic() - start < 1.0 * busy()
    assert len(faults) == 1
    reader.stop()


class HeldUpGrabber(ScriptedGrabber):
    """Returns much later than asked, as on a host that stopped the process; its frame comes right after."""

    def next_frame(self, timeout_s: float) -> Frame | None:
        if self.items.empty() and not self.fired:
            self.fired = 1
            time.sleep(1.0)
            return None
        return super().next_frame(timeout_s)


def test_a_host_that_held_the_reader_up_is_no_silence_of_the_camera() -> None:
    grabber = HeldUpGrabber()
    reader = started(grabber, period_s=0.05)
    wait_until(lambda: grabber.fired == 1)
    time.sleep(1.0)
    grabber.send(1)
    assert taken(reader, 1) == [1]
    assert reader.fault is None
    reader.stop()


def test_under_software_triggers_the_watchdog_waits_for_a_trigger() -> None:
    grabber = ScriptedGrabber()
    reader = started(grabber, period_s=0.05, expects_frames=False)
    assert reader.take(0.3) is None
    assert reader.fault is None
    reader.trigger()
    grabber.send(0)
    assert taken(reader, 1) == [0]
    assert reader.take(0.3) is None
    assert reader.fault is None
    reader.trigger()
    wait_until(lambda: reader.fault is not None, 2.0)
    reader.stop()


def test_stopping_ends_a_wait_and_the_simulated_camera_works_behind_it() -> None:
    class Dark:
        def expose(self, cam: str, *, exposure_ms: float, gain_db: float, rng: np.random.Generator) -> np.ndarray:
            return rng.integers(0, 255, size=(8, 8)).astype(np.uint8)

    camera = SimFrameGrabber(Dark(), "cam1", image_size_px=(8, 8), bit_depth=8, first_sequence=65534, latency_s=0.0)
    camera.open()
    camera.faults.drop = 1
    reader = CameraReader(camera, name="cam1", period_s=1.0, expects_frames=False)
    reader.start()
    for _ in range(4):
        reader.trigger()
        time.sleep(0.01)
    assert taken(reader, 3) == [65535, 65536, 65537]
    waiter = threading.Thread(target=reader.take, args=(30.0,))
    waiter.start()
    reader.stop()
    waiter.join(2.0)
    assert not waiter.is_alive()
    camera.close()
