"""Serial ports of this machine and their problems, found without opening any.

Opening a port moves its modem lines, and a byte sent to an unknown device may set a machine in motion. So everything
here comes from the system's own tables: sysfs, the access rights, open files, locks and the kernel's consoles.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from serial.tools import list_ports

from stereorig.core.errors import StageError
from stereorig.drivers.cameras.protocol import FoundDevice

# USB ids of devices that are likely behind the port; Newport's are from Linux' ftdi_sio driver
_NEWPORT = 0x104D
_HINTS: dict[tuple[int, int | None], str] = {
    (_NEWPORT, 0x3002): "Newport CONEX-CC: driver conex-cc",
    (_NEWPORT, 0x3000): "Newport Agilis controller: no driver here speaks its language",
    (_NEWPORT, 0x3006): "Newport CONEX-AGP: no driver here speaks its language",
    (_NEWPORT, None): "a Newport device",
    (0x1A72, None): "PI controller: driver pi",
    (0x2939, None): "Zaber device: driver zaber",
    (0x0403, 0xFAF0): "Thorlabs Kinesis or APT controller: driver kinesis",
    (0x0403, None): "FTDI adapter, as many motion controllers and RS-232 cables have",
    (0x067B, None): "Prolific RS-232 adapter",
    (0x10C4, None): "Silicon Labs RS-232 adapter",
    (0x1A86, None): "WCH RS-232 adapter",
}

# USB devices that no driver of Linux turns into a port
_WITHOUT_DRIVER = {
    (_NEWPORT, 0x3001): (
        "Newport ESP301",
        "Linux has no driver for this USB port: use the controller's RS-232 port, at 19200 baud, with a USB adapter",
    )
}


def discover_ports(
    *,
    proc: Path = Path("/proc"),
    dev: Path = Path("/dev"),
    locks: Path = Path("/var/lock"),
    usb: Path = Path("/sys/bus/usb/devices"),
) -> list[FoundDevice]:
    """List serial ports with their problems.

    Parameters
    ----------
    proc, dev, locks, usb
        Paths of the system's tables.

    Returns
    -------
    list of FoundDevice
        ``extra`` may hold ``link`` (a name that stays the same when the port is plugged in elsewhere or later than
        another), ``usb`` (vendor and product id) and ``hint`` (the device that the USB ids suggest).

    Raises
    ------
    StageError
        ``discovery_failed`` when the system cannot be asked.
    """
    try:
        ports: Iterable[Any] = sorted(list_ports.comports())
    except (OSError, ValueError) as error:
        raise StageError(
            f"The serial ports cannot be listed: {error}.",
            code="discovery_failed",
            remedy="Name the port in the rig file all the same.",
        ) from error
    links = _links(dev / "serial" / "by-id") or _links(dev / "serial" / "by-path")
    return [*(_describe(port, links, proc, locks) for port in ports), *_without_port(usb)]


def _without_port(usb: Path) -> list[FoundDevice]:
    """Return the controllers on USB that have no serial port on Linux, each with the way that works."""
    found = []
    for folder in sorted(usb.glob("*")):
        with contextlib.suppress(OSError, ValueError):
            vendor, product = (int((folder / name).read_text(), 16) for name in ("idVendor", "idProduct"))
            if (vendor, product) in _WITHOUT_DRIVER:
                model, problem = _WITHOUT_DRIVER[vendor, product]
                address = f"{vendor:04x}:{product:04x}"
                found.append(
                    FoundDevice(
                        kind="serial",
                        driver="",
                        device=f"usb {folder.name}",
                        model=model,
                        address=address,
                        problem=problem,
                        extra={"usb": address},
                    )
                )
    return found


def port_problem(path: str, *, proc: Path = Path("/proc"), locks: Path = Path("/var/lock")) -> str | None:
    """Return the problem for which a port cannot be used, with the remedy; ``None`` when none is known."""
    try:
        there = os.stat(path)  # noqa: PTH116  # follows a link below /dev/serial, as opening would
    except OSError as error:
        return f"cannot be found ({error.strerror}): check cable and power"
    if not os.access(path, os.R_OK | os.W_OK):
        return _no_access(there)
    console = _console(path, proc)
    if console:
        return "the kernel writes its console to it: take console= out of the boot options, or use another port"
    holders = _holders(there, path, proc, locks)
    if holders:
        return f"in use by {', '.join(holders)}: end that program first"
    return None


def _describe(port: Any, links: dict[str, str], proc: Path, locks: Path) -> FoundDevice:
    extra = {}
    usb = ""
    if port.vid is not None and port.pid is not None:
        usb = extra["usb"] = f"{port.vid:04x}:{port.pid:04x}"
        hint = _HINTS.get((port.vid, port.pid)) or _HINTS.get((port.vid, None))
        if hint:
            extra["hint"] = hint
    link = links.get(str(Path(port.device).resolve()))
    if link:
        extra["link"] = link
    named = " ".join(text for text in (port.manufacturer, port.product) if text)
    return FoundDevice(
        kind="serial",
        driver="",
        device=port.device,
        model=named or (port.description if port.description != "n/a" else ""),
        serial=port.serial_number or "",
        address=usb,
        problem=port_problem(port.device, proc=proc, locks=locks),
        extra=extra,
    )


def _links(folder: Path) -> dict[str, str]:
    try:
        return {str(link.resolve()): str(link) for link in sorted(folder.iterdir())}
    except OSError:  # no USB port was ever plugged in
        return {}


def _no_access(there: os.stat_result) -> str:
    group_may = there.st_mode & stat.S_IRGRP and there.st_mode & stat.S_IWGRP
    try:
        entry = grp.getgrgid(there.st_gid)
        user = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return f"no right to read and write it ({stat.filemode(there.st_mode)}): ask who looks after this machine"
    if not group_may or entry.gr_name == "root":
        return (
            f"no right to read and write it ({stat.filemode(there.st_mode)}, group {entry.gr_name}): "
            "give it to a group of yours by a udev rule"
        )
    if user in entry.gr_mem and there.st_gid not in os.getgroups():
        return f"no right to read and write it yet: you joined the group {entry.gr_name}, log out and in again"
    return (
        f"no right to read and write it: join its group with 'sudo usermod -aG {entry.gr_name} {user}', "
        "then log out and in again"
    )


def _console(path: str, proc: Path) -> bool:
    try:
        lines = (proc / "consoles").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return False
    return any(line.split()[:1] == [Path(path).resolve().name] for line in lines)


def _holders(there: os.stat_result, path: str, proc: Path, locks: Path) -> list[str]:
    """Name the other programs that hold the port: by open files (other users' only as root), locks and lock files."""
    pids = _openers(str(Path(path).resolve()), proc) | _lockers(there, proc)
    with contextlib.suppress(OSError, ValueError):
        pids.add(int((locks / f"LCK..{Path(path).resolve().name}").read_text(encoding="ascii").split()[0]))
    own = os.getpid()
    return [_name(pid, proc) for pid in sorted(pids) if pid != own and (proc / str(pid)).exists()]


def _openers(target: str, proc: Path) -> set[int]:
    found = set()
    for folder in proc.glob("[0-9]*/fd"):
        with contextlib.suppress(OSError):  # another user's, or gone in between
            if any(_link_target(link) == target for link in folder.iterdir()):
                found.add(int(folder.parent.name))
    return found


def _link_target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:
        return ""


def _lockers(there: os.stat_result, proc: Path) -> set[int]:
    # "1: FLOCK  ADVISORY  WRITE 30475 00:1a:3 0 EOF": major and minor in hex, then the inode
    wanted = (os.major(there.st_dev), os.minor(there.st_dev), there.st_ino)
    found = set()
    with contextlib.suppress(OSError):
        for line in (proc / "locks").read_text(encoding="ascii", errors="replace").splitlines():
            words = line.split()
            with contextlib.suppress(ValueError, IndexError):
                major, minor, inode = words[5].split(":")
                if (int(major, 16), int(minor, 16), int(inode)) == wanted:
                    found.add(int(words[4]))
    return found


def _name(pid: int, proc: Path) -> str:
    try:
        return f"{(proc / str(pid) / 'comm').read_text(encoding='utf-8', errors='replace').strip()} (process {pid})"
    except OSError:
        return f"process {pid}"
