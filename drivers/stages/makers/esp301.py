"""Newport ESP300 and ESP301: up to three axes on one line.

Commands end in CR, replies in CR LF. A reply does not name its question, so the line is synchronised again by asking
for the version, whose reply is unmistakable. The controller keeps ten errors in a queue: three digits belong to an axis
(``103``: axis 1, following error), fewer to none. It does not report if an axis was homed: the driver keeps the axes
that it homed itself, and clears them when the line was lost.

References
----------
Newport, *ESP301 Integrated 3-Axis Motion Controller/Driver, User's Manual*, EDH0235En1030, chapters 3 and appendix A.
"""

from __future__ import annotations

import re
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
from stereorig.drivers.stages.refusals import motor_off, unit_not_length
from stereorig.drivers.stages.wire_stage import WireStage, finite, flag

# SN codes of the length units; an axis in counts, steps or angles cannot carry a camera by millimetres
_MM_PER_UNIT = {2: 1.0, 3: 1e-3, 4: 25.4, 5: 25.4e-3, 6: 25.4e-6}
_UNIT_NAMES = {2: "mm", 3: "um", 4: "in", 5: "milli-in", 6: "micro-in"}
_ODD_UNITS = {
    0: "encoder counts",
    1: "motor steps",
    7: "degrees",
    8: "gradians",
    9: "radians",
    10: "milliradians",
    11: "microradians",
}
_QUEUE_LENGTH = 10
_HOME_MODE = 1  # argument of OR: home switch and index

# The part of an axis error behind the axis number -> code of the stage protocol
_AXIS_CODES = {
    1: "out_of_range",
    2: "motion_fault",
    3: "motion_fault",
    4: "motion_fault",
    5: "motion_fault",
    6: "out_of_limits",
    7: "out_of_limits",
    8: "motion_fault",
    9: "motion_fault",
    10: "out_of_range",
    11: "out_of_range",
    13: "motor_off",
    20: "motion_fault",
}


def _is_version(line: str) -> bool:
    # ESP300, ESP301, ESP302, and their forerunners ESP6000 and ESP7000
    return re.match(r"ESP[0-9]{3,4}\b", line) is not None


