"""The only holder of a camera of pylon's, and pylon's errors as the project's."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam.errors import RECONNECT, NamedCamera
from stereorig.drivers.cameras.protocol import CameraOptions
from stereorig.drivers.cameras.pylon.discovery import PROTOCOLS, accessibility, find, prop
from stereorig.drivers.cameras.pylon.library import factory, genapi, pylon

# Cameras that this process holds: pylon's emulator would open one twice
_held: set[str] = set()
_lock = threading.Lock()


class PylonDevice(NamedCamera):
    """A camera that is under our control.

    Parameters
    ----------
    options
        Name of the camera.
    check
        Called before each question; raises when the camera was closed in the meantime.
    """

    def __init__(self, options: CameraOptions, check: Callable[[], None]) -> None:
        super().__init__(options.device, check)
        self._camera: Any = None
        self._info: Any = None
        self._holds = ""

    def connect(self, buffers: int) -> None:
        """Take control of the camera; ``buffers`` frames may be under way.

        Raises
        ------
        CameraError
            ``camera_lost`` when there is none of this name, ``camera_busy`` when another program controls it.
        """
        info = find(self.name.strip()) if self.name.strip() else None
        if info is None:
            raise self.lost("is no camera that pylon finds, by its serial number, name, MAC or IP address")
        with _lock:
            if prop(info, "FullName") in _held:
                raise self.busy()
            self._holds = prop(info, "FullName")
            _held.add(self._holds)
        state = accessibility(info)
        if state in ("Opened", "OpenedExclusively"):
            raise self.busy()
        if state == "NotReachable":
            raise self.lost("does not answer at its address")
        self._info = info
        try:
            camera = pylon().InstantCamera(factory().CreateDevice(info))
            # pylon's usual configuration would change trigger and acquisition when it opens the camera
            nothing = pylon().ConfigurationEventHandler()
            camera.RegisterConfiguration(nothing, pylon().RegistrationMode_ReplaceAll, pylon().Cleanup_Delete)
            camera.MaxNumBuffer.Value = max(2, buffers)
            camera.Open()
            self._camera = camera
        except genapi().GenericException as error:
            raise self.translated(error) from None

    @contextlib.contextmanager
    def asked(self, name: object = None, value: object = None, *, ended: bool = False) -> Iterator[Any]:
        """Give the camera (``InstantCamera``) to a block whose errors are about a feature and its value.

        Parameters
        ----------
        name, value
            For the error text.
        ended
            True if the camera may be closed already.
        """
        if not ended:
            self._check()
        if self._camera is None:
            raise self.lost("is not open")
        try:
            yield self._camera
        except genapi().GenericException as error:
            raise self.translated(error, name, value) from None

    @property
    def removed(self) -> bool:
        """Return True if pylon has noticed that the camera is gone; does not ask it."""
        return self._camera is not None and bool(self._camera.IsCameraDeviceRemoved())

    def listed(self, name: str) -> str:
        """Return a property that the camera was listed with."""
        return prop(self._info, name)

    @property
    def protocol(self) -> str:
        """Its protocol, as far as it is known."""
        return PROTOCOLS.get(self.listed("DeviceClass"), "")

    def drop(self) -> None:
        """Release the camera and its control."""
        camera, self._camera = self._camera, None
        if camera is not None:
            # if the camera is gone, only this end is closed
            with contextlib.suppress(genapi().GenericException):
                camera.Close()
            with contextlib.suppress(genapi().GenericException):
                camera.DestroyDevice()
        with _lock:
            _held.discard(self._holds)

    def translated(self, error: Any, name: object = None, value: object = None) -> CameraError:
        """Return an error of pylon as one of the project's."""
        # behind the sentence comes the place in pylon's source
        text = str(error).split(" : ")[0].rstrip(". ")
        known = genapi()
        if self.removed:
            return self.lost("was unplugged or switched off")
        if isinstance(error, (known.OutOfRangeException, known.InvalidArgumentException)):
            return self.out_of_range(name, value, f"what the camera accepts: {text}")
        if isinstance(error, (known.AccessException, known.LogicalErrorException, known.PropertyException)):
            return self.unknown(name or "its description", f"cannot be used: {text}")
        if "another application" in text or "another client" in text:
            return self.busy()
        return CameraError(f"{self.name}: {text}.", code="camera_lost", remedy=RECONNECT, camera=self.name)
