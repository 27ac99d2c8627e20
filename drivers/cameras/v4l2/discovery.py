"""Identity of video devices, and discovery of those that are usable cameras."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import FoundDevice
from stereorig.drivers.cameras.v4l2 import structures as v
from stereorig.drivers.cameras.v4l2.device import V4l2Device
from stereorig.drivers.cameras.v4l2.picture import PictureFormat
from stereorig.drivers.cameras.v4l2.stream import probe_flags

_SYS = Path("/sys/class/video4linux")
_LINKS = (Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path"))


@dataclass(frozen=True)
class Identity:
    """Identity of a device. ``serial`` is the maker's if the bus has it, else the position on the bus."""

    model: str
    serial: str
    firmware: str = ""
    extra: dict[str, str] = field(default_factory=dict)


def identity(path: str, capability: v.Capability) -> Identity:
    """Return the identity of a device from its driver and its bus."""
    bus_info = capability.bus_info.decode("utf-8", "replace")
    extra = {
        "bus_info": bus_info,
        "kernel_driver": capability.driver.decode("utf-8", "replace"),
        "kernel": ".".join(str(capability.version >> shift & 255) for shift in (16, 8, 0)),
    }
    serial, firmware = "", ""
    for folder in _parents(path):
        if (folder / "idVendor").is_file():  # a USB device
            serial, firmware = _word(folder / "serial"), _word(folder / "bcdDevice")
            extra["usb_id"] = f"{_word(folder / 'idVendor')}:{_word(folder / 'idProduct')}"
            extra["usb_speed_mbit_s"] = _word(folder / "speed")
            break
    return Identity(
        model=capability.card.decode("utf-8", "replace"), serial=serial or bus_info, firmware=firmware, extra=extra
    )


def _parents(path: str) -> list[Path]:
    """Return the device's folders in sysfs, from its own to the bus's root."""
    try:
        own = (_SYS / Path(path).resolve().name / "device").resolve(strict=True)
    except OSError:
        return []
    return [own, *own.parents]


def _word(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def discover() -> list[FoundDevice]:
    """List the capture devices, also those that cannot be used, with their problems."""
    nodes = sorted(Path("/dev").glob("video[0-9]*"), key=lambda node: int(re.sub(r"\D", "", node.name) or 0))
    return [found for node in nodes if (found := _examined(node)) is not None]


def _examined(node: Path) -> FoundDevice | None:
    try:
        device = V4l2Device(str(node)).open()
    except CameraError as error:
        if error.code == "not_a_camera":
            return None
        return FoundDevice(
            kind="camera", driver="v4l2", device=str(node), model=_word(_SYS / node.name / "name"), problem=_text(error)
        )
    try:
        with device.use():
            wanted = v.CAP_VIDEO_CAPTURE | v.CAP_VIDEO_CAPTURE_MPLANE
            if not device.capabilities & wanted:
                return None  # outputs, codecs' other ends, and the nodes for metadata that webcams have
            known = identity(str(node), device.capability)
            return FoundDevice(
                kind="camera",
                driver="v4l2",
                device=_stable_name(node, has_serial=known.serial != known.extra["bus_info"]),
                model=known.model,
                serial=known.serial,
                address=known.extra["bus_info"],
                problem=_problem(device),
                extra={"node": str(node), **known.extra},
            )
    finally:
        device.close()


def _problem(device: V4l2Device) -> str | None:
    try:
        if not device.capabilities & v.CAP_STREAMING:
            return "It cannot stream into mapped buffers, and this driver reads in no other way. Use another camera."
        picture = PictureFormat(device)
        if not picture.gray_formats:
            names = ", ".join(name.strip() for name in picture.other_formats()) or "none at all"
            return f"It sends only formats without plain brightness ({names}). Use a camera with a gray or YUV format."
        probe_flags(device, picture)
        layout = picture.layout()
        if layout.gray is not None:
            picture.require_readable(layout)
    except CameraError as error:
        return _text(error)
    return None


def _text(error: CameraError) -> str:
    return f"{error.cause} {error.remedy}"


def _stable_name(node: Path, *, has_serial: bool) -> str:
    """Return a link that names this device after a restart too; without a serial number, the link by its socket.

    Two cameras of one model without serial numbers share one name by id, which then means either of them.
    """
    for folder in _LINKS if has_serial else _LINKS[::-1]:
        if folder.is_dir():
            for link in sorted(folder.iterdir()):
                if link.resolve() == node:
                    return str(link)
    return str(node)
