"""A chain of Zaber devices after the ASCII protocol manual: one axis each, or one device with several axes.

Axes are those of our simulated controllers, so that faults of a motion are the same.
"""

from __future__ import annotations

import re
from typing import Unpack

from stereorig.sim.controllers.axis import SimAxis
from stereorig.sim.controllers.wire import Motion, WireAxis, WireController

_COMMAND = re.compile(r"/(?:([0-9]{1,2})(?: ([0-9])(?: ([0-9]{1,2}))?)? ?)?(.*?)(?::([0-9A-F]{2}))?")
_SPEED, _RAMP = 1.6384, 1.6384e-4


class FakeZaber(WireController):
    """Devices 1 and 2 of one axis each, or device 1 with axes 1 and 2 (``one_device``)."""

    terminator = b"\n"
    mm = 4.096e-5  # a microstep, by which the suite's accelerations are whole numbers

    def __init__(self, *, one_device: bool = False, firmware: str = "7.28", **motion: Unpack[Motion]) -> None:
        super().__init__(motion.get("time_scale", 1.0))
        self.firmware, self._dot = firmware, "." if firmware[0] == "7" else ""
        places = [(1, 1), (1, 2)] if one_device else [(1, 1), (2, 1)]
        self.axes = {place: WireAxis.make(self.clock, **motion) for place in places}
        self.flags: dict[tuple[int, int], set[str]] = {place: {"WR"} for place in places}
        self._homing: set[tuple[int, int]] = set()

    def axis(self, number: int) -> SimAxis:
        return list(self.axes.values())[number - 1].motor

    def _execute(self, text: str) -> bytes:
        found = _COMMAND.fullmatch(text)
        if found is None:
            return b""
        device, axis, number, words, checksum = found.groups()
        if checksum is not None and (sum(text[1:-3].encode()) + int(checksum, 16)) & 0xFF:
            return b""
        lines = ""
        for one in sorted({place[0] for place in self.axes}):
            if int(device or 0) in (0, one):
                lines += self._answer(one, int(axis or 0), f" {int(number):02d}" if number else "", words)
        return lines.encode()

    def _answer(self, device: int, scope: int, number: str, words: str) -> str:
        places = [place for place in self.axes if place[0] == device and scope in (0, place[1])]
        for place in places:
            self._follow(place)
        data = self._do(device, scope, places, words.split()) if places else "BADAXIS"
        refused = data.isupper() and data.isalpha()
        warnings = sorted(set().union(*(self.flags[place] for place in places)))
        moving = any(self.axes[place].motor.moving for place in places)
        return (
            f"@{device:02d} {scope}{number} {'RJ' if refused else 'OK'} {'BUSY' if moving else 'IDLE'} "
            f"{warnings[0] if warnings else '--'} {data}\r\n"
        )

    def _follow(self, place: tuple[int, int]) -> None:
        motor = self.axes[place].motor
        trouble = motor.take_trouble()
        if trouble is not None:
            self.flags[place].add("FS" if trouble == "following_error" else "WL")
            self._homing.discard(place)
        if place in self._homing and not motor.moving:
            motor.set_home()
            self._homing.discard(place)
            self.flags[place] -= {"WR", "WH"}

    def _do(self, device: int, scope: int, places: list[tuple[int, int]], words: list[str]) -> str:
        match words:
            case []:
                return "0"
            case ["get", setting]:
                return self._get(device, scope, places, setting)
            case ["set", ("maxspeed" | "accel") as setting, value]:
                axis = self.axes[places[0]]
                per_s = int(value) * self.mm / (_SPEED if setting == "maxspeed" else _RAMP)
                name = "velocity_mm_s" if setting == "maxspeed" else "acceleration_mm_s2"
                if not 0 < per_s <= getattr(axis, f"max_{name}") * 1.0001:
                    return "BADDATA"
                setattr(axis.motor, name, per_s)
            case ["warnings", *clear]:
                flags = sorted(set().union(*(self.flags[place] for place in places)))
                for place in places if clear else []:
                    self.flags[place] -= {"FS", "WL", "NI"}
                return " ".join([f"{len(flags):02d}", *flags])
            case ["driver", order]:
                for place in places:
                    if order == "disable":
                        self.axes[place].motor.cut()
                        self._homing.discard(place)
                        self.flags[place].add("FO")
                    else:
                        self.flags[place].discard("FO")
            case ["stop" | "estop" as order]:
                for place in places:
                    self._homing.discard(place)
                    self.axes[place].motor.stop() if order == "stop" else self.axes[place].motor.cut()
            case ["home"] | ["move", "abs", _]:
                if any("FO" in self.flags[place] for place in places):
                    return "DRIVERDISABLED"
                for place in places:
                    axis, self.flags[place] = self.axes[place], self.flags[place] - {"FS", "WL"}
                    if words == ["home"]:
                        self.flags[place].add("WR")
                        self._homing.add(place)
                        axis.motor.move_home()
                        continue
                    if not axis.low_mm <= int(words[2]) * self.mm <= axis.high_mm:
                        return "BADDATA"
                    axis.motor.move_to(int(words[2]) * self.mm)
            case _:
                return "BADCOMMAND"
        return "0"

    def _get(self, device: int, scope: int, places: list[tuple[int, int]], setting: str) -> str:
        axis, dot = self.axes[places[0]], self._dot
        of_device = {
            "version": self.firmware,
            f"device{dot}id": "50081",
            "system.serial": str(40000 + device),
            "system.access": "1",
            "system.axiscount": str(len([place for place in self.axes if place[0] == device])),
        }
        of_axis = {
            "pos": str(round(axis.motor.encoder_mm / self.mm)),
            "limit.min": str(round(axis.low_mm / self.mm)),
            "limit.max": str(round(axis.high_mm / self.mm)),
            "maxspeed": str(round(axis.motor.velocity_mm_s / self.mm * _SPEED)),
            "accel": str(round(axis.motor.acceleration_mm_s2 / self.mm * _RAMP)),
            f"peripheral{dot}id": "0",
        }
        return {**of_device, **of_axis}.get(setting, "BADCOMMAND") if scope or setting in of_device else "BADCOMMAND"
