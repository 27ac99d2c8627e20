"""The IP address of a GigE Vision camera: now, and after it is switched on again."""

from __future__ import annotations

import time
from ipaddress import IPv4Address, IPv4Interface

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.connect import connected
from stereorig.drivers.cameras.aravis.discovery import find
from stereorig.drivers.cameras.aravis.features import AravisFeatures
from stereorig.drivers.cameras.aravis.library import aravis
from stereorig.drivers.cameras.genicam import gvcp
from stereorig.drivers.cameras.genicam.gvcp import ControlState, control_state

# A camera takes its new address at once or after a restart of its network
_TAKES_S = 8.0
_PERSISTENT = ("GevPersistentIPAddress", "GevPersistentSubnetMask", "GevPersistentDefaultGateway")
_SWITCH = "GevCurrentIPConfigurationPersistentIP"


def set_address(name: str, wanted: IPv4Interface, gateway: IPv4Address | None = None) -> None:
    """Give a camera an address and network mask, for now and for good.

    Parameters
    ----------
    name
        The camera's id, serial number or MAC address; its MAC address also if Aravis does not list it.
    wanted
        Address with the length of its network's prefix.
    gateway
        None for a camera that sends to its own network only.

    Raises
    ------
    CameraError
        ``camera_lost`` if no such camera is there or it does not answer at its new address; ``camera_busy``;
        ``unknown_feature`` if it has the address now but cannot keep it.
    """
    aravis().update_device_list()
    listed = find(name)
    mac = gvcp.mac_of(name if listed is None else listed.physical_id)
    if mac is None:
        raise CameraError(
            f"{name} is no GigE Vision camera that answers, nor a MAC address.",
            code="camera_lost",
            remedy="Name it by the MAC address on its label, such as 00:30:53:1a:2b:3c.",
            camera=name,
        )
    way_out = gateway or IPv4Address(0)
    address = str(wanted.ip)
    if listed is None or listed.address != address:
        if control_state(address) is not ControlState.SILENT:
            raise _lost(name, f"would share {address} with another device that answers there", "Choose a free address.")
        _force(name, gvcp.force_ip_packet(mac, wanted, way_out), address)
    with connected(address) as device:
        features = AravisFeatures(device)
        for feature, value in zip(_PERSISTENT, (wanted.ip, wanted.netmask, way_out), strict=True):
            features.write(feature, int(value))
        features.write(_SWITCH, True)


def _force(name: str, command: bytes, address: str) -> None:
    if not gvcp.send_force_ip(command):
        raise _lost(name, "cannot be reached: no interface has an IPv4 address", "Give this machine's interface one.")
    until = time.monotonic() + _TAKES_S
    while control_state(address) is ControlState.SILENT:
        if time.monotonic() > until:
            raise _lost(
                name,
                f"does not answer at {address}, {_TAKES_S:g} s after it was given that address",
                "Give this machine's interface an address in that network, and close what else holds the camera.",
            )
        time.sleep(0.1)


def _lost(name: str, why: str, remedy: str) -> CameraError:
    return CameraError(f"{name} {why}.", code="camera_lost", remedy=remedy, camera=name)
