"""``stereorig report``: one HTML file with results, settings and uncertainty."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.cli.measurement.coverage import add_coverage, coverage_from
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.report.task import SECTIONS, ReportOptions, chosen_sections
from stereorig.server.results.gauges import FRAME_HELP
from stereorig.server.results.gauges.framed import asked_at, in_frame
from stereorig.server.results.metadata import load_metadata


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add(
        "folder",
        metavar="DATA_OR_RESULTS",
        type=Path,
        help="a data folder, a test's, an analysis', or an output of stereorig measure --out",
    )
    add("--test", metavar="ID", help="which test of a data folder (its only one)")
    add("--analysis", metavar="ID", help="analysis of a test (the newest with results)")
    add("--calibration", metavar="FILE", type=Path, help="the calibration, if it is not in the results' folder")
    add(
        "--metadata",
        "--facts",
        metavar="TOML",
        type=Path,
        help="lenses, light, pattern, specimen, static steps ...; the test's own if left out",
    )
    add("--frame", metavar="FRAME", help=FRAME_HELP)
    add("--out", metavar="FILE", type=Path, default=Path("report.html"), help="the report (report.html)")
    add("--logo", metavar="FILE", type=Path, help="PNG, JPEG or SVG (report_logo.png of the data folder)")
    add(
        "--sections",
        metavar="NAME,NAME",
        type=lambda text: [name.strip() for name in text.split(",")],
        default=list(SECTIONS),
        help=f"some of {', '.join(SECTIONS)}",
    )
    add_coverage(parser)


def run(args: argparse.Namespace) -> int:
    """Make the report; print the items that are not stated."""
    # the drawing library takes a second to load
    from stereorig.server.report.build import make_report
    from stereorig.server.report.source import find_source

    if args.out.suffix.lower() not in (".html", ".htm"):
        raise InputError(
            f"--out {args.out} does not end in .html.",
            code="output_unusable",
            remedy="Give file.html; a browser prints it as PDF.",
        )
    metadata = None if args.metadata is None else load_metadata(args.metadata)
    source = find_source(
        args.folder, test=args.test, analysis=args.analysis, calibration=args.calibration, metadata=metadata
    )
    with tempfile.TemporaryDirectory() as folder:
        first = source.files[min(source.files)]
        asked = asked_at(args.frame, first)
        if asked is not None:
            framed = in_frame(list(source.files.values()), asked, Path(folder) / "frame")
            source = source.in_frame(dict(zip(source.files, framed, strict=True)))
        options = ReportOptions(chosen_sections(args.sections), args.logo)
        line = ProgressLine()
        try:
            made = make_report(source, coverage_from(args), options, lambda *at: _show(line, *at))
        finally:
            line.close()
    make_folder(args.out.absolute().parent)
    write_bytes(args.out, made.page)
    for doubt in (*(f"{reason} since this was measured" for reason in source.stale), *source.doubts):
        print(f"note: {doubt}")
    print(f"written: {args.out}, {len(made.page) / 2**20:.1f} MiB; {len(made.missing)} items are not stated")
    for item in made.missing:
        print(f"  {item.name}: {item.remedy}")
    return 0


def _show(line: ProgressLine, phase: str, done: int, total: int) -> None:
    """Show the progress; drawing takes as long as reading many steps."""
    line.show(f"report: {phase} {done + 1} of {total}", 0.5 * (done / total + (phase == "drawing")))
