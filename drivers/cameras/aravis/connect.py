"""Connecting: from the name in a rig file to a camera under our control, its packets as large as the network takes."""

from __future__ import annotations

import contextlib
import ipaddress
from collections.abc import Callable, Iterator

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.device import AravisDevice
from stereorig.drivers.cameras.aravis.discovery import find
from stereorig.drivers.cameras.aravis.library import aravis
from stereorig.drivers.cameras.genicam.gvcp import ControlState, control_state, longest_packet
from stereorig.drivers.cameras.protocol import CameraOptions

_PACKET_SIZE = "GevSCPSPacketSize"
_TEST_PACKET = "GevSCPSFireTestPacket"


def connect(device: AravisDevice, options: CameraOptions, on_lost: Callable[[], None]) -> None:
    """Open the camera that the options name: by id, serial number, MAC or IP address.

    ``on_lost`` is called from a thread of Aravis when a USB3 camera is lost.

    Raises
    ------
    CameraError
        ``camera_lost``, ``camera_busy``; ``out_of_range`` for a packet size that does not pass.
    """
    name = options.device.strip()
    if not name:
        # Aravis would open the first camera that it finds
        raise CameraError(
            "No camera is named.", code="camera_lost", remedy="Name it as `stereorig devices` lists it.", camera=name
        )
    device.connect(_ready(device, name), on_lost)
    if device.is_gige:
        try:
            _set_packet_size(device, options.packet_size_bytes)
        except CameraError as error:
            # a camera whose packet size cannot be read may have one that works
            if error.code != "unknown_feature" or options.packet_size_bytes is not None:
                raise


@contextlib.contextmanager
def connected(name: str) -> Iterator[AravisDevice]:
    """Connect to a camera, by id, serial number, MAC or IP address, for the length of a block; raises as `connect`."""
    options = CameraOptions(device=name)
    device = AravisDevice(options, lambda: None)
    try:
        connect(device, options, lambda: None)
        yield device
    finally:
        device.drop()


def _ready(device: AravisDevice, name: str) -> str:
    """Return the id to open; a camera that cannot be opened is refused here, since Aravis would take 2.5 s for that."""
    if _is_address(name):
        _check_control(device, control_state(name))
        return name
    camera = find(name)
    state = None if camera is None or not camera.address else control_state(camera.address)
    if camera is None or state is ControlState.SILENT:
        # it may be new, or have another address by now
        aravis().update_device_list()
        camera = find(name)
        if camera is None:
            raise device.lost("is no camera that answers, by its id, serial number, MAC or IP address")
        state = control_state(camera.address) if camera.address else None
    _check_control(device, state)
    # a name that is no ASCII may be written otherwise here than Aravis has it
    return camera.id if camera.id.isascii() or not camera.address else camera.address


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _check_control(device: AravisDevice, state: ControlState | None) -> None:
    if state is ControlState.HELD:
        raise device.busy()
    if state is ControlState.SILENT:
        raise device.lost("does not answer at its address")


def _set_packet_size(device: AravisDevice, wanted: int | None) -> None:
    """Set the size, or else the largest that passes.

    A camera that sends no test packets keeps its own size, as long as it fits the network's packets: of divided ones
    Aravis sees the first part only.
    """
    device.ask_camera("gv_set_packet_size_adjustment", aravis().GvPacketSizeAdjustment.NEVER)
    low, high = (int(bound) for bound in device.ask_camera("get_integer_bounds", _PACKET_SIZE))
    step = int(device.ask_camera("get_integer_increment", _PACKET_SIZE))
    # a test packet may pass in parts, which cost far more than smaller packets
    high = min(high, longest_packet(device.address()) or high)
    if device.ask_camera("is_feature_available", _TEST_PACKET):
        high = min(high, int(device.ask_camera("gv_auto_packet_size")))
    if wanted is None and int(device.ask_camera("gv_get_packet_size")) > high:
        wanted = high - (high - low) % step
    if wanted is None:
        return
    if not low <= wanted <= high or (wanted - low) % step:
        allowed = f"{low} to {high} in steps of {step}, which is what the camera and the network (its MTU) let pass"
        raise device.out_of_range("packet_size_bytes", wanted, allowed)
    device.ask_camera("gv_set_packet_size", wanted)
    taken = int(device.ask_camera("gv_get_packet_size"))
    if taken != wanted:
        raise device.out_of_range("packet_size_bytes", wanted, f"what it takes: it made {taken} of it")
