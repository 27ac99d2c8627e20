"""Both cameras together: synchronised captures, averages, live frames.

Cameras wait for software triggers. A capture fires both and takes the frames that carry those trigger numbers. Live
views use the same way when nobody captures, and otherwise show what the captures brought: recording comes first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from core.errors import CameraError, StateError
from drivers.frames import CameraDescription, CameraSettings, Frame, FrameCounters, FrameGrabber, FrameStatus, Pixels

Cam = Literal["cam1", "cam2"]
CAMERAS: tuple[Cam, Cam] = ("cam1", "cam2")
_STALE_DURING_CAPTURE_S = 0.5


@dataclass(frozen=True, eq=False)
class PairShot:
    """One captured pair, averaged over ``frames`` exposures.

    Attributes
    ----------
    pixels
        Camera name -> (rows, cols) uint8 or uint16; an average is rounded to 16 bit with ``scale`` counts a grey level.
    scale
        What one grey level of the camera became in ``pixels`` (1 for a single frame).
    skew_ms
        Largest difference of the two exposures' beginnings.
    """

    pixels: dict[str, Pixels]
    bit_depth: dict[str, int]
    sequence: dict[str, int]
    frames: int
    scale: int
    skew_ms: float
    host_ns: int


@dataclass(eq=False)
class CameraUnit:
    """One opened camera."""

    name: Cam
    grabber: FrameGrabber
    timeout_s: float = 3.0
    description: CameraDescription = field(init=False)
    settings: CameraSettings = field(init=False)
    latest: Frame | None = None
    delivered: int = 0
    incomplete: int = 0
    timeouts: int = 0

    def open(self, settings: CameraSettings) -> None:
        """Connect, push settings, arm for software triggers."""
        self.grabber.open()
        self.description = self.grabber.describe()
        self.timeout_s += self.description.latency_s
        self.settings = self.grabber.configure(settings)
        self.grabber.arm()

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change settings; the camera is armed again afterwards, whatever happens."""
        self.grabber.disarm()
        try:
            self.settings = self.grabber.configure(settings)
        finally:
            self.grabber.arm()
        return self.settings

    def wait_for(self, trigger: int | None) -> Frame:
        """Return the complete frame of ``trigger``; older ones are thrown away.

        Raises
        ------
        CameraError
            ``camera_silent`` if none came in time, ``frame_incomplete`` if it came damaged.
        """
        deadline = time.monotonic() + self.timeout_s
        while (left := deadline - time.monotonic()) > 0.0:
            frame = self.grabber.next_frame(left)
            if frame is None:
                break
            if trigger is not None and frame.trigger is not None and frame.trigger != trigger:
                continue
            if frame.status is not FrameStatus.OK:
                self.incomplete += 1
                raise CameraError(f"{self.name} delivered an incomplete frame.", code="frame_incomplete",
                                  remedy="Capture again; check cable and packet size if it comes back.")  # fmt: skip
            self.delivered += 1
            self.latest = frame
            return frame
        self.timeouts += 1
        raise CameraError(f"{self.name} sent no frame in {self.timeout_s:g} s after its trigger.", code="camera_silent",
                          remedy="Check power and cable, then POST /rig/reconnect.", camera=self.name)  # fmt: skip

    def counters(self) -> dict[str, int]:
        """What became of the frames."""
        own = FrameCounters(delivered=self.delivered, incomplete=self.incomplete).as_dict()
        return {**own, "timeouts": self.timeouts}


class CameraPair:
    """Camera 1 and camera 2 with one trigger."""

    def __init__(self, cam1: CameraUnit, cam2: CameraUnit) -> None:
        self.units: dict[Cam, CameraUnit] = {"cam1": cam1, "cam2": cam2}
        self._lock = threading.Lock()
        self._capturing = threading.Event()

    def _grab(self) -> tuple[Frame, Frame]:
        a, b = self.units["cam1"], self.units["cam2"]
        number1, number2 = a.grabber.trigger(), b.grabber.trigger()
        return a.wait_for(number1), b.wait_for(number2)

    def shoot(self, frames: int, *, max_skew_ms: float, check: Callable[[], None] | None = None) -> PairShot:
        """Capture ``frames`` pairs and average each camera's.

        Raises
        ------
        StateError
            ``skew_too_large`` if the exposures of a pair began too far apart.
        """
        self._capturing.set()
        try:
            with self._lock:
                return self._shoot(frames, max_skew_ms, check)
        finally:
            self._capturing.clear()

    def _shoot(self, frames: int, max_skew_ms: float, check: Callable[[], None] | None) -> PairShot:
        sums: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.uint32]]] = {}
        worst = 0.0
        for index in range(frames):
            if check is not None:
                check()
            one, two = self._grab()
            skew = abs(one.device_ns - two.device_ns) / 1e6
            worst = max(worst, skew)
            if skew > max_skew_ms:
                raise StateError(
                    f"The exposures began {skew:.3f} ms apart, the rig allows {max_skew_ms:g} ms.",
                    code="skew_too_large",
                    remedy="Use a common trigger, or raise max_skew_ms for a static scene.",
                    skew_ms=skew,
                    max_skew_ms=max_skew_ms,
                )
            if frames > 1:
                for cam, frame in (("cam1", one), ("cam2", two)):
                    if index == 0:
                        sums[cam] = np.zeros(frame.pixels.shape, dtype=np.uint32)
                    sums[cam] += frame.pixels
        pixels: dict[str, Pixels] = {"cam1": one.pixels, "cam2": two.pixels}
        scale = 1
        if frames > 1:
            # keep the average's fraction: a mean of 8 bit frames knows more than 8 bits
            scale = 2 ** (16 - max(one.bit_depth, two.bit_depth))
            pixels = {
                cam: np.clip(np.round(s * (scale / frames)), 0, 65535).astype(np.uint16) for cam, s in sums.items()
            }
        return PairShot(
            pixels,
            {"cam1": one.bit_depth, "cam2": two.bit_depth},
            {"cam1": one.sequence, "cam2": two.sequence},
            frames,
            scale,
            worst,
            one.host_ns,
        )

    def live(self, cam: Cam, max_age_s: float) -> Frame:
        """Return a frame for looking at, at most ``max_age_s`` old where recording allows it."""
        unit = self.units[cam]
        frame = unit.latest
        age = float("inf") if frame is None else time.monotonic() - frame.host_ns / 1e9
        limit = max(max_age_s, _STALE_DURING_CAPTURE_S) if self._capturing.is_set() else max_age_s
        if frame is not None and age <= limit:
            return frame
        if not self._lock.acquire(timeout=0.5 if frame is None else 0.05):
            if frame is not None:
                return frame
            raise StateError("The cameras are capturing and have no live frame yet.", code="camera_busy")
        try:
            self._grab()
        finally:
            self._lock.release()
        assert unit.latest is not None
        return unit.latest

    def configure(self, cam: Cam, settings: CameraSettings) -> CameraSettings:
        """Change one camera's settings between captures."""
        with self._lock:
            return self.units[cam].configure(settings)

    def close(self) -> None:
        """Release both cameras."""
        for unit in self.units.values():
            unit.grabber.close()
