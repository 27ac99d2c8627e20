"""``stereorig doctor``: checks of the bench."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.cli.operation.serve import DEFAULT_PORT, check_record, default_config
from stereorig.server.doctor import Check, examine
from stereorig.server.doctor.report import line_of

LONGEST_S = 3600.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Check the whole bench that a rig file names: software, machine, cameras (identity, settings, rates, losses, "
        "skew, images), stage (state, limits, answers, stop) and disk. Each line has the measured value and its limit; "
        "the exit status is 0 if nothing failed and 1 otherwise. No service may hold the devices at that time."
    )
    add = parser.add_argument
    add("--config", type=Path, help="rig file (default: the simulated paper rig)")
    add("--data", type=Path, default=Path("data"), help="data folder, whose disk is timed (default: ./data)")
    add("--host", default="127.0.0.1", help="address that the service is to listen on (default: 127.0.0.1)")
    add("--port", type=int, default=DEFAULT_PORT, help=f"its port (default: {DEFAULT_PORT})")
    add("--seconds", type=float, default=5.0, help="how long pairs are captured for (default: 5)")
    add(
        "--move",
        action="store_true",
        help="allow each axis that is ready a move of 0.1 mm and back; a simulated stage does so anyway",
    )
    add(
        "--home",
        action="store_true",
        help="allow each axis to search home, over its whole travel; a simulated stage does so anyway",
    )
    add(
        "--record",
        type=Path,
        metavar="FILE",
        help="write a transcript of the stage's wire to FILE, for reports of trouble",
    )
    add("--json", action="store_true", help="print the report as JSON when all is done")


def run(args: argparse.Namespace) -> int:
    """Examine; print; 0 if the bench is good."""
    if not 0.0 < args.seconds <= LONGEST_S:
        raise InputError(f"--seconds {args.seconds:g} is not above 0 and up to {LONGEST_S:g}.")

    if args.record is not None:
        check_record(args.record)

    def on_check(check: Check) -> None:
        print(line_of(check), flush=True)

    path = args.config or default_config()
    report = examine(
        path,
        seconds=args.seconds,
        data=args.data,
        host=args.host,
        port=args.port,
        move=args.move,
        home=args.home,
        record=args.record,
        on_check=None if args.json else on_check,
    )
    print(report.model_dump_json(indent=1) if args.json else f"\n{report.verdict}")
    return 0 if report.good else 1
