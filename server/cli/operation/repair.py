"""``stereorig repair``: put a data folder in order after a crash."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from stereorig.server.cli.operation.verify import record, report
from stereorig.server.store.repair import repair


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Quarantine steps without their commit mark, remove half-written files, rebuild the catalogue from the "
        "folders, and list everything that was done. Damaged files are listed and left alone. Ends with 1 when there "
        "are any."
    )
    parser.add_argument("data", type=Path, metavar="DATA", help="data folder, with no service running on it")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Repair and print."""
    outcome = repair(args.data)
    if args.json:
        print(json.dumps({"done": list(outcome.done), "after": record(outcome.after)}, indent=1))
    else:
        print("\n".join([*outcome.done, *report(outcome.after)]))
    return 0 if outcome.after.sound else 1
