"""A simulated chain of SMC100CC controllers: one axis an address, its states, its error letters and fault bits.

State numbers, letters and texts are the manual's. Only the first command on a line is carried out, as with the real
one.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from sim.controllers.axis import SimAxis, SimClock, Trouble
from sim.controllers.wire import WireController

_COMMAND = re.compile(r"(\d*)([A-Z]{2})(\?|[A-Z@]$|[-+.\dEe]*)")

_TEXTS = {
    "@": "No error.",
    "A": "Unknown message code or floating point controller address.",
    "B": "Controller address not correct.",
    "C": "Parameter missing or out of range.",
    "D": "Command not allowed.",
    "E": "Home sequence already started.",
    "G": "Displacement out of limits.",
    "H": "Command not allowed in NOT REFERENCED state.",
    "I": "Command not allowed in CONFIGURATION state.",
    "J": "Command not allowed in DISABLE state.",
    "K": "Command not allowed in READY state.",
    "L": "Command not allowed in HOMING state.",
    "M": "Command not allowed in MOVING state.",
}
_BITS: dict[Trouble, int] = {"negative_limit": 0x0001, "positive_limit": 0x0002, "following_error": 0x0020}

_NOT_REFERENCED = (0x0A, 0x0B, 0x0C, 0x0F)
_CONFIGURATION = 0x14
_HOMING = 0x1E
_MOVING = 0x28
_READY = (0x32, 0x33, 0x34)
_DISABLE = (0x3C, 0x3D)


class _Refusal(Exception):
    """A command that leaves an error letter instead of being carried out."""


@dataclass
class _Unit:
    motor: SimAxis
    low_mm: float
    high_mm: float
    max_velocity_mm_s: float
    state: int = 0x0A
    errors: int = 0
    letter: str = "@"

    def group(self) -> str:
        """Return the letter for a command that this state does not allow."""
        for states, letter in ((_NOT_REFERENCED, "H"), (_READY, "K"), (_DISABLE, "J")):
            if self.state in states:
                return letter
        return {_CONFIGURATION: "I", _HOMING: "L", _MOVING: "M"}[self.state]


class SimSMC100(WireController):
    """The simulated chain.

    Parameters
    ----------
    addresses
        Addresses on the chain, 1 to 31.
    travel_mm
        (low, high) software limits that each reports, measured from home.
    velocity_mm_s, acceleration_mm_s2
        Power-on values.
    time_scale
        How many times faster than real the axes run; the speeds that they report stay those of the stage.
    start_mm
        Where the axes stand at power-on, from home.
    """

    terminator = b"\r\n"

    def __init__(
        self,
        *,
        addresses: tuple[int, ...] = (1, 2),
        travel_mm: tuple[float, float] = (-50.0, 50.0),
        velocity_mm_s: float = 10.0,
        acceleration_mm_s2: float = 40.0,
        time_scale: float = 1.0,
        start_mm: float = 0.0,
    ) -> None:
        super().__init__()
        if not addresses or not all(1 <= address <= 31 for address in addresses):
            raise ValueError(f"addresses lie between 1 and 31, got {addresses}")
        self.clock = SimClock(time_scale)
        self._units = {
            address: _Unit(
                SimAxis(
                    self.clock,
                    velocity_mm_s=velocity_mm_s,
                    acceleration_mm_s2=acceleration_mm_s2,
                    start_mm=start_mm,
                ),
                travel_mm[0],
                travel_mm[1],
                max_velocity_mm_s=4 * velocity_mm_s,
            )
            for address in addresses
        }
        self._words: dict[str, Callable[[_Unit, str], str | None]] = {
            "PA": self._pa,
            "PR": self._pr,
            "PT": self._pt,
            "TP": lambda unit, _p: f"{unit.motor.encoder_mm:.4f}",
            "TH": lambda unit, _p: f"{unit.motor.goal_mm:.4f}",
            "TS": lambda unit, _p: f"{unit.errors:04X}{unit.state:02X}",
            "TE": self._te,
            "TB": lambda _u, p: f"{p} {_TEXTS[p]}" if p in _TEXTS else None,
            "OR": self._or,
            "MM": self._mm,
            "ST": self._st,
            "VA": self._va,
            "AC": self._ac,
            "SL": self._sl,
            "SR": self._sr,
            "PW": self._pw,
            "RS": self._rs,
            "ID": lambda _u, _p: "SIM-TRA25CC",
            "VE": lambda _u, _p: " SMC100CC 1.2.0",
        }

    def axis(self, number: int) -> SimAxis:
        """Give access to an axis and its faults."""
        return self._units[number].motor

    def cut_power(self) -> bytes:
        """Lose the motor supply and get it back: all references are gone, and the chain sends a NUL byte."""
        with self._lock:
            for unit in self._units.values():
                unit.motor.cut()
                unit.state, unit.errors, unit.letter = 0x0A, 0, "@"
            self.line_faults.stray += b"\0"
        return b"\0"

    def _execute(self, text: str) -> bytes:
        for unit in self._units.values():
            self._update(unit)
        match = _COMMAND.match(text.strip("\0 ").upper())
        if match is None:
            return b""
        number, word, parameter = match.groups()
        if not number:
            if word == "ST":
                for unit in self._units.values():
                    self._st(unit, "")
            return b""
        unit_or_none = self._units.get(int(number))
        if unit_or_none is None:
            return b""
        unit = unit_or_none
        if word not in self._words:
            unit.letter = "A"
            return b""
        try:
            reply = self._words[word](unit, parameter)
        except _Refusal as refusal:
            unit.letter = str(refusal)
            return b""
        except ValueError:
            unit.letter = "C"
            return b""
        if reply is None:
            return b""
        return f"{int(number)}{word}{reply}\r\n".encode("ascii")

    def _update(self, unit: _Unit) -> None:
        trouble = unit.motor.take_trouble()
        if trouble is not None:
            unit.errors |= _BITS[trouble]
            if unit.state == _HOMING:
                unit.state = 0x0B
            elif trouble == "following_error":
                unit.state = 0x3D
            else:
                unit.state = 0x0F
        if unit.state in (_HOMING, _MOVING) and not unit.motor.moving:
            if unit.state == _HOMING:
                unit.motor.set_home()
            unit.state = 0x32 if unit.state == _HOMING else 0x33

    def _move(self, unit: _Unit, target_mm: float) -> None:
        if unit.state not in _READY:
            raise _Refusal(unit.group())
        if not unit.low_mm <= target_mm <= unit.high_mm:
            raise _Refusal("G")
        unit.motor.move_to(target_mm)
        unit.state = _MOVING

    def _pa(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return f"{unit.motor.goal_mm:.4f}"
        self._move(unit, float(parameter))
        return None

    def _pr(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return f"{unit.motor.goal_mm:.4f}"
        self._move(unit, unit.motor.goal_mm + float(parameter))
        return None

    def _pt(self, unit: _Unit, parameter: str) -> str | None:
        speed, ramp = unit.motor.velocity_mm_s, unit.motor.acceleration_mm_s2
        return f"{abs(float(parameter)) / speed + speed / ramp:.4f}"

    def _te(self, unit: _Unit, _parameter: str) -> str | None:
        letter, unit.letter = unit.letter, "@"
        return letter

    def _or(self, unit: _Unit, _parameter: str) -> str | None:
        if unit.state == _HOMING:
            raise _Refusal("E")
        if unit.state not in _NOT_REFERENCED:
            raise _Refusal(unit.group())
        unit.errors = 0
        unit.state = _HOMING
        unit.motor.move_home()
        return None

    def _mm(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "0" and unit.state in _READY:
            unit.state = 0x3C
        elif parameter == "1" and unit.state in _DISABLE:
            unit.state, unit.errors = 0x34, 0
        elif parameter not in ("0", "1"):
            raise _Refusal("C")
        else:
            raise _Refusal(unit.group())
        return None

    def _st(self, unit: _Unit, _parameter: str) -> str | None:
        unit.motor.stop()
        if unit.state == _HOMING:
            unit.motor.cut()
            unit.state = 0x0B
        return None

    def _va(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return f"{unit.motor.velocity_mm_s:.4f}"
        self._check_settable(unit)
        value = float(parameter)
        if not 0 < value <= unit.max_velocity_mm_s:
            raise _Refusal("C")
        unit.motor.velocity_mm_s = value
        return None

    def _ac(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return f"{unit.motor.acceleration_mm_s2:.4f}"
        self._check_settable(unit)
        value = float(parameter)
        if not value > 0:
            raise _Refusal("C")
        unit.motor.acceleration_mm_s2 = value
        return None

    def _sl(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return f"{unit.low_mm:.4f}"
        self._check_settable(unit)
        unit.low_mm = float(parameter)
        return None

    def _sr(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return f"{unit.high_mm:.4f}"
        self._check_settable(unit)
        unit.high_mm = float(parameter)
        return None

    def _pw(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return "1" if unit.state == _CONFIGURATION else "0"
        if parameter == "1" and unit.state in _NOT_REFERENCED:
            unit.state = _CONFIGURATION
        elif parameter == "0" and unit.state == _CONFIGURATION:
            unit.state = 0x0C
        else:
            raise _Refusal(unit.group())
        return None

    def _rs(self, unit: _Unit, _parameter: str) -> str | None:
        unit.motor.cut()
        unit.state, unit.errors, unit.letter = 0x0A, 0, "@"
        return None

    @staticmethod
    def _check_settable(unit: _Unit) -> None:
        if unit.state not in (*_READY, *_DISABLE, _CONFIGURATION):
            raise _Refusal(unit.group())
