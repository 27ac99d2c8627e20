"""Sources of pairs: software triggers fired for each one, or two streams of frames matched all the time."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal, Protocol, TypeVar

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.counter_offset import AlignedPairing
from stereorig.drivers.acquisition.pairing import NumberPairing, Pair, PairingAccount, TimePairing
from stereorig.drivers.acquisition.simultaneity import Simultaneity
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.protocol import FrameStatus

T = TypeVar("T")
Check = Callable[[], None]
Units = Mapping[CameraName, CameraUnit]

# A frame that was lost or damaged on its way is triggered again; a camera that is lost is not
_ATTEMPTS = 3
_SLICE_S = 0.1
_KEPT_PAIRS = 8
# Frames of one camera that wait for the other's; of fast ones so many as a busy host may be late with
_DEPTH, _FAST_S, _LAG_S = 8, 0.01, 1.0
# Read-out of a sensor: no longer than the shortest frame period, or than this, since a camera may overlap the two; and
# the jitter of arrivals that remains
_READ_OUT_MS = 20.0
_JITTER_MS = 2.0
# An exposure may seem to begin before its command, by the error of a latch
_LATCH_NS = 5_000_000


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


def times_of(units: Units, *, wired: bool) -> Simultaneity:
    """Return the knowledge of both cameras' times; ``wired`` if one edge starts their exposures."""

    def common() -> float | None:
        one, two = (units[cam].description for cam in CAMERAS)
        same = one.clock != "" and one.clock == two.clock
        return one.clock_error_ms + two.clock_error_ms if same else None

    return Simultaneity(common=common, wired=wired, read_out_ms=lambda: _read_out_ms(units))


def _read_out_ms(units: Units) -> float:
    """Return how much longer than the other's one camera's frame may take from the exposure's begin to its arrival."""
    longest = _READ_OUT_MS
    for unit in units.values():
        rates = unit.description.frame_rate_range_hz
        longest = max(longest, 1000.0 / rates[1] if rates is not None and rates[1] > 0.0 else 1000.0 * unit.period_s)
    one, two = (units[cam].settings.exposure_ms or 0.0 for cam in CAMERAS)
    return longest + abs(one - two) + _JITTER_MS


