"""``stereorig devices``: the connected devices, and their faults."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from ipaddress import IPv4Interface

from stereorig.core.errors import InputError
from stereorig.drivers.cameras.aravis.address import set_address
from stereorig.drivers.cameras.genicam.table import Feature
from stereorig.drivers.registry import look_at_camera
from stereorig.server.rig.devices import DeviceFinder, DeviceListing, ListedDevice

LONGEST_S = 600.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "List cameras and serial ports with their faults. Nothing is opened and no byte is sent to a serial "
        "port; 'stereorig doctor' asks the devices that a rig file names, and --features and --dump one camera."
    )
    one = parser.add_mutually_exclusive_group()
    one.add_argument("--features", metavar="CAMERA", help="print every feature of this GenICam camera, value and range")
    one.add_argument(
        "--dump",
        metavar="CAMERA",
        help="print this camera's description and every value, for a report of trouble (JSON)",
    )
    one.add_argument(
        "--set-address",
        nargs=2,
        metavar=("CAMERA", "ADDRESS"),
        help="give a GigE Vision camera an address, now and for good: its id, serial number or MAC address, and the "
        "address with its network, such as 192.168.10.11/24",
    )
    parser.add_argument("--json", action="store_true", help="print JSON, the same as GET /api/v1/devices")
    parser.add_argument(
        "--timeout", type=float, default=5.0, metavar="SECONDS", help="time limit for each driver (default: 5)"
    )


def run(args: argparse.Namespace) -> int:
    """Look and print."""
    if not 0.0 < args.timeout <= LONGEST_S:
        raise InputError(f"--timeout {args.timeout:g} is not above 0 and up to {LONGEST_S:g} s.")
    if args.set_address is not None:
        camera, text = args.set_address
        try:
            wanted = IPv4Interface(text)
        except ValueError as error:
            raise InputError(f"--set-address {text} is no IPv4 address with its network: {error}.") from error
        if wanted.network.prefixlen == 32:
            raise InputError(f"--set-address {text} has no network: write {text.split('/')[0]}/24 for 255.255.255.0.")
        set_address(camera, wanted)
        print(f"{camera} has {wanted} now, and after it is switched on again.")
        return 0
    if args.dump is not None:
        about, rows = look_at_camera(args.dump)
        print(json.dumps({**about, "features": [asdict(row) for row in rows]}, indent=1, ensure_ascii=False))
        return 0
    if args.features is not None:
        _, rows = look_at_camera(args.features)
        print(json.dumps([asdict(row) for row in rows], indent=1) if args.json else features_report(rows))
        return 0
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


def features_report(rows: Sequence[Feature]) -> str:
    """Return the features of a camera as text, a line each."""
    cells = [("feature", "access", "value", "range", "rig file")]
    for row in rows:
        value = "" if row.value is None else f"{row.value:.6g}" if isinstance(row.value, float) else str(row.value)
        steps = f" in steps of {row.step:g}" if row.step not in (None, 1) else ""
        ends = "" if row.low is None or row.high is None else f"{row.low:g} to {row.high:g}{steps}"
        allowed = row.trouble or ends or ", ".join(row.entries)
        cells.append((row.name, row.access, f"{value} {row.unit or ''}".strip(), allowed, row.setting or ""))
    widths = [min(max(len(line[i]) for line in cells), 48) for i in range(5)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip() for line in cells
    )


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
