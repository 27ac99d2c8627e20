"""Newport SMC100 (CC and PP) and CONEX-CC: one axis a controller, up to 31 on one line, by address.

Commands and replies end in CR LF, and a reply repeats address and command, so it always names its question. The
controller reports if it was homed; it refuses with a letter (``H``: not allowed in NOT REFERENCED state) and reports
faults of the motion as bits next to its state. Further commands on a line are dropped, so each command has its own
line. A NUL byte on the line means that the motor's power was cut and came back.

Two traps. Homing is possible in NOT REFERENCED state only: a controller that holds its reference just moves to zero.
And in CONFIGURATION state, which a program may have left it in, it refuses every motion; leaving that state writes its
flash memory, which bears a hundred writes, so this is only done on request.

References
----------
Newport, *SMC100CC & SMC100PP, Single-Axis Motion Controller/Driver, User's Manual*; *CONEX-CC, Controller
Documentation*: command TS and appendices on errors.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from stereorig.core.errors import StageError
from stereorig.drivers.stages.protocol import (
    AxisIdentity,
    AxisOptions,
    AxisState,
    AxisStatus,
    ControllerMessage,
    StageIdentity,
)
from stereorig.drivers.stages.refusals import (
    configuration_state,
    motion_fault,
    motor_off,
    not_homed,
    not_in_configuration,
)
from stereorig.drivers.stages.wire_stage import WireStage, finite

_STATES = {
    **dict.fromkeys((0x0A, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x10, 0x11), AxisState.NOT_HOMED),
    0x14: AxisState.CONFIGURATION,
    **dict.fromkeys((0x1E, 0x1F), AxisState.HOMING),
    0x28: AxisState.MOVING,
    **dict.fromkeys((0x32, 0x33, 0x34, 0x35), AxisState.READY),
    **dict.fromkeys((0x3C, 0x3D, 0x3E, 0x3F), AxisState.MOTOR_OFF),
}
_POSITIONER_ERRORS = (
    "negative end of run",
    "positive end of run",
    "peak current limit",
    "RMS current limit",
    "short circuit",
    "following error",
    "homing time out",
    "wrong ESP stage",
    "DC voltage too low",
    "80 W output power exceeded",
)
_CODES = {
    "C": "out_of_range",
    "G": "out_of_limits",
    "H": "not_homed",
    "I": "configuration_state",
    "J": "motor_off",
    "N": "out_of_limits",
}
# moved by the keypad (SMC100) or by a stream of targets (CONEX-CC)
_FOREIGN_MOTION = (0x46, 0x47)
_READY_TO_TRACK = (0x36, 0x37, 0x38)
_OPEN_LOOP = "its control loop is off (SC0): it moves, and holds no position"
_CONFIGURATION_S = 12.0  # leaving CONFIGURATION takes the controller up to 10 s, in which it is silent


class SMC100Stage(WireStage):
    """Driver for a chain of SMC100 or CONEX-CC controllers; see `stereorig.drivers.stages.wire_stage.WireStage`.

    The controller's own number of an axis is its address.
    """

    _driver = "smc100"
    _terminator, _baudrate, _flow_control = b"\r\n", 57600, "software"

    def __init__(self, url: str, options: Mapping[int, AxisOptions], **settings: Any) -> None:
        super().__init__(url, options, **settings)
        self._known_errors: dict[int, int] = {}
        self._open_loop: set[int] = set()

    def leave_configuration(self, axis: int) -> None:
        """Leave CONFIGURATION state (PW0), which writes the controller's flash memory; never done unasked."""
        self._check_axis(axis)
        with self._motion_lock:
            if self._read_status(axis).state is not AxisState.CONFIGURATION:
                raise not_in_configuration(axis)
            self._line.command(f"{self._own[axis]}PW0")
            time.sleep(0.1)
            self._read_word(axis, timeout_s=_CONFIGURATION_S)
            self._raise_refusal((axis,), "leaving of the configuration state")

    def _text(self, axis: int, word: str, parameter: str = "") -> str:
        return self._line.query(
            f"{self._own[axis]}{word}{parameter}", lambda line: _answer(self._own[axis], word, line)
        )

    def _number(self, axis: int, word: str, parameter: str = "") -> float:
        return self._line.query(
            f"{self._own[axis]}{word}{parameter}", lambda line: finite(_answer(self._own[axis], word, line))
        )

    def _read_word(self, axis: int, *, timeout_s: float | None = None) -> tuple[int, int]:
        return self._line.query(
            f"{self._own[axis]}TS", lambda line: _status_word(self._own[axis], line), timeout_s=timeout_s
        )

    def _connect(self) -> StageIdentity:
        versions = {axis: self._text(axis, "VE") for axis in self.axes}
        # the stage's name is the first part of "LTA-HS_PN:B..._UD:..."
        names = {axis: self._text(axis, "ID", "?").partition("_PN:")[0] for axis in self.axes}
        axes = tuple(AxisIdentity(axis, names[axis], versions[axis]) for axis in self.axes)
        return StageIdentity(self._driver, *_model_and_firmware(versions[self.axes[0]]), self._line.url, axes)

    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        return self._number(axis, "SL", "?"), self._number(axis, "SR", "?")

    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        # without a reference the controller refuses new speeds; homing comes back here
        if self._read_status(axis).state in (AxisState.READY, AxisState.MOTOR_OFF):
            option = self._options[axis]
            self._keep(self._drain_errors(axis))
            if option.acceleration_mm_s2 is not None:
                self._line.command(f"{self._own[axis]}AC{option.acceleration_mm_s2:.6f}")
            if option.velocity_mm_s is not None:
                self._line.command(f"{self._own[axis]}VA{option.velocity_mm_s:.6f}")
            self._raise_refusal((axis,), f"velocity {option.velocity_mm_s} mm/s")
        return self._number(axis, "VA", "?"), self._number(axis, "AC", "?")

    def _read_position_mm(self, axis: int) -> float:
        return self._number(axis, "TP")

    def _read_status(self, axis: int) -> AxisStatus:
        errors, number = self._read_word(axis)
        fresh = self._fresh_errors(axis, errors)
        self._keep(fresh)
        state = _STATES.get(number, AxisState.FAULT)
        detail = "; ".join(message.text for message in fresh)
        if fresh and state is not AxisState.NOT_HOMED:
            state = AxisState.FAULT
        if number in _FOREIGN_MOTION:
            detail = "it is moved by a keypad, or follows targets (TK1); stop it first"
        elif number in _READY_TO_TRACK:
            detail = "it waits for targets to follow (TK1); leave that by TK0"
        elif number not in _STATES:
            detail = f"unknown state {number:02X}"
        elif state is AxisState.CONFIGURATION:
            detail = "it was left in its configuration state (PW1); leave it by PW0"
        moving = number in (0x1E, 0x1F, 0x28, *_FOREIGN_MOTION)
        homed = _STATES.get(number) not in (AxisState.NOT_HOMED, AxisState.CONFIGURATION, AxisState.HOMING)
        motor_on = _STATES.get(number) in (AxisState.READY, AxisState.MOVING, AxisState.HOMING)
        return AxisStatus(axis, state, self._read_position_mm(axis), motor_on, homed, moving, detail)

    def _fresh_errors(self, axis: int, errors: int) -> list[ControllerMessage]:
        """Return the faults since the last reading; some models clear them on reading, some do not."""
        fresh = errors & ~self._known_errors.get(axis, 0)
        self._known_errors[axis] = errors
        return [
            ControllerMessage(f"{1 << bit:04X}", text, axis)
            for bit, text in enumerate(_POSITIONER_ERRORS)
            if fresh >> bit & 1
        ]

    def _switch_motor(self, axis: int, *, on: bool) -> None:
        status = self._read_status(axis)
        if status.motor_on is on or not status.homed:
            return  # before homing there is nothing to switch: homing itself switches the motor on
        self._line.command(f"{self._own[axis]}MM{1 if on else 0}")
        self._raise_refusal((axis,), f"motor {'on' if on else 'off'}")
        if self._read_status(axis).motor_on is not on:
            raise StageError(
                f"The motor of axis {axis} did not switch {'on' if on else 'off'}.",
                code="motion_fault",
                remedy="Check the motor cable and the controller's power.",
                axis=axis,
            )

    def _start_homing(self, axis: int) -> None:
        status = self._read_status(axis)
        if status.state is AxisState.CONFIGURATION:
            raise configuration_state(axis)
        if status.state is AxisState.MOTOR_OFF:
            raise motor_off(axis)
        self._keep(self._drain_errors(axis))
        self._line.command(f"{self._own[axis]}PA0" if status.homed else f"{self._own[axis]}OR")
        self._raise_refusal((axis,), "search for home")

    def _finish_homing(self, axis: int) -> None:
        status = self._read_status(axis)
        if not status.homed:
            raise motion_fault(axis, f"did not find home ({status.detail or status.state})")
        self._velocity_mm_s[axis], self._acceleration_mm_s2[axis] = self._set_dynamics(axis)

    def _send_move(self, axis: int, position_mm: float) -> None:
        self._line.command(f"{self._own[axis]}PA{position_mm:.6f}")

    def _stop_text(self, axis: int | None) -> str:
        return "ST" if axis is None else f"{self._own[axis]}ST"

    def _abort_text(self) -> str:
        return "ST"  # it has no harder one; the motors follow when all is at rest

    def _check_settable(self, axis: int) -> None:
        status = self._read_status(axis)
        if status.state is AxisState.CONFIGURATION:
            raise configuration_state(axis)
        if not status.homed:
            raise not_homed(axis)

    def _drain_errors(self, axis: int | None = None) -> list[ControllerMessage]:
        found: list[ControllerMessage] = []
        for address in self.axes if axis is None else (axis,):
            found += self._fresh_errors(address, self._read_word(address)[0])
            letter = self._text(address, "TE")
            if letter != "@":
                text = self._text(address, "TB", letter)
                found.append(ControllerMessage(letter, text.removeprefix(letter).strip(), address))
        return found

    def _code_of(self, message: ControllerMessage) -> str | None:
        # a fault of the positioner has four digits: the command was taken, its motion failed
        return "motion_fault" if len(message.code) == 4 else _CODES.get(message.code)


