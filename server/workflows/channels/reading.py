"""The channels that the rig file names: read all the time, stored in tests' folders, known at each exposure."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.core.live.channels import appears_in, has_moved, reading_at, stuck_since
from stereorig.core.robust import MAD_TO_SIGMA
from stereorig.drivers.channels.lines import ChannelLine, LineSource
from stereorig.server.config.channel_section import ChannelSection
from stereorig.server.documents.steps import StepMetadata
from stereorig.server.formats.channel_units import FORCE_N, unit_of
from stereorig.server.workflows.channels.kept import KeptReadings

#: readings of a channel that are kept in memory: 20 s at 1 kHz
_READINGS = 20_000
_LOOKED_AT = 2000  # newest readings that show whether a channel is stuck
_LONGEST_WAIT_S = 1.0  # for the reading behind an exposure
_KEEP_EVERY_S, _LOOK_EVERY_S = 10.0, 0.5
_DIGITS = 9  # of a number without the scale, which only rounding has more of
Put = Callable[[Sequence[tuple[float, dict[str, float]]]], object]


@dataclass(frozen=True)
class StepChannels:
    """Values of the channels for a step.

    Attributes
    ----------
    values, u
        At the exposure, by name, and standard uncertainties.
    units
        Unit of each value.
    load_n
        Load in newtons; None if no channel is the load, or it is not known.
    warnings
        Channels that are not known, or that cannot be believed, each with the reason.
    """

    values: dict[str, float] = field(default_factory=dict)
    u: dict[str, float] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    load_n: float | None = None
    warnings: list[str] = field(default_factory=list)

    def with_step(self, stated: StepMetadata, warnings: Sequence[str]) -> dict[str, object]:
        """Return the entries of a step's document; a channel or load that the client stated replaces the reading."""
        read = {name: value for name, value in self.values.items() if name not in stated.channels}
        found: dict[str, object] = {
            "channels": {**read, **stated.channels},
            "channel_units": {**{name: self.units[name] for name in read}, **stated.channel_units},
            "channel_u": {name: self.u[name] for name in read},
            "load_n": self.load_n if stated.load_n is None else stated.load_n,
            "warnings": [*warnings, *self.warnings],
        }
        return found if self.values or self.warnings else {}


class _Readings:
    """The newest readings of a channel, in the order of their times; for one thread that puts, under the hub's lock."""

    def __init__(self, section: ChannelSection) -> None:
        self.section, self._held, self._n = section, np.empty((2, 2 * _READINGS)), 0
        self.came = 0
        self.decimals = 0

    def put(self, time_s: float, value: float) -> None:
        if self._n == self._held.shape[1]:
            self._held[:, :_READINGS], self._n = self._held[:, _READINGS:], _READINGS
        if self._n:
            time_s = max(time_s, float(self._held[0, self._n - 1]) + 1e-6)  # its delay has changed
        self._held[:, self._n] = time_s, value
        self._n, self.came = self._n + 1, self.came + 1
        digits = f"{self.sent(value):.{_DIGITS}g}".partition("e")[0].partition(".")[2]
        self.decimals = max(self.decimals, len(digits))

    def newest(self, most: int = _READINGS) -> tuple[Float, Float]:
        """Return copies of times and values."""
        t, y = self._held[:, max(self._n - most, 0) : self._n].copy()
        return t, y

    def sent(self, values: Float | float) -> Float | float:
        """Return the numbers that the instrument sent."""
        return (values - self.section.offset) / (self.section.scale or 1.0)

    @property
    def resolution(self) -> float:
        return abs(self.section.scale) * 10.0**-self.decimals


