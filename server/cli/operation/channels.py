"""``stereorig channels import``: a load frame's record, aligned with the steps of a test on a running service."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.api.models.channels import ChannelsImported, ChannelsPreview, StepAligned
from stereorig.server.demo.client import ServiceClient
from stereorig.server.formats.load_frames.description import RecordRead

#: form fields of the operation, by the option that gives each
_RECORD = ("time_column", "decimal", "segment", "date_order")
_FIELDS = (*_RECORD, "starts_utc", "at_step", "at_s", "offset_s", "max_gap_s", "load")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    add = actions.add_parser(
        "import", help="give each step of a test the channels of a CSV at the time at which it was taken"
    ).add_argument
    add("test", metavar="TEST", help="id of the test")
    add("file", metavar="CSV", type=Path, help="table with a row of titles: times, then channels; units in brackets")
    add("--time-column", metavar="TITLE", help="title of the times' column, or its number (as titles say)")
    add("--decimal", choices=(".", ","), help="decimal mark of all numbers (as the cells decide it)")
    add(
        "--segment",
        type=int,
        metavar="N",
        help="which readings, from 1, if the clock falls or a footer follows; 0: all",
    )
    add("--date-order", choices=("dmy", "mdy"), help="of dates as 03/01/2026 (as the dates decide it)")
    add("--starts-utc", metavar="TIME", help="when the record's own clock was zero, as 2026-03-01T12:00:00Z")
    add("--at-step", type=int, metavar="N", help="or: this step was taken at the record's time --at")
    add("--at", dest="at_s", type=float, metavar="S", help="time of the record at which --at-step was taken, s (0)")
    add("--offset", dest="offset_s", type=float, metavar="S", help="seconds by which the record's clock is behind (0)")
    add(
        "--max-gap",
        dest="max_gap_s",
        type=float,
        metavar="S",
        help="largest distance of readings that are joined, s (three times their median distance)",
    )
    add("--load", metavar="CHANNEL", help="channel that is the steps' load, in any unit of force: force_kn")
    add("--preview", action="store_true", help="show columns, units, lines left out and open questions; change nothing")
    add("--replace", action="store_true", help="write over channels that steps have already")
    add("--url", default="http://127.0.0.1:8000", help="address of the service (default: %(default)s)")
    add("--key", metavar="KEY", help="key of the service, if it requires one")


def run(args: argparse.Namespace) -> int:
    """Send the record, print the channels of each step."""
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
            f"/tests/{args.test}/channels:{'preview' if args.preview else 'import'}",
            files={"file": (args.file.name, content, "text/csv")},
            data={**form, "replace": str(args.replace).lower()},
        )
    if args.preview:
        shown = ChannelsPreview.model_validate(answer.json())
        _print_columns(shown.read)
        _print_read(shown.read)
        _print_steps(shown.steps)
        print(f"an import is refused so: {shown.refused}" if shown.refused else "an import would give these values")
        return 0
    found = ChannelsImported.model_validate(answer.json())
    units = ", ".join(f"{name} ({unit})" for name, unit in found.channels.items())
    print(f"{found.readings} readings, one in {found.interval_s:.6g} s: {units}")
    _print_read(found.read)
    _print_steps(found.steps)
    if found.steps_next_cursor is not None:
        print(f"... and {found.n_steps - len(found.steps)} further steps; {found.n_aligned} of all have channels now")
        for reason, count in found.reasons.items():
            print(f"{count} steps: {reason}")
    return 0


def _print_columns(read: RecordRead) -> None:
    for one in read.columns:
        cells = f"{one.numbers} numbers, {one.empty} empty, {one.unread} not read"
        mark = f", decimal mark {one.decimal!r}" if one.decimal else ""
        kind = f"channel {one.name}" if one.name else one.kind
        print(f"column {one.title!r}: {kind}, unit {one.unit}, {cells}{mark}; first cell {one.example!r}")


def _print_read(read: RecordRead) -> None:
    """Print the lines left out, and the doubts to be checked by the user."""
    if read.left_above or read.left_between or read.left_below:
        print(f"lines left out: {read.left_above} above the table, {read.left_between} in it, {read.left_below} below")
        for one in read.left_lines:
            print(f"  line {one.line}: {one.text}")
    for doubt in read.doubts:
        print(f"look at: {doubt}")


def _print_steps(steps: list[StepAligned]) -> None:
    for step in steps:
        values = ", ".join(f"{name} {value:.6g}" for name, value in step.channels.items())
        parts = [values, f"missing: {step.missing}" if step.missing else ""]
        when = "" if step.time_s is None else f" at {step.time_s:.3f} s"
        print(f"step {step.n}{when}: {'; '.join(part for part in parts if part)}")
