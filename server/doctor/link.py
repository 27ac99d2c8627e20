"""The way from the cameras to this machine: packets, the load of each link, and the system's settings for it."""

from __future__ import annotations

import ipaddress
from pathlib import Path

from core.names import CAMERAS, CameraName
from drivers.acquisition.unit import CameraUnit
from server.doctor.cameras import Watch
from server.doctor.report import Notebook

#: counts of the drivers that grow only when something goes wrong on the way
_TROUBLES = (
    "failed_buffers",
    "underruns",
    "timeouts",
    "aborted_buffers",
    "missing_frames",
    "size_mismatches",
    "missing_packets",
    "error_packets",
    "resent_packets",
    "errors",
    "short",
    "not_requeued",
    "odd_stamps",
)
#: a link has no room for resends and other traffic above this share
_LOAD = 0.8
#: many small packets wear a processor out above this rate
_SMALL_PACKETS_MIB_PER_S = 50.0
_JUMBO = 8000


def check_link(book: Notebook, unit: CameraUnit, seen: Watch) -> None:
    """Note what the driver counted while the watch lasted."""
    counts = seen.link.get(unit.name, {})
    bad = {name: int(counts[name]) for name in _TROUBLES if counts.get(name, 0) > 0}
    packets = int(counts.get("received_packets", 0))
    text = ", ".join(f"{number} {name.replace('_', ' ')}" for name, number in bad.items()) or "nothing went wrong"
    if packets:
        text += f" in {packets} packets"
    if not counts:
        book.note(unit.name, "link", "not checked", "the driver counts nothing")
        return
    book.note(
        unit.name,
        "link",
        "warning" if bad else "ok",
        text,
        remedy="Check cable, packet size, socket buffers and the link's load (docs/how_to/cameras.md).",
        figures=dict(counts),
    )


def check_network(
    book: Notebook,
    units: dict[CameraName, CameraUnit],
    seen: Watch,
    *,
    proc: Path = Path("/proc"),
    sys: Path = Path("/sys/class/net"),
) -> None:
    """Look at the interfaces that GigE Vision cameras hang on, and at the buffers for their packets."""
    on: dict[str, list[CameraName]] = {}
    for cam in CAMERAS:
        address = units[cam].description.extra.get("address", "")
        if units[cam].description.extra.get("protocol") == "GigE Vision" and address:
            name = interface_of(address, proc)
            if name is None:
                book.note(
                    "network",
                    f"way to {cam}",
                    "warning",
                    f"no interface leads to {address}",
                    remedy="Give the interface an address in the camera's network.",
                )
            else:
                on.setdefault(name, []).append(cam)
    for name, cams in on.items():
        _check_interface(book, name, cams, units, seen, sys)
    if on:
        _check_buffers(book, seen, proc)


def interface_of(address: str, proc: Path) -> str | None:
    """Name the interface that packets to an IPv4 address leave by; None if there is none."""
    wanted = ipaddress.IPv4Address(address)
    if wanted.is_loopback:
        return "lo"
    best: tuple[int, str] | None = None
    for line in _read(proc / "net" / "route").splitlines()[1:]:
        words = line.split()  # Iface Destination Gateway Flags RefCnt Use Metric Mask; numbers as the host stores them
        network, mask = (int.from_bytes(bytes.fromhex(words[i])[::-1], "big") for i in (1, 7))
        if int(wanted) & mask == network and (best is None or mask > best[0]):
            best = mask, words[0]
    return None if best is None else best[1]


def _check_interface(
    book: Notebook, name: str, cams: list[CameraName], units: dict[CameraName, CameraUnit], seen: Watch, sys: Path
) -> None:
    speed, mtu = _number(sys / name / "speed"), _number(sys / name / "mtu")
    mib_per_s = sum(seen.bytes_per_s(cam) for cam in cams) / 2**20
    load = mib_per_s * 2**20 * 8 / (speed * 1e6) if speed else None
    sizes = [units[cam].description.extra.get("packet_size_bytes", "unknown") for cam in cams]
    crowded = load is not None and load > _LOAD
    small = mtu is not None and mtu < _JUMBO and mib_per_s > _SMALL_PACKETS_MIB_PER_S
    book.note(
        "network",
        name,
        "warning" if crowded or small else "ok",
        f"{' and '.join(cams)}: {mib_per_s:.1f} MiB/s"
        + (f", {100 * load:.0f} % of {speed:.0f} Mbit/s" if load is not None else ", speed of the link unknown")
        + f"; packets of {' and '.join(sizes)} bytes, MTU {'unknown' if mtu is None else f'{mtu:.0f}'}",
        limit=None if load is None else f"{100 * _LOAD:.0f} %",
        remedy="Give each camera a link of its own, or lower rate, region or bit depth."
        if crowded
        else f"Switch jumbo frames on: ip link set {name} mtu 9000 (cameras and switch must support them too).",
        mib_per_s=mib_per_s,
        load=load,
        mtu=mtu,
    )


def _check_buffers(book: Notebook, seen: Watch, proc: Path) -> None:
    room = _number(proc / "sys" / "net" / "core" / "rmem_max")
    frame = 0 if seen.last is None else max(pixels.nbytes for pixels in seen.last.pixels.values())
    if room is None:
        book.note("network", "socket buffers", "not checked", "the system does not report their size")
        return
    book.note(
        "network",
        "socket buffers",
        "ok" if room >= frame else "warning",
        f"up to {room / 2**20:.2f} MiB (net.core.rmem_max), an image has {frame / 2**20:.2f} MiB",
        limit="an image",
        remedy="sysctl -w net.core.rmem_max=33554432, so that a short delay of this program loses no packet.",
        rmem_max=room,
    )


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:  # a link that is down has no speed, a tunnel none at all
        return ""


def _number(path: Path) -> float | None:
    try:
        number = float(_read(path))
    except ValueError:
        return None
    return number if number > 0 else None
