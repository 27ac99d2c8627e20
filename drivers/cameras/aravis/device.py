"""The only holder of a camera's handle, so that its release ends the connection.

Aravis keeps a camera under control as long as its object lives. An error that is kept also keeps the local variables of
the functions it came through: none of these functions has the handle among them, only this class's attributes have.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.library import aravis, glib_error, text_of
from stereorig.drivers.cameras.genicam.errors import RECONNECT, NamedCamera
from stereorig.drivers.cameras.protocol import CameraOptions

# errors of these kinds speak of the connection; others of a formula or a text of the camera's description
_OF_THE_CONNECTION = ("arv-device-error-quark", "g-io-error-quark")


class AravisDevice(NamedCamera):
    """A camera that is under our control.

    Every call that asks the camera takes about a millisecond, or 2.5 s when it does not answer.

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
        self._handle: Any = None
        self._handler: int | None = None

    def connect(self, device_id: str, on_lost: Callable[[], None]) -> None:
        """Take control of the camera; ``on_lost`` is called from a thread of Aravis when a USB3 camera is lost.

        Raises
        ------
        CameraError
            ``camera_lost`` when there is none of this id, ``camera_busy`` when another program controls it.
        """
        try:
            self._camera = aravis().Camera.new(device_id)
        except glib_error() as error:
            raise self.translated(error) from None
        self._handle = self._camera.get_device()
        if self.is_gige and not self._handle.is_controller():
            # without control Aravis opens it all the same, for reading only; letting go of that may take 2.5 s
            threading.Thread(target=self.drop, name=f"release {self.name}", daemon=True).start()
            raise self.busy()
        if not self.is_gige:
            # With a GigE camera the signal comes from a thread of Aravis that the handle's end waits for: releasing the
            # handle during the signal would make that thread wait for itself, which ends the program.
            self._handler = self._handle.connect("control-lost", lambda _device: on_lost())
        self.stop()  # an acquisition left running by a program that crashed, or a connection that broke

    def in_control(self) -> bool:
        """True if the camera is still under control, as far as Aravis knows; does not ask it."""
        handle = self._handle
        return handle is not None and (not self.is_gige or bool(handle.is_controller()))

    def drop(self) -> None:
        """Release the camera and its control; takes 2.5 s if it does not answer."""
        if self._handle is not None and self._handler is not None:
            self._handle.disconnect(self._handler)
            self._handler = None
        self._handle = None
        self._camera = None

    @property
    def is_gige(self) -> bool:
        """True for a GigE Vision camera."""
        return isinstance(self._handle, aravis().GvDevice)

    @property
    def protocol(self) -> str:
        """Its protocol, as far as it is one of these."""
        if self.is_gige:
            return "GigE Vision"
        # a library that was built without USB has no such class
        usb = getattr(aravis(), "UvDevice", None)
        return "USB3 Vision" if usb is not None and isinstance(self._handle, usb) else ""

    def node(self, name: str) -> Any:
        """Node of the camera's description, or None; does not keep the connection."""
        return None if self._handle is None else self._handle.get_feature(name)

    def ask(self, method: str, *args: Any) -> Any:
        """Call a method of the device (``ArvDevice``)."""
        self._check()
        try:
            return getattr(self._handle, method)(*args)
        except glib_error() as error:
            raise self.translated(error, *args) from None

    def ask_camera(self, method: str, *args: Any) -> Any:
        """Call a method of the camera (``ArvCamera``)."""
        self._check()
        try:
            return getattr(self._camera, method)(*args)
        except glib_error() as error:
            raise self.translated(error, *args) from None

    def ask_node(self, name: str, method: str) -> Any:
        """Call a method of a node of the camera's description (``ArvGcNode``)."""
        self._check()
        try:
            return getattr(self._handle.get_feature(name), method)()
        except glib_error() as error:
            raise self.translated(error, name) from None

    def stop(self) -> None:
        """Ask the camera to stop sending, even when it was closed; raises nothing."""
        if self._camera is not None:
            try:
                self._camera.stop_acquisition()
            except glib_error():  # it is not there, or not under control any more
                return

    def text(self, method: str, *args: Any) -> str:
        """Return a text from a method of the device (``ArvDevice``), in any encoding that the maker used."""
        return text_of(lambda: self.ask(method, *args))

    def text_of(self, method: str) -> str:
        """Return a text about the camera, empty if it has none."""
        self._check()
        try:
            return text_of(getattr(self._camera, method))
        except glib_error() as error:
            lost = self.translated(error)
            if lost.code != "camera_lost":
                return ""
            raise lost from None

    def description(self) -> str:
        """Return the camera's description (GenICam XML)."""
        xml = self._handle.get_genicam_xml()
        text = xml[0] if isinstance(xml, tuple) else xml
        return text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text or "")

    def start_stream(self) -> tuple[Any, int]:
        """Return a new stream (``ArvStream``) and the size of its buffers."""
        return self.ask_camera("create_stream", None, None), int(self.ask_camera("get_payload"))

    def address(self) -> str:
        """IP address of a GigE Vision camera, or an empty string."""
        if not self.is_gige:
            return ""
        return str(self._handle.get_device_address().get_address().to_string())

    def translated(self, error: Any, name: object = None, value: object = None) -> CameraError:
        """Return an error of Aravis as one of the project's."""
        text = str(error.message)
        if error.domain == "arv-gc-error-quark":
            codes = aravis().GcError
            if error.code in (codes.OUT_OF_RANGE, codes.ENUM_ENTRY_NOT_FOUND):
                return self.out_of_range(name, value, f"what the camera accepts: {text}")
            return self.unknown(name, f"cannot be used: {text}")
        if error.domain not in _OF_THE_CONNECTION:
            # a formula that divides by zero, a register without a length: the cable is not to blame
            return self.unknown(name or "its description", f"cannot be used: {text}")
        codes = aravis().DeviceError
        if error.domain == "arv-device-error-quark" and error.code in (
            codes.GENICAM_NOT_FOUND,
            codes.INVALID_PARAMETER,
            codes.PROTOCOL_ERROR_BAD_ALIGNMENT,
            codes.PROTOCOL_ERROR_BUSY,
            codes.PROTOCOL_ERROR_INVALID_ADDRESS,
            codes.PROTOCOL_ERROR_NOT_IMPLEMENTED,
        ):
            return self.unknown(name or "its description", f"cannot be used: {text}")
        if error.code in (codes.FEATURE_NOT_FOUND, codes.WRONG_FEATURE):
            return self.unknown(name, f"is not there: {text}")
        if error.code == codes.PROTOCOL_ERROR_ACCESS_DENIED:
            return self.busy() if name is None else self.unknown(name, f"is locked now: {text}")
        if error.code in (codes.PROTOCOL_ERROR_INVALID_PARAMETER, codes.PROTOCOL_ERROR_WRITE_PROTECT):
            return self.out_of_range(name, value, f"what the camera accepts: {text}")
        return CameraError(f"{self.name}: {text}.", code="camera_lost", remedy=RECONNECT, camera=self.name)