class ReadChannels:
    """Reads the rig file's channels from its start to its stop.

    Parameters
    ----------
    sections
        The rig file's sections: no request names an address or a program.
    kept
        Writes the readings into tests' folders.
    """

    def __init__(self, sections: Sequence[ChannelSection], kept: KeptReadings) -> None:
        self._kept = kept
        self._readings = {section.name: _Readings(section) for section in sections}
        self._lines = {
            section.name: ChannelLine(
                LineSource(**section.model_dump(exclude={"unit", "load", "latency_ms"})), self._put_of(section.name)
            )
            for section in sections
        }
        self._came = threading.Condition()
        self._listeners: list[Put] = []
        self._faults: dict[str, str] = {}
        self._stuck: dict[str, tuple[float, bool]] = {}
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._look_after, name="channels", daemon=True)

    def _put_of(self, name: str) -> Callable[[float, float], None]:
        def put(time_s: float, value: float) -> None:
            line, readings = self._lines[name], self._readings[name]
            with self._came:
                readings.put(time_s - line.delay_s - readings.section.latency_ms / 1e3, value)
                self._came.notify_all()
            for listener in list(self._listeners):
                listener([(time_s, {name: value})])

        return put

    def start(self) -> None:
        """Begin to read."""
        for line in self._lines.values():
            line.start()
        if self._lines:
            self._thread.start()

    def stop(self) -> None:
        """End the reading, and write the last readings."""
        self._ending.set()
        for line in self._lines.values():
            line.end()
        for line in self._lines.values():
            line.stop()
        if self._thread.ident is not None:
            self._thread.join()

    def listen(self, put: Put) -> Callable[[], None]:
        """Hand each reading on, stamped at its arrival; return a function that ends it."""
        self._listeners.append(put)

        def end() -> None:
            if put in self._listeners:
                self._listeners.remove(put)

        return end

    def refuse_posted(self, names: set[str]) -> None:
        """Raise an error for names of channels that are read.

        Raises
        ------
        InputError
            ``channel_is_read``.
        """
        both = sorted(names & self._lines.keys())
        if both:
            raise InputError(
                f"The channel {both[0]} is read by the service.",
                code="channel_is_read",
                remedy="Post readings under another name; the rig file's [[channels]] has those that are read.",
            )

    def document(self) -> dict[str, dict[str, object]]:
        """Return for each channel its unit, the state of its line, its newest reading and its fault."""
        found: dict[str, dict[str, object]] = {}
        for name, line in self._lines.items():
            with self._came:
                t, y = self._readings[name].newest(1)
                came = self._readings[name].came
            last = {"last_time_s": float(t[-1]), "last_value": float(y[-1])} if len(t) else {}
            unit, fault = self._readings[name].section.unit, self._faults.get(name, "")
            found[name] = {"unit": unit, "line": asdict(line.state), "readings": came, "fault": fault, **last}
        return found

    def readings(self, name: str) -> tuple[Float, Float]:
        """Return times and values of a channel, as far as they are in memory.

        Raises
        ------
        InputError
            ``channel_unknown``.
        """
        if name not in self._readings:
            raise InputError(
                f"No channel {name!r} is read; there are {', '.join(self._readings) or 'none'}.",
                code="channel_unknown",
                remedy="Name a channel of the rig file's [[channels]].",
            )
        with self._came:
            return self._readings[name].newest()

    # at an exposure -----------------------------------------------------------------------------------------------

    def attend(self, test_id: str) -> None:
        """Store the readings in this test's folder from now on, and the readings of the minute before."""
        if self._lines:
            self._kept.attend(test_id, time.monotonic())

    def settled(self, at_s: float) -> bool:
        """Return True if every channel that is being read has a reading behind a time, or cannot be waited for."""
        late = time.monotonic() - at_s > _LONGEST_WAIT_S
        return late or all(self._is_past(name, at_s) for name in self._lines)

    def _is_past(self, name: str, at_s: float) -> bool:
        t, _ = self._readings[name].newest(1)
        return (len(t) > 0 and t[-1] >= at_s) or self._lines[name].state.state != "reading"

    def at(self, at_s: float) -> StepChannels:
        """Return the channels at a time on the host's monotonic clock; wait for the readings behind it, up to 1 s."""
        with self._came:
            while not self.settled(at_s):
                self._came.wait(0.02)
            held = {name: readings.newest() for name, readings in self._readings.items()}
        found = StepChannels(warnings=[f"Channel {name}: {why}." for name, why in self._faults.items()])
        if self._kept.problem:
            found.warnings.append(f"Readings of channels are not stored with the test: {self._kept.problem}")
        load_n = None
        for name, (t, y) in held.items():
            readings = self._readings[name]
            section = readings.section
            # the way of a line may take twice as long, or no time
            late_s = (self._lines[name].delay_s + section.latency_ms / 1e3) / np.sqrt(3.0)
            u_time_s = float(np.hypot(late_s, _jitter(t)))
            one = reading_at(t, y, at_s, resolution=readings.resolution, u_time_s=u_time_s)
            if isinstance(one, str):
                state = self._lines[name].state
                why = f"it is {state.state}, {state.reason}" if state.state != "reading" else one
                found.warnings.append(f"Channel {name} is not known at the exposure: {why}.")
                continue
            found.values[name], found.u[name] = one.value, one.u
            found.units[name] = section.unit or unit_of(name)
            if section.load:
                load_n = one.value * FORCE_N[section.unit]
        return StepChannels(found.values, found.u, found.units, load_n, found.warnings)

    # in the background --------------------------------------------------------------------------------------------

    def _look_after(self) -> None:
        keep_s = time.monotonic() + _KEEP_EVERY_S
        while not self._ending.wait(_LOOK_EVERY_S):
            self._faults = self._found_faults()
            if time.monotonic() >= keep_s or self._kept.is_new:
                self._keep()
                keep_s = time.monotonic() + _KEEP_EVERY_S
        self._keep()

    def _keep(self) -> None:
        with self._came:
            held = {name: readings.newest() for name, readings in self._readings.items()}
        self._kept.write(held)

    def _found_faults(self) -> dict[str, str]:
        with self._came:
            held = {name: readings.newest(_LOOKED_AT) for name, readings in self._readings.items()}
        reading = [name for name, line in self._lines.items() if line.state.state == "reading"]
        faults: dict[str, str] = {}
        for name in reading:
            # the readings before it are forgotten in time
            stuck = stuck_since(*held[name]) or self._stuck.get(name)
            if stuck is None or _changes(*held[name], stuck[0]):
                self._stuck.pop(name, None)
                continue
            since_s, noisy = self._stuck[name] = stuck
            others = [other for other in reading if other != name]
            # without noise before, the quantity may rest while others only flicker
            moves = _changes if noisy else has_moved
            moved = [other for other in others if moves(*held[other], since_s)]
            if moved or (noisy and not others):
                value, beside = held[name][1][-1], f" while {moved[0]} changes" if moved else ""
                faults[name] = f"it is stuck at {value:.9g} for {time.monotonic() - since_s:.3g} s{beside}"
        sent = {name: self._as_sent(name, held[name]) for name in reading}
        for one, two in itertools.permutations(reading, 2):
            within_s = 2.0 * max(_interval(sent[one][0]), _interval(sent[two][0])) + 0.01
            if two not in faults and appears_in(sent[one], sent[two], within_s):
                faults[two] = f"readings of {one} appear in it"
        return faults

    def _as_sent(self, name: str, held: tuple[Float, Float]) -> tuple[Float, Float]:
        return held[0], np.round(self._readings[name].sent(held[1]), self._readings[name].decimals)


def _changes(t: Float, y: Float, since_s: float) -> bool:
    return len(np.unique(y[t >= since_s])) > 1


def _interval(t: Float) -> float:
    return float(np.median(np.diff(t[-200:]))) if len(t) > 1 else 0.0


def _jitter(t: Float) -> float:
    """Return the scatter of the times at which readings come, which is the line's; bounded for irregular ones."""
    between = np.diff(t[-50:])
    if len(between) < 3:
        return 0.0
    middle = float(np.median(between))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(between - middle))) / math.sqrt(2.0)
    return min(scatter, middle / math.sqrt(12.0))
