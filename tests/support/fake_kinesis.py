"""A Thorlabs controller of one motor after the published APT protocol; what comes unasked goes before the next reply.

The axis is that of our simulated controllers, so that faults of a motion are the same.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Unpack

from stereorig.sim.controllers.axis import SimAxis
from stereorig.sim.controllers.wire import Motion, WireAxis, WireController

_FAMILIES = {"KDC101": (22.369621333, 0.0076354972), "KST101": (53.68, 0.011), "KBD101": (6.7108864, 6.87194767e-4)}


class FakeKinesis(WireController):
    """Channel 1 of ``model``; after a command the state shows motion only from question number ``lag`` on."""

    terminator = b""
    mm = 1e-4  # a count

    def __init__(self, *, model: str = "KDC101", lag: int = 0, **motion: Unpack[Motion]) -> None:
        super().__init__(motion.get("time_scale", 1.0))
        self.model, self.lag = model, lag
        self.wire_axis = WireAxis.make(self.clock, **motion)
        self.enabled, self.homed, self.homing, self.running, self.error = False, False, False, False, False
        self._asked = 0
        self._unasked = b""

    def axis(self, number: int) -> SimAxis:
        assert number == 1
        return self.wire_axis.motor

    @staticmethod
    def frames(buffer: bytearray) -> Iterator[bytes]:
        """Cut messages off the front, each as hexadecimal text."""
        while len(buffer) >= 6:
            size = 6 + (int.from_bytes(buffer[2:4], "little") if buffer[4] & 0x80 else 0)
            if len(buffer) < size:
                return
            yield bytes(buffer[:size]).hex().encode()
            del buffer[:size]

    def _short(self, number: int, first: int = 1, second: int = 0) -> bytes:
        return struct.pack("<HBBBB", number, first, second, 0x01, 0x50)

    def _long(self, number: int, data: bytes) -> bytes:
        return struct.pack("<HHBB", number, len(data), 0x81, 0x50) + data

    def _follow(self) -> None:
        motor = self.wire_axis.motor
        self.error |= motor.take_trouble() == "following_error"
        if self.running and not motor.moving:
            self.running = False
            self._unasked += self._short(0x0444) if self.homing else self._long(0x0464, self._state(0))
            if self.homing:
                motor.set_home()
                self.homed, self.homing = True, False

    def _state(self, asked: int) -> bytes:
        motor = self.wire_axis.motor
        bits = (0x400 if self.homed else 0) | (0x4000 if self.error else 0) | (1 << 31 if self.enabled else 0)
        if motor.moving and asked >= self.lag:
            bits |= 0x200 if self.homing else 0x10 if motor.velocity_now_mm_s > 0 else 0x20
        return struct.pack("<HiHHI", 1, round(motor.encoder_mm / self.mm), 0, 0, bits)

    def _begin(self) -> bool:
        self._asked, self.error = 0, False
        self.running = self.enabled
        return self.enabled

    def _execute(self, text: str) -> bytes:
        data = bytes.fromhex(text)
        number, motor = int.from_bytes(data[:2], "little"), self.wire_axis.motor
        self._follow()
        reply = b""
        match number:
            case 0x0005:
                info = struct.pack("<I8sH4B60sHHH", 27000001, self.model.encode(), 44, 3, 2, 1, 0, b"", 3, 0, 1)
                reply = self._long(0x0006, info)
            case 0x0210:
                self.enabled = data[3] == 1
                if not self.enabled:
                    motor.cut()
            case 0x0211:
                reply = self._short(0x0212, 1, 1 if self.enabled else 2)
            case 0x0413:
                _, _, ramp, speed = struct.unpack_from("<H3i", data, 6)
                speeds, ramps = _FAMILIES[self.model]
                axis = self.wire_axis
                motor.velocity_mm_s = min(speed / speeds * self.mm, axis.max_velocity_mm_s)
                motor.acceleration_mm_s2 = min(ramp / ramps * self.mm, axis.max_acceleration_mm_s2)
            case 0x0414:
                speeds, ramps = _FAMILIES[self.model]
                speed, ramp = round(motor.velocity_mm_s / self.mm * speeds), motor.acceleration_mm_s2 / self.mm * ramps
                reply = self._long(0x0415, struct.pack("<H3i", 1, 0, round(ramp), speed))
            case 0x0443 if self._begin():
                self.homing, self.homed = True, False
                motor.move_home()
            case 0x0453 if self._begin():
                self.homing = False
                motor.move_to(struct.unpack_from("<Hi", data, 6)[1] * self.mm)
            case 0x0465:
                if self.running:
                    self._unasked += self._long(0x0466, self._state(0))
                self.running = self.homing = False
                motor.cut() if data[3] == 1 else motor.stop()
            case 0x0490 | 0x0480 if (number == 0x0480) is (self.model == "KST101"):
                reply = self._long(number + 1, self._state(self._asked))
                self._asked += 1
        unasked, self._unasked = self._unasked, b""
        return unasked + reply
