"""Assignment of frames to software triggers."""

from __future__ import annotations

import time
from collections.abc import Callable

# Fire times are kept for so many triggers
_KEPT = 256


class TriggerNumbers:
    """Gives each frame the number of its trigger by the device's frame numbers.

    A camera counts the frames that it exposes. The first frame after arming belongs to the first trigger, and a frame
    whose number is n higher to the trigger n later: so a frame that is lost on its way does not shift those after it.

    Two things are assumed. The first frame after arming is not lost without a trace, unless the camera begins to count
    at 1 with each arming or continues its count, which both can be detected. And the camera makes a frame of every
    trigger; most ignore one that comes while they are busy, without counting it. If either is wrong, frames seem to
    come long after their triggers: a frame that would be later than ``patience_s`` is given to the next trigger that it
    can belong to, and the frames after it follow. Below that, pairs made by such numbers are a trigger apart, which
    their skew shows.

    Parameters
    ----------
    first, last
        Range of the frame counter.
    before
        Triggers that were fired through earlier connections: numbers continue from there.
    clock_ns
        The host's monotonic clock.
    """

    def __init__(
        self, first: int, last: int, *, before: int = 0, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._first = first
        self._size = last - first + 1
        self._clock_ns = clock_ns
        self._fired = before
        self._armed_at = before  # triggers fired before the last arming
        self._at_ns: dict[int, int] = {}
        self._anchor: tuple[int, int] | None = None  # a frame number and its trigger's
        self._newest: int | None = None

    def arm(self) -> None:
        """Begin a new run; trigger numbers continue."""
        self._armed_at = self._fired
        self._anchor = None
        self._at_ns.clear()

    def fire(self, send: Callable[[], None]) -> int:
        """Count a trigger, send it and return its number; the first is 1. One that cannot be sent does not count."""
        # counted before it is sent: its frame may be here before the call returns
        self._at_ns[self._fired + 1] = self._clock_ns()
        self._at_ns.pop(self._fired + 1 - _KEPT, None)
        self._fired += 1
        try:
            send()
        except BaseException:
            self._fired -= 1
            raise
        return self._fired

    def of_frame(self, number: int, arrived_ns: int, patience_s: float, damaged: int = 0) -> int | None:
        """Return the trigger of a frame; None for one that no trigger can have made.

        Parameters
        ----------
        number
            Frame number by the device.
        arrived_ns
            When it came, by the host's monotonic clock.
        patience_s
            The longest that a frame may take from its trigger.
        damaged
            Frames since arming of which it is only known that they were lost.
        """
        fired = self._fired - self._armed_at
        if fired == 0:
            return None
        if self._anchor is None:
            self._anchor = number, self._armed_at + 1 + self._lost_before(number, fired, damaged)
        known, trigger = self._anchor
        step = (number - known) % self._size
        if step >= self._size / 2:
            step -= self._size
        trigger += step
        if step >= 0:
            self._newest = number
            while trigger < self._fired and arrived_ns - self._at_ns.get(trigger, arrived_ns) > patience_s * 1e9:
                trigger += 1
            self._anchor = number, trigger
        return trigger if self._armed_at < trigger <= self._fired else None

    def _lost_before(self, number: int, fired: int, damaged: int) -> int:
        """Return the number of frames lost before the first that came after arming."""
        begins = [number - self._first]  # the counter began again
        if self._newest is not None:
            begins.append((number - self._newest - 1) % self._size)  # it continued
        possible = [lost for lost in begins if 0 <= lost < fired]
        return min(possible, default=min(damaged, fired - 1))
