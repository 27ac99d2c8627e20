"""Memory of a live measurement: its last values, readings of channels, and the offset of their clocks."""

from __future__ import annotations

import itertools
import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from stereorig.core.errors import InputError
from stereorig.core.live.clocks import ClockOffset, clock_offset, value_at

#: frames and readings kept: some two minutes at 50 Hz, 20 s of a channel at 1 kHz
KEPT_FRAMES, KEPT_READINGS = 6000, 20_000
MAX_CHANNELS = 50
_GAPS = 3.0


@dataclass(frozen=True)
class Moment:
    """One frame in the series: its number, its time on the host's monotonic clock, values by gauge and quantity."""

    number: int
    time_s: float
    values: Mapping[str, Mapping[str, float]]


@dataclass
class _Channel:
    time_s: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT_READINGS))
    values: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT_READINGS))
    offset: ClockOffset | None = None

    @property
    def shift_s(self) -> float:
        return 0.0 if self.offset is None else self.offset.offset_s

    @property
    def gap_s(self) -> float:
        """Largest distance of readings that are joined, s: three times their mean distance."""
        if len(self.time_s) < 2:
            return 0.0
        return _GAPS * (self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)


class LiveSeries:
    """Frames' values and channels' readings; every method may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._moments: deque[Moment] = deque(maxlen=KEPT_FRAMES)
        self._channels: dict[str, _Channel] = {}

    def add(self, moment: Moment) -> None:
        """Keep a measured frame."""
        with self._lock:
            self._moments.append(moment)

    def put(self, readings: Sequence[tuple[float, Mapping[str, float]]]) -> int:
        """Keep readings of channels, (time by the channel's clock, values); return how many values are new.

        Raises
        ------
        InputError
            ``channels_out_of_order`` for a time that is not after the channel's last one; ``too_many_channels``.
        """
        with self._lock:
            last = {name: channel.time_s[-1] for name, channel in self._channels.items() if channel.time_s}
            for time_s, values in readings:  # all or none
                for name in values:
                    if time_s <= last.get(name, -math.inf):
                        raise InputError(
                            f"The reading of {name} at {time_s:.9g} s is not after that at {last[name]:.9g} s.",
                            code="channels_out_of_order",
                            remedy="Send readings in the order of their times, each once.",
                        )
                    last[name] = time_s
            if len(last) > MAX_CHANNELS:
                raise InputError(
                    f"{len(last)} channels; {MAX_CHANNELS} at most.",
                    code="too_many_channels",
                    remedy="Send the channels that are needed.",
                )
            for time_s, values in readings:
                for name, value in values.items():
                    channel = self._channels.setdefault(name, _Channel())
                    channel.time_s.append(time_s)
                    channel.values.append(value)
        return sum(len(values) for _, values in readings)

    def align(self, name: str, gauge: str, quantity: str, within_s: float, *, keep: bool = True) -> ClockOffset:
        """Estimate a channel's clock from a motion that it and a gauge both show; ``keep`` uses it from now on.

        Raises
        ------
        InputError
            ``channel_unknown``, ``gauge_unknown``, ``clock_readings``.
        MeasurementError
            ``offset_unknown``.
        """
        with self._lock:
            channel = self._known(name)
            readings = list(channel.time_s), list(channel.values)
            seen = [(m.time_s, m.values.get(gauge, {}).get(quantity, math.nan)) for m in self._moments]
        seen = [(t, y) for t, y in seen if math.isfinite(y)]
        if not seen:
            raise InputError(
                f"The gauge {gauge} has no value of {quantity} yet.",
                code="gauge_unknown",
                remedy="Name a gauge of the live measurement and one of its quantities.",
            )
        found = clock_offset(*readings, *zip(*seen, strict=True), within_s=within_s)
        if keep:
            with self._lock:
                channel.offset = found
        return found

    def _known(self, name: str) -> _Channel:
        if name not in self._channels:
            there = ", ".join(sorted(self._channels)) or "none"
            raise InputError(
                f"No reading of the channel {name!r} has come; there are {there}.",
                code="channel_unknown",
                remedy="POST its readings first.",
            )
        return self._channels[name]

    def channels(self) -> dict[str, dict[str, float | int | None]]:
        """Return of each channel the number of readings, its last time and value, and the offset of its clock."""
        with self._lock:
            return {
                name: {
                    "readings": len(channel.values),
                    "last_time_s": channel.time_s[-1],
                    "last_value": channel.values[-1],
                    "offset_s": channel.shift_s,
                    "offset_u_s": None if channel.offset is None else channel.offset.u_s,
                }
                for name, channel in self._channels.items()
            }

    def history(self, after: int, limit: int) -> list[dict[str, object]]:
        """Return frames after a number, the oldest first, with the channels at their exposure where these are known."""
        with self._lock:
            moments = list(itertools.islice((m for m in self._moments if m.number > after), limit))
            channels = {
                name: ([t + c.shift_s for t in c.time_s], list(c.values), c.gap_s) for name, c in self._channels.items()
            }
        out = []
        for moment in moments:
            at = {name: value_at(t, y, moment.time_s, gap) for name, (t, y, gap) in channels.items()}
            out.append(
                {
                    "number": moment.number,
                    "time_s": moment.time_s,
                    "values": moment.values,
                    "channels": {name: value for name, value in at.items() if math.isfinite(value)},
                }
            )
        return out
