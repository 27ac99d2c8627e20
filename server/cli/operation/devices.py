"""``stereorig devices``: what is connected, and what is wrong with it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from core.errors import InputError
from server.rig.devices import DeviceFinder, DeviceListing, ListedDevice

LONGEST_S = 600.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "List cameras and serial ports with what is wrong with each. Nothing is opened and no byte is sent to a serial "
        "port; 'stereorig doctor' asks the devices that a rig file names."
    )
    parser.add_argument("--json", action="store_true", help="print JSON, the same as GET /api/v1/devices")
    parser.add_argument(
        "--timeout", type=float, default=5.0, metavar="SECONDS", help="time limit for each driver (default: 5)"
    )


def run(args: argparse.Namespace) -> int:
    """Look and print."""
    if not 0.0 < args.timeout <= LONGEST_S:
        raise InputError(f"--timeout {args.timeout:g} is not above 0 and up to {LONGEST_S:g} s.")
    listing = DeviceFinder().find(timeout_s=args.timeout)
    print(listing.model_dump_json(indent=1) if args.json else report(listing))
    return 0


def report(listing: DeviceListing) -> str:
    """Return the list as text."""
    lines = ["Cameras"]
    lines += _table(("driver", "device", "model", "serial", "address", "state"), listing.cameras)
    lines += ["", "Serial ports"]
    lines += _table(("device", "model", "serial", "address", "state"), listing.serial_ports)
    troubled = [driver for driver in listing.drivers if driver.state != "ok"]
    if troubled:
        lines += ["", "Drivers that could not search"]
        lines += [f"  {driver.name}: {driver.problem} {driver.remedy}" for driver in troubled]
    return "\n".join(lines)


def _table(columns: Sequence[str], devices: Sequence[ListedDevice]) -> list[str]:
    if not devices:
        return ["  none found"]
    rows = [list(columns)] + [[_cell(device, column) for column in columns] for device in devices]
    widths = [max(len(row[i]) for row in rows) for i in range(len(columns))]
    lines = []
    for row, device in zip(rows, (None, *devices), strict=True):
        lines.append("  " + "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
        if device is not None:
            lines += [f"      {text}" for text in _remarks(device)]
    return lines


def _cell(device: ListedDevice, column: str) -> str:
    if column == "state":
        return "problem" if device.problem else "in use by this service" if device.in_use_by else "usable"
    return str(getattr(device, column)) or "-"


def _remarks(device: ListedDevice) -> list[str]:
    remarks = [] if device.problem is None else [f"problem: {device.problem}"]
    if "link" in device.extra:
        remarks.append(f"lasting name: {device.extra['link']}")
    if "hint" in device.extra:
        remarks.append(f"by its USB ids: {device.extra['hint']}")
    return remarks
