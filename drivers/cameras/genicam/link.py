"""The link that GigE Vision cameras send over: its interface and speed, and the share of it that a camera may take."""

from __future__ import annotations

import ipaddress
import math
from pathlib import Path

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam import synonyms
from stereorig.drivers.cameras.genicam.features import CameraFeatures

# A link has no room for resends and other traffic above this share of its speed
LOAD = 0.8
#: features that hold a camera back, the first that can be written counts: bytes a second, or a pause after each packet
SHARES = (*synonyms.THROUGHPUT_LIMIT, synonyms.PACKET_PAUSE)
#: Ethernet's bytes around a packet, its gap included
AROUND_BYTES = 38


def interface_of(address: str, proc: Path = Path("/proc")) -> str | None:
    """Name the interface that packets to an IPv4 address leave by; None if there is none."""
    wanted = ipaddress.IPv4Address(address)
    if wanted.is_loopback:
        return "lo"
    best: tuple[int, str] | None = None
    for line in read_text(proc / "net" / "route").splitlines()[1:]:
        words = line.split()  # Iface Destination Gateway Flags RefCnt Use Metric Mask; numbers as the host stores them
        network, mask = (int.from_bytes(bytes.fromhex(words[i])[::-1], "big") for i in (1, 7))
        if int(wanted) & mask == network and (best is None or mask > best[0]):
            best = mask, words[0]
    return None if best is None else best[1]


def speed_of(interface: str, sys: Path = Path("/sys/class/net")) -> float | None:
    """Return the speed of an interface in bytes a second; None if it has none that is known."""
    speed = read_number(sys / interface / "speed")
    return None if speed is None else speed * 1e6 / 8


def read_text(path: Path) -> str:
    """Return the text of one of the system's files, empty if it cannot be read."""
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:  # a link that is down has no speed, a tunnel none at all
        return ""


def read_number(path: Path) -> float | None:
    """Return the number in one of the system's files; None if there is none above zero."""
    try:
        number = float(read_text(path))
    except ValueError:
        return None
    return number if number > 0 else None


def hold_back(features: CameraFeatures, bytes_per_s: float, link_bytes_per_s: float, ticks_per_s: float) -> None:
    """Let a disarmed camera send at most so many bytes a second, or as few as it can, if it has a feature for that.

    ``link_bytes_per_s`` is the speed at this machine's end; ticks are of the camera's clock. Raises `CameraError`.
    """
    if features.writable(synonyms.THROUGHPUT_MODE) and "On" in features.entries(synonyms.THROUGHPUT_MODE):
        features.write(synonyms.THROUGHPUT_MODE, "On")
    name = next((name for name in _shares(features) if features.writable(name)), None)
    if name is None:
        return
    bounds = features.bounds(name)
    step = bounds.step or 1.0
    if name == synonyms.PACKET_PAUSE:
        packet = features.read_number("GevSCPSPacketSize") + AROUND_BYTES
        own = [features.read_number(name) * unit for name, unit in synonyms.LINK_SPEED.items() if features.has(name)]
        # the camera's end of the link may be faster than this one: a packet takes less time there
        pause_s = packet * (1.0 / bytes_per_s - 1.0 / (max(own, default=0.0) or link_bytes_per_s))
        value = bounds.first + math.ceil((pause_s * ticks_per_s - bounds.first) / step) * step
    else:
        value = bounds.first + math.floor((bytes_per_s - bounds.first) / step) * step
    value = min(max(value, bounds.low), bounds.high)
    features.write(name, int(value) if features.kind(name) == "integer" else float(value))


def held_back_by(features: CameraFeatures) -> str:
    """Return the feature that holds a camera back with its value; empty if it has none, or none that can be read."""
    try:
        off = features.has(synonyms.THROUGHPUT_MODE) and features.is_at(synonyms.THROUGHPUT_MODE, "Off")
        name = features.first(*_shares(features)[off:])
        return "" if name is None else f"{name} = {features.read_number(name):.0f}"
    except CameraError as error:
        if error.code == "camera_lost":
            raise
        return ""


def _shares(features: CameraFeatures) -> list[str]:
    # Aravis knows standard registers that the camera may not have
    return [name for name in SHARES if name in features.names]
