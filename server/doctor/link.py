"""The way from the cameras to this machine: packets, the load of each link, and the system's settings for it."""

from __future__ import annotations

import math
from pathlib import Path

from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.genicam.describe import GIGE
from stereorig.drivers.cameras.genicam.link import AROUND_BYTES, LOAD, SHARES, interface_of, read_number
from stereorig.drivers.cameras.genicam.synonyms import PACKET_PAUSE
from stereorig.server.doctor.cameras import PairLog
from stereorig.server.doctor.report import Notebook

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
#: many small packets wear a processor out above this rate
_SMALL_PACKETS_MIB_PER_S = 50.0
_JUMBO = 8000
#: of IP and UDP, which the drivers do not count
_HEADERS = 28


def check_link(book: Notebook, unit: CameraUnit, seen: PairLog) -> None:
    """Note the driver's counts during the watch."""
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
    seen: PairLog,
    *,
    proc: Path = Path("/proc"),
    sys: Path = Path("/sys/class/net"),
) -> None:
    """Look at the interfaces that GigE Vision cameras hang on, and at the buffers for their packets."""
    on: dict[str, list[CameraName]] = {}
    for cam in CAMERAS:
        address = units[cam].description.extra.get("address", "")
        if units[cam].description.extra.get("protocol") == GIGE and address:
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


def _check_interface(
    book: Notebook, name: str, cams: list[CameraName], units: dict[CameraName, CameraUnit], seen: PairLog, sys: Path
) -> None:
    speed, mtu = read_number(sys / name / "speed"), read_number(sys / name / "mtu")
    mib_per_s = sum(seen.bytes_per_s(cam) for cam in cams) / 2**20
    load = mib_per_s * 2**20 * 8 / (speed * 1e6) if speed else None
    sizes = [units[cam].description.extra.get("packet_size_bytes", "unknown") for cam in cams]
    crowded = load is not None and load > LOAD
    shared = len(cams) > 1 and speed is not None
    shares, rate_hz = _shares([units[cam] for cam in cams], speed * 1e6 / 8, seen) if shared and speed else ("", None)
    asked_hz = max(units[cam].rate_hz or 0.0 for cam in cams)
    lost = any(
        seen.link.get(cam, {}).get(name, 0) > 0 for cam in cams for name in ("missing_packets", "resent_packets")
    )
    tight = shared and (lost or asked_hz > (rate_hz or math.inf))
    small = mtu is not None and mtu < _JUMBO and mib_per_s > _SMALL_PACKETS_MIB_PER_S
    book.note(
        "network",
        name,
        "warning" if crowded or small or tight else "ok",
        f"{' and '.join(cams)}: {mib_per_s:.1f} MiB/s"
        + (f", {100 * load:.0f} % of {speed:.0f} Mbit/s" if load is not None else ", speed of the link unknown")
        + f"; packets of {' and '.join(sizes)} bytes, MTU {'unknown' if mtu is None else f'{mtu:.0f}'}{shares}",
        limit=None if load is None else f"{100 * LOAD:.0f} %",
        remedy="Give each camera a link of its own, or lower rate, region or bit depth."
        if crowded or tight
        else f"Switch jumbo frames on: ip link set {name} mtu 9000 (cameras and switch must support them too).",
        mib_per_s=mib_per_s,
        load=load,
        mtu=mtu,
        safe_rate_hz=rate_hz,
    )


def _shares(units: list[CameraUnit], link_bytes_per_s: float, seen: PairLog) -> tuple[str, float | None]:
    """Return how cameras share their link, and the rate up to which no packet should be lost; None if not known."""
    none = f"has none of {', '.join(SHARES)} and sends as fast as it can"
    texts, shares, rates = [], [], []
    for unit in units:
        text = unit.description.extra.get("link_share", "")
        name, _, value = text.partition(" = ")
        texts.append(f"{unit.name} {text or none}")
        share = float(value) if value else math.inf
        if name == PACKET_PAUSE:
            # the pause of its equal share, unless it did not take it or the rig file gives another one
            own = share == 0.0 or name in (unit.wanted.features or {})
            share = math.inf if own else LOAD * link_bytes_per_s / len(units)
        shares.append(share)
        size = _image_bytes(seen, unit.name)
        rates.append(share / size if size else math.inf)
    rate_hz = min(rates) if sum(shares) <= 1.001 * LOAD * link_bytes_per_s and max(rates) < math.inf else None
    promise = "" if rate_hz is None else f"; no packet should be lost up to {rate_hz:.3g} images/s of each"
    return f"; {', '.join(texts)}{promise}", rate_hz


def _image_bytes(seen: PairLog, cam: CameraName) -> float:
    """Return the bytes that an image takes of the link, its packets' headers included; zero if none came."""
    counted, images = seen.link.get(cam, {}), seen.frames.get(cam, {}).get("delivered", 0)
    around = counted.get("received_packets", 0) * (_HEADERS + AROUND_BYTES)
    return (counted.get("transferred_bytes", 0) + around) / images if images else 0.0


def _check_buffers(book: Notebook, seen: PairLog, proc: Path) -> None:
    room = read_number(proc / "sys" / "net" / "core" / "rmem_max")
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
