"""How the rig takes pairs in each trigger mode, and what it does when frames or cameras get lost."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.sources import PairSource, StreamedPairs, TriggeredPairs
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.protocol import CameraSettings, FrameGrabber, Pixels, TriggerMode
from stereorig.server.rig.cameras import CameraPair
from stereorig.server.rig.reconnect import ReconnectWatch
from stereorig.sim.grabber import SimFrameGrabber, TriggerLine
from tests.support.camera_bench import seconds_until
from tests.support.patience import busy


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a camera be silent for long: on a busy machine the pulse generator of the bench is late."""
    monkeypatch.setattr("stereorig.drivers.acquisition.reader._MIN_PATIENCE_S", 10.0)


def balanced(account: dict[str, int]) -> bool:
    return account["triggered"] == sum(account[name] for name in ("paired", "unpaired", "incomplete", "dropped"))


@pytest.mark.parametrize(("trigger", "rate_hz"), [("software", None), ("free", 25.0)])
def test_a_capture_averages_whole_pairs(trigger: str, rate_hz: float | None) -> None:
    with rig_bench(trigger, rate_hz=rate_hz, max_skew_ms=25.0) as bench:  # type: ignore[arg-type]
        shot = bench.pair.capture(4)
        assert shot.frames == 4
        assert shot.pixels["cam1"].dtype == np.uint16
        assert shot.pixels["cam2"].shape == (SIZE[1], SIZE[0])
        assert shot.skew_ms <= 25.0
        assert bench.pair.account()["paired"] >= 4


def test_in_free_run_a_capture_begins_after_it_was_asked_for() -> None:
    with rig_bench("free", rate_hz=25.0, max_skew_ms=25.0) as bench:
        bench.pair.capture(1)
        for _ in range(3):
            asked = time.monotonic_ns()
            shot = bench.pair.capture(1)
            assert shot.host_ns > asked + 1e9 / 25.0


@pytest.mark.fault(13)
@pytest.mark.parametrize("cam", ["cam1", "cam2"])
def test_a_dropped_frame_under_software_triggers_is_asked_for_again_and_counted(cam: str) -> None:
    with rig_bench() as bench:
        bench.pair.capture(1)
        bench.line.faults_of(cam).drop = 1
        shot = bench.pair.capture(1)
        assert shot.skew_ms == 0.0
        assert bench.pair.capture(2).skew_ms == 0.0
        bench.pair.close()
        account = bench.pair.account()
        assert balanced(account)
        assert (account["triggered"], account["paired"], account["unpaired"]) == (5, 4, 1)
        assert not bench.lost


@pytest.mark.fault(13)
def test_a_trigger_that_neither_camera_answered_is_dropped() -> None:
    with rig_bench() as bench:
        bench.pair.capture(1)
        bench.line.faults_of("cam1").drop = bench.line.faults_of("cam2").drop = 1
        bench.pair.capture(1)
        bench.pair.close()
        account = bench.pair.account()
        assert balanced(account)
        assert (account["triggered"], account["paired"], account["dropped"]) == (3, 2, 1)


@pytest.mark.fault(13)
@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("by", ["time", "frame"])
def test_a_dropped_frame_on_a_pulse_line_leaves_its_partner_unpaired(by: str) -> None:
    with rig_bench("hardware", rate_hz=25.0, by=by, max_skew_ms=1.0) as bench, bench.pulses(25.0):
        bench.pair.capture(3)
        bench.line.faults_of("cam2").drop = 1
        assert bench.pair.capture(8).skew_ms == 0.0
        bench.pair.close()
        account = bench.pair.account()
        assert balanced(account)
        assert account["unpaired"] >= 1
        assert account["refused"] == 0


@pytest.mark.fault(13)
@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("by", ["time", "frame"])
def test_a_camera_that_missed_a_pulse_never_gives_a_pair_of_two_pulses(by: str) -> None:
    # a pulse that the camera did not see is no gap in its count: by number alone every later pair would be wrong
    with rig_bench("hardware", rate_hz=25.0, by=by, max_skew_ms=1000.0) as bench:
        with bench.pulses(25.0):
            bench.pair.capture(3)
        bench.line.pulse(missed_by="cam2")
        with bench.pulses(25.0):
            for _ in range(6):
                assert bench.pair.capture(1).skew_ms == 0.0
        bench.pair.close()
        account = bench.pair.account()
        assert balanced(account)
        assert account["slips"] == (by == "frame")


