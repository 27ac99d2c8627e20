"""``stereorig verify``: check a data folder; changes nothing."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from stereorig.server.store.verify import Verification, verify


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Read every document of a data folder and compare every file with its checksum. Changes nothing; a service may "
        "run on the folder. Ends with 1 when something is damaged."
    )
    parser.add_argument("data", type=Path, metavar="DATA", help="data folder of 'stereorig serve'")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--repair",
        action="store_true",
        help="quarantine unfinished steps, rebuild the catalogue; with no service running on the folder",
    )


def run(args: argparse.Namespace) -> int:
    """Look and print."""
    found = verify(args.data)
    if args.json:
        print(json.dumps(record(found), indent=1))
    else:
        print("\n".join(report(found)))
    return 0 if found.sound else 1


def record(found: Verification) -> dict[str, object]:
    """Return it as plain data."""
    return {
        "sound": found.sound,
        "files_verified": found.files,
        "files_without_checksum": found.unknown,
        "findings": [asdict(finding) for finding in found.findings],
    }


def report(found: Verification) -> list[str]:
    """Return it as text, the worst first."""
    order = ("damaged", "incomplete", "index", "foreign")
    lines = [
        f"{finding.level}: {finding.path}: {finding.text}"
        for finding in sorted(found.findings, key=lambda one: order.index(one.level))
    ]
    more = f", {found.unknown} without a checksum on record" if found.unknown else ""
    lines.append(f"{'sound' if found.sound else 'DAMAGED'}: {found.files} files match their checksums{more}")
    return lines
