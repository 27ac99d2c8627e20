"""One connection to a camera through pylon."""

from __future__ import annotations

import contextlib

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam.describe import GIGE, describe
from stereorig.drivers.cameras.genicam.session import CameraSession
from stereorig.drivers.cameras.genicam.settings import CameraControl
from stereorig.drivers.cameras.pixels import PixelFormat
from stereorig.drivers.cameras.protocol import CameraDescription, CameraIdentity, CameraOptions
from stereorig.drivers.cameras.pylon.device import PylonDevice
from stereorig.drivers.cameras.pylon.discovery import DRIVER
from stereorig.drivers.cameras.pylon.features import PylonFeatures
from stereorig.drivers.cameras.pylon.library import genapi, pylon
from stereorig.drivers.cameras.pylon.stream import PylonStream

# pylon waits so long for a frame's missing packets
_RETENTION_S = 0.2
# A camera that was just started, or has just exposed, is not ready for a trigger at once
_READY_S = 1.0
_PACKET_SIZE = "GevSCPSPacketSize"


class PylonSession(CameraSession):
    """An opened camera with its stream; see `stereorig.drivers.cameras.genicam.session.CameraSession`.

    Parameters
    ----------
    options
        Name of the camera, and its options.
    """

    _features: PylonFeatures

    def __init__(self, options: CameraOptions) -> None:
        super().__init__(options)
        self._camera = self._device = PylonDevice(options, self._check)

    def _connect(self) -> None:
        self._device.connect(self._options.buffers)
        self._features = PylonFeatures(self._device)
        self._control = CameraControl(self._device, self._features, self._options)
        self._set_packet_size()

    def _set_packet_size(self) -> None:
        wanted = self._options.packet_size_bytes
        if wanted is not None:
            size = self._features.check_value(_PACKET_SIZE, wanted, "packet_size_bytes")
            self._features.write(_PACKET_SIZE, size)
            return
        with self._device.asked() as camera:
            largest = camera.GetStreamGrabberNodeMap().GetNode("AutoPacketSize")
            if largest is not None and genapi().IsWritable(largest):
                largest.SetValue(True)

    def _address(self) -> str:
        return self._device.listed("IpAddress")

    def _in_control(self) -> bool:
        return not self._device.removed

    def _describe(self) -> CameraDescription:
        device = self._device
        extra = {"vendor": device.listed("VendorName"), "protocol": device.protocol, "address": self._address()}
        gige = device.protocol == GIGE
        if gige:
            extra["packet_size_bytes"] = str(self._features.read(_PACKET_SIZE))
        identity = CameraIdentity(device.listed("ModelName"), device.listed("SerialNumber"))
        latency_s = _RETENTION_S if gige else 0.0
        return describe(self._features, self._control, identity, driver=DRIVER, latency_s=latency_s, extra=extra)

    def _make_stream(self, region_px: tuple[int, int, int, int], pixel_format: PixelFormat) -> PylonStream:
        return PylonStream(self._device, region_px, pixel_format, int(self._ticks_per_s()), self._lose)

    def _start(self) -> None:
        with self._device.asked() as camera:
            camera.StartGrabbing(pylon().GrabStrategy_OneByOne)

    def _stop(self) -> None:
        with contextlib.suppress(CameraError), self._device.asked(ended=True) as camera:
            camera.StopGrabbing()

    def _fire(self) -> None:
        # a camera that is still busy with its last frame would ignore the trigger in silence
        with self._device.asked(self._control.software_command()) as camera:
            if camera.CanWaitForFrameTriggerReady():
                camera.WaitForFrameTriggerReady(round(1000 * _READY_S), pylon().TimeoutHandling_Return)
            camera.ExecuteSoftwareTrigger()

    def _drop(self) -> None:
        with contextlib.suppress(AttributeError):  # it could not be opened
            self._features.release()
        self._device.drop()