def test_pulses_that_come_when_they_like_are_waited_for() -> None:
    with rig_bench("hardware", capture_timeout_s=5.0) as bench:
        time.sleep(0.5)
        assert not bench.away  # silence means nothing here
        timer = threading.Timer(0.3, bench.line.pulse)
        timer.start()
        shot = bench.pair.capture(1)
        assert shot.skew_ms == 0.0
        timer.join()


def test_a_pulse_that_never_comes_is_named() -> None:
    with rig_bench("hardware", capture_timeout_s=0.3) as bench:
        with pytest.raises(CameraError) as caught:
            bench.pair.capture(1)
        assert caught.value.code == "no_frames"


@pytest.mark.fault(16)
def test_a_skew_that_moves_the_image_too_far_is_refused_with_both_figures() -> None:
    with rig_bench(speed_px_s=20.0, skew_is_set=False) as bench:
        bench.line.faults_of("cam2").skew_ms = 2.0  # below the 5 ms of the rig, but 0.04 px
        with pytest.raises(CameraError) as caught:
            bench.pair.capture(4)
        assert caught.value.code == "skew_too_large"
        assert caught.value.context["skew_ms"] == pytest.approx(2.0)
        assert caught.value.context["image_speed_px_s"] == pytest.approx(20.0, rel=0.25)
        bench.world.speed_px_s = 0.0
        bench.pair.capture(4)
    with rig_bench(speed_px_s=20.0, skew_is_set=True) as bench:
        bench.line.faults_of("cam2").skew_ms = 2.0
        assert bench.pair.capture(4).image_speed_px_s == pytest.approx(20.0, rel=0.25)


def shoot_on(pair: CameraPair) -> None:
    while True:
        pair.capture(1)


@pytest.mark.fault(11)
@pytest.mark.fault(12)
@pytest.mark.parametrize("how", ["gone", "silent"])
@pytest.mark.parametrize(("trigger", "rate_hz"), [("software", None), ("free", 25.0)])
def test_a_lost_camera_comes_back_with_its_settings(trigger: str, rate_hz: float | None, how: str) -> None:
    back: list[str] = []
    with rig_bench(trigger, rate_hz=rate_hz, max_skew_ms=50.0) as bench:  # type: ignore[arg-type]
        watch = ReconnectWatch(bench.pair, back.append)
        watch.start()
        try:
            bench.pair.configure("cam2", CameraSettings(exposure_ms=7.0, gain_db=3.0))
            bench.pair.capture(1)
            setattr(bench.line.faults_of("cam2"), how, True)
            began = time.monotonic()
            with pytest.raises(CameraError) as caught:
                shoot_on(bench.pair)
            assert caught.value.code == "camera_lost"
            assert time.monotonic() - began < 1.0 * busy()
            seconds_until(lambda: bool(bench.lost), 1.0)
            assert {cam for cam, _ in bench.lost} == {"cam2"}
            time.sleep(0.6)
            if how == "gone":
                assert not back
            bench.line.faults_of("cam2").gone = bench.line.faults_of("cam2").silent = False
            returned = time.monotonic()
            shot = None
            while shot is None:  # one that was opened again while still silent is lost once more before it is back
                seconds_until(lambda: not bench.away, 3.0)
                with contextlib.suppress(CameraError) if how == "silent" else contextlib.nullcontext():
                    shot = bench.pair.capture(1)
                assert time.monotonic() - returned < 3.0 * busy()
            assert set(shot.pixels) == {"cam1", "cam2"}
            settings = bench.units["cam2"].settings
            assert (settings.exposure_ms, settings.gain_db) == (7.0, 3.0)
            assert bench.units["cam2"].reconnections >= 1
            assert back[-1] == "cam2"
            assert balanced(bench.pair.account())
        finally:
            watch.stop()


@pytest.mark.fault(11)
def test_a_camera_that_comes_back_without_its_settings_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    with rig_bench() as bench:
        bench.pair.configure("cam2", CameraSettings(gain_db=6.0))
        make = bench.grabber

        def forgetful(cam: str):  # type: ignore[no-untyped-def]
            grabber = make(cam)  # type: ignore[arg-type]
            take = grabber.configure
            monkeypatch.setattr(
                grabber, "configure", lambda settings: take(CameraSettings(trigger=settings.trigger)), raising=False
            )
            return grabber

        bench.line.faults_of("cam2").gone = True
        seconds_until(lambda: bool(bench.away), 1.0)
        bench.line.faults_of("cam2").gone = False
        bench.units["cam2"]._make = lambda: forgetful("cam2")
        with pytest.raises(CameraError) as caught:
            bench.pair.reopen("cam2")
        assert caught.value.code == "settings_not_restored"
        assert "gain_db was 6.0" in caught.value.cause
        with pytest.raises(CameraError):
            bench.pair.capture(1)


