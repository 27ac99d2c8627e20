"""A simulated ESP301: three axes, its commands, its error queue, on three `SimAxis`.

It supports the commands of the driver and the usual third-party drivers: identification, motor power, homing, moves,
stop, abort, velocities, limits, units and errors. Commands may be joined by semicolons; each query has a reply of its
own, ended by CR LF. The list of error texts is the manual's (appendix A).
"""

from __future__ import annotations

import functools
import math
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Unpack

from stereorig.sim.controllers.axis import SimAxis, Trouble
from stereorig.sim.controllers.wire import Motion, WireAxis, WireController

_COMMAND = re.compile(r"([0-9]*)([A-Z]{2})(.*)")
_LONGEST_LINE = 80
_TICK_S = 400e-6  # one servo cycle, the unit of the time stamps in the error queue

_TEXTS = {
    0: "NO ERROR DETECTED",
    4: "EMERGENCY STOP ACTIVATED",
    6: "COMMAND DOES NOT EXIST",
    7: "PARAMETER OUT OF RANGE",
    9: "AXIS NUMBER OUT OF RANGE",
    27: "COMMAND NOT ALLOWED",
    37: "AXIS NUMBER MISSING",
    38: "COMMAND PARAMETER MISSING",
}
_AXIS_TEXTS = {
    1: "PARAMETER OUT OF RANGE",
    3: "FOLLOWING ERROR THRESHOLD EXCEEDED",
    4: "POSITIVE HARDWARE LIMIT DETECTED",
    5: "NEGATIVE HARDWARE LIMIT DETECTED",
    6: "POSITIVE SOFTWARE LIMIT DETECTED",
    7: "NEGATIVE SOFTWARE LIMIT DETECTED",
    10: "MAXIMUM VELOCITY EXCEEDED",
    11: "MAXIMUM ACCELERATION EXCEEDED",
    13: "MOTOR NOT ENABLED",
    20: "HOMING ABORTED",
    30: "COMMAND NOT ALLOWED DURING HOMING",
}
# SN codes -> mm; counts and steps go by the resolution, angles are shown as if a degree were a millimetre
_MM_PER_UNIT = {2: 1.0, 3: 1e-3, 4: 25.4, 5: 25.4e-3, 6: 25.4e-6}
_UNITS = range(12)
_DECIMALS = {2: 4, 3: 1, 4: 6, 5: 3, 6: 0}
_TROUBLE_CODES: dict[Trouble, int] = {"following_error": 3, "positive_limit": 4, "negative_limit": 5}


class _Refusal(Exception):
    """A command that ends in the error queue instead of being carried out."""

    def __init__(self, code: int, axis: int | None = None) -> None:
        super().__init__(code, axis)
        self.code = code
        self.axis = axis


@dataclass
class _Axis(WireAxis):
    power: bool = False
    homing: bool = False
    unit: int = 2
    deceleration_mm_s2: float = 40.0
    home_mode: int = 1

    @property
    def mm_per_unit(self) -> float:
        """Length of the unit that this axis shows and takes."""
        return _MM_PER_UNIT.get(self.unit, 1.0 if self.unit > 1 else self.motor.resolution_mm)

    def show(self, mm: float) -> str:
        """Write a length, a velocity or an acceleration in the axis' unit."""
        return f"{mm / self.mm_per_unit:.{_DECIMALS.get(self.unit, 0 if self.unit < 2 else 4)}f}"

    def take(self, text: str) -> float:
        """Read a length, a velocity or an acceleration that was given in the axis' unit, in mm."""
        value = float(text)
        if not math.isfinite(value):
            raise ValueError("not a finite number")
        return value * self.mm_per_unit


@dataclass(frozen=True)
class _Setting:
    """A value that a command shows and sets: its name, on motor or axis, and the error for a refused value."""

    name: str
    allowed: Callable[[_Axis, float], bool] = lambda _axis, _value: True
    code: int = 0
    of_motor: bool = False


