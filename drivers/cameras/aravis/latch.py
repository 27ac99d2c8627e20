"""The time of a camera's clock, read together with the host's."""

from __future__ import annotations

import time
from collections.abc import Callable

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.device import AravisDevice
from stereorig.drivers.cameras.genicam import synonyms
from stereorig.drivers.cameras.genicam.features import CameraFeatures
from stereorig.drivers.cameras.protocol import Latch

# GigE Vision's own registers: control (2: latch), then the latched value's two halves
_CONTROL_REGISTER, _LATCH, _VALUE_REGISTERS = 0x0944, 2, (0x0948, 0x094C)


class ClockLatch:
    """Reads the camera's time by the latch that its description has, or by GigE Vision's own registers.

    Parameters
    ----------
    device, features
        The camera and its features.
    ticks_per_s
        Function that returns the frequency of the camera's clock.
    """

    def __init__(self, device: AravisDevice, features: CameraFeatures, ticks_per_s: Callable[[], float]) -> None:
        self._device, self._features, self._ticks_per_s = device, features, ticks_per_s
        self._names = next((names for names in synonyms.TIMESTAMP_LATCH if all(map(features.kind, names))), None)
        self._ns_per_tick: float | None = None

    def read(self) -> Latch | None:
        """Return the time, in ns, with the host's before and after; ``None`` if the camera keeps none.

        Raises
        ------
        CameraError
            ``camera_lost``.
        """
        try:
            if self._names is not None:
                before = time.monotonic_ns()
                self._device.ask("execute_command", self._names[0])
                after = time.monotonic_ns()
                ticks = int(self._features.read_number(self._names[1]))
            elif self._device.is_gige:
                before = time.monotonic_ns()
                self._device.ask("write_register", _CONTROL_REGISTER, _LATCH)
                after = time.monotonic_ns()
                high, low = (int(self._device.ask("read_register", at)) & 0xFFFFFFFF for at in _VALUE_REGISTERS)
                ticks = high << 32 | low
            else:
                return None
            if ticks == 0:
                return None
            if self._ns_per_tick is None:
                # as Aravis turns the stamps of frames into nanoseconds
                self._ns_per_tick = 1e9 / self._ticks_per_s()
        except CameraError as error:
            if error.code == "camera_lost":
                raise
            return None
        return Latch(before, round(ticks * self._ns_per_tick), after)
