"""Thorlabs' controllers of one motor by the APT protocol: K-Cubes, T-Cubes, LTS and MLJ stages.

Messages are binary, six bytes and optional data; here they are hexadecimal text. A reply has the number of its
question, so the line is synchronised again by asking who is there. A stop after half a message is not understood, as
binary messages have no end. The controller counts encoder counts or microsteps, whose length is in the rig file; it
knows if it was homed. Its limits of travel come from the rig file alone.

References
----------
Thorlabs, *APT Controllers, Host-Controller Communications Protocol*, issue 39: messages, status bits, units of time.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Mapping
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
from stereorig.drivers.stages.refusals import motion_fault, motor_off, no_travel, unit_not_length
from stereorig.drivers.stages.serial_line import SerialLine
from stereorig.drivers.stages.wire_stage import WireStage

_HOST, _UNIT, _LONG = 0x01, 0x50, 0x80
_REQ_INFO, _GET_INFO, _STOP_UPDATES = 0x0005, 0x0006, 0x0012
_SET_ENABLED, _SET_SPEEDS, _REQ_SPEEDS, _GET_SPEEDS = 0x0210, 0x0413, 0x0414, 0x0415
_HOME, _HOMED_NOW, _MOVE, _MOVED, _STOP, _STOPPED = 0x0443, 0x0444, 0x0453, 0x0464, 0x0465, 0x0466
_AT_ONCE, _ON_RAMP = 1, 2
_LIMIT_SWITCHES, _MOVING, _HOMING, _HOMED, _POSITION_ERROR, _ENABLED = 0x3, 0xF0, 0x200, 0x400, 0x4000, 1 << 31
# model -> units of a velocity and an acceleration in counts and seconds, question for the state and its reply
_SERVO_S, _BRUSHLESS_S = 2048 / 6e6, 102.4e-6
_Family = tuple[float, float, int, int]
_SERVO: _Family = (65536 * _SERVO_S, 65536 * _SERVO_S**2, 0x0490, 0x0491)
_BRUSHLESS: _Family = (65536 * _BRUSHLESS_S, 65536 * _BRUSHLESS_S**2, 0x0490, 0x0491)
_STEPPER: _Family = (53.68, 0.011, 0x0480, 0x0481)
_FAMILIES = {"DC": _SERVO, "BD": _BRUSHLESS, "ST": _STEPPER, "TS": _STEPPER, "LJ": _STEPPER}  # by letters 2 and 3
_BEGUN_S = 0.5  # after a command the state shows no motion for a moment
_SWITCHED_S = 1.0


def _message(number: int, first: int = 1, second: int = 0, data: bytes = b"") -> str:
    if data:
        return (struct.pack("<HHBB", number, len(data), _UNIT | _LONG, _HOST) + data).hex()
    return struct.pack("<HBBBB", number, first, second, _UNIT, _HOST).hex()


class _Line(SerialLine):
    """A line of binary messages; records the ends of motions and unasked messages of the controller."""

    ended = False

    def _bytes(self, text: str) -> bytes:
        return bytes.fromhex(text)

    def _discard_waiting(self) -> None:
        """Keep unasked messages: none is taken for the reply to another question."""

    def _read_line(self, deadline: float) -> str | None:
        while True:
            held = self._pending
            if len(held) >= 6:
                size = 6 + (held[2] | held[3] << 8 if held[4] & _LONG else 0)
                if held[4] & ~_LONG not in (0, _HOST) or held[5] != _UNIT or size > 261:
                    del held[0]  # noise
                    continue
                if len(held) >= size:
                    found = bytes(held[:size])
                    del held[:size]
                    self.ended |= found[0] | found[1] << 8 in (_HOMED_NOW, _MOVED, _STOPPED)
                    return found.hex()
            if time.monotonic() >= deadline:
                return None
            self._pending += self._read()


class KinesisStage(WireStage):
    """Driver for one controller of one motor; parameters as `stereorig.drivers.stages.wire_stage.WireStage`."""

    _line: _Line
    _line_class, _terminator, _flow_control = _Line, b"", "hardware"
    _resync = (_message(_REQ_INFO, 0), lambda reply: reply.startswith("0600"))

    def __init__(self, url: str, options: Mapping[int, AxisOptions], **settings: Any) -> None:
        super().__init__(url, options, **settings)
        self._mm = {axis: option.mm_per_step or 0.0 for axis, option in options.items()}
        self._family = _SERVO
        self._begun_s = 0.0

    def _ask(self, question: int, reply: int, form: str, first: int = 1) -> tuple[int, ...]:
        def parse(line: str) -> tuple[int, ...]:
            data = bytes.fromhex(line)
            if data[0] | data[1] << 8 != reply or len(data) < 6 + struct.calcsize(form):
                raise ValueError(f"not message {reply:04X}")
            return struct.unpack_from(form, data, 6)

        return self._line.query(_message(question, first), parse)

    def _connect(self) -> StageIdentity:
        self._line.command(_message(_STOP_UPDATES, 0))
        axis = self.axes[0]
        serial, name, low, middle, high = self._ask(_REQ_INFO, _GET_INFO, "<I8s2xBBB", 0)
        model = bytes(name).split(b"\0")[0].decode("ascii", errors="replace").strip()
        family = _FAMILIES.get(model[1:3])
        if family is None:
            raise StageError(
                f"The controller {self._line.url} is a {model!r}, whose units of velocity the driver does not know.",
                code="stage_refused",
                remedy="Use a KDC101, TDC001, KST101, TST001, KBD101, TBD001, LTS or MLJ.",
            )
        self._family = family
        if not self._mm[axis]:
            raise unit_not_length(axis, self._line.url, "encoder counts", "Set mm_per_step in the rig file.")
        identity = AxisIdentity(axis, "a stage", str(serial), "counts")
        return StageIdentity("kinesis", f"Thorlabs {model}", f"{high}.{middle}.{low}", self._line.url, (identity,))

    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        soft = self._options[axis].soft_limits_mm
        if soft is None:
            raise no_travel(axis, self._line.url)
        return soft

    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        option, mm, (speed, ramp, _, _) = self._options[axis], self._mm[axis], self._family
        before = wanted = self._ask(_REQ_SPEEDS, _GET_SPEEDS, "<H3i")  # channel, least velocity, acceleration, velocity
        if option.velocity_mm_s is not None:
            wanted = (*wanted[:3], round(option.velocity_mm_s / mm * speed))
        if option.acceleration_mm_s2 is not None:
            wanted = (*wanted[:2], max(1, round(option.acceleration_mm_s2 / mm * ramp)), wanted[3])
        taken = before
        if wanted != before and max(wanted) < 1 << 31:
            self._line.command(_message(_SET_SPEEDS, data=struct.pack("<H3i", *wanted)))
            taken = self._ask(_REQ_SPEEDS, _GET_SPEEDS, "<H3i")
        if taken != wanted or min(wanted[2:]) <= 0:
            self._line.command(_message(_SET_SPEEDS, data=struct.pack("<H3i", *before)))
            raise StageError(
                f"Axis {axis} did not take the velocity {wanted[3] / speed * mm:g} mm/s and the acceleration "
                f"{wanted[2] / ramp * mm:g} mm/s^2, but {taken[3] / speed * mm:g} and {taken[2] / ramp * mm:g}.",
                code="out_of_range",
                remedy="Give values that the stage can do.",
                axis=axis,
            )
        return taken[3] / speed * mm, taken[2] / ramp * mm

    def _state(self) -> tuple[int, int]:
        _, counts, _, bits = self._ask(*self._family[2:], "<Hi4sI")
        return counts, bits

    def _read_position_mm(self, axis: int) -> float:
        return self._state()[0] * self._mm[axis]

    def _read_status(self, axis: int) -> AxisStatus:
        counts, bits = self._state()
        if self._line.ended or time.monotonic() - self._begun_s > _BEGUN_S:
            self._begun_s = 0.0
        moving = bool(bits & (_MOVING | _HOMING)) or self._begun_s > 0.0
        enabled, homed, detail = bool(bits & _ENABLED), bool(bits & _HOMED), ""
        if moving:
            state = AxisState.HOMING if bits & _HOMING else AxisState.MOVING
        elif bits & _POSITION_ERROR and axis in self._moving:
            state, detail = AxisState.FAULT, "reports: position error too large"
        elif not enabled:
            state = AxisState.MOTOR_OFF
        else:
            state = AxisState.READY if homed else AxisState.NOT_HOMED
        if bits & _LIMIT_SWITCHES and not detail:
            detail = f"is on the {'forward' if bits & 1 else 'reverse'} limit switch"
        return AxisStatus(axis, state, counts * self._mm[axis], enabled, homed, moving, detail)

    def _switch_motor(self, axis: int, *, on: bool) -> None:
        self._line.command(_message(_SET_ENABLED, 1, 1 if on else 2))
        limit = time.monotonic() + _SWITCHED_S
        while bool(self._state()[1] & _ENABLED) is not on:
            if time.monotonic() > limit:
                raise motion_fault(axis, f"did not switch its motor {'on' if on else 'off'}")

    def _begin(self, message: str) -> None:
        self._line.ended, self._begun_s = False, time.monotonic()
        self._line.command(message)

    def _start_homing(self, axis: int) -> None:
        if not self._state()[1] & _ENABLED:
            raise motor_off(axis)
        self._begin(_message(_HOME))

    def _finish_homing(self, axis: int) -> None:
        if not self._state()[1] & _HOMED:
            raise motion_fault(axis, "did not find home")

    def _send_move(self, axis: int, position_mm: float) -> None:
        self._begin(_message(_MOVE, data=struct.pack("<Hi", 1, round(position_mm / self._mm[axis]))))

    def _stop_text(self, axis: int | None) -> str:  # noqa: ARG002 - there is one
        return _message(_STOP, 1, _ON_RAMP)

    def _abort_text(self) -> str:
        return _message(_STOP, 1, _AT_ONCE)

    def _drain_errors(self, axis: int | None = None) -> list[ControllerMessage]:  # noqa: ARG002
        return []  # it keeps none: the state shows a fault

    def _code_of(self, message: ControllerMessage) -> str | None:  # noqa: ARG002
        return None
