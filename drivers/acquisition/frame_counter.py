"""Reading frame counters: gaps, repeats, late arrivals and the wrap of a counter with few bits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Arrival(StrEnum):
    """Place of a frame in the sequence, by its number."""

    NEXT = "next"  # newer than all before; `Reading.missing` frames were skipped
    DUPLICATE = "duplicate"
    LATE = "late"  # out of order: older than the newest


@dataclass(frozen=True)
class CounterReading:
    """Reading of one frame number.

    Attributes
    ----------
    arrival
        See there.
    number
        The counter as it would be without its wrap, from the first frame's own number on.
    missing
        Number of frames skipped before this one.
    """

    arrival: Arrival
    number: int
    missing: int = 0


class SequenceReader:
    """Unwraps one camera's frame counter.

    A counter that runs from ``first`` to ``last`` and starts again can be read as long as less than half of its range
    is lost at once.

    Parameters
    ----------
    first, last
        Range of the counter. GigE Vision's 16-bit block numbers run from 1 to 65535, most others from 0.
    """

    def __init__(self, first: int = 0, last: int = 2**16 - 1) -> None:
        if not 0 <= first < last:
            raise ValueError(f"a counter from {first} to {last} does not count")
        self._first = first
        self._size = last - first + 1
        self._newest: int | None = None
        self._recent: set[int] = set()
        self._only: int | None = None  # the one number that all frames bore so far
        #: True if the device's number stays as it is: frames are counted here, and lost ones leave no gap
        self.counts = False

    def read(self, raw: int, *, fresh: bool = False) -> CounterReading:
        """Read the next frame number as the device gave it; ``fresh`` if its stamp shows that it is a new frame."""
        if not 0 <= raw - self._first < self._size:
            raise ValueError(f"frame number {raw} is outside the counter's range")
        if self._newest is None:
            self._newest = self._only = raw
            self._recent = {raw}
            return CounterReading(Arrival.NEXT, raw)
        self._only = raw if raw == self._only else None
        self.counts = fresh and self._only is not None
        if self.counts:
            self._newest += 1
            return CounterReading(Arrival.NEXT, self._newest)
        step = (raw - self._newest) % self._size
        if step >= self._size / 2:
            step -= self._size
        number = self._newest + step
        if number in self._recent:
            return CounterReading(Arrival.DUPLICATE, number)
        self._recent.add(number)
        if step < 0:
            return CounterReading(Arrival.LATE, number)
        self._newest = number
        # further back than this it cannot be distinguished from a late frame, which is refused too
        self._recent = {known for known in self._recent if known > number - 64}
        return CounterReading(Arrival.NEXT, number, step - 1)
