"""Both cameras together: synchronised captures, averages, live frames, and their return after a loss.

A capture takes the next pairs of the rig's `drivers.acquisition.sources.PairSource`. Live views use the same way when
nothing is captured, and otherwise show what the captures brought: recording comes first.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from core.errors import CameraError, StateError
from core.names import CAMERAS, CameraName
from drivers.acquisition.pairing import Pair, PairingAccount
from drivers.acquisition.sources import PairSource, TriggeredPairs
from drivers.acquisition.unit import CameraUnit
from drivers.cameras.protocol import CameraSettings, Frame, Pixels
from server.config.rig_file import SKEW_PX
from server.rig.image_speed import ImageMotion, image_motion

#: where there is nothing older to show, a live view waits this long behind another one or a capture
_FIRST_FRAME_S = 5.0
_STALE_DURING_CAPTURE_S = 0.5
_BEHIND_CAPTURE_S = 0.002


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """One captured pair, averaged over ``frames`` exposures.

    Attributes
    ----------
    pixels
        Camera name -> (rows, cols) uint8 or uint16; an average is rounded to 16 bit with ``scale`` counts a grey level.
    scale
        Factor on the camera's grey levels in ``pixels`` (1 for a single frame).
    skew_ms
        Largest difference of the two exposures' beginnings.
    image_speed_px_s
        Speed of camera 1's image from the first to the last frame; None for a single frame, or where it cannot
        be known.
    settings
        Exposure (ms) and gain (dB) of each camera, as read back.
    frame_counts
        Counters of each camera's frames during the capture.
    pair_counts
        Counters of the triggers during the capture.
    """

    pixels: dict[str, Pixels]
    bit_depth: dict[str, int]
    sequence: dict[str, int]
    frames: int
    scale: int
    skew_ms: float
    host_ns: int
    image_speed_px_s: float | None = None
    settings: dict[str, dict[str, float | None]] = field(default_factory=dict)
    frame_counts: dict[str, dict[str, int]] = field(default_factory=dict)
    pair_counts: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PairMark:
    """Place of a pair among all that its source made."""

    source: PairSource
    number: int


class _Average:
    """Mean of each camera's frames, pair by pair."""

    def __init__(self, first: Pair) -> None:
        self.first = self.last = first
        self.frames = 1
        self.skew_ms = abs(first.skew_ms)
        self._sums: dict[CameraName, NDArray[np.uint32]] = {}

    def add(self, pair: Pair) -> None:
        """Take one more pair."""
        if not self._sums:
            self._sums = {cam: self.last[cam].pixels.astype(np.uint32) for cam in CAMERAS}
        self.last = pair
        self.frames += 1
        self.skew_ms = max(self.skew_ms, abs(pair.skew_ms))
        for cam in CAMERAS:
            self._sums[cam] += pair[cam].pixels

    @property
    def scale(self) -> int:
        """Factor on a grey level: a mean of 8 bit frames resolves more than 8 bits."""
        return 1 if self.frames == 1 else 2 ** (16 - max(self.last[cam].bit_depth for cam in CAMERAS))

    def pixels(self, cam: CameraName) -> Pixels:
        """Mean of one camera's frames; a single one as it came."""
        if self.frames == 1:
            return self.last[cam].pixels
        return np.clip(np.round(self._sums[cam] * (self.scale / self.frames)), 0, 65535).astype(np.uint16)