class NoPairs:
    """Placeholder for the source of pairs as long as a camera was not found, which raises the reason."""

    def __init__(self, units: Units) -> None:
        self._units = units

    def start(self) -> None:
        """Do nothing."""

    def next_pair(self, check: Check | None = None) -> Pair:  # noqa: ARG002
        """See `PairSource`; raises the fault of the camera that is missing."""
        self.refresh()
        raise CameraError("Both cameras have just been found.", code="no_frames", remedy="Send the request again.")

    def newest(self, after: int, check: Check | None = None) -> tuple[int, Pair]:
        """See `PairSource`; raises as `next_pair`."""
        return after, self.next_pair(check)

    def refresh(self) -> None:
        """Raise the fault of the camera that is missing."""
        for unit in self._units.values():
            _ = unit.reader

    def account(self) -> PairingAccount:
        """Counters of no pair."""
        return PairingAccount()

    def stop(self) -> None:
        """Do nothing."""


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
            remedy="Capture again; POST /rig:reconnect if it comes back.",
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
        """Close open pairs."""
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
                common_clock=times_of(self._units, wired=False),
                origin=dict(numbers),
            )
            self._origin = numbers["cam1"]
        self._pairing.triggered(numbers["cam1"] - self._origin + 1)
        return numbers

    def _collect(self, cam: CameraName, number: int, fired: float, periods: float) -> tuple[Pair | None, bool]:
        """Take a camera's frames up to the frame of one trigger; return True if the last of them was incomplete."""
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
        Longest wait of a capture for a pulse if no rate is known.
    wired
        True if one edge starts both exposures; None: if both cameras wait for pulses.
    period_s
        Least time between two exposures, twice the window of pairs by time; None: from the cameras' settings.
    """

    def __init__(
        self,
        units: Units,
        *,
        by: Literal["time", "frame"],
        max_skew_ms: float,
        capture_timeout_s: float,
        wired: bool | None = None,
        period_s: float | None = None,
    ) -> None:
        self._units = units
        self._capture_timeout_s = capture_timeout_s
        periods = [unit.period_s for unit in units.values()]
        make = TimePairing if by == "time" else AlignedPairing
        if wired is None:
            wired = all(unit.trigger == "hardware" for unit in units.values())
        self._pairing: TimePairing | AlignedPairing = make(
            period_ms=1000.0 * (period_s or max(periods)),
            max_skew_ms=max_skew_ms,
            common_clock=times_of(units, wired=wired),
            depth=max(_DEPTH, round(_LAG_S / max(periods))) if max(periods) < _FAST_S else _DEPTH,
        )
        self._pairs: deque[Pair] = deque(maxlen=_KEPT_PAIRS)
        self._came = 0
        #: is given each pair as it is made
        self.on_pair: Callable[[Pair], None] | None = None
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
                        if self.on_pair is not None:
                            self.on_pair(pair)
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

        return self._await(lambda: self._begun(since), check)

    def _begun(self, since_ns: int) -> Pair | None:
        """Return the first pair whose exposures began since then."""
        return next((pair for pair in self._pairs if min(pair.cam1.begun_ns, pair.cam2.begun_ns) >= since_ns), None)

    def newest(self, after: int, check: Check | None = None) -> tuple[int, Pair]:
        """See `PairSource`.

        Raises
        ------
        CameraError
            ``no_frames`` when no pair came in time.
        """
        return self._await(lambda: (self._came, self._pairs[-1]) if self._came > after else None, check)

    def _await(self, find: Callable[[], T | None], check: Check | None) -> T:
        """Return the first result of ``find``, which is called with the lock held after each change of the pairs."""
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
        """End the threads and close open pairs."""
        self._ending = True
        for thread in self._threads:
            thread.join()
        with self._changed:
            self._pairing.finish()


class CommandedPairs(StreamedPairs):
    """Lets both cameras expose by one command, and takes the pair that it makes.

    Parameters
    ----------
    units
        Both cameras, armed.
    fire
        Sends the command: an action, or the trigger of the camera that drives the other by its strobe line.
    max_skew_ms, wired
        As in `StreamedPairs`.
    lead_s
        From the command to the exposures.
    """

    def __init__(
        self, units: Units, *, fire: Callable[[], object], max_skew_ms: float, wired: bool, lead_s: float = 0.0
    ) -> None:
        patience_s = lead_s + max(unit.patience_s for unit in units.values())
        super().__init__(
            units,
            by="time",
            max_skew_ms=max_skew_ms,
            capture_timeout_s=patience_s,
            wired=wired,
            # a command follows another one whose frames are missing after this patience
            period_s=1.5 * (patience_s - lead_s),
        )
        self._fire = fire
        self._fired = 0
        self._firing = threading.Lock()

    def next_pair(self, check: Check | None = None) -> Pair:
        """See `PairSource`.

        Raises
        ------
        CameraError
            ``pair_incomplete`` when three commands in a row made no pair.
        """
        with self._firing:
            for _ in range(_ATTEMPTS):
                since, came = time.monotonic_ns() - _LATCH_NS, self._came
                self._fire()
                self._fired += 1
                try:
                    return self._await(lambda: self._begun(since) if self._came > came else None, check)  # noqa: B023
                except CameraError as error:
                    if error.code != "no_frames":
                        raise
        raise CameraError(
            f"{_ATTEMPTS} commands in a row made no pair: frames did not arrive.",
            code="pair_incomplete",
            remedy="Check that both cameras get the command (their statistics), then capture again.",
        )

    def newest(self, after: int, check: Check | None = None) -> tuple[int, Pair]:
        """See `PairSource`: none comes before it is asked for."""
        return after + 1, self.next_pair(check)

    def refresh(self) -> None:
        """Fire once; a missing pair is no fault here."""
        with contextlib.suppress(CameraError):
            self.next_pair()
        super().refresh()

    @property
    def _regular(self) -> bool:
        return False

    def account(self) -> PairingAccount:
        """Counters of all commands; one without any frame yet counts as dropped."""
        known = super().account()
        dropped = max(0, self._fired - known.triggered)
        return replace(known, triggered=known.triggered + dropped, dropped=known.dropped + dropped)
