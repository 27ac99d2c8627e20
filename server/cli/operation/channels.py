"""``stereorig channels import``: a load frame's record, aligned with the steps of a test on a running service."""

from __future__ import annotations

import argparse
from pathlib import Path

from core.errors import InputError
from server.api.models.channels import ChannelsImported
from server.demo.client import ServiceClient

#: form fields of the operation, by the option that gives each
_FIELDS = ("time_column", "starts_utc", "at_step", "at_s", "offset_s", "max_gap_s", "load")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    add = actions.add_parser(
        "import", help="give each step of a test the channels of a CSV at the time at which it was taken"
    ).add_argument
    add("test", metavar="TEST", help="id of the test")
    add("file", metavar="CSV", type=Path, help="table with a row of titles: times, then channels; units in brackets")
    add("--time-column", metavar="TITLE", help="title of the times' column (the first that says so)")
    add("--starts-utc", metavar="TIME", help="when the record's own clock was zero, as 2026-03-01T12:00:00Z")
    add("--at-step", type=int, metavar="N", help="or: this step was taken at the record's time --at")
    add("--at", dest="at_s", type=float, metavar="S", help="time of the record at which --at-step was taken, s (0)")
    add("--offset", dest="offset_s", type=float, metavar="S", help="seconds by which the record's clock is behind (0)")
    add(
        "--max-gap",
        dest="max_gap_s",
        type=float,
        metavar="S",
        help="readings further apart are not joined, s (three times their median distance)",
    )
    add("--load", metavar="CHANNEL", help="channel that is the steps' load, in N or kN: force_kn")
    add("--replace", action="store_true", help="write over channels that steps have already")
    add("--url", default="http://127.0.0.1:8000", help="address of the service (default: %(default)s)")
    add("--key", metavar="KEY", help="key of the service, where it asks for one")


def run(args: argparse.Namespace) -> int:
    """Send the record, print what each step got."""
    try:
        content = args.file.read_bytes()
    except OSError as error:
        raise InputError(
            f"{args.file} cannot be read: {error.strerror}.", code="file_missing", remedy="Check the path."
        ) from error
    form = {name: str(value) for name in _FIELDS if (value := getattr(args, name)) is not None}
    headers = {} if args.key is None else {"Authorization": f"Bearer {args.key}"}
    with ServiceClient(args.url.rstrip("/"), headers=headers) as client:
        answer = client.call(
            "POST",
            f"/tests/{args.test}/channels:import",
            files={"file": (args.file.name, content, "text/csv")},
            data={**form, "replace": str(args.replace).lower()},
        )
    found = ChannelsImported.model_validate(answer.json())
    units = ", ".join(f"{name} ({unit})" for name, unit in found.channels.items())
    print(f"{found.readings} readings, one in {found.interval_s:.6g} s: {units}")
    for step in found.steps:
        values = ", ".join(f"{name} {value:.6g}" for name, value in step.channels.items())
        parts = [values, f"missing: {step.missing}" if step.missing else ""]
        when = "" if step.time_s is None else f" at {step.time_s:.3f} s"
        print(f"step {step.n}{when}: {'; '.join(part for part in parts if part)}")
    if found.steps_next_cursor is not None:
        print(f"... and {found.n_steps - len(found.steps)} further steps; {found.n_aligned} of all have channels now")
        for reason, count in found.reasons.items():
            print(f"{count} steps: {reason}")
    return 0
