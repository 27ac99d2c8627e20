"""Discovery of the cameras that Aravis finds, and search for the one that a rig file names."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from stereorig.drivers.cameras.aravis.library import aravis, text_of
from stereorig.drivers.cameras.genicam.errors import several
from stereorig.drivers.cameras.genicam.gvcp import ControlState, control_state
from stereorig.drivers.cameras.protocol import FoundDevice

DRIVER = "aravis"
_GIGE = "GigEVision"
_PROBLEMS = {
    ControlState.HELD: "Another program or the running service uses it: close that first.",
    ControlState.SILENT: "It does not answer at its address: give it one by stereorig devices --set-address.",
}
_EXTRA = ("vendor", "protocol", "physical_id", "manufacturer_info")


@dataclass(frozen=True)
class ListedCamera:
    """A line of Aravis' list; ``address`` is empty but for GigE Vision cameras."""

    id: str
    physical_id: str
    model: str
    serial: str
    address: str
    extra: dict[str, str]


def _listed() -> Iterator[ListedCamera]:
    for index in range(int(aravis().get_n_devices())):

        def of(name: str, index: int = index) -> str:
            return text_of(lambda: getattr(aravis(), f"get_device_{name}")(index))

        yield ListedCamera(
            of("id"),
            of("physical_id"),
            of("model"),
            of("serial_nbr"),
            of("address") if of("protocol") == _GIGE else "",
            {name: value for name in _EXTRA if (value := of(name))},
        )


def discover() -> list[FoundDevice]:
    """List the GigE Vision and USB3 Vision cameras that answer; takes a second.

    ``problem`` of a GigE Vision camera: it is in use, or its address cannot be reached; of a USB3 Vision camera neither
    is known without opening it.

    Raises
    ------
    CameraError
        ``driver_missing`` when Aravis is not installed.
    """
    aravis().update_device_list()
    return [
        FoundDevice(
            kind="camera",
            driver=DRIVER,
            device=one.id,
            model=one.model,
            serial=one.serial,
            address=one.address,
            problem=_PROBLEMS.get(control_state(one.address)) if one.address else None,
            extra=one.extra,
        )
        for one in _listed()
    ]


def find(name: str) -> ListedCamera | None:
    """Return the camera of this id, serial number or MAC address in Aravis' present list; None without one.

    Raises
    ------
    CameraError
        ``camera_lost`` when several cameras have the serial number or MAC address.
    """
    cameras = list(_listed())
    found = [one for one in cameras if one.id == name] or [
        one for one in cameras if name in (one.serial, one.physical_id)
    ]
    if len(found) > 1:
        raise several(name, (one.id for one in found))
    return found[0] if found else None