@pytest.mark.fault(17)
def test_another_camera_than_the_expected_is_refused() -> None:
    with pytest.raises(CameraError) as caught, rig_bench(serial="4711"):
        pass
    assert caught.value.code == "wrong_camera"
    assert "4711" in caught.value.cause
    with rig_bench() as bench:
        bench.units["cam1"]._size_px = (640, 480)
        with pytest.raises(CameraError) as caught:
            bench.units["cam1"].reconnect()
        assert caught.value.code == "image_size_mismatch"


# Two simulated cameras behind the rig's own parts, small enough for tests of pairing and loss.

SIZE = (64, 48)


class MovingWorld:
    """A textured wall that moves at a known speed; noise makes every frame its own.

    It stands where it is at the newest pulse of the trigger line: a busy machine exposes later than a frame is stamped.
    """

    def __init__(self, line: TriggerLine, speed_px_s: float = 0.0) -> None:
        self.speed_px_s = speed_px_s
        self._line, self._began_ns = line, time.monotonic_ns()
        # a sum of waves can be shifted by any fraction of a pixel without an interpolator
        rng = np.random.default_rng(7)
        waves = np.array([(*rng.uniform(-1.2, 1.2, 2), rng.uniform(0, 2 * np.pi)) for _ in range(60)])
        self._across, down, self._phase = waves.T[..., np.newaxis]
        self._down = np.exp(1j * down * np.arange(SIZE[1]))

    def expose(self, cam: CameraName, *, exposure_ms: float, gain_db: float, rng: np.random.Generator | None) -> Pixels:
        assert rng is not None
        x = np.arange(SIZE[0]) - self.speed_px_s * (self._line.newest.at_ns - self._began_ns) / 1e9
        waves = self._down.T @ np.exp(1j * (self._across * x + self._phase))  # each wave is a product of its directions
        image = waves.imag * 15.0 + 128.0
        return np.clip(image + rng.normal(0, 1.0, image.shape), 0, 255).astype(np.uint8)


class Bench:
    """Units, a pair and the trigger line between the cameras."""

    def __init__(
        self,
        trigger: TriggerMode = "software",
        *,
        rate_hz: float | None = None,
        by: str = "time",
        max_skew_ms: float = 5.0,
        skew_is_set: bool = True,
        capture_timeout_s: float = 2.0,
        speed_px_s: float = 0.0,
        latency_s: float = 0.0,
        **unit_options: Any,
    ) -> None:
        self.line = TriggerLine()
        self.world = MovingWorld(self.line, speed_px_s)
        self.latency_s = latency_s
        self.lost: list[tuple[CameraName, CameraError]] = []
        self.units: dict[CameraName, CameraUnit] = {
            cam: CameraUnit(
                cam,
                partial(self.grabber, cam),
                trigger=trigger,
                rate_hz=rate_hz,
                size_px=SIZE,
                on_lost=lambda name, error: self.lost.append((name, error)),
                **unit_options,
            )
            for cam in CAMERAS
        }

        def source() -> PairSource:
            if trigger == "software":
                return TriggeredPairs(self.units, max_skew_ms=max_skew_ms)
            return StreamedPairs(
                self.units,
                by=by,  # type: ignore[arg-type]
                max_skew_ms=max_skew_ms,
                capture_timeout_s=capture_timeout_s,
            )

        for unit in self.units.values():
            unit.open(CameraSettings(exposure_ms=5.0))
        self.pair = CameraPair(self.units["cam1"], self.units["cam2"], make_source=source, skew_is_set=skew_is_set)
        self.pair.start()

    @property
    def away(self) -> list[CameraName]:
        """Cameras that cannot be used."""
        return [cam for cam, unit in self.units.items() if unit.fault is not None]

    def grabber(self, cam: CameraName) -> FrameGrabber:
        return SimFrameGrabber(
            self.world, cam, image_size_px=SIZE, bit_depth=8, line=self.line, latency_s=self.latency_s
        )

    @contextmanager
    def pulses(self, rate_hz: float) -> Iterator[None]:
        """A pulse generator on the trigger line."""
        ending = threading.Event()

        def run() -> None:
            while not ending.wait(1.0 / rate_hz):
                self.line.pulse()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            thread.join()


@contextmanager
def rig_bench(trigger: TriggerMode = "software", **options: Any) -> Iterator[Bench]:
    """A bench, closed afterwards."""
    bench = Bench(trigger, **options)
    try:
        yield bench
    finally:
        bench.pair.close()
