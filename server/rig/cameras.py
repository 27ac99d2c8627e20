"""Both cameras together: synchronised captures, averages, live frames, and their return after a loss.

A capture takes the next pairs of the rig's `stereorig.drivers.acquisition.sources.PairSource`. Live views use the same
way when nothing is captured, and otherwise show the frames of the captures: recording comes first.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import CameraError, StateError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.pairing import Pair, PairingAccount
from stereorig.drivers.acquisition.simultaneity import SkewSource, in_words, no_common_ptp
from stereorig.drivers.acquisition.sources import CommandedPairs, NoPairs, PairSource, StreamedPairs, TriggeredPairs
from stereorig.drivers.acquisition.unit import CameraUnit, share_links
from stereorig.drivers.cameras.protocol import CameraDescription, CameraSettings, Frame, Pixels
from stereorig.server.config.rig_file import SKEW_PX
from stereorig.server.rig.recorder import PairRing, RingState, begun_ns

if TYPE_CHECKING:
    from stereorig.server.rig.image_speed import ImageMotion

_log = logging.getLogger("stereorig.rig")

#: three announcements of 2 s until a camera has a master, and some corrections by it (IEEE 1588's usual profile)
PTP_S = 10.0
# Its state is asked for every second
_PTP_LOOK_S = 0.05
#: side of the square in the middle of an image whose motion is measured
_MOTION_WINDOW_PX = 512
#: if there is no older frame to show, a live view waits this long behind another one or a capture
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
    skew_ms, skew_uncertainty_ms, skew_source
        Largest difference of the two exposures' beginnings, its largest error, and its source.
    image_speed_px_s
        Speed of camera 1's image from the first to the last frame; None for a single frame, or if it cannot
        be known.
    settings
        Exposure (ms) and gain (dB) of each camera, as read back; its temperature if it reports one.
    frame_counts
        Counters of each camera's frames during the capture.
    pair_counts
        Counters of the triggers during the capture.
    exposed_s
        Middle of camera 1's exposures on the host's monotonic clock, on average; None if it is not known.
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
    exposed_s: float | None = None
    skew_uncertainty_ms: float = 0.0
    skew_source: SkewSource = "clock"

    @property
    def skew(self) -> dict[str, object]:
        """Skew with its uncertainty and source, as records keep them."""
        names = ("skew_ms", "skew_uncertainty_ms", "skew_source")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, eq=False)
class GatheredPairs:
    """Pairs that were averaged, before their motion is judged.

    Attributes
    ----------
    pair
        The average, without the image's speed.
    motion
        The middle of camera 1's first and last frame; None for a single frame.
    skew_is_set
        True if the rig's skew limit was set by its user.
    """

    pair: CapturedPair
    motion: tuple[Frame, Frame] | None
    skew_is_set: bool

    def judged(self) -> CapturedPair:
        """Return the pair with the speed of its image.

        Raises
        ------
        CameraError
            ``skew_too_large`` if the image moved too far between the exposures of both cameras.
        """
        if self.motion is None:
            return self.pair
        # the process that holds the cameras measures no motion, and so loads no image library
        from stereorig.server.rig.image_speed import image_motion

        motion = image_motion(*self.motion)
        if motion is None:
            return self.pair
        if not self.skew_is_set:
            _check_skew(self.pair, motion)
        return replace(self.pair, image_speed_px_s=motion.speed_px_s)


@dataclass(frozen=True)
class PairMark:
    """Place of a pair among all that its source made; the source by its number."""

    source: int
    number: int


class _Average:
    """Mean of each camera's frames, pair by pair."""

    def __init__(self, first: Pair) -> None:
        self.first = self.last = first
        self.frames = 1
        self._begun_ns = begun_ns(first.cam1)
        self.worst = first
        self._sums: dict[CameraName, NDArray[np.uint32]] = {}

    def add(self, pair: Pair) -> None:
        """Take one more pair."""
        if not self._sums:
            self._sums = {cam: self.last[cam].pixels.astype(np.uint32) for cam in CAMERAS}
        self.last = pair
        self.frames += 1
        self._begun_ns += begun_ns(pair.cam1)
        self.worst = max(self.worst, pair, key=lambda one: abs(one.skew_ms))
        for cam in CAMERAS:
            self._sums[cam] += pair[cam].pixels

    def exposed_s(self, exposure_ms: float | None) -> float:
        """Middle of camera 1's exposures, on average."""
        return self._begun_ns / self.frames / 1e9 + (exposure_ms or 0.0) / 2e3

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
        Makes the source; called again after anything that arms a camera again.
    skew_is_set
        True if the rig's skew limit was set by its user. Else a pair whose skew moves the image by more than 0.01 px,
        at the speed that was seen, is refused too.
    ptp
        True if both cameras are to follow one PTP master: the first capture after an arming waits for that.
    """

    def __init__(
        self,
        cam1: CameraUnit,
        cam2: CameraUnit,
        *,
        make_source: Callable[[], PairSource],
        skew_is_set: bool = False,
        ptp: bool = False,
    ) -> None:
        self.units: dict[CameraName, CameraUnit] = {"cam1": cam1, "cam2": cam2}
        self._make_source = make_source
        self._skew_is_set = skew_is_set
        self._ptp = ptp
        self._ptp_until_s: float | None = None
        self._earlier = PairingAccount()
        self._source = self._made()
        self._sources = 1  # made so far; the number of the present one
        self._lock = threading.Lock()
        self._capturing = threading.Event()
        self._ring: PairRing | None = None
        self._before_record: tuple[dict[CameraName, dict[str, int]], dict[str, int]] = {}, {}

    def _made(self) -> PairSource:
        return self._make_source() if all(unit.was_found for unit in self.units.values()) else NoPairs(self.units)

    def start(self) -> None:
        """Share out the link that both cameras send over, if they do, and begin to take frames."""
        self._armed()
        self._source.start()

    def _armed(self) -> None:
        share_links(self.units.values())
        self._ptp_until_s = time.monotonic() + PTP_S if self._ptp else None

    def described(self) -> dict[CameraName, tuple[CameraDescription, CameraSettings]]:
        """Return the description and the settings of both cameras, which another process asks for at once."""
        return {cam: (unit.description, unit.settings) for cam, unit in self.units.items()}

    def account(self) -> dict[str, int]:
        """Counters of the triggers."""
        now = self._source.account()
        return {f.name: getattr(self._earlier, f.name) + getattr(now, f.name) for f in fields(PairingAccount)}

    def _restart_source(self) -> None:
        source = self._source
        source.stop()
        self._earlier, self._source = PairingAccount(**self.account()), self._made()
        self._sources += 1
        self._feed_ring()
        self._source.start()

    def capture(self, frames: int = 1, check: Callable[[], None] | None = None) -> CapturedPair:
        """Capture ``frames`` pairs and average each camera's; ``check`` may raise between them.

        Raises
        ------
        CameraError
            ``skew_too_large`` if the exposures of a pair began at too different times, or an error of the cameras.
        """
        return self.gather(frames, check).judged()

    def gather(self, frames: int = 1, check: Callable[[], None] | None = None) -> GatheredPairs:
        """Capture as `capture` does, and leave the judgement of the image's motion to the caller."""
        self._await_ptp(check)
        self._capturing.set()
        try:
            with self._lock:
                counts, account = {cam: unit.counters() for cam, unit in self.units.items()}, self.account()
                mean = _Average(self._next_pair(check))
                while mean.frames < frames:
                    mean.add(self._next_pair(check))
                pair = self._captured(mean, counts, account)
                motion = (_middle(mean.first.cam1), _middle(mean.last.cam1)) if frames > 1 else None
                return GatheredPairs(pair, motion, self._skew_is_set)
        finally:
            self._capturing.clear()

    def _await_ptp(self, check: Callable[[], None] | None) -> None:
        while self._ptp_until_s is not None:
            why = no_common_ptp({cam: unit.description for cam, unit in self.units.items()})
            if why and time.monotonic() < self._ptp_until_s:
                if check is not None:
                    check()
                time.sleep(_PTP_LOOK_S)
                continue
            if why:
                _log.warning("no common PTP clock %g s after the arming: %s; skews have another source", PTP_S, why)
            self._ptp_until_s = None

    def _captured(
        self, mean: _Average, counts: dict[CameraName, dict[str, int]], account: dict[str, int]
    ) -> CapturedPair:
        last = mean.last
        return CapturedPair(
            pixels={cam: mean.pixels(cam) for cam in CAMERAS},
            bit_depth={cam: last[cam].bit_depth for cam in CAMERAS},
            sequence={cam: last[cam].sequence for cam in CAMERAS},
            frames=mean.frames,
            scale=mean.scale,
            skew_ms=abs(mean.worst.skew_ms),
            skew_uncertainty_ms=mean.worst.skew_uncertainty_ms,
            skew_source=mean.worst.skew_source,
            host_ns=last.cam1.host_ns,
            settings={cam: _state(unit) for cam, unit in self.units.items()},
            frame_counts={cam: _grown(unit.counters(), counts[cam]) for cam, unit in self.units.items()},
            pair_counts=_grown(self.account(), account),
            exposed_s=mean.exposed_s(self.units["cam1"].settings.exposure_ms),
        )

    # a recording --------------------------------------------------------------------------------------------------

    def record(self, *, room: int, before_s: float, period_s: float) -> None:
        """Begin to hold pairs in a `stereorig.server.rig.recorder.PairRing`; ``period_s`` between software triggers."""
        self.end_record()
        exposure_ms = self.units["cam1"].settings.exposure_ms or 0.0
        self._before_record = {cam: unit.counters() for cam, unit in self.units.items()}, self.account()
        self._ring = PairRing(room=room, before_s=before_s, exposure_s=exposure_ms / 1e3)
        self._feed_ring()
        if self.fires:
            arguments = (lambda: self._fired(), period_s)
            threading.Thread(target=self._ring.fire, args=arguments, name="recording", daemon=True).start()

    def _fired(self) -> Pair:
        with self._lock:
            return self._source.next_pair()

    def _feed_ring(self) -> None:
        if isinstance(self._source, StreamedPairs) and not self.fires:
            self._source.on_pair = None if self._ring is None else self._ring.add

    def _recording(self) -> PairRing:
        if self._ring is None:
            raise StateError("No pairs are recorded: the rig was opened again.", code="recording_lost")
        return self._ring

    def recorded(self) -> RingState:
        """Return the pairs that came since the last call."""
        state = self._recording().state()
        faults = [unit.fault.code for unit in self.units.values() if unit.fault is not None]
        return replace(state, fault=faults[0] if faults else state.fault)

    def keep_recorded(self, numbers: Sequence[int], from_number: int | None = None) -> list[int]:
        """Keep pairs, see `stereorig.server.rig.recorder.PairRing.keep`."""
        return self._recording().keep(numbers, from_number=from_number)

    def keep_until(self, last: int) -> None:
        """Keep no pair behind this one."""
        self._recording().stop_keeping(last)

    def take_recorded(self) -> tuple[int, CapturedPair, bool] | None:
        """Return the next pair that is kept, with its number and whether its skew is within the limit."""
        found = self._recording().take()
        if found is None:
            return None
        counts, account = self._before_record
        return found[0], self._captured(_Average(found[1]), counts, account), found[1].accepted

    def end_record(self) -> None:
        """Let the ring go."""
        ring, self._ring = self._ring, None
        self._feed_ring()
        if ring is not None:
            ring.end()

    def record_counters(self) -> dict[str, dict[str, int]]:
        """Return the counters of frames and triggers since the recording began."""
        counts, account = self._before_record
        found: dict[str, dict[str, int]] = {"triggers": _grown(self.account(), account)}
        for cam, unit in self.units.items():
            found[cam] = _grown(unit.counters(), counts[cam])
        return found

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
            Its mark, the number of skipped pairs between both, and the pair, of any skew.

        Raises
        ------
        CameraError
            The cameras' own errors; ``no_frames`` when no pair came in time.
        """
        if self.fires:
            while self._capturing.is_set():
                check()
                time.sleep(_BEHIND_CAPTURE_S)
            with self._lock:
                source = self._source
                _, pair = source.newest(0, check)
            return PairMark(self._sources, 0), 0, pair
        # streams are shared: a capture and this one take the same pairs
        which, source = self._sources, self._source
        last = after.number if after is not None and after.source == which else None
        number, pair = source.newest(last or 0, check)
        return PairMark(which, number), 0 if last is None else number - last - 1, pair

    @property
    def fires(self) -> bool:
        """True if pairs come when they are asked for alone, by software triggers or commands."""
        return isinstance(self._source, TriggeredPairs | CommandedPairs)

    def live(self, cam: CameraName, max_age_s: float, after: int | None = None) -> Frame:
        """Return a frame for looking at, at most ``max_age_s`` old where recording allows it.

        ``after`` is the number of the frame that the caller has: it is given another one, unless a capture runs or
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
            if unit.latest is frame:  # else another view took it just now
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

    def missing(self) -> dict[CameraName, CameraError]:
        """Faults of the cameras that were not found yet."""
        return {cam: unit.fault for cam, unit in self.units.items() if unit.fault is not None and not unit.was_found}

    def reopen(self, cam: CameraName) -> None:
        """Connect a lost camera again, or one that was not found yet, with its settings; raises when that fails."""
        unit = self.units[cam]
        unit.reconnect()
        with self._lock:
            self._source.stop()
            unit.resume()
            self._armed()
            self._restart_source()

    def close(self) -> None:
        """Release both cameras."""
        for unit in self.units.values():
            unit.release()
        self._source.stop()


