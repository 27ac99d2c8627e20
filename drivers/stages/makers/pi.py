"""PI's motion controllers by their General Command Set, GCS 2 (C-863, C-884, C-867, E-873 and others).

A reply names its axis and not its question, so the line is synchronised again by asking for the identity. The
controller keeps one error, which reading clears, and knows if an axis has its reference (``FRF?``). Single control
characters are commands without an end: one asks for motion, another one stops all axes at once.

References
----------
Physik Instrumente, *C-863 Mercury Controller*, user manual MS249E, and *PI GCS 2.0* commands: error codes.
"""

from __future__ import annotations

from stereorig.core.errors import StageError
from stereorig.drivers.stages.protocol import AxisIdentity, AxisState, AxisStatus, ControllerMessage, StageIdentity
from stereorig.drivers.stages.refusals import motion_fault, motor_off, unit_not_length
from stereorig.drivers.stages.serial_line import SerialLine
from stereorig.drivers.stages.wire_stage import WireStage, finite, flag

_MOTION, _STOP_ALL = "\x05", "\x18"
_UNKNOWN_COMMAND, _STOPPED = 2, 10
_ERRORS: dict[int, tuple[str, str | None]] = {
    2: ("unknown command", None),
    5: ("no reference or no servo", "not_homed"),
    7: ("position out of limits", "out_of_limits"),
    8: ("velocity out of limits", "out_of_range"),
    15: ("no such axis", "invalid_axis"),
    17: ("parameter out of range", "out_of_range"),
    23: ("no such axis", "invalid_axis"),
    45: ("reference not found", "motion_fault"),
    49: ("limit switch not reached", "motion_fault"),
    84: ("motor off", "motor_off"),
    216: ("on a limit switch", "motion_fault"),
    500: ("emergency stop pressed", "motion_fault"),
    501: ("emergency stop was pressed", "motion_fault"),
    1024: ("position error too large, servo switched off", "motion_fault"),
}


class _Line(SerialLine):
    """A line whose single-character commands have no terminator."""

    def _bytes(self, text: str) -> bytes:
        return text.encode("ascii") if text in (_MOTION, _STOP_ALL) else super()._bytes(text)


def _is_identity(line: str) -> bool:
    return line.count(",") >= 3


