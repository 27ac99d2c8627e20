"""Newport XPS (C8, Q8, RL, D), by its own functions over TCP; an axis is the one positioner of a group.

The controller knows its axes by name, ``Group1.Pos`` for axis 1 if the rig file has no other. A motion is stopped on
its ramp by GroupMoveAbort. A search for home can only be ended by GroupKill, which switches the motor off and forgets
the reference; so is every motion ended when the process of this driver dies. As with the SMC100, a group that has its
reference is moved to zero by `home`, since the controller refuses another search.

References
----------
Newport, *XPS Controller, Programmer's Manual*: group states, and the functions named Group and Positioner.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stereorig.drivers.stages.makers.xps_line import XPSLine, XPSRefusal
from stereorig.drivers.stages.protocol import (
    AxisIdentity,
    AxisOptions,
    AxisState,
    AxisStatus,
    ControllerMessage,
    StageIdentity,
)
from stereorig.drivers.stages.refusals import motion_fault, motor_off, unit_not_length
from stereorig.drivers.stages.serial_stage import SerialStage

# states of a group
_NOT_INITIALISED = {*range(10), 50, 52, 60, 61, 63, 66, 67, 71, 72, 83, 106}
_READY = {*range(10, 20), 56, 70, 77, 79}
_DISABLED = {*range(20, 40), 58, 59, *range(74, 77), *range(80, 83), *range(84, 104)}
_NOT_REFERENCED, _HOMING = 42, 43
_ABORTED = {44, 45, 47}  # moves that GroupMoveAbort ends; all others need GroupKill
_MOVING = {*_ABORTED, 40, 41, _HOMING, 46, 48, 49, 51, 64, 104, 105}
_CODES = {-17: "out_of_range", -25: "motion_fault", -35: "out_of_limits", -45: "motion_fault"}
_INITIALISED_S, _TAKEN_S = 45.0, 0.5
_POLL_S = 0.02


class XPSStage(SerialStage):
    """Driver for the Newport XPS.

    Parameters
    ----------
    url
        ``socket://host``, with ``:port`` if it is not 5001.
    options
        Axis number -> how it is used; each axis needs a group of its own.
    record
        Not used: there is no single wire.
    timeout_s
        Longest time of an answer.
    numbers
        Axis number -> N of ``GroupN.Pos`` if ``positioner`` does not name it; the same if left out.
    **serial
        Baud rate and flow control, which a network does not have.
    """

    _line: XPSLine

    def __init__(
        self,
        url: str,
        options: Mapping[int, AxisOptions],
        *,
        record: Path | None = None,  # noqa: ARG002
        timeout_s: float = 0.5,
        numbers: Mapping[int, int] | None = None,
        **serial: Any,  # noqa: ARG002
    ) -> None:
        self._name = {
            axis: option.positioner or f"Group{axis if numbers is None else numbers[axis]}.Pos"
            for axis, option in options.items()
        }
        self._group = {axis: name.partition(".")[0] for axis, name in self._name.items()}
        super().__init__(XPSLine(url, list(self._group.values()), timeout_s=timeout_s), options, numbers)
        self._to_kill: set[str] = set()  # groups whose motion only GroupKill ends
        self._greatest_of: dict[int, tuple[float, float]] = {}

    def _ask(self, axis: int, function: str) -> str:
        try:
            return self._line.ask(function)
        except XPSRefusal as refusal:
            raise self._refusal(axis, function, [self._message(axis, refusal.code)]) from refusal

    def _numbers(self, axis: int, function: str, count: int) -> list[float]:
        answer = self._ask(axis, f"{function}({self._name[axis]},{','.join(count * ['double *'])})")
        try:
            values = [float(value) for value in answer.split(",")]
        except ValueError:
            values = []
        if len(values) != count or not all(abs(value) < float("inf") for value in values):
            raise self._line.lost(f"answered {answer!r} to {function}")
        return values

    def _code(self, axis: int) -> int:
        answer = self._ask(axis, f"GroupStatusGet({self._group[axis]},int *)")
        try:
            return int(answer)
        except ValueError:
            raise self._line.lost(f"answered {answer!r} to GroupStatusGet") from None

    def _message(self, axis: int, code: int) -> ControllerMessage:
        try:
            text = self._line.ask(f"ErrorStringGet({code},char *)")
        except XPSRefusal:
            text = "an error without a text"
        return ControllerMessage(str(code), text, axis)

    def _connect(self) -> StageIdentity:
        firmware = self._ask(self.axes[0], "FirmwareVersionGet(char *)")
        axes = []
        for axis in self.axes:
            model, unit = (self._stage_parameter(axis, name) for name in ("SmartStageName", "Unit"))
            if unit not in ("mm", ""):
                remedy = "Choose an axis with a linear stage that counts in millimetres."
                raise unit_not_length(axis, self._line.url, f"{unit} ({self._name[axis]}, {model})", remedy)
            maximum = self._numbers(axis, "PositionerMaximumVelocityAndAccelerationGet", 2)
            self._greatest_of[axis] = (maximum[0], maximum[1])
            axes.append(AxisIdentity(axis, model or self._name[axis], self._name[axis]))
        name, _, version = firmware.strip().partition(" ")
        return StageIdentity("xps", name, version.removeprefix("Firmware").strip(), self._line.url, tuple(axes))

    def _stage_parameter(self, axis: int, name: str) -> str:
        try:
            return self._line.ask(f"PositionerStageParameterGet({self._name[axis]},{name},char *)").strip()
        except XPSRefusal:  # not every firmware has every parameter
            return ""

    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        low, high = self._numbers(axis, "PositionerUserTravelLimitsGet", 2)
        return low, high

    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        option = self._options[axis]
        velocity, acceleration, *jerk = self._numbers(axis, "PositionerSGammaParametersGet", 4)
        if option.velocity_mm_s is not None or option.acceleration_mm_s2 is not None:
            wanted = (option.velocity_mm_s or velocity, option.acceleration_mm_s2 or acceleration, *jerk)
            texts = ",".join(f"{value:.9g}" for value in wanted)
            self._ask(axis, f"PositionerSGammaParametersSet({self._name[axis]},{texts})")
            velocity, acceleration, *_ = self._numbers(axis, "PositionerSGammaParametersGet", 4)
        return velocity, acceleration

    def _greatest(self, axis: int) -> tuple[float | None, float | None]:
        return self._greatest_of[axis]

    def _read_position_mm(self, axis: int) -> float:
        return self._numbers(axis, "GroupPositionCurrentGet", 1)[0]

    def _read_status(self, axis: int) -> AxisStatus:
        # the answer of a motion first: a state that is read after it belongs to the motion's end
        moving = self._line.runs(self._group[axis])
        code = self._code(axis)
        if code in _MOVING - _ABORTED:
            self._to_kill.add(self._group[axis])
        elif code in _READY:
            self._to_kill.discard(self._group[axis])
        moving |= code in _MOVING
        if moving:
            state = AxisState.HOMING if code == _HOMING else AxisState.MOVING
        elif code in _READY:
            state = AxisState.READY
        elif code in _DISABLED:
            state = AxisState.MOTOR_OFF
        else:
            known = code in _NOT_INITIALISED or code == _NOT_REFERENCED
            state = AxisState.NOT_HOMED if known else AxisState.FAULT
        detail = ""
        if code not in _READY | _MOVING:
            detail = f"reports: {self._ask(axis, f'GroupStatusStringGet({code},char *)')}"
        homed = code in _READY | _DISABLED | _ABORTED
        motor_on = code not in _NOT_INITIALISED | _DISABLED
        return AxisStatus(axis, state, self._read_position_mm(axis), motor_on, homed, moving, detail)

    def _switch_motor(self, axis: int, *, on: bool) -> None:
        code, group = self._code(axis), self._group[axis]
        if on and code in _NOT_INITIALISED:
            self._to_kill.add(group)
            self._run(axis, f"GroupInitialize({group})")
        elif on and code in _DISABLED:
            self._run(axis, f"GroupMotionEnable({group})")
        elif not on and code in _READY:
            self._run(axis, f"GroupMotionDisable({group})")
        elif not on and code == _NOT_REFERENCED:
            self._run(axis, f"GroupKill({group})")
        if self._read_status(axis).motor_on is not on:
            raise motion_fault(axis, f"did not switch its motor {'on' if on else 'off'}")

    def _run(self, axis: int, function: str) -> None:
        noted = self._note_stops((axis,))
        self._keep(self._drain_errors(axis))
        self._line.start(self._group[axis], function)
        limit = time.monotonic() + _INITIALISED_S
        while self._line.runs(self._group[axis]):
            self._check_not_stopped(noted)
            if time.monotonic() > limit:
                raise motion_fault(axis, f"did not end {function}")
            time.sleep(_POLL_S)
        self._raise_refusal((axis,), function)

    def _start_homing(self, axis: int) -> None:
        code = self._code(axis)
        if code in _NOT_INITIALISED | _DISABLED:
            raise motor_off(axis)
        self._keep(self._drain_errors(axis))
        if code != _NOT_REFERENCED:
            self._send_move(axis, self._check_target(axis, 0.0))
            return
        self._to_kill.add(self._group[axis])
        self._begin(axis, f"GroupHomeSearch({self._group[axis]})")

    def _finish_homing(self, axis: int) -> None:
        status = self._read_status(axis)
        if not status.homed:
            raise motion_fault(axis, f"did not find home ({status.detail or status.state})")

    def _send_move(self, axis: int, position_mm: float) -> None:
        self._to_kill.discard(self._group[axis])
        self._begin(axis, f"GroupMoveAbsolute({self._name[axis]},{position_mm:.6f})")

    def _begin(self, axis: int, function: str) -> None:
        """Start a motion, and return when the controller has taken it: a stop comes by another connection."""
        group = self._group[axis]
        self._line.start(group, function)
        limit = time.monotonic() + _TAKEN_S
        while self._line.runs(group) and self._code(axis) not in _MOVING and time.monotonic() < limit:
            time.sleep(_POLL_S)

    def _stop_text(self, axis: int | None) -> str:
        groups = [self._group[one] for one in (self.axes if axis is None else (axis,))]
        return ";".join(f"{'GroupKill' if group in self._to_kill else 'GroupMoveAbort'}({group})" for group in groups)

    def _last_text(self) -> str:
        return ";".join(f"GroupKill({group})" for group in self._group.values())

    def _abort_text(self) -> str:
        return self._stop_text(None)  # the motors follow when all is at rest

    def _drain_errors(self, axis: int | None = None) -> list[ControllerMessage]:
        return [
            self._message(one, code)
            for one in (self.axes if axis is None else (axis,))
            for code in self._line.codes(self._group[one])
        ]

    def _code_of(self, message: ControllerMessage) -> str | None:
        return _CODES.get(int(message.code))
