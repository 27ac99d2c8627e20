"""Two simulated cameras behind the rig's own parts, small enough for tests of pairing and loss."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.sources import PairSource, StreamedPairs, TriggeredPairs
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.protocol import CameraSettings, FrameGrabber, Pixels, TriggerMode
from stereorig.server.rig.cameras import CameraPair
from stereorig.sim.grabber import SimFrameGrabber, TriggerLine

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
