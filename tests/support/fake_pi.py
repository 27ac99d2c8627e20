"""A PI controller after the published General Command Set (GCS 2): axes 1 and 2, one error, commands of one character.

Axes are those of our simulated controllers, so that faults of a motion are the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Unpack

from stereorig.sim.controllers.axis import SimAxis
from stereorig.sim.controllers.wire import Motion, WireAxis, WireController

_KNOWN = (
    "CSV? *IDN? ERR? SAI? HLP? CST? PUN? POS? MOV MOV? VEL VEL? ACC ACC? DEC DEC? SVO SVO? FRF FRF? TMN? TMX? HLT STP"
)
_KNOWN += " ONT? EAX EAX? #5 #7 #24"


class FakePI(WireController):
    """Axes 1 and 2; ``old`` firmware knows neither PUN?, CST? nor EAX."""

    terminator = b"\n"

    def __init__(self, *, unit: str = "MM", old: bool = False, **motion: Unpack[Motion]) -> None:
        super().__init__(motion.get("time_scale", 1.0))
        self.unit, self.unknown = unit, {"PUN?", "CST?", "EAX", "EAX?"} if old else set()
        self.axes = {number: WireAxis.make(self.clock, **motion) for number in (1, 2)}
        self.servo, self.referenced = dict.fromkeys(self.axes, False), dict.fromkeys(self.axes, False)
        self.error = 0
        self._homing: set[int] = set()

    def axis(self, number: int) -> SimAxis:
        return self.axes[number].motor

    @staticmethod
    def frames(buffer: bytearray) -> Iterator[bytes]:
        """Cut commands off the front: single control characters have no end."""
        while buffer:
            end = 0 if buffer[0] < 32 and buffer[0] not in b"\r\n" else buffer.find(b"\n")
            if end < 0:
                return
            line = bytes(buffer[: end + 1])
            del buffer[: end + 1]
            if line.strip(b"\n"):
                yield line

    def _follow(self) -> None:
        for number, axis in self.axes.items():
            trouble = axis.motor.take_trouble()
            if trouble is not None:
                self.error = -1024 if trouble == "following_error" else 216
                self.servo[number] = trouble != "following_error"
                self._homing.discard(number)
            if number in self._homing and not axis.motor.moving:
                axis.motor.set_home()
                self._homing.discard(number)
                self.referenced[number] = True

    def _execute(self, text: str) -> bytes:
        self._follow()
        if text == "\x05":
            moving = sum(1 << (number - 1) for number, axis in self.axes.items() if axis.motor.moving)
            return f"{moving:X}\n".encode()
        if text == "\x07":
            return b"\xb1\n"
        word, *arguments = text.replace("\x18", "STP").split()
        if word not in _KNOWN.split() or word in self.unknown:
            self.error = 2
            return b""
        if word == "SAI?":
            arguments.clear()  # ALL, deactivated axes too
        pairs = word in ("VEL", "ACC", "DEC", "MOV", "SVO", "EAX")
        if not {"1", "2"}.issuperset(arguments[::2] if pairs else arguments):
            self.error = 15
            return b""
        if word.endswith("?"):
            return self._reply(word, [int(one) for one in arguments] or list(self.axes)).encode()
        if word in ("HLT", "STP", "FRF"):
            for number in [int(one) for one in arguments] or list(self.axes):
                self._simple(word, number)
        else:
            for number, value in zip(arguments[::2], arguments[1::2], strict=True):
                self._set(word, int(number), float(value))
        return b""

    def _reply(self, word: str, numbers: list[int]) -> str:
        if word == "*IDN?":
            return "(c)2019 Physik Instrumente (PI) GmbH & Co. KG, C-884.4DB, 119012345, 1.2.0.1\n"
        if word == "CSV?":
            return "2.0\n"
        if word == "ERR?":
            error, self.error = self.error, 0
            return f"{error}\n"
        if word == "SAI?":
            return " \n".join(map(str, self.axes)) + "\n"
        if word == "HLP?":
            known = [name for name in _KNOWN.split() if name not in self.unknown]
            return " \n".join(["The following commands are valid:", *known, "end of help"]) + "\n"
        return " \n".join(f"{number}={self._value(word, number)}" for number in numbers) + "\n"

    def _value(self, word: str, number: int) -> str:
        axis = self.axes[number]
        values = {
            "POS?": f"{axis.motor.encoder_mm:.7f}",
            "MOV?": f"{axis.motor.goal_mm:.7f}",
            "TMN?": f"{axis.low_mm:.7f}",
            "TMX?": f"{axis.high_mm:.7f}",
            "VEL?": f"{axis.motor.velocity_mm_s:.7f}",
            "ACC?": f"{axis.motor.acceleration_mm_s2:.7f}",
            "DEC?": f"{axis.motor.acceleration_mm_s2:.7f}",
            "SVO?": str(int(self.servo[number])),
            "EAX?": "1",
            "FRF?": str(int(self.referenced[number])),
            "ONT?": str(int(not axis.motor.moving)),
            "PUN?": self.unit,
            "CST?": "M-531.DD1",
        }
        return values[word]

    def _simple(self, word: str, number: int) -> None:
        motor = self.axes[number].motor
        if word == "FRF":
            if not self.servo[number]:
                self.error = 5
                return
            self.referenced[number] = False
            self._homing.add(number)
            motor.move_home()
            return
        self.error = 10
        self._homing.discard(number)
        motor.stop() if word == "HLT" else motor.cut()

    def _set(self, word: str, number: int, value: float) -> None:
        axis = self.axes[number]
        if word == "SVO":
            self.servo[number] = bool(value)
            if not value:
                axis.motor.cut()
        elif word == "VEL" and 0 < value <= axis.max_velocity_mm_s:
            axis.motor.velocity_mm_s = value
        elif word in ("ACC", "DEC") and 0 < value <= axis.max_acceleration_mm_s2:
            axis.motor.acceleration_mm_s2 = value
        elif word in ("VEL", "ACC", "DEC"):
            self.error = 8 if word == "VEL" else 17
        elif word == "MOV":
            if not self.servo[number] or not self.referenced[number]:
                self.error = 5
            elif not axis.low_mm <= value <= axis.high_mm:
                self.error = 7
            else:
                axis.motor.move_to(value)
