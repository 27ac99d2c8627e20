"""One connection to a camera through Aravis."""

from __future__ import annotations

import time
from collections.abc import Callable

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.connect import connect
from stereorig.drivers.cameras.aravis.device import AravisDevice
from stereorig.drivers.cameras.aravis.discovery import DRIVER
from stereorig.drivers.cameras.aravis.features import AravisFeatures
from stereorig.drivers.cameras.aravis.stream import RETENTION_S, CameraStream
from stereorig.drivers.cameras.genicam import synonyms
from stereorig.drivers.cameras.genicam.describe import describe
from stereorig.drivers.cameras.genicam.features import CameraFeatures
from stereorig.drivers.cameras.genicam.grabber import GenicamGrabber
from stereorig.drivers.cameras.genicam.session import CameraSession
from stereorig.drivers.cameras.genicam.settings import CameraControl
from stereorig.drivers.cameras.pixels import PixelFormat
from stereorig.drivers.cameras.protocol import CameraDescription, CameraIdentity, CameraOptions, Latch

# Time that a camera may need to stop: one and a half frames, within these limits
_SHORTEST_S, _LONGEST_S = 0.05, 1.5


class AravisSession(CameraSession):
    """An opened camera with its stream; see `stereorig.drivers.cameras.genicam.session.CameraSession`.

    Parameters
    ----------
    options
        Name of the camera, and its options.
    """

    def __init__(self, options: CameraOptions) -> None:
        super().__init__(options)
        self._stopped_s = 0.0
        self._camera = self._device = AravisDevice(options, self._check)

    def _connect(self) -> None:
        why_lost = self._why_lost  # the handler must not keep the connection alive
        connect(self._device, self._options, lambda: why_lost.append("was unplugged"))
        self._stopped_s = time.monotonic()
        self._features = AravisFeatures(self._device)
        self._control = CameraControl(self._device, self._features, self._options)
        self._latch = ClockLatch(self._device, self._features, self._ticks_per_s)

    def _address(self) -> str:
        return self._device.address()

    def _ticks_per_s(self) -> float:
        return (float(self._device.ask("get_timestamp_tick_frequency")) if self._device.is_gige else 0.0) or 1e9

    def _in_control(self) -> bool:
        return self._device.in_control()

    def _describe(self) -> CameraDescription:
        device = self._device
        extra = {"vendor": device.text_of("get_vendor_name"), "protocol": device.protocol}
        if device.is_gige:
            extra["address"] = device.address()
            extra["packet_size_bytes"] = str(device.ask_camera("gv_get_packet_size"))
        return describe(
            self._features,
            self._control,
            CameraIdentity(device.text_of("get_model_name"), device.text_of("get_device_serial_number")),
            driver=DRIVER,
            latency_s=RETENTION_S if device.is_gige else 0.0,
            extra=extra,
        )

    def _make_stream(self, region_px: tuple[int, int, int, int], pixel_format: PixelFormat) -> CameraStream:
        self._await_standstill()
        stream = CameraStream(self._device.name, region_px=region_px, pixel_format=pixel_format)
        stream.start(self._device, self._options.buffers)
        return stream

    def _await_standstill(self) -> None:
        # a stopped camera finishes its frame first; without the time for it, it continues to send to the stream that is
        # gone
        rate = self._settings.frame_rate_hz
        frame_s = max(1.0 / rate if rate else 0.0, (self._settings.exposure_ms or 0.0) / 1000.0)
        left = self._stopped_s + min(1.5 * frame_s + _SHORTEST_S, _LONGEST_S) - time.monotonic()
        if left > 0:
            self._ended.wait(left)
            self._check()

    def _start(self) -> None:
        self._device.ask_camera("start_acquisition")

    def _stop(self) -> None:
        self._device.stop()
        self._stopped_s = time.monotonic()

    def latch(self) -> Latch | None:
        """Return the camera's time now."""
        with self._asking:
            self._check()
            return self._latch.read()

    def _fire(self) -> None:
        self._device.ask("execute_command", self._control.software_command())

    def _drop(self) -> None:
        self._device.drop()


# A GenICam camera, GigE Vision or USB3 Vision, through Aravis.


class AravisGrabber(GenicamGrabber):
    """A GenICam camera; see `stereorig.drivers.cameras.protocol.FrameGrabber`.

    Feature reads of a camera that is gone take 2.5 s each, which nothing can shorten. So only `open`, `configure`,
    `arm`, `disarm`, `trigger`, `latch` and `renew_clock` ask the camera; the others never wait for it.

    Parameters
    ----------
    options
        ``device`` is an id as `discover` lists it, a serial number, a MAC or an IP address.
    """

    def __init__(self, options: CameraOptions) -> None:
        super().__init__(options, AravisSession)


# The time of a camera's clock, read together with the host's.

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
