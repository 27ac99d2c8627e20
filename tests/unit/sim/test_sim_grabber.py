"""The simulated cameras keep the grabber protocol, share their trigger and show their faults."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import CameraSettings, FrameGrabber, FrameStatus, Pixels
from stereorig.sim.grabber import SimFrameGrabber, TriggerLine

SIZE = (24, 16)  # width, height


class Corridor:
    """A world whose images encode their camera and its settings."""

    def __init__(self) -> None:
        self.exposures: list[tuple[str, float, float]] = []
        self.lock = threading.Lock()

    def expose(self, cam: str, *, exposure_ms: float, gain_db: float, rng: np.random.Generator | None) -> Pixels:
        assert rng is not None
        with self.lock:
            self.exposures.append((cam, exposure_ms, gain_db))
        image = rng.integers(0, 4000, size=(SIZE[1], SIZE[0])).astype(np.uint16)
        image[0, 0] = int(cam[-1])
        return image


@pytest.fixture
def pair() -> Iterator[tuple[SimFrameGrabber, SimFrameGrabber]]:
    world = Corridor()
    cams = (
        SimFrameGrabber(world, "cam1", image_size_px=SIZE, bit_depth=12),
        SimFrameGrabber(world, "cam2", image_size_px=SIZE, bit_depth=12),
    )
    for cam in cams:
        cam.open()
        cam.arm()
    yield cams
    for cam in cams:
        cam.close()


def test_it_is_a_grabber_and_describes_itself(pair: tuple[SimFrameGrabber, SimFrameGrabber]) -> None:
    assert isinstance(pair[0], FrameGrabber)
    description = pair[0].describe()
    assert description.image_size_px == SIZE
    assert description.serial != pair[1].describe().serial


def test_one_pulse_exposes_both_cameras_at_the_same_instant(pair: tuple[SimFrameGrabber, SimFrameGrabber]) -> None:
    for _ in range(5):
        numbers = [pair[0].trigger()]
        time.sleep(0.02)  # the second call comes late, the pulse is the same
        numbers.append(pair[1].trigger())
        frames = [cam.next_frame(2.0) for cam in pair]
        assert frames[0] is not None
        assert frames[1] is not None
        assert [frames[0].trigger, frames[1].trigger] == numbers
        assert numbers[0] == numbers[1]
        assert frames[0].device_ns == frames[1].device_ns
        assert [int(frame.pixels[0, 0]) for frame in frames if frame] == [1, 2]
    assert frames[0].sequence == 4
    assert not np.array_equal(frames[0].pixels, frames[1].pixels)


def test_a_camera_triggered_alone_does_not_pull_the_other_to_an_old_pulse(
    pair: tuple[SimFrameGrabber, SimFrameGrabber],
) -> None:
    for _ in range(3):
        pair[0].trigger()
    first, second = pair[0].trigger(), pair[1].trigger()
    assert first == second


def test_a_second_call_seconds_late_joins_the_pulse_and_the_first_camera_joins_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line, now = TriggerLine(), [0]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])
    first = line.fire("cam1")
    now[0] = 3 * 10**9  # as on a machine that stopped the process
    assert line.fire("cam2") == first
    alone = line.fire("cam2")
    assert alone.at_ns == now[0]
    now[0] = 4 * 10**9
    second = line.fire("cam1")
    assert (second.at_ns, line.fire("cam2")) == (now[0], second)
    now[0] = 20 * 10**9
    assert line.fire("cam2").at_ns == now[0]


def test_settings_come_back_as_taken_and_bad_ones_change_nothing(pair: tuple[SimFrameGrabber, SimFrameGrabber]) -> None:
    cam = pair[0]
    taken = cam.configure(CameraSettings(exposure_ms=4.0, gain_db=6.0))
    assert (taken.exposure_ms, taken.gain_db, taken.bit_depth) == (4.0, 6.0, 12)
    for bad in (
        CameraSettings(gain_db=3.0, exposure_ms=1e9),
        CameraSettings(exposure_ms=math.nan),
        CameraSettings(gain_db=-1.0),
        CameraSettings(bit_depth=8),
        CameraSettings(trigger="by hand"),  # type: ignore[arg-type]
        CameraSettings(region_px=(20, 0, 8, 8)),
    ):
        with pytest.raises(CameraError) as caught:
            cam.configure(bad)
        assert caught.value.code == "out_of_range"
    assert cam.configure(CameraSettings()) == taken
    cam.trigger()
    assert cam.next_frame(2.0) is not None
    assert cam._world.exposures[-1] == ("cam1", 4.0, 6.0)  # type: ignore[attr-defined]


def test_free_run_delivers_at_its_rate_until_disarmed(pair: tuple[SimFrameGrabber, SimFrameGrabber]) -> None:
    cam = pair[0]
    cam.configure(CameraSettings(trigger="free", frame_rate_hz=50.0))
    cam.disarm()
    cam.arm()
    frames = [cam.next_frame(2.0) for _ in range(12)]
    assert [frame.sequence for frame in frames if frame] == list(range(12))
    gaps = np.diff([frame.device_ns for frame in frames if frame]) / 1e6
    assert np.median(gaps) > 10.0  # of 20: on a busy machine one comes late, and the next after it in time
    with pytest.raises(CameraError) as caught:
        cam.trigger()
    assert caught.value.code == "wrong_trigger"
    cam.disarm()
    while cam.next_frame(0.0) is not None:
        pass
    assert cam.next_frame(0.1) is None


def test_a_dropped_frame_leaves_a_gap_in_the_numbers(pair: tuple[SimFrameGrabber, SimFrameGrabber]) -> None:
    cam = pair[0]
    cam.faults.drop = 1
    cam.trigger()
    cam.trigger()
    frame = cam.next_frame(2.0)
    assert frame is not None
    assert frame.sequence == 1


def test_an_incomplete_frame_says_so_and_a_duplicate_comes_twice(pair: tuple[SimFrameGrabber, SimFrameGrabber]) -> None:
    cam = pair[0]
    cam.faults.incomplete = 1
    cam.trigger()
    frame = cam.next_frame(2.0)
    assert frame is not None
    assert frame.status is FrameStatus.INCOMPLETE
    cam.faults.duplicate = 1
    cam.trigger()
    first, second = cam.next_frame(2.0), cam.next_frame(2.0)
    assert first is not None
    assert second is not None
    assert first.sequence == second.sequence
    assert first.status is FrameStatus.OK


def test_silence_is_a_timeout_and_a_gone_camera_an_error(pair: tuple[SimFrameGrabber, SimFrameGrabber]) -> None:
    cam = pair[0]
    cam.faults.silent = True
    cam.trigger()
    assert cam.next_frame(0.1) is None
    cam.faults.gone = True
    for call in (lambda: cam.next_frame(0.1), cam.trigger, cam.open, cam.describe):
        with pytest.raises(CameraError) as caught:
            call()
        assert caught.value.code == "camera_lost"
    cam.faults.gone = cam.faults.silent = False
    cam.close()
    cam.open()
    cam.arm()
    cam.trigger()
    assert cam.next_frame(2.0) is not None


def test_a_busy_camera_is_named_so() -> None:
    cam = SimFrameGrabber(Corridor(), "cam1", image_size_px=SIZE, bit_depth=12)
    cam.faults.busy = True
    with pytest.raises(CameraError) as caught:
        cam.open()
    assert caught.value.code == "camera_busy"


def test_the_same_seed_makes_the_same_noise() -> None:
    images = []
    for _ in range(2):
        cam = SimFrameGrabber(Corridor(), "cam2", image_size_px=SIZE, bit_depth=12, seed=7)
        cam.open()
        cam.arm()
        cam.trigger()
        frame = cam.next_frame(2.0)
        cam.close()
        assert frame is not None
        images.append(frame.pixels)
    assert np.array_equal(*images)


def test_an_error_while_making_the_image_reaches_who_waits_for_it() -> None:
    class Broken:
        def expose(self, cam: str, *, exposure_ms: float, gain_db: float, rng: object) -> Pixels:
            raise RuntimeError("no light")

    cam = SimFrameGrabber(Broken(), "cam1", image_size_px=SIZE, bit_depth=12)
    cam.open()
    cam.arm()
    cam.trigger()
    with pytest.raises(CameraError, match="no light"):
        cam.next_frame(2.0)
    cam.close()
