"""Services of a GigE Vision camera that Aravis lacks: its controlling program, the length of packets, action commands.

Aravis can only find out if a camera is controlled by trying to take control itself, for 2.5 s. Reading the register
disturbs no other program.
"""

from __future__ import annotations

import fcntl
import itertools
import socket
import struct
import time
from collections.abc import Sequence
from enum import StrEnum
from ipaddress import IPv4Address, IPv4Interface

import psutil

_PORT = 3956
_KEY, _ANSWER_WANTED = 0x42, 0x01
_READ_REGISTER, _READ_REGISTER_ANSWER = 0x0080, 0x0081
_CONTROL_CHANNEL_PRIVILEGE = 0x0A00
_HELD_BITS = 0x3  # exclusive access, control access
_ACCESS_DENIED = 0x8006
_ACTION, _ACTION_ANSWER, _SCHEDULED = 0x0100, 0x0101, 0x80
_NO_REFERENCE_TIME, _ACTION_LATE = 0x8013, 0x8016
_INTERFACE_ADDRESS, _INTERFACE_MASK = 0x8915, 0x891B  # Linux's ioctls
_actions = itertools.count()
_IP_MTU = 14  # Linux; Python has no name for it


class ControlState(StrEnum):
    """Control of a camera."""

    FREE = "free"
    HELD = "held"
    SILENT = "silent"  # it did not answer


def control_state(address: str, *, timeout_s: float = 0.3, attempts: int = 2) -> ControlState:
    """Ask the GigE Vision camera at an IP address for the program that controls it.

    An answer to an earlier attempt counts too: a camera that is busy answers late.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.settimeout(timeout_s)
        for number in range(1, attempts + 1):
            question = struct.pack(
                ">BBHHHI", _KEY, _ANSWER_WANTED, _READ_REGISTER, 4, number, _CONTROL_CHANNEL_PRIVILEGE
            )
            try:
                line.connect((address, _PORT))
                line.send(question)
                answer = line.recv(64)
            except OSError:  # nothing in time, or no way there
                continue
            state = _state_in(answer, number)
            if state is not None:
                return state
    return ControlState.SILENT


def _state_in(answer: bytes, last: int) -> ControlState | None:
    """Return the state that an answer to one of the questions up to ``last`` holds; None if it is no such answer."""
    if len(answer) < 8:
        return None
    status, command, _, echo = struct.unpack(">HHHH", answer[:8])
    if command != _READ_REGISTER_ANSWER or not 1 <= echo <= last:
        return None
    if status == _ACCESS_DENIED:
        return ControlState.HELD
    if status == 0 and len(answer) >= 12:
        (value,) = struct.unpack(">I", answer[8:12])
        return ControlState.HELD if value & _HELD_BITS else ControlState.FREE
    return ControlState.FREE


def longest_packet(address: str) -> int | None:
    """Return the largest undivided IP packet to or from this address, in bytes (MTU); None if not known."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            line.connect((address, _PORT))  # sends nothing
            return line.getsockopt(socket.IPPROTO_IP, _IP_MTU)
    except OSError:
        return None


class ActionAnswer(StrEnum):
    """A camera's answer to an action command."""

    DONE = "done"
    LATE = "late"  # its time was over: done at once
    NO_TIME = "no_time"  # it follows no master clock
    REFUSED = "refused"
    SILENT = "silent"


def send_action(
    addresses: Sequence[str],
    keys: tuple[int, int, int],
    *,
    at_ns: int | None = None,
    broadcast: bool = True,
    timeout_s: float = 0.1,
) -> dict[str, ActionAnswer]:
    """Send one action command to all cameras and return each camera's answer.

    Parameters
    ----------
    addresses
        IP addresses of the cameras.
    keys
        Device key, group key and group mask; a camera with other keys does nothing.
    at_ns
        Time of the action by the cameras' common clock; None: at once.
    broadcast
        One packet for all, if one interface reaches them all; else one for each.
    timeout_s
        Wait for the answers.
    """
    number = next(_actions) % 65535 + 1
    body = struct.pack(">III", *keys) + (b"" if at_ns is None else struct.pack(">Q", at_ns))
    flags = _ANSWER_WANTED | (0 if at_ns is None else _SCHEDULED)
    packet = struct.pack(">BBHHH", _KEY, flags, _ACTION, len(body), number) + body
    together = _broadcast_address(addresses) if broadcast else None
    answers = dict.fromkeys(addresses, ActionAnswer.SILENT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        for target in addresses if together is None else (together,):
            line.sendto(packet, (target, _PORT))
        deadline = time.monotonic() + timeout_s
        while ActionAnswer.SILENT in answers.values() and (left := deadline - time.monotonic()) > 0.0:
            line.settimeout(left)
            try:
                answer, (address, _) = line.recvfrom(64)
            except OSError:  # nothing in time, or an address that refuses it
                continue
            known = _action_answer(answer, number)
            if known is not None and address in answers:
                answers[address] = known
    return answers


def _action_answer(answer: bytes, number: int) -> ActionAnswer | None:
    if len(answer) < 8:
        return None
    status, command, _, echo = struct.unpack(">HHHH", answer[:8])
    if command != _ACTION_ANSWER or echo != number:
        return None
    special = {0: ActionAnswer.DONE, _ACTION_LATE: ActionAnswer.LATE, _NO_REFERENCE_TIME: ActionAnswer.NO_TIME}
    return special.get(status, ActionAnswer.REFUSED)


def _broadcast_address(addresses: Sequence[str]) -> str | None:
    """Return the broadcast address of the interface that all these addresses are on, or None."""
    wanted = [int.from_bytes(socket.inet_aton(address), "big") for address in addresses]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        for _, name in socket.if_nameindex():
            try:
                own, mask = (
                    int.from_bytes(fcntl.ioctl(line, question, struct.pack("256s", name.encode()[:15]))[20:24], "big")
                    for question in (_INTERFACE_ADDRESS, _INTERFACE_MASK)
                )
            except OSError:  # an interface without an IPv4 address
                continue
            if all(one & mask == own & mask for one in wanted):
                return socket.inet_ntoa((own | ~mask & 0xFFFFFFFF).to_bytes(4, "big"))
    return None


# GigE Vision's FORCEIP: gives a camera an address that it keeps until it is switched off, in any network.
#
# The camera is named by its MAC address, since packets to its present IP address may have no way there.

_FORCE_IP, _NUMBER = 0x0004, 1
#: 2 bytes reserved, MAC; then address, mask and gateway, each behind 12 reserved bytes
_BODY = struct.Struct(">2x6s12x4s12x4s12x4s")


def force_ip_packet(mac: bytes, wanted: IPv4Interface, gateway: IPv4Address) -> bytes:
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


def send_force_ip(command: bytes) -> list[str]:
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