def _accelerates(axis: _Axis, value: float) -> bool:
    return 0 < value <= axis.max_acceleration_mm_s2


_SETTINGS = {
    "VA": _Setting("velocity_mm_s", lambda axis, value: 0 < value <= axis.max_velocity_mm_s, 10, of_motor=True),
    "AC": _Setting("acceleration_mm_s2", _accelerates, 11, of_motor=True),
    "AG": _Setting("deceleration_mm_s2", _accelerates, 11),
    "VU": _Setting("max_velocity_mm_s", lambda _axis, value: value > 0, 1),
    "AU": _Setting("max_acceleration_mm_s2", lambda _axis, value: value > 0, 1),
    "SL": _Setting("low_mm"),
    "SR": _Setting("high_mm"),
}


class SimESP301(WireController):
    """The simulated controller.

    Attributes
    ----------
    axes
        Number of axes, 1 to 3.
    motion
        See `stereorig.sim.controllers.wire.Motion`.
    """

    terminator = b"\r"

    def __init__(self, *, axes: int = 3, **motion: Unpack[Motion]) -> None:
        super().__init__(motion.get("time_scale", 1.0))
        if not 1 <= axes <= 3:
            raise ValueError(f"an ESP301 has 1 to 3 axes, not {axes}")
        self._axes = {number: _Axis.make(self.clock, **motion) for number in range(1, axes + 1)}
        self._queue: deque[tuple[int, int]] = deque(maxlen=10)
        self._words: dict[str, Callable[[int, _Axis, str], str | None]] = {
            "PA": self._pa,
            "PR": self._pr,
            "TP": lambda _n, axis, _p: axis.show(axis.motor.encoder_mm),
            "DP": lambda _n, axis, _p: axis.show(axis.motor.goal_mm),
            "TV": lambda _n, axis, _p: axis.show(axis.motor.velocity_now_mm_s),
            "MD": lambda _n, axis, _p: "0" if axis.motor.moving else "1",
            "MO": self._mo,
            "MF": self._mf,
            "WS": self._ws,
            "OR": self._or,
            "DH": self._dh,
            "ST": self._st,
            "SN": self._sn,
            **{word: functools.partial(self._setting, setting) for word, setting in _SETTINGS.items()},
            "ID": lambda number, _a, _p: f"SIM-LTA-HS, SN{number:04d}",
        }

    def axis(self, number: int) -> SimAxis:
        """Give access to an axis and its faults."""
        return self._axes[number].motor

    def _execute(self, text: str) -> bytes:
        self._update()
        replies = []
        if len(text) > _LONGEST_LINE:
            self._error(6)
            return b""
        for part in text.replace(" ", "").upper().split(";"):
            if part:
                try:
                    reply = self._one(part)
                except _Refusal as refusal:
                    self._error(refusal.code, refusal.axis)
                    continue
                if reply is not None:
                    replies.append(reply.encode("ascii") + b"\r\n")
        return b"".join(replies)

    def _one(self, text: str) -> str | None:
        match = _COMMAND.fullmatch(text)
        if match is None:
            raise _Refusal(6)
        number, word, parameter = match.groups()
        if word in ("VE", "TE", "TB", "AB") or (word == "ST" and not number):
            return self._general(word)
        if word not in self._words:
            raise _Refusal(6)
        if not number:
            raise _Refusal(37)
        axis = self._axes.get(int(number))
        if axis is None:
            raise _Refusal(9)
        try:
            return self._words[word](int(number), axis, parameter)
        except ValueError as error:
            raise _Refusal(7) from error

    def _general(self, word: str) -> str | None:
        if word == "VE":
            return "ESP301 Version 3.09 08/01/15"
        if word == "TE":
            return str(self._queue.popleft()[0] if self._queue else 0)
        if word == "TB":
            code, stamp = self._queue.popleft() if self._queue else (0, int(self.clock.now() / _TICK_S))
            return f"{code}, {stamp}, {_TEXTS[code] if code < 100 else _AXIS_TEXTS[code % 100]}"
        for number, axis in self._axes.items():
            if word == "ST":
                self._st(number, axis, "")
            else:
                self._mf(number, axis, "")
        if word == "AB":
            self._error(4)
        return None

    def _error(self, code: int, axis: int | None = None) -> None:
        number = code if axis is None else 100 * axis + code
        self._queue.append((number, int(self.clock.now() / _TICK_S)))

    def _update(self) -> None:
        for number, axis in self._axes.items():
            trouble = axis.motor.take_trouble()
            if trouble is not None:
                self._error(_TROUBLE_CODES[trouble], number)
                if axis.homing:
                    axis.homing = False
                    self._error(20, number)
                if trouble == "following_error":
                    axis.power = False
            if axis.homing and not axis.motor.moving:
                axis.homing = False
                axis.motor.set_home()

    def _start(self, number: int, axis: _Axis, target_mm: float) -> None:
        if axis.homing:
            raise _Refusal(30, number)
        if not axis.power:
            raise _Refusal(13, number)
        if target_mm > axis.high_mm:
            raise _Refusal(6, number)
        if target_mm < axis.low_mm:
            raise _Refusal(7, number)
        axis.motor.move_to(target_mm)
        return

    def _pa(self, number: int, axis: _Axis, parameter: str) -> str | None:
        if parameter == "?":
            return axis.show(axis.motor.goal_mm)
        if not parameter:
            raise _Refusal(38)
        self._start(number, axis, axis.take(parameter))
        return None

    def _pr(self, number: int, axis: _Axis, parameter: str) -> str | None:
        if not parameter:
            raise _Refusal(38)
        self._start(number, axis, axis.motor.goal_mm + axis.take(parameter))
        return None

    def _mo(self, _number: int, axis: _Axis, parameter: str) -> str | None:
        if parameter == "?":
            return "1" if axis.power else "0"
        axis.power = True
        return None

    def _mf(self, number: int, axis: _Axis, parameter: str) -> str | None:
        if parameter == "?":
            return "0" if axis.power else "1"
        axis.motor.cut()
        if axis.homing:
            axis.homing = False
            self._error(20, number)
        axis.power = False
        return None

    def _ws(self, _number: int, axis: _Axis, parameter: str) -> str | None:
        """Delay the following commands until the axis rests; as with the real one, even a stop waits behind it."""
        after_s = float(parameter or 0.0) / 1000 / self.clock.time_scale
        while axis.motor.moving:
            time.sleep(0.001)
        time.sleep(after_s)
        self._update()
        return None

    def _or(self, number: int, axis: _Axis, parameter: str) -> str | None:
        mode = int(parameter) if parameter else axis.home_mode
        if not 0 <= mode <= 6:
            raise _Refusal(1, number)
        if not axis.power:
            raise _Refusal(13, number)
        axis.homing = True
        axis.motor.move_home()
        return None

    def _dh(self, _number: int, axis: _Axis, parameter: str) -> str | None:
        axis.motor.define_position(axis.take(parameter) if parameter else 0.0)
        return None

    def _st(self, number: int, axis: _Axis, _parameter: str) -> str | None:
        axis.motor.stop()
        if axis.homing:
            axis.homing = False
            self._error(20, number)
        return None

    def _setting(self, setting: _Setting, number: int, axis: _Axis, parameter: str) -> str | None:
        owner = axis.motor if setting.of_motor else axis
        if parameter == "?":
            return axis.show(getattr(owner, setting.name))
        value = axis.take(parameter)
        if not setting.allowed(axis, value):
            raise _Refusal(setting.code, number)
        setattr(owner, setting.name, value)
        return None

    def _sn(self, number: int, axis: _Axis, parameter: str) -> str | None:
        if parameter == "?":
            return str(axis.unit)
        if int(parameter) not in _UNITS:
            raise _Refusal(1, number)
        axis.unit = int(parameter)  # as with the real controller, the stage stays in place and its numbers change
        return None
