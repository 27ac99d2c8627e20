"""A ring of pairs in memory: the pairs of the last moment, and the pairs to keep; each is accounted for."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from stereorig.core.errors import CameraError
from stereorig.drivers.acquisition.pairing import Pair
from stereorig.drivers.cameras.protocol import Frame

_PAUSE_S = 0.02  # after an error of the cameras


@dataclass(frozen=True)
class RingState:
    """Changes since the last call.

    Attributes
    ----------
    times_s
        Number, and middle of camera 1's exposure on the host's monotonic clock, of each pair.
    lost
        Pairs that were to be kept and found no room.
    fault
        Code of the error for which no pairs come; empty if they do.
    """

    times_s: Sequence[tuple[int, float]]
    lost: int
    fault: str


class PairRing:
    """Pairs by number, from 0; the oldest that is not kept goes first.

    Parameters
    ----------
    room
        Pairs at once.
    before_s
        Pairs as old as this are held for a decision.
    exposure_s
        Exposure of camera 1.
    """

    def __init__(self, *, room: int, before_s: float, exposure_s: float) -> None:
        self._room, self._before_s, self._exposure_s = room, before_s, exposure_s
        self._lock = threading.Lock()
        self._pairs: OrderedDict[int, tuple[float, Pair]] = OrderedDict()
        self._kept: OrderedDict[int, Pair] = OrderedDict()
        self._from: int | None = None
        self._times: list[tuple[int, float]] = []
        self._came, self._lost = 0, 0
        self._ending = threading.Event()
        self._fault = ""

    def add(self, pair: Pair) -> None:
        """Take a pair."""
        at_s = begun_ns(pair.cam1) / 1e9 + self._exposure_s / 2.0
        with self._lock:
            number, self._came = self._came, self._came + 1
            self._times.append((number, at_s))
            if self._from is not None and number >= self._from:
                self._keep(number, pair)
            else:
                self._pairs[number] = at_s, pair
            while self._pairs:
                first, (then_s, _) = next(iter(self._pairs.items()))
                if then_s >= at_s - self._before_s and len(self._pairs) + len(self._kept) <= self._room:
                    break
                del self._pairs[first]

    def _keep(self, number: int, pair: Pair) -> None:
        if len(self._kept) >= self._room:
            self._lost += 1
        else:
            self._kept[number] = pair

    def state(self) -> RingState:
        """Return the changes since the last call."""
        with self._lock:
            times, self._times = self._times, []
            return RingState(times, self._lost, self._fault)

    def keep(self, numbers: Sequence[int], *, from_number: int | None = None) -> list[int]:
        """Keep the given pairs, and all from a number on; return the given numbers that were dropped already."""
        with self._lock:
            self._from = from_number if from_number is not None else self._from
            wanted = set(numbers) | {n for n in self._pairs if self._from is not None and n >= self._from}
            for number in sorted(wanted):
                found = self._pairs.pop(number, None)
                if found is not None:
                    self._keep(number, found[1])
            return [number for number in numbers if number not in self._kept]

    def stop_keeping(self, last: int) -> None:
        """Keep nothing behind a pair."""
        with self._lock:
            self._from = None
            for number in [number for number in self._kept if number > last]:
                del self._kept[number]

    def take(self) -> tuple[int, Pair] | None:
        """Return the first pair that is kept, and hold it no longer; None without any."""
        with self._lock:
            return self._kept.popitem(last=False) if self._kept else None

    def fire(self, next_pair: Callable[[], Pair], period_s: float) -> None:
        """Take pairs of triggered cameras until the end."""
        due_s = time.monotonic()
        while not self._ending.wait(max(due_s - time.monotonic(), 0.0)):
            due_s = max(due_s + period_s, time.monotonic())
            try:
                self.add(next_pair())
                self._fault = ""
            except CameraError as error:
                self._fault = error.code
                self._ending.wait(_PAUSE_S)

    def end(self) -> None:
        """Let a thread that fires end."""
        self._ending.set()


def begun_ns(frame: Frame) -> int:
    """Return the beginning of a frame's exposure on the host's monotonic clock, as far as it is known."""
    return frame.host_ns if frame.exposed_ns is None else frame.exposed_ns
