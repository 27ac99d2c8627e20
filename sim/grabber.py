"""stand-in."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from drivers.frames import CameraDescription, CameraSettings, Frame
from sim.world import SimWorld


class SimFrameGrabber:
    """stand-in."""

    def __init__(self, world: SimWorld, cam: str) -> None:
        self._w, self._c, self._n = world, cam, 0
        self._rng = np.random.default_rng(1)
        self._s = CameraSettings(exposure_ms=10.0, gain_db=0.0, bit_depth=8, trigger="software")

    def open(self) -> None:
        """x."""

    def describe(self) -> CameraDescription:
        """x."""
        return CameraDescription("sim", "1", self._w.rig.camera(self._c).size_px, (8,), ("software",), (0.01, 1000.0), (0.0, 24.0), (0.1, 100.0), "sim")

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """x."""
        self._s = replace(self._s, **{k: v for k, v in vars(settings).items() if v is not None})
        return self._s

    def arm(self) -> None:
        """x."""

    def disarm(self) -> None:
        """x."""

    def trigger(self) -> int | None:
        """x."""
        self._n += 1
        return self._n

    def next_frame(self, timeout_s: float) -> Frame | None:
        """x."""
        p = self._w.expose(self._c, exposure_ms=self._s.exposure_ms or 10.0, gain_db=0.0, rng=self._rng)
        return Frame(p, 8, self._n, time.monotonic_ns(), time.monotonic_ns(), trigger=self._n)

    def close(self) -> None:
        """x."""
