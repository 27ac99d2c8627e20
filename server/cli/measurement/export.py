"""``stereorig export``: results in the forms that other programs read."""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.cli.measurement.coverage import add_coverage, coverage_from
from stereorig.server.exports.request import FORMATS, ExportRequest, steps_in
from stereorig.server.exports.run import export
from stereorig.server.exports.source import find_source
from stereorig.server.formats.figures.options import COLOURS, MAX_LEVELS, FigureStyle
from stereorig.server.formats.files import make_folder
from stereorig.server.formats.results.variables import described
from stereorig.server.results.gauges import FRAME_HELP
from stereorig.server.results.gauges.framed import asked_at, in_frame


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add(
        "folder",
        metavar="FOLDER",
        type=Path,
        help="a test's folder, an analysis' folder, or results of stereorig measure",
    )
    add(
        "--format",
        required=True,
        choices=FORMATS,
        help="nc: as stored; csv; vtu with a pvd series for ParaView; mat: "
        "MATLAB; h5: HDF5, all steps stacked; png, svg: figures; gif, mp4: films over the steps",
    )
    add("--out", required=True, type=Path, metavar="DIR", help="folder for the files; made if it is not there")
    add("--analysis", metavar="ID", help="which of a test's analyses (its only one)")
    add("--step", action="append", default=[], metavar="N[-M][,...]", help="these steps only; repeatable (all)")
    add(
        "--variable",
        action="append",
        default=[],
        metavar="NAME[,...]",
        help="these variables only; repeatable (all; of figures and films w_mm, or z_mm of a shape)",
    )
    add("--frame", metavar="FRAME", help=FRAME_HELP)
    add("--limits", metavar="LOW,HIGH", help="ends of the colour scale, in the variable's unit")
    add("--percentiles", metavar="LOW,HIGH", default="1,99", help="else of the values, where the scale ends (1,99)")
    add("--colours", choices=COLOURS, default="viridis", help="colour map (viridis)")
    add("--levels", type=int, default=0, metavar="N", help=f"bands of one colour, up to {MAX_LEVELS} (0: smooth)")
    add("--reverse", action="store_true", help="the colour map from its other end")
    add("--opacity", type=float, default=0.75, metavar="N", help="opacity of the map over the image, up to 1 (0.75)")
    add("--width", type=int, default=900, metavar="PX", help="of figures and films (900)")
    add("--over-image", action="store_true", help="draw over camera 1's reference image")
    add("--image", type=Path, metavar="FILE", help="camera 1's reference image, if it was moved")
    add("--fps", type=float, default=2.0, metavar="N", help="steps a second in a film (2)")
    add_coverage(parser)


def run(args: argparse.Namespace) -> int:
    """Export; print the files' names."""
    style = FigureStyle(
        limits=None if args.limits is None else _pair("--limits", args.limits),
        percentiles=_pair("--percentiles", args.percentiles),
        colours=args.colours,
        width_px=args.width,
        opacity=args.opacity,
        levels=args.levels,
        reverse=args.reverse,
    )
    request = ExportRequest(
        format=args.format,
        steps=steps_in(",".join(args.step)) if args.step else None,
        style=style,
        fps=args.fps,
        variables=[name for text in args.variable for name in text.split(",")] or None,
        over_image=args.over_image or args.image is not None,
        coverage=coverage_from(args),
    )
    source = find_source(args.folder, args.analysis)
    if args.image is not None:
        source = replace(source, image=args.image)
    for reason in source.stale_reasons:
        print(f"STALE: {reason} since this was measured; measure again")
    make_folder(args.out)
    count = 0
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(path) for path in source.files]
        drawn = request.drawn_variables
        strain = drawn is None or any(described(name).part == "strain" for name in drawn)
        framed = in_frame(files, asked_at(args.frame, files[0]), Path(folder) / "frame", strain=strain)
        for path in export(replace(source, files=framed), request, args.out):
            print(path)
            count += 1
    print(f"written: {count} file{'s' if count != 1 else ''} in {args.out}")
    return 0


def _pair(option: str, text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InputError(
            f"{option} {text!r} is not two numbers.", code="figure_style_invalid", remedy=f"Give {option} LOW,HIGH."
        )
    return low, high
