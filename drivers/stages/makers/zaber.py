"""Zaber's devices by their ASCII protocol (firmware 6.06 and later): a chain of devices on one line.

A command names device, axis and a number that its reply repeats, so that no late reply answers another question. Every
reply has the most severe warning; ``WR`` is an axis that lost its reference. Devices count microsteps, whose length
depends on a screw that they do not know: it is in the rig file.

References
----------
Zaber Technologies, *ASCII Protocol Manual*, firmware 6 and 7: messages, warning flags, settings.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from stereorig.core.errors import StageError
from stereorig.drivers.stages.protocol import (
    AxisIdentity,
    AxisOptions,
    AxisState,
    AxisStatus,
    ControllerMessage,
    StageIdentity,
)
from stereorig.drivers.stages.refusals import motion_fault, motor_off, unit_not_length
from stereorig.drivers.stages.wire_stage import WireStage, finite

# in microsteps a second, and a second squared
_SPEED_UNIT, _RAMP_UNIT = 1.6384, 1.6384e-4
_REPLY = re.compile(r"@([0-9]{2}) ([0-9]) ([0-9]{2}) (OK|RJ) (IDLE|BUSY) (\S{2}) ([^:]*)(?::[0-9A-F]{2})?")
_NO_REFERENCE = {"WR", "WH"}
_MOTOR_OFF = {"FO", "FD", "FH", "FV"}
_TEXTS = {
    "FF": "critical system error",
    "FN": "peripheral not supported",
    "FZ": "peripheral inactive",
    "FH": "emergency stop pressed",
    "FV": "supply voltage out of range, driver disabled",
    "FO": "driver disabled",
    "FC": "inrush current",
    "FM": "motor too hot",
    "FD": "driver disabled",
    "FQ": "encoder error",
    "FS": "stalled and stopped",
    "FE": "limit error",
    "FT": "twisted",
    "WL": "unexpected limit switch",
    "WV": "supply voltage out of range",
    "WT": "controller too hot",
    "WS": "stalled and recovered",
    "WM": "displaced while at rest",
}
_CODES = {"BADDATA": "out_of_range", "DRIVERDISABLED": "motor_off"}


class _Reply(NamedTuple):
    accepted: bool
    busy: bool
    data: str


class ZaberStage(WireStage):
    """Driver for a chain of Zaber devices; parameters as `stereorig.drivers.stages.wire_stage.WireStage`.

    The axis with the own number N is axis 1 of device N if ``positioner`` does not name device and axis.
    """

    _terminator = b"\n"

    def __init__(self, url: str, options: Mapping[int, AxisOptions], **settings: Any) -> None:
        super().__init__(url, options, **settings)
        names = {axis: (option.positioner or f"{self._own[axis]}.1").split(".") for axis, option in options.items()}
        self._place = {axis: f"{int(device):02d} {int(own)}" for axis, (device, own) in names.items()}
        self._mm = {axis: option.mm_per_step or 0.0 for axis, option in options.items()}
        self._ids = itertools.count(1)

    def _ask(self, axis: int, text: str, *, device: bool = False, once: bool = False) -> _Reply:
        place = f"{self._place[axis][:2]} 0" if device else self._place[axis]
        question = f"{place} {next(self._ids) % 100:02d}"

        def parse(line: str) -> _Reply:
            found = _REPLY.fullmatch(line)
            if found is None or " ".join(found.groups()[:3]) != question:
                raise ValueError(f"not a reply to {question}")
            return _Reply(found[4] == "OK", found[5] == "BUSY", found[7].strip())

        return self._line.query(f"/{question} {text}", parse, once=once)

    def _value(self, axis: int, text: str, request: str = "", *, device: bool = False, once: bool = False) -> str:
        reply = self._ask(axis, text, device=device, once=once)
        if not reply.accepted:
            message = ControllerMessage(reply.data, "rejected", axis)
            raise self._refusal(axis, request or f"command {text!r}", [message])
        return reply.data

    def _start(self, axis: int, text: str) -> None:
        try:
            self._value(axis, text, once=True)
        except StageError as error:
            if error.code != "stage_lost":  # where only the reply is lost, state and position will show the motion
                raise

    def _number(self, axis: int, setting: str) -> float:
        data = self._value(axis, f"get {setting}")
        try:
            return finite(data)
        except ValueError:
            message = ControllerMessage(data, "is no number", axis)
            raise self._refusal(axis, f"setting {setting}", [message]) from None

    def _connect(self) -> StageIdentity:
        axes, firmwares = [], []
        for axis in self.axes:
            if not self._mm[axis]:
                raise unit_not_length(axis, self._line.url, "microsteps", "Set mm_per_step in the rig file.")
            firmwares.append(self._value(axis, "get version", device=True))
            dot = "." if float(firmwares[-1]) >= 7.0 else ""  # firmware 6 has no dot in these names
            model = self._value(axis, f"get device{dot}id", device=True)
            peripheral = self._ask(axis, f"get peripheral{dot}id")
            if peripheral.accepted and peripheral.data != "0":
                model += f", peripheral {peripheral.data}"
            serial = self._value(axis, "get system.serial", device=True)
            axes.append(AxisIdentity(axis, f"device {model}", serial, "microsteps"))
        return StageIdentity("zaber", f"Zaber {axes[0].model}", firmwares[0], self._line.url, tuple(axes))

    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        low, high = (self._number(axis, f"limit.{side}") * self._mm[axis] for side in ("min", "max"))
        return low, high

    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        option, mm = self._options[axis], self._mm[axis]
        wanted = {"maxspeed": (option.velocity_mm_s, _SPEED_UNIT), "accel": (option.acceleration_mm_s2, _RAMP_UNIT)}
        for (setting, (value, unit)), name in zip(wanted.items(), ("velocity", "acceleration"), strict=True):
            if value is not None:
                self._value(axis, f"set {setting} {max(1, round(value / mm * unit))}", f"{name} {value:g} (mm, s)")
        velocity, ramp = (self._number(axis, setting) / unit * mm for setting, (_, unit) in wanted.items())
        if velocity <= 0.0 or ramp <= 0.0:
            raise StageError(
                f"Axis {axis} has the velocity {velocity:g} mm/s and the acceleration {ramp:g} mm/s^2 (0: no ramp).",
                code="out_of_range",
                remedy="Set velocity_mm_s and acceleration_mm_s2 in the rig file.",
                axis=axis,
            )
        return velocity, ramp

    def _read_position_mm(self, axis: int) -> float:
        return self._number(axis, "pos") * self._mm[axis]

    def _flags(self, axis: int, words: str) -> tuple[bool, list[str]]:
        reply = self._ask(axis, words)
        return reply.busy, reply.data.split()[1:]  # the first one is their number

    def _read_status(self, axis: int) -> AxisStatus:
        # motion first: a position read after "idle" is then the end of the motion
        moving, flags = self._flags(axis, "warnings")
        position = self._read_position_mm(axis)
        homed, motor_on = not _NO_REFERENCE.intersection(flags), not _MOTOR_OFF.intersection(flags)
        if moving:
            state = AxisState.MOVING if homed else AxisState.HOMING
        elif any(flag[0] == "F" and flag not in ("FO", "FD") for flag in flags):
            state = AxisState.FAULT
        elif not motor_on:
            state = AxisState.MOTOR_OFF
        else:
            state = AxisState.READY if homed else AxisState.NOT_HOMED
        found = [_TEXTS.get(flag, "a warning") + f" ({flag})" for flag in flags if flag[0] in "FW"]
        detail = f"reports: {', '.join(found)}" if found and state is not AxisState.NOT_HOMED else ""
        return AxisStatus(axis, state, position, motor_on, homed, moving, detail)

    def _switch_motor(self, axis: int, *, on: bool) -> None:
        self._keep(self._drain_errors(axis))  # which clears a fault
        self._value(axis, f"driver {'enable' if on else 'disable'}")
        if self._read_status(axis).motor_on is not on:
            raise motion_fault(axis, f"did not switch its motor {'on' if on else 'off'}")

    def _start_homing(self, axis: int) -> None:
        if not self._read_status(axis).motor_on:
            raise motor_off(axis)
        self._keep(self._drain_errors(axis))
        self._start(axis, "home")

    def _finish_homing(self, axis: int) -> None:
        status = self._read_status(axis)
        if not status.homed:
            raise motion_fault(axis, f"did not find home ({status.detail or status.state})")

    def _send_move(self, axis: int, position_mm: float) -> None:
        self._start(axis, f"move abs {round(position_mm / self._mm[axis])}")

    def _stop_text(self, axis: int | None) -> str:
        return "/stop" if axis is None else f"/{self._place[axis]} stop"

    def _abort_text(self) -> str:
        return "/estop"

    def _drain_errors(self, axis: int | None = None) -> list[ControllerMessage]:
        return [
            ControllerMessage(flag, _TEXTS.get(flag, "a fault"), one)
            for one in (self.axes if axis is None else (axis,))
            for flag in self._flags(one, "warnings clear")[1]
            if (flag[0] == "F" and flag not in _MOTOR_OFF) or flag == "WL"
        ]

    def _code_of(self, message: ControllerMessage) -> str | None:
        # a warning has two letters: the command was taken, its motion failed
        return "motion_fault" if len(message.code) == 2 else _CODES.get(message.code)