class ESP301Stage(WireStage):
    """Driver for the ESP300 and ESP301; parameters as `stereorig.drivers.stages.wire_stage.WireStage`.

    The default rate is the one of the ESP301's USB port; RS-232 runs at 19200.
    """

    _terminator, _baudrate, _flow_control = b"\r", 921600, "hardware"
    _resync = ("VE?", _is_version)

    def __init__(self, url: str, options: Mapping[int, AxisOptions], **settings: Any) -> None:
        super().__init__(url, options, **settings)
        self._mm_per_unit: dict[int, float] = {}
        self._unit: dict[int, int] = {}
        self._max_dynamics: dict[int, tuple[float | None, float | None]] = {}
        # axis -> how often the line had been lost when the axis was homed: one loss more, and it may have lost its zero
        self._homed_at: dict[int, int] = {}

    def _connect(self) -> StageIdentity:
        version = self._line.query("VE?", _version)
        axes = []
        for axis in self.axes:
            model = self._line.query(f"{self._own[axis]}ID?", _text)
            unit = self._line.query(f"{self._own[axis]}SN?", _integer)
            if unit not in _MM_PER_UNIT:
                odd = f"{_ODD_UNITS.get(unit, f'unit {unit}')} ({model})"
                remedy = "Choose an axis with a linear stage, or set its units (SN) to millimetres."
                raise unit_not_length(axis, self._line.url, odd, remedy)
            self._unit[axis] = unit
            scale = self._mm_per_unit[axis] = _MM_PER_UNIT[unit]
            self._max_dynamics[axis] = (self._ask_greatest(axis, "VU?", scale), self._ask_greatest(axis, "AU?", scale))
            name, _, serial = (part.strip() for part in model.partition(","))
            axes.append(AxisIdentity(axis, name, serial, _UNIT_NAMES[unit]))
        self._homed_at = {axis: self._line.losses for axis, option in self._options.items() if option.assume_homed}
        model, _, firmware = version.partition("Version")
        # the second part of "3.08 09/09/02" is the date
        return StageIdentity("esp301", model.strip(), firmware.strip().split(" ")[0], self._line.url, tuple(axes))

    def _ask(self, axis: int, text: str) -> float:
        return self._line.query(f"{self._own[axis]}{text}", finite)

    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        scale = self._mm_per_unit[axis]
        return self._ask(axis, "SL?") * scale, self._ask(axis, "SR?") * scale

    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        option, scale = self._options[axis], self._mm_per_unit[axis]
        self._drain_errors()
        if option.acceleration_mm_s2 is not None:
            self._line.command(f"{self._own[axis]}AC{option.acceleration_mm_s2 / scale:.6f}")
            self._line.command(f"{self._own[axis]}AG{option.acceleration_mm_s2 / scale:.6f}")
        if option.velocity_mm_s is not None:
            self._line.command(f"{self._own[axis]}VA{option.velocity_mm_s / scale:.6f}")
        self._raise_refusal((axis,), f"velocity {option.velocity_mm_s} mm/s")
        return self._ask(axis, "VA?") * scale, self._ask(axis, "AC?") * scale

    def _read_position_mm(self, axis: int) -> float:
        return self._ask(axis, "TP") * self._mm_per_unit[axis]

    def _read_status(self, axis: int) -> AxisStatus:
        # motion first: a position read after "done" is then the end of the motion
        moving = not self._line.query(f"{self._own[axis]}MD?", flag)
        motor_on = self._line.query(f"{self._own[axis]}MO?", flag)
        position = self._read_position_mm(axis)
        homed = self._homed_at.get(axis) == self._line.losses
        if moving:
            state = AxisState.MOVING
        elif not motor_on:
            state = AxisState.MOTOR_OFF
        else:
            state = AxisState.READY if homed else AxisState.NOT_HOMED
        return AxisStatus(axis, state, position, motor_on, homed, moving)

    def _switch_motor(self, axis: int, *, on: bool) -> None:
        self._keep(self._drain_errors())
        self._line.command(f"{self._own[axis]}{'MO' if on else 'MF'}")
        self._raise_refusal((axis,), f"motor {'on' if on else 'off'}")
        if self._line.query(f"{self._own[axis]}MO?", flag) is not on:
            raise StageError(
                f"The motor of axis {axis} did not switch {'on' if on else 'off'}.",
                code="motion_fault",
                remedy="Check the motor cable, the interlock and the emergency stop.",
                axis=axis,
            )

    def _start_homing(self, axis: int) -> None:
        if not self._line.query(f"{self._own[axis]}MO?", flag):
            raise motor_off(axis)
        self._keep(self._drain_errors())
        self._homed_at.pop(axis, None)
        mode = self._options[axis].home_mode
        self._line.command(f"{self._own[axis]}OR{_HOME_MODE if mode is None else mode}")
        self._raise_refusal((axis,), "search for home")

    def _finish_homing(self, axis: int) -> None:
        self._homed_at[axis] = self._line.losses

    def _send_move(self, axis: int, position_mm: float) -> None:
        self._line.command(f"{self._own[axis]}PA{position_mm / self._mm_per_unit[axis]:.6f}")

    def _stop_text(self, axis: int | None) -> str:
        return "ST" if axis is None else f"{self._own[axis]}ST"

    def _abort_text(self) -> str:
        return "AB"

    def _distrust(self, axis: int) -> None:
        self._homed_at.pop(axis, None)

    def _check_unit(self, axis: int) -> None:
        unit = self._line.query(f"{self._own[axis]}SN?", _integer)
        if unit != self._unit[axis]:
            now = _UNIT_NAMES.get(unit, _ODD_UNITS.get(unit, f"unit {unit}"))
            raise StageError(
                f"Axis {axis} counts in {now}; when it was opened it counted in {_UNIT_NAMES[self._unit[axis]]}.",
                code="units_changed",
                remedy=f"Set its unit back (SN{self._unit[axis]}), or reconnect the rig.",
                axis=axis,
            )

    def _greatest(self, axis: int) -> tuple[float | None, float | None]:
        return self._max_dynamics[axis]

    def _ask_greatest(self, axis: int, word: str, scale: float) -> float | None:
        try:
            return self._ask(axis, word) * scale
        except StageError:  # a firmware without this query
            return None

    def _drain_errors(self, _axis: int | None = None) -> list[ControllerMessage]:
        found: list[ControllerMessage] = []
        for _ in range(2 * _QUEUE_LENGTH):  # bounded: a controller may fill its queue without end
            message = self._line.query("TB?", _message)
            if message is None:
                break
            found.append(message if message.axis is None else replace(message, axis=self._axis_of(message.axis)))
        return found

    def _code_of(self, message: ControllerMessage) -> str | None:
        return None if message.axis is None else _AXIS_CODES.get(int(message.code) % 100)


def _version(line: str) -> str:
    if not _is_version(line):
        raise ValueError("not the version of an ESP controller")
    return line


def _text(line: str) -> str:
    if not line.isprintable():
        raise ValueError("not a text")
    return line


def _integer(line: str) -> int:
    return int(line)


def _message(line: str) -> ControllerMessage | None:
    """Read ``code, time stamp, TEXT``; ``None`` for an empty queue."""
    code, stamp, text = (part.strip() for part in line.split(",", 2))
    int(stamp)
    number = int(code)
    if number == 0:
        return None
    return ControllerMessage(str(number), text, number // 100 if number >= 100 else None)
