"""GigE Vision's FORCEIP: gives a camera an address that it keeps until it is switched off, in any network.

The camera is named by its MAC address, since packets to its present IP address may have no way there.
"""

from __future__ import annotations

import socket
import struct
from ipaddress import IPv4Address, IPv4Interface

import psutil

_PORT = 3956
_KEY, _ANSWER_WANTED = 0x42, 0x01
_FORCE_IP, _NUMBER = 0x0004, 1
#: 2 bytes reserved, MAC; then address, mask and gateway, each behind 12 reserved bytes
_BODY = struct.Struct(">2x6s12x4s12x4s12x4s")


def packet(mac: bytes, wanted: IPv4Interface, gateway: IPv4Address) -> bytes:
    """Return the command for the camera of a MAC address (6 bytes)."""
    body = _BODY.pack(mac, wanted.ip.packed, wanted.netmask.packed, gateway.packed)
    return struct.pack(">BBHHH", _KEY, _ANSWER_WANTED, _FORCE_IP, len(body), _NUMBER) + body


def mac_of(text: str) -> bytes | None:
    """Return the six bytes of a MAC address as text, with colons, hyphens or neither; None if it is none."""
    digits = text.replace(":", "").replace("-", "")
    try:
        return bytes.fromhex(digits) if len(digits) == 12 else None
    except ValueError:
        return None


def send(command: bytes) -> list[str]:
    """Broadcast a command on every interface that has an IPv4 address; return the interfaces that took it."""
    taken = []
    for name, addresses in psutil.net_if_addrs().items():
        for own in (one.address for one in addresses if one.family == socket.AF_INET):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
                line.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
                try:
                    line.bind((own, 0))  # the broadcast leaves by the interface of this address
                    line.sendto(command, ("255.255.255.255", _PORT))
                except OSError:  # the interface is down
                    continue
            taken.append(name)
    return taken
