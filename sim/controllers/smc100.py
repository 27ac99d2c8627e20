"""A simulated chain of SMC100CC, SMC100PP or CONEX-CC controllers: one axis an address, states, letters, fault bits.

State numbers, letters and texts are the manual's. Only the first command on a line is carried out, as with the real
one. In CONFIGURATION state limits and the largest velocity and acceleration are the flash memory's, which leaving that
state writes; elsewhere velocity, acceleration and limits are working values.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Unpack

from stereorig.sim.controllers.axis import SimAxis, Trouble
from stereorig.sim.controllers.wire import Motion, WireAxis, WireController

_COMMAND = re.compile(r"([0-9]*)(FRM|FRS|QIL|[A-Z]{2})(\?|[A-Z@]$|[-+.0-9Ee]*)")

_TEXTS = {
    "@": "No error.",
    "A": "Unknown message code or floating point controller address.",
    "B": "Controller address not correct.",
    "C": "Parameter missing or out of range.",
    "D": "Command not allowed.",
    "E": "Home sequence already started.",
    "F": "ESP stage name unknown.",
    "G": "Displacement out of limits.",
    "H": "Command not allowed in NOT REFERENCED state.",
    "I": "Command not allowed in CONFIGURATION state.",
    "J": "Command not allowed in DISABLE state.",
    "K": "Command not allowed in READY state.",
    "L": "Command not allowed in HOMING state.",
    "M": "Command not allowed in MOVING state.",
    "N": "Current position out of software limit.",
    "S": "Communication Time Out.",
    "U": "Error during EEPROM access.",
    "V": "Error during command execution.",
    "W": "Command not allowed for PP version.",
    "X": "Command not allowed for CC version.",
}
_BITS: dict[Trouble, int] = {"negative_limit": 0x0001, "positive_limit": 0x0002, "following_error": 0x0020}

_NOT_REFERENCED = (0x0A, 0x0B, 0x0C, 0x0F)
_CONFIGURATION = 0x14
_HOMING = 0x1E
_MOVING = 0x28
_READY = (0x32, 0x33, 0x34)
_DISABLE = (0x3C, 0x3D)

Model = Literal["SMC100CC", "SMC100PP", "CONEX-CC"]
_VERSIONS: dict[Model, str] = {"SMC100CC": "1.2.0", "SMC100PP": "1.2.0", "CONEX-CC": "2.0.1"}
# configuration that is only stored: word -> (default, lowest, highest), as in the SMC100PP's manual
_KEPT = {
    "BA": (0.0, 0.0, 1e12),
    "BH": (0.0, 0.0, 1e12),
    "FRM": (100.0, 1.0, 2000.0),
    "FRS": (0.02, 1e-6, 1e12),
    "HT": (2.0, 0.0, 4.0),
    "JR": (0.04, 1e-3, 1e12),
    "OH": (4.0, 1e-6, 1e12),
    "OT": (27.5, 1.0, 1e3),
    "QIL": (0.4, 0.05, 3.0),
    "SA": (2.0, 2.0, 31.0),
    "VB": (0.0, 0.0, 1e12),
    "ZX": (3.0, 1.0, 3.0),
}
_STEPPERS_ONLY = ("FRM", "FRS", "VB")
_COMPENSATIONS = {"BA": "BH", "BH": "BA"}


class _Refusal(Exception):
    """A command that leaves an error letter instead of being carried out."""


@dataclass
class _Unit(WireAxis):
    kept: dict[str, float] = field(default_factory=lambda: {word: value for word, (value, _, _) in _KEPT.items()})
    flash_writes: int = 0
    state: int = 0x0A
    errors: int = 0
    letter: str = "@"
    loop: str = "1"

    def __post_init__(self) -> None:
        self.stored_low_mm, self.stored_high_mm = self.low_mm, self.high_mm

    def group(self) -> str:
        """Return the letter for a command that this state does not allow."""
        for states, letter in ((_NOT_REFERENCED, "H"), (_READY, "K"), (_DISABLE, "J")):
            if self.state in states:
                return letter
        return {_CONFIGURATION: "I", _HOMING: "L", _MOVING: "M"}[self.state]


class SimSMC100(WireController):
    """The simulated chain.

    Attributes
    ----------
    addresses
        Addresses on the chain, 1 to 31.
    model
        Model that each controller reports.
    motion
        See `stereorig.sim.controllers.wire.Motion`.
    """

    terminator = b"\r\n"

    def __init__(
        self, *, addresses: tuple[int, ...] = (1, 2), model: Model = "SMC100CC", **motion: Unpack[Motion]
    ) -> None:
        super().__init__(motion.get("time_scale", 1.0))
        self.model: Model = model
        if not addresses or not all(1 <= address <= 31 for address in addresses):
            raise ValueError(f"addresses lie between 1 and 31, got {addresses}")
        self._units = {address: _Unit.make(self.clock, **motion) for address in addresses}
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
            "VA": functools.partial(self._speed, "velocity_mm_s"),
            "AC": functools.partial(self._speed, "acceleration_mm_s2"),
            "SL": functools.partial(self._limit, "low_mm"),
            "SR": functools.partial(self._limit, "high_mm"),
            "PW": self._pw,
            "RS": self._rs,
            "ID": lambda _u, _p: "SIM-TRA25CC",
            "VE": lambda _u, _p: f" {self.model} {_VERSIONS[self.model]}",
        }
        if model == "CONEX-CC":
            self._words["SC"] = lambda unit, _p: unit.loop

    def axis(self, number: int) -> SimAxis:
        """Give access to an axis and its faults."""
        return self._units[number].motor

    def flash_writes(self, number: int) -> int:
        """Count how often a controller has written its flash memory, which bears about a hundred times."""
        return self._units[number].flash_writes

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
        if word == "ZT":
            return self._configuration(int(number), unit)
        try:
            if word in _KEPT:
                reply = self._keep(unit, word, parameter)
            elif word in self._words:
                reply = self._words[word](unit, parameter)
            else:
                raise _Refusal("A")
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

    def _configuration(self, address: int, unit: _Unit) -> bytes:
        """List the whole configuration, as it would have to be sent to another controller."""
        values = {
            "AC": unit.max_acceleration_mm_s2,
            "SL": unit.stored_low_mm,
            "SR": unit.stored_high_mm,
            "VA": unit.max_velocity_mm_s,
            **{word: value for word, value in unit.kept.items() if self._supports(word)},
        }
        lines = ["PW1", "IDSIM-TRA25CC", *(f"{word}{values[word]:g}" for word in sorted(values)), "PW0"]
        return "".join(f"{address}{line}\r\n" for line in lines).encode("ascii")

    def _supports(self, word: str) -> bool:
        return self.model == "SMC100PP" or word not in _STEPPERS_ONLY

    def _keep(self, unit: _Unit, word: str, parameter: str) -> str | None:
        if not self._supports(word):
            raise _Refusal("X")
        if parameter == "?":
            return f"{unit.kept[word]:g}"
        if unit.state != _CONFIGURATION:
            raise _Refusal(unit.group())
        value, (_, low, high) = float(parameter), _KEPT[word]
        other = _COMPENSATIONS.get(word)
        # zero is no value that a compensation can be set to: the other command switches it off
        if not low <= value <= high or (other is not None and value == 0):
            raise _Refusal("C")
        unit.kept[word] = value
        if other is not None:
            unit.kept[other] = 0.0
        return None

    def _speed(self, name: str, unit: _Unit, parameter: str) -> str | None:
        """Show or set ``velocity_mm_s`` or ``acceleration_mm_s2``; in configuration, the largest one too."""
        if parameter == "?":
            return f"{getattr(unit.motor, name):.4f}"
        self._check_settable(unit)
        value = float(parameter)
        if unit.state == _CONFIGURATION and 1e-6 < value < 1e12:
            setattr(unit, f"max_{name}", value)
        if not 0 < value <= getattr(unit, f"max_{name}"):
            raise _Refusal("C")
        setattr(unit.motor, name, value)
        return None

    def _limit(self, name: str, unit: _Unit, parameter: str) -> str | None:
        """Show or set ``low_mm`` or ``high_mm``; in configuration, the stored one too."""
        if parameter == "?":
            return f"{getattr(unit, name):.4f}"
        self._check_settable(unit)
        value = float(parameter)
        if not 0 <= (value if name == "high_mm" else -value) < 1e12:
            raise _Refusal("C")
        setattr(unit, name, value)
        if unit.state == _CONFIGURATION:
            setattr(unit, f"stored_{name}", value)
        return None

    def _pw(self, unit: _Unit, parameter: str) -> str | None:
        if parameter == "?":
            return "1" if unit.state == _CONFIGURATION else "0"
        if parameter == "1" and unit.state in _NOT_REFERENCED:
            unit.state = _CONFIGURATION
        elif parameter == "0" and unit.state == _CONFIGURATION:
            unit.state = 0x0C
            unit.flash_writes += 1
        else:
            raise _Refusal(unit.group())
        return None

    def _rs(self, unit: _Unit, _parameter: str) -> str | None:
        unit.motor.cut()
        unit.state, unit.errors, unit.letter = 0x0A, 0, "@"
        unit.low_mm, unit.high_mm = unit.stored_low_mm, unit.stored_high_mm
        return None

    @staticmethod
    def _check_settable(unit: _Unit) -> None:
        if unit.state not in (*_READY, *_DISABLE, _CONFIGURATION):
            raise _Refusal(unit.group())
