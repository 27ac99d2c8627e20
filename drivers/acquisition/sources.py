"""Sources of pairs: software triggers fired for each one, or two streams of frames matched all the time."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Literal, Protocol, TypeVar

from core.errors import CameraError
from core.names import CAMERAS, CameraName
from drivers.acquisition.counter_offset import AlignedPairing
from drivers.acquisition.pairing import NumberPairing, Pair, PairingAccount, TimePairing
from drivers.acquisition.unit import CameraUnit
from drivers.cameras.protocol import Frame, FrameStatus

T = TypeVar("T")
Check = Callable[[], None]
Units = Mapping[CameraName, CameraUnit]

# A frame that was lost or damaged on its way is triggered again; a camera that is lost is not
_ATTEMPTS = 3
_SLICE_S = 0.1
_KEPT_PAIRS = 8


class PairSource(Protocol):
    """Delivers pairs of frames that belong together, once it was started."""

    def start(self) -> None:
        """Begin to take the cameras' frames."""

    def next_pair(self, check: Check | None = None) -> Pair:
        """Return a pair exposed after this call; ``check`` may raise while it waits."""

    def newest(self, after: int, check: Check | None = None) -> tuple[int, Pair]:
        """Return the newest pair with its number among all that came, which is above ``after``; wait for one.

        Pairs between them are passed over. ``check`` may raise while it waits.
        """

    def refresh(self) -> None:
        """Make the units' latest frames new."""

    def account(self) -> PairingAccount:
        """Counters of all triggers so far."""

    def stop(self) -> None:
        """End it; the account stays."""


def common_clock(units: Units) -> bool:
    """True if the device times of both cameras may be compared."""
    one, two = (units[cam].description.clock for cam in CAMERAS)
    return one != "" and one == two


class TriggeredPairs:
    """Fires both cameras' software triggers and takes the frames that bear their numbers."""

    def __init__(self, units: Units, *, max_skew_ms: float) -> None:
        self._units = units
        self._max_skew_ms = max_skew_ms
        self._pairing: NumberPairing | None = None
        self._origin = 0

    def start(self) -> None:
        """Do nothing: frames come when they are triggered."""

    def next_pair(self, check: Check | None = None) -> Pair:
        """See `PairSource`.

        Raises
        ------
        CameraError
            ``frame_incomplete`` or ``pair_incomplete`` when three triggers in a row made no whole pair.
        """
        damaged: CameraName | None = None
        for attempt in range(_ATTEMPTS):
            if check is not None:
                check()
            numbers, fired = self._fire(), time.monotonic()
            # a camera that answered none of them is lost: the watchdog raises its error first
            periods = 1.0 if attempt < _ATTEMPTS - 1 else 2.0
            made: Pair | None = None
            for cam in CAMERAS:
                found, spoiled = self._collect(cam, numbers[cam], fired, periods)
                made = found or made
                damaged = cam if spoiled else damaged
            if made is not None:
                return made
        if damaged is not None:
            raise CameraError(
                f"{damaged} delivered incomplete frames, {_ATTEMPTS} triggers in a row.",
                code="frame_incomplete",
                remedy="Check cable and packet size, then capture again.",
                camera=damaged,
            )
        raise CameraError(
            f"{_ATTEMPTS} triggers in a row made no pair: frames did not arrive.",
            code="pair_incomplete",
            remedy="Capture again; POST /rig/reconnect if it comes back.",
        )

    def newest(self, after: int, check: Check | None = None) -> tuple[int, Pair]:
        """See `PairSource`: none comes before it is asked for."""
        return after + 1, self.next_pair(check)

    def refresh(self) -> None:
        """Fire once; a missing pair is no fault here."""
        with contextlib.suppress(CameraError):
            self.next_pair()
        for cam in CAMERAS:
            _ = self._units[cam].reader

    def account(self) -> PairingAccount:
        """Counters of all triggers."""
        return PairingAccount() if self._pairing is None else self._pairing.account

    def stop(self) -> None:
        """Close what is open."""
        if self._pairing is not None:
            self._pairing.finish()

    def _fire(self) -> dict[CameraName, int]:
        readers = {cam: self._units[cam].reader for cam in CAMERAS}  # neither is fired when one is lost
        numbers: dict[CameraName, int] = {}
        for cam, reader in readers.items():
            number = reader.trigger()
            if number is None:
                raise CameraError(
                    f"{cam} does not number its triggers.",
                    code="frame_format",
                    remedy="Use the free or the hardware trigger in the rig file.",
                    camera=cam,
                )
            numbers[cam] = number
        if self._pairing is None:
            self._pairing = NumberPairing(
                by="trigger",
                max_skew_ms=self._max_skew_ms,
                common_clock=common_clock(self._units),
                origin=dict(numbers),
            )
            self._origin = numbers["cam1"]
        self._pairing.triggered(numbers["cam1"] - self._origin + 1)
        return numbers

    def _collect(self, cam: CameraName, number: int, fired: float, periods: float) -> tuple[Pair | None, bool]:
        """Take a camera's frames up to that of one trigger; return True if the last of them was incomplete."""
        unit, pairing = self._units[cam], self._pairing
        assert pairing is not None
        deadline = fired + periods * unit.patience_s
        made: Pair | None = None
        while True:
            left = deadline - time.monotonic()
            frame = unit.reader.take(min(_SLICE_S, max(0.0, left)))  # raises when the watchdog gives the camera up
            if frame is None:
                if left <= 0.0:
                    return made, False
                continue
            whole = frame.status is FrameStatus.OK
            if whole:
                unit.latest = frame
            if frame.trigger is None and not whole:
                return made, True  # damaged so that its trigger is not known
            made = pairing.feed(cam, frame) or made
            if frame.trigger is None or frame.trigger >= number:
                return made, not whole


