"""Devices and ports that this user may not open, or another program holds: the service's port, USB cameras."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from pathlib import Path

from stereorig.server.cell.cell import Cell
from stereorig.server.cell.sandbox import ALL_WALLS, walls
from stereorig.server.doctor.report import Notebook

# interface class, subclass of USB3 Vision
_USB3_VISION = ("ef", "05")
_RULE = 'SUBSYSTEM=="usb", ENV{ID_USB_INTERFACES}=="*:ef05??:*", MODE="0660", GROUP="plugdev"'


def check_service_port(book: Notebook, host: str, port: int) -> None:
    """See whether the service could listen on its port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
        except (OSError, OverflowError) as error:
            taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            book.note(
                "service",
                "port",
                "warning",
                f"another program listens on port {port} of {host}" if taken else f"{host}:{port}: {error}",
                remedy=f"If that is no service of yours, start it with another port: stereorig serve --port {port + 1}."
                if taken
                else "Give 'stereorig serve' a --port above 1023, and a --host of this machine.",
            )
            return
    book.note("service", "port", "ok", f"port {port} of {host} is free")


def check_cell(book: Notebook) -> None:
    """See which walls there are around the reading of a file that a client sends."""
    with book.guard("service", "foreign files"), contextlib.closing(Cell()) as cell:
        held = cell.read(walls, [])
        lacking = [name for name in ALL_WALLS if name not in held]
        book.note(
            "service",
            "foreign files",
            "warning" if lacking else "ok",
            f"read behind {', '.join(held)}" + (f"; this system has no {' and no '.join(lacking)}" if lacking else ""),
            remedy="Use Linux 5.13 or newer, and a container that allows Landlock and seccomp.",
        )


def check_usb_cameras(
    book: Notebook, *, devices: Path = Path("/sys/bus/usb/devices"), dev: Path = Path("/dev")
) -> None:
    """Note for each USB3 Vision camera that is plugged in if this user may open it."""
    cameras = {path.name.split(":")[0] for path in devices.glob("*:*") if _class_of(path) == _USB3_VISION}
    for name in sorted(cameras):
        node = _node_of(devices / name, dev)
        if node is None:
            continue
        allowed = os.access(node, os.R_OK | os.W_OK)
        what = _text(devices / name / "product") or name
        book.note(
            "software",
            "USB camera",
            "ok" if allowed else "failed",
            f"{what} at {node} is ours to use" if allowed else f"{what}: this user may not open {node}",
            remedy=f"As root write {_RULE} to /etc/udev/rules.d/70-cameras.rules, add the user to plugdev, log in "
            "again, and plug the camera in again.",
        )


def _class_of(interface: Path) -> tuple[str, str]:
    return _text(interface / "bInterfaceClass"), _text(interface / "bInterfaceSubClass")


def _node_of(device: Path, dev: Path) -> Path | None:
    bus, number = _text(device / "busnum"), _text(device / "devnum")
    if not (bus.isascii() and bus.isdecimal() and number.isascii() and number.isdecimal()):
        return None
    node = dev / "bus" / "usb" / f"{int(bus):03d}" / f"{int(number):03d}"
    return node if node.exists() else None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:  # unplugged just now
        return ""