class PIStage(WireStage):
    """Driver for PI's controllers; parameters as `stereorig.drivers.stages.wire_stage.WireStage`."""

    _line_class, _terminator = _Line, b"\n"
    _resync = ("*IDN?", _is_identity)

    def _text(self, axis: int, word: str) -> str:
        return self._line.query(f"{word} {self._own[axis]}", lambda line: _of_axis(self._own[axis], line))

    def _number(self, axis: int, word: str) -> float:
        return self._line.query(f"{word} {self._own[axis]}", lambda line: finite(_of_axis(self._own[axis], line)))

    def _flag(self, axis: int, word: str) -> bool:
        return self._line.query(f"{word} {self._own[axis]}", lambda line: flag(_of_axis(self._own[axis], line)))

    def _optional(self, axis: int, word: str, default: str) -> str:
        """Return the reply to a question that older firmware does not know and does not answer."""
        self._keep(self._drain_errors())
        try:
            return self._text(axis, word)
        except StageError:
            if str(_UNKNOWN_COMMAND) not in [message.code for message in self._drain_errors()]:
                raise
            return default

    def _connect(self) -> StageIdentity:
        model, serial, firmware = self._line.query("*IDN?", _identity)
        axes = []
        for axis in self.axes:
            unit = self._optional(axis, "PUN?", "MM")
            name = self._optional(axis, "CST?", "a stage")
            if unit.upper() != "MM":
                remedy = "Choose an axis with a linear stage, and set its unit to mm."
                raise unit_not_length(axis, self._line.url, f"{unit} ({name})", remedy)
            axes.append(AxisIdentity(axis, name))
        return StageIdentity("pi", f"PI {model} {serial}", firmware, self._line.url, tuple(axes))

    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        return self._number(axis, "TMN?"), self._number(axis, "TMX?")

    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        option, own = self._options[axis], self._own[axis]
        self._keep(self._drain_errors())
        if option.acceleration_mm_s2 is not None:
            for word in ("ACC", "DEC"):
                self._line.command(f"{word} {own} {option.acceleration_mm_s2:.6f}")
        if option.velocity_mm_s is not None:
            self._line.command(f"VEL {own} {option.velocity_mm_s:.6f}")
        self._raise_refusal((axis,), f"velocity {option.velocity_mm_s} mm/s")
        return self._number(axis, "VEL?"), self._number(axis, "ACC?")

    def _read_position_mm(self, axis: int) -> float:
        return self._number(axis, "POS?")

    def _read_status(self, axis: int) -> AxisStatus:
        # motion first: a position read after it is then the end of the motion
        moving = bool(self._line.query(_MOTION, _bits) >> (self._own[axis] - 1) & 1)
        servo, homed = self._flag(axis, "SVO?"), self._flag(axis, "FRF?")
        position, detail = self._read_position_mm(axis), ""
        if moving:
            state = AxisState.MOVING if homed else AxisState.HOMING
        elif not servo:
            state = AxisState.MOTOR_OFF
            if axis in self._moving:  # before the stop that follows replaces the error
                found = self._drain_errors()
                self._keep(found)
                detail = "; ".join(message.text for message in found)
        else:
            state = AxisState.READY if homed else AxisState.NOT_HOMED
        return AxisStatus(axis, state, position, servo, homed, moving, detail)

    def _switch_motor(self, axis: int, *, on: bool) -> None:
        own = self._own[axis]
        if on:
            self._line.command(f"EAX {own} 1")  # which not every controller has
        self._keep([message for message in self._drain_errors() if message.code != str(_UNKNOWN_COMMAND)])
        self._line.command(f"SVO {own} {int(on)}")
        self._raise_refusal((axis,), f"motor {'on' if on else 'off'}")
        if self._flag(axis, "SVO?") is not on:
            raise motion_fault(axis, f"did not switch its servo {'on' if on else 'off'}")

    def _start_homing(self, axis: int) -> None:
        if not self._flag(axis, "SVO?"):
            raise motor_off(axis)
        self._keep(self._drain_errors())
        self._line.command(f"FRF {self._own[axis]}")
        self._raise_refusal((axis,), "search for home")

    def _finish_homing(self, axis: int) -> None:
        if not self._flag(axis, "FRF?"):
            raise motion_fault(axis, "did not find its reference")

    def _send_move(self, axis: int, position_mm: float) -> None:
        self._line.command(f"MOV {self._own[axis]} {position_mm:.6f}")

    def _stop_text(self, axis: int | None) -> str:
        return "HLT" if axis is None else f"HLT {self._own[axis]}"

    def _abort_text(self) -> str:
        return _STOP_ALL

    def _drain_errors(self, axis: int | None = None) -> list[ControllerMessage]:  # noqa: ARG002 - it keeps one for all
        code = self._line.query("ERR?", int)
        if code in (0, _STOPPED):
            return []
        return [ControllerMessage(str(code), _ERRORS.get(abs(code), ("an error of the controller", None))[0])]

    def _code_of(self, message: ControllerMessage) -> str | None:
        return _ERRORS.get(abs(int(message.code)), ("", None))[1]


def _identity(line: str) -> tuple[str, str, str]:
    if not _is_identity(line) or not line.isprintable():
        raise ValueError("not the identity of a controller")
    model, serial, firmware = (part.strip() for part in line.rsplit(",", 3)[1:])
    return model, serial, firmware


def _of_axis(own: int, line: str) -> str:
    axis, equals, value = line.partition("=")
    if axis.strip() != str(own) or not equals or not value.isprintable():
        raise ValueError(f"not a reply for axis {own}")
    return value.strip()


def _bits(line: str) -> int:
    return int(line, 16)
