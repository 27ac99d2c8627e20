"""Both cameras together: synchronised captures, averages, live frames.

Cameras wait for software triggers. A capture fires both and takes the frames that carry those trigger numbers. Live
views use the same way when nobody captures, and otherwise show what the captures brought: recording comes first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.errors import CameraError, StateError
from drivers.frames import CameraDescription, CameraSettings, Frame, FrameCounters, FrameGrabber, Pixels
from drivers.pairing import NumberPairing, Pair, PairingAccount
from drivers.reader import CameraReader

Cam = Literal["cam1", "cam2"]
CAMERAS: tuple[Cam, Cam] = ("cam1", "cam2")
_SLICE_S = 0.1
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


class CameraUnit:
    """One camera: its grabber, its reader thread, the settings it has."""

    def __init__(self, name: Cam, grabber: FrameGrabber) -> None:
        self.name = name
        self.grabber = grabber
        self.latest: Frame | None = None
        self._reader: CameraReader | None = None
        self._earlier = FrameCounters()

    def open(self, settings: CameraSettings) -> None:
        """Connect, push settings, arm for software triggers."""
        self.grabber.open()
        self.description: CameraDescription = self.grabber.describe()
        self.settings: CameraSettings = self.grabber.configure(settings)
        self._start()

    def _start(self) -> None:
        # from a trigger to its frame: the exposure, and a generous read-out
        period_s = (self.settings.exposure_ms or 0.0) / 1000.0 + 0.2
        self._reader = CameraReader(self.grabber, name=self.name, period_s=period_s, expects_frames=False)
        self._reader.start()

    def _stop(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.stop()
            new, old = reader.counters.as_dict(), self._earlier.as_dict()
            self._earlier = FrameCounters(**{name: old[name] + n for name, n in new.items()})

    @property
    def reader(self) -> CameraReader:
        """The running reader."""
        if self._reader is None:
            raise CameraError(f"{self.name} is not armed.", code="camera_lost", remedy="POST /rig/reconnect.")
        return self._reader

    @property
    def fault(self) -> CameraError | None:
        """Why the camera was lost, or None."""
        return None if self._reader is None else self._reader.fault

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change settings; the camera is armed again afterwards, whatever happens."""
        self._stop()
        try:
            self.settings = self.grabber.configure(settings)
        finally:
            self._start()
        return self.settings

    def counters(self) -> dict[str, int]:
        """What became of the frames since the camera was opened."""
        now = FrameCounters() if self._reader is None else self._reader.counters
        old = self._earlier.as_dict()
        return {name: old[name] + n for name, n in now.as_dict().items()}

    def close(self) -> None:
        """End the reader, release the camera."""
        self._stop()
        self.grabber.close()


class CameraPair:
    """Camera 1 and camera 2 with one trigger."""

    def __init__(self, cam1: CameraUnit, cam2: CameraUnit, *, max_skew_ms: float) -> None:
        self.units: dict[Cam, CameraUnit] = {"cam1": cam1, "cam2": cam2}
        self._max_skew_ms = max_skew_ms
        self._pairing: NumberPairing | None = None
        self._lock = threading.Lock()
        self._capturing = threading.Event()

    def account(self) -> dict[str, int]:
        """What became of every trigger."""
        return PairingAccount().as_dict() if self._pairing is None else self._pairing.account.as_dict()

    def _grab(self) -> Pair:
        numbers = {cam: self.units[cam].reader.trigger() or 0 for cam in CAMERAS}
        if self._pairing is None:
            # all cameras hang on one trigger line, whose clock the simulated ones share
            self._pairing = NumberPairing(
                by="trigger", max_skew_ms=self._max_skew_ms, common_clock=True, origin=dict(numbers)
            )
        made: Pair | None = None
        for cam in CAMERAS:
            made = self._pairing.feed(cam, self._frame_of(cam, numbers[cam], self._pairing)) or made
        if made is None:
            raise CameraError(
                f"The frames of trigger {numbers['cam1']} make no pair.",
                code="pair_incomplete",
                remedy="Capture again; POST /rig/reconnect if it comes back.",
            )
        return made

    def _frame_of(self, cam: Cam, number: int, pairing: NumberPairing) -> Frame:
        """Wait for a camera's frame of one trigger; what still comes of earlier ones goes into the account."""
        unit = self.units[cam]
        damaged = unit.counters()["incomplete"]
        while True:
            frame = unit.reader.take(_SLICE_S)  # raises when the watchdog gives the camera up
            if frame is None:
                if unit.counters()["incomplete"] > damaged:
                    raise CameraError(
                        f"{cam} delivered an incomplete frame.",
                        code="frame_incomplete",
                        remedy="Capture again; check cable and packet size if it comes back.",
                        camera=cam,
                    )
                continue
            unit.latest = frame
            if frame.trigger is None or frame.trigger == number:
                return frame
            pairing.feed(cam, frame)

    def shoot(self, frames: int, check: Callable[[], None] | None = None) -> PairShot:
        """Capture ``frames`` pairs and average each camera's; ``check`` may raise between them.

        Raises
        ------
        CameraError
            ``skew_too_large`` if the exposures of a pair began too far apart, or what the cameras bring up.
        """
        self._capturing.set()
        try:
            with self._lock:
                return self._shoot(frames, check)
        finally:
            self._capturing.clear()

    def _shoot(self, frames: int, check: Callable[[], None] | None) -> PairShot:
        sums: dict[str, NDArray[np.uint32]] = {}
        worst = 0.0
        for index in range(frames):
            if check is not None:
                check()
            pair = self._grab().require()
            one, two = pair.cam1, pair.cam2
            worst = max(worst, abs(pair.skew_ms))
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
            unit.close()