class ConexCCStage(SMC100Stage):
    """Driver for the CONEX-CC: the SMC100's commands over USB at 921600 baud, with the version ``CONEX-CC``."""

    _driver = "conex-cc"
    _baudrate = 921600

    def _connect(self) -> StageIdentity:
        identity = super()._connect()
        self._open_loop = {axis for axis in self.axes if self._loop_is_open(axis)}
        self._keep([ControllerMessage("SC0", _OPEN_LOOP, axis) for axis in sorted(self._open_loop)])
        return identity

    def _loop_is_open(self, axis: int) -> bool:
        try:
            return self._text(axis, "SC", "?") == "0"
        except StageError:  # a firmware without this query
            return False

    def _read_status(self, axis: int) -> AxisStatus:
        status = super()._read_status(axis)
        if axis not in self._open_loop:
            return status
        return replace(status, detail="; ".join(text for text in (status.detail, _OPEN_LOOP) if text))


def _model_and_firmware(version: str) -> tuple[str, str]:
    """Return both from ``CONEX-CC 2.0.1`` or ``SMC_CC - Controller-driver version  3. 1. 2``."""
    found = re.fullmatch(r"(\S+)(?: - [^0-9]{0,40})? +([0-9][0-9. ]*)", version)
    if found is None:
        return version, ""
    model = found[1].replace("SMC_", "SMC100") if found[1].startswith("SMC_") else found[1]
    return model, found[2].replace(" ", "")


def _answer(axis: int, word: str, line: str) -> str:
    prefix = f"{axis}{word}"
    if not line.startswith(prefix) or not line.isprintable():
        raise ValueError(f"not an answer to {prefix}")
    return line.removeprefix(prefix).strip()


def _status_word(axis: int, line: str) -> tuple[int, int]:
    """Read ``1TSabcdef``: positioner errors (abcd) and state (ef), both hexadecimal."""
    text = _answer(axis, "TS", line)
    if not re.fullmatch(r"[0-9A-Fa-f]{6}", text):
        raise ValueError("not a state of six hexadecimal digits")
    return int(text[:4], 16), int(text[4:], 16)