def _middle(frame: Frame) -> Frame:
    """Return the middle of a frame."""
    rows, columns = frame.pixels.shape
    height, width = min(rows, _MOTION_WINDOW_PX), min(columns, _MOTION_WINDOW_PX)
    top, left = (rows - height) // 2, (columns - width) // 2
    return replace(frame, pixels=frame.pixels[top : top + height, left : left + width].copy())


def _state(unit: CameraUnit) -> dict[str, float | None]:
    settings, celsius = unit.settings, unit.description.temperature_c
    state = {"exposure_ms": settings.exposure_ms, "gain_db": settings.gain_db}
    return state if celsius is None else {**state, "temperature_c": celsius}


def _grown(after: dict[str, int], before: dict[str, int]) -> dict[str, int]:
    return {name: count - before.get(name, 0) for name, count in after.items()}


def _check_skew(pair: CapturedPair, motion: ImageMotion) -> None:
    moved_px = motion.within_px(max(0.0, pair.skew_ms - pair.skew_uncertainty_ms))
    if moved_px > SKEW_PX:
        raise CameraError(
            f"The exposures began {pair.skew_ms:.3f} ms apart ({in_words(pair.skew_source, pair.skew_uncertainty_ms)}) "
            f"while the image moved at {motion.speed_px_s:.3g} px/s: "
            f"at least {moved_px:.3f} px between the two cameras, {SKEW_PX:g} px are allowed.",
            code="skew_too_large",
            remedy="Use a common hardware trigger, let the specimen rest, or set max_skew_ms in the rig file.",
            **pair.skew,
            image_speed_px_s=motion.speed_px_s,
        )