class StreamedPairs:
    """Matches two streams of frames, of free-running cameras or of cameras on one trigger line.

    Parameters
    ----------
    units
        Both cameras, armed.
    by
        ``time``: frames that began within half a period; ``frame``: by frame number, aligned by time.
    max_skew_ms
        Above it a pair is refused.
    capture_timeout_s
        Longest wait of a capture for a pulse where no rate is known.
    """

    def __init__(
        self, units: Units, *, by: Literal["time", "frame"], max_skew_ms: float, capture_timeout_s: float
    ) -> None:
        self._units = units
        self._capture_timeout_s = capture_timeout_s
        periods = [unit.period_s for unit in units.values()]
        make = TimePairing if by == "time" else AlignedPairing
        self._pairing: TimePairing | AlignedPairing = make(
            period_ms=1000.0 * max(periods), max_skew_ms=max_skew_ms, common_clock=common_clock(units)
        )
        self._pairs: deque[Pair] = deque(maxlen=_KEPT_PAIRS)
        self._came = 0
        self._changed = threading.Condition()
        self._ending = False
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Take both cameras' frames, each in a thread of its own."""
        for cam in CAMERAS:
            thread = threading.Thread(target=self._pump, args=(cam,), name=f"pairs {cam}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def _pump(self, cam: CameraName) -> None:
        unit = self._units[cam]
        try:
            reader = unit.reader
            while not self._ending:
                frame = reader.take(_SLICE_S)
                if frame is None:
                    continue
                if frame.status is FrameStatus.OK:
                    unit.latest = frame
                with self._changed:
                    pair = self._pairing.feed(cam, frame)
                    if pair is not None:
                        self._pairs.append(pair)
                        self._came += 1
                        self._changed.notify_all()
        except CameraError:
            pass  # the unit raises the reason to its callers
        with self._changed:
            self._changed.notify_all()

    def next_pair(self, check: Check | None = None) -> Pair:
        """See `PairSource`.

        Raises
        ------
        CameraError
            ``no_frames`` when no pair came in time.
        """
        since = time.monotonic_ns()
        if self._regular:
            # a frame's time on the host's clock contains the shortest delay of its way, two periods at most
            since += round(2e9 * max(unit.period_s for unit in self._units.values()))

        def begun_since() -> Pair | None:
            return next((pair for pair in self._pairs if min(_begin(pair.cam1), _begin(pair.cam2)) >= since), None)

        return self._await(begun_since, check)

    def newest(self, after: int, check: Check | None = None) -> tuple[int, Pair]:
        """See `PairSource`.

        Raises
        ------
        CameraError
            ``no_frames`` when no pair came in time.
        """
        return self._await(lambda: (self._came, self._pairs[-1]) if self._came > after else None, check)

    def _await(self, find: Callable[[], T | None], check: Check | None) -> T:
        """Return what is found among the pairs, as soon as it is there; ``find`` is called with the lock held."""
        limit = self._limit_s()
        deadline = time.monotonic() + limit
        while True:
            if check is not None:
                check()
            for unit in self._units.values():
                _ = unit.reader
            with self._changed:
                found = find()
                if found is not None:
                    return found
                self._changed.wait(_SLICE_S)
            if time.monotonic() > deadline:
                raise CameraError(
                    f"No pair of frames came in {limit:g} s.",
                    code="no_frames",
                    remedy="Check that the trigger's pulses reach both cameras, and that both run at the same rate.",
                )

    @property
    def _regular(self) -> bool:
        """True if frames come by themselves, at a known rate."""
        return all(unit.trigger == "free" or unit.rate_hz is not None for unit in self._units.values())

    def _limit_s(self) -> float:
        if not self._regular:
            return self._capture_timeout_s
        return 2.0 + max(10.0 * unit.period_s + unit.description.latency_s for unit in self._units.values())

    def refresh(self) -> None:
        """Do nothing: frames come by themselves."""
        for cam in CAMERAS:
            _ = self._units[cam].reader

    def account(self) -> PairingAccount:
        """Counters of all pairs and missing frames."""
        with self._changed:
            return self._pairing.account

    def stop(self) -> None:
        """End the threads and close what is open."""
        self._ending = True
        for thread in self._threads:
            thread.join()
        with self._changed:
            self._pairing.finish()


def _begin(frame: Frame) -> int:
    return frame.host_ns if frame.exposed_ns is None else frame.exposed_ns
