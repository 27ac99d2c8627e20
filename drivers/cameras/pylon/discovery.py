"""Discovery of the cameras that pylon finds, and search for the one that a rig file names."""

from __future__ import annotations

from typing import Any

from stereorig.drivers.cameras.genicam.errors import several
from stereorig.drivers.cameras.protocol import FoundDevice
from stereorig.drivers.cameras.pylon.library import factory, genapi, pylon

DRIVER = "pylon"
#: device class -> protocol
PROTOCOLS = {"BaslerGigE": "GigE Vision", "BaslerUsb": "USB3 Vision", "BaslerCamEmu": "emulated"}
#: properties by which a rig file may name a camera
_NAMES = ("SerialNumber", "FullName", "UserDefinedName", "FriendlyName", "MacAddress", "IpAddress")
_PROBLEMS = {
    "Opened": "Another program or the running service uses it: close that first.",
    "OpenedExclusively": "Another program or the running service uses it: close that first.",
    "NotReachable": "It does not answer at its address: give it one by stereorig devices --set-address.",
}


def found_devices() -> list[FoundDevice]:
    """List Basler's cameras, also those that cannot be used.

    Raises
    ------
    CameraError
        ``driver_missing`` when pypylon is not installed.
    """
    return [_found(info) for info in factory().EnumerateDevices()]


def _found(info: Any) -> FoundDevice:
    serial = prop(info, "SerialNumber")
    extra = {
        "vendor": prop(info, "VendorName"),
        "protocol": PROTOCOLS.get(prop(info, "DeviceClass"), ""),
        "physical_id": prop(info, "MacAddress"),
        "user_name": prop(info, "UserDefinedName"),
    }
    return FoundDevice(
        kind="camera",
        driver=DRIVER,
        device=serial or prop(info, "FullName"),
        model=prop(info, "ModelName"),
        serial=serial,
        address=prop(info, "IpAddress"),
        problem=_PROBLEMS.get(accessibility(info)),
        extra={name: text for name, text in extra.items() if text},
    )


def prop(info: Any, name: str) -> str:
    """Return a property of a listed camera; empty if it has none."""
    there, text = info.GetPropertyValue(name)
    return str(text) if there else ""


def accessibility(info: Any) -> str:
    """Return ``Ok``, ``Opened``, ``OpenedExclusively``, ``NotReachable``; empty if pylon does not know."""
    try:
        _, state = factory().IsDeviceAccessibleInfo(info)
    except genapi().GenericException:  # it is gone since it was listed
        return "NotReachable"
    names = ("Ok", "Opened", "OpenedExclusively", "NotReachable")
    return next((name for name in names if getattr(pylon(), f"Accessibility_{name}") == state), "")


def find(name: str) -> Any:
    """Return pylon's line of the camera of this serial number, name, MAC or IP address; None if there is none.

    Raises
    ------
    CameraError
        ``camera_lost`` when several cameras have the name.
    """
    listed = list(factory().EnumerateDevices())
    plain = name.replace(":", "").upper()  # MAC addresses without colons
    for key in _NAMES:
        wanted = plain if key == "MacAddress" else name
        found = [info for info in listed if wanted and prop(info, key) == wanted]
        if len(found) > 1:
            raise several(name, (prop(info, "SerialNumber") for info in found))
        if found:
            return found[0]
    return None
