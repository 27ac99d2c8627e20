"""Two data of a GigE Vision camera that Aravis does not give: its controlling program, and the length of packets.

Aravis can only find out if a camera is controlled by trying to take control itself, for 2.5 s. Reading the register
disturbs no other program.
"""

from __future__ import annotations

import socket
import struct
from enum import StrEnum

_PORT = 3956
_KEY, _ANSWER_WANTED = 0x42, 0x01
_READ_REGISTER, _READ_REGISTER_ANSWER = 0x0080, 0x0081
_CONTROL_CHANNEL_PRIVILEGE = 0x0A00
_HELD_BITS = 0x3  # exclusive access, control access
_ACCESS_DENIED = 0x8006
_IP_MTU = 14  # Linux; Python has no name for it


class ControlState(StrEnum):
    """Control of a camera."""

    FREE = "free"
    HELD = "held"
    SILENT = "silent"  # it did not answer


def control_state(address: str, *, timeout_s: float = 0.3, attempts: int = 2) -> ControlState:
    """Ask the GigE Vision camera at an IP address for the program that controls it."""
    for number in range(1, attempts + 1):
        question = struct.pack(">BBHHHI", _KEY, _ANSWER_WANTED, _READ_REGISTER, 4, number, _CONTROL_CHANNEL_PRIVILEGE)
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
                line.settimeout(timeout_s)
                line.connect((address, _PORT))
                line.send(question)
                answer = line.recv(64)
        except OSError:  # nothing in time, or no way there
            continue
        if len(answer) < 8:
            continue
        status, command, _, echo = struct.unpack(">HHHH", answer[:8])
        if command != _READ_REGISTER_ANSWER or echo != number:
            continue
        if status == _ACCESS_DENIED:
            return ControlState.HELD
        if status == 0 and len(answer) >= 12:
            (value,) = struct.unpack(">I", answer[8:12])
            return ControlState.HELD if value & _HELD_BITS else ControlState.FREE
        return ControlState.FREE
    return ControlState.SILENT


def longest_packet(address: str) -> int | None:
    """Return the largest undivided IP packet to or from this address, in bytes (MTU); None if not known."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.connect((address, _PORT))  # sends nothing
            return line.getsockopt(socket.IPPROTO_IP, _IP_MTU)
    except OSError:
        return None