class CameraPair:
    """Camera 1 and camera 2 with one source of pairs.

    Parameters
    ----------
    cam1, cam2
        Opened.
    make_source
        Makes the source; called again after anything that arms a camera anew.
    skew_is_set
        True if the rig's skew limit was set by its user. Else a pair whose skew moves the image by more than 0.01 px,
        at the speed that was seen, is refused too.
    """

    def __init__(
        self, cam1: CameraUnit, cam2: CameraUnit, *, make_source: Callable[[], PairSource], skew_is_set: bool = False
    ) -> None:
        self.units: dict[CameraName, CameraUnit] = {"cam1": cam1, "cam2": cam2}
        self._make_source = make_source
        self._skew_is_set = skew_is_set
        self._earlier = PairingAccount()
        self._source = make_source()
        self._lock = threading.Lock()
        self._capturing = threading.Event()

    def start(self) -> None:
        """Begin to take frames."""
        self._source.start()

    def account(self) -> dict[str, int]:
        """Counters of the triggers."""
        now = self._source.account()
        return {f.name: getattr(self._earlier, f.name) + getattr(now, f.name) for f in fields(PairingAccount)}

    def _restart_source(self) -> None:
        source = self._source
        source.stop()
        self._earlier, self._source = PairingAccount(**self.account()), self._make_source()
        self._source.start()

    def capture(self, frames: int = 1, check: Callable[[], None] | None = None) -> CapturedPair:
        """Capture ``frames`` pairs and average each camera's; ``check`` may raise between them.

        Raises
        ------
        CameraError
            ``skew_too_large`` if the exposures of a pair began too far apart, or what the cameras bring up.
        """
        self._capturing.set()
        try:
            with self._lock:
                counts, account = {cam: unit.counters() for cam, unit in self.units.items()}, self.account()
                mean = _Average(self._next_pair(check))
                while mean.frames < frames:
                    mean.add(self._next_pair(check))
                motion = image_motion(mean.first.cam1, mean.last.cam1) if frames > 1 else None
                if not self._skew_is_set and motion is not None:
                    _check_skew(mean.skew_ms, motion)
                last = mean.last
                return CapturedPair(
                    pixels={cam: mean.pixels(cam) for cam in CAMERAS},
                    bit_depth={cam: last[cam].bit_depth for cam in CAMERAS},
                    sequence={cam: last[cam].sequence for cam in CAMERAS},
                    frames=frames,
                    scale=mean.scale,
                    skew_ms=mean.skew_ms,
                    host_ns=last.cam1.host_ns,
                    image_speed_px_s=None if motion is None else motion.speed_px_s,
                    settings={cam: _exposure(unit.settings) for cam, unit in self.units.items()},
                    frame_counts={cam: _grown(unit.counters(), counts[cam]) for cam, unit in self.units.items()},
                    pair_counts=_grown(self.account(), account),
                )
        finally:
            self._capturing.clear()

    def _next_pair(self, check: Callable[[], None] | None) -> Pair:
        if check is not None:
            check()
        return self._source.next_pair(check).require()

    def newest(self, after: PairMark | None, check: Callable[[], None]) -> tuple[PairMark, int, Pair]:
        """Return the newest pair after the one that the caller has, for measuring; wait for one. Captures come first.

        Parameters
        ----------
        after
            Mark of the last pair that it was given; None for the first.
        check
            May raise while it waits.

        Returns
        -------
        tuple
            Its mark, the number of pairs between both that were passed over, and the pair, whatever its skew.

        Raises
        ------
        CameraError
            What the cameras bring up; ``no_frames`` when no pair came in time.
        """
        if self.fires:
            while self._capturing.is_set():
                check()
                time.sleep(_BEHIND_CAPTURE_S)
            with self._lock:
                source = self._source
                _, pair = source.newest(0, check)
            return PairMark(source, 0), 0, pair
        source = self._source  # streams are shared: a capture and this one take the same pairs
        last = after.number if after is not None and after.source is source else None
        number, pair = source.newest(last or 0, check)
        return PairMark(source, number), 0 if last is None else number - last - 1, pair

    @property
    def fires(self) -> bool:
        """True if pairs come when they are asked for alone, by software triggers."""
        return isinstance(self._source, TriggeredPairs)

    def live(self, cam: CameraName, max_age_s: float, after: int | None = None) -> Frame:
        """Return a frame for looking at, at most ``max_age_s`` old where recording allows it.

        ``after`` is the number of the frame that the caller has: it is given another one, unless a capture goes on or
        the camera made none since. Views at the same time share a frame.
        """
        unit = self.units[cam]
        frame = unit.latest
        age = float("inf") if frame is None else time.monotonic() - frame.host_ns / 1e9
        capturing = self._capturing.is_set()
        limit = max(max_age_s, _STALE_DURING_CAPTURE_S) if capturing else max_age_s
        if frame is not None and age <= limit and (capturing or frame.sequence != after):
            return frame
        if not self._lock.acquire(timeout=_FIRST_FRAME_S if frame is None else 0.05):
            if frame is not None:
                return frame
            raise StateError("The cameras are capturing and have no live frame yet.", code="camera_busy")
        try:
            if unit.latest is frame:  # else another view took it meanwhile
                self._source.refresh()
        finally:
            self._lock.release()
        frame = unit.latest
        if frame is None:
            raise CameraError(
                f"{cam} has not delivered a frame yet.",
                code="no_frames",
                remedy="Check that its trigger reaches it.",
                camera=cam,
            )
        return frame

    def configure(self, cam: CameraName, settings: CameraSettings) -> CameraSettings:
        """Change one camera's settings between captures."""
        with self._lock:
            self._source.stop()
            try:
                return self.units[cam].configure(settings)
            finally:
                self._restart_source()

    def lost(self) -> list[CameraName]:
        """Cameras that cannot be used."""
        return [cam for cam in CAMERAS if self.units[cam].fault is not None]

    def reopen(self, cam: CameraName) -> None:
        """Connect a lost camera again, with its settings; raises when that fails."""
        unit = self.units[cam]
        unit.reconnect()
        with self._lock:
            self._source.stop()
            unit.resume()
            self._restart_source()

    def close(self) -> None:
        """Release both cameras."""
        for unit in self.units.values():
            unit.release()
        self._source.stop()


def _exposure(settings: CameraSettings) -> dict[str, float | None]:
    return {"exposure_ms": settings.exposure_ms, "gain_db": settings.gain_db}


def _grown(after: dict[str, int], before: dict[str, int]) -> dict[str, int]:
    return {name: count - before.get(name, 0) for name, count in after.items()}


def _check_skew(skew_ms: float, motion: ImageMotion) -> None:
    moved_px = motion.within_px(skew_ms)
    if moved_px > SKEW_PX:
        raise CameraError(
            f"The exposures began {abs(skew_ms):.3f} ms apart while the image moved at {motion.speed_px_s:.3g} px/s: "
            f"at least {moved_px:.3f} px between the two cameras, {SKEW_PX:g} px are allowed.",
            code="skew_too_large",
            remedy="Use a common hardware trigger, let the specimen rest, or set max_skew_ms in the rig file.",
            skew_ms=skew_ms,
            image_speed_px_s=motion.speed_px_s,
        )
