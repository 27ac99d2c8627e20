"""``stereorig gauge``: extensometers, lines, areas, rigid motion and frames, from result files."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pydantic import ValidationError

from stereorig.core.errors import InputError
from stereorig.server.cli.measurement.coverage import add_coverage, coverage_from
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.gauges.matlab import gauges_mat
from stereorig.server.formats.gauges.readings import GaugeReadings, LineReading, Number, StepReadings
from stereorig.server.formats.gauges.table import gauges_csv
from stereorig.server.formats.results.folder import first_results
from stereorig.server.formats.results.summary import to_json
from stereorig.server.results.gauges import FRAME_HELP
from stereorig.server.results.gauges.fields import FieldWriter
from stereorig.server.results.gauges.framed import asked_at
from stereorig.server.results.gauges.readings import read_gauges
from stereorig.server.results.gauges.request import Alignment, GaugeRequest
from stereorig.server.wording import problems_in

_FORMS = {".csv": gauges_csv, ".json": lambda readings: to_json(readings.document()), ".mat": gauges_mat}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("folder", metavar="FOLDER", type=Path, help="results of stereorig measure, or of an analysis: step_0000.nc ...")
    add(
        "--point",
        action="append",
        default=[],
        metavar="X,Y",
        help="values at a position; repeatable, as all gauges; positions are px of camera "
        "1's reference image; NAME= in front names a gauge",
    )
    add(
        "--extensometer",
        action="append",
        default=[],
        metavar="X0,Y0,X1,Y1",
        help="length, elongation, engineering and true strain",
    )
    add(
        "--point-mm",
        action="append",
        default=[],
        metavar="X,Y",
        help="a position by X and Y of the reference, in the frame asked for",
    )
    add(
        "--extensometer-mm",
        action="append",
        default=[],
        metavar="X0,Y0,X1,Y1",
        help="an extensometer between two such positions",
    )
    add(
        "--line",
        action="append",
        default=[],
        metavar="X0,Y0,X1,Y1[,N]",
        help="values at N positions along a line (one a grid step)",
    )
    add(
        "--area",
        action="append",
        default=[],
        metavar="X0,Y0,X1,Y1",
        help="statistics over a rectangle; six or more numbers: a polygon; all: the whole field",
    )
    add(
        "--variable",
        action="append",
        default=[],
        metavar="NAME",
        help="read this variable of the files at points, lines and areas (position and displacement)",
    )
    add(
        "--align",
        metavar="plane|3-2-1:X,Y,...",
        help="frame: best-fit plane of the reference, or six positions: three "
        "on the plane, two on the X axis, one at X = 0",
    )
    add("--frame", metavar="FRAME", help=f"instead of --align: {FRAME_HELP}")
    add("--x-direction", metavar="X,Y,Z", help="of --align plane, system frame (1,0,0)")
    add(
        "--remove-rigid",
        nargs="?",
        const="all",
        metavar="X0,Y0,X1,Y1",
        help="take out the rigid motion of the whole field, or of a rectangle or polygon",
    )
    add("--robust", action="store_true", help="let no outlier draw the rigid motion")
    add("--step", action="append", default=[], type=int, metavar="N", help="read this step only; repeatable (all)")
    add(
        "--difference-from",
        type=int,
        metavar="N",
        help="also subtract the readings of step N from each step's: the uncertainty that both share cancels",
    )
    add_coverage(parser)
    add(
        "--field-out",
        metavar="DIR",
        type=Path,
        help="write whole fields as result files, in the frame and without the motion asked for",
    )
    add(
        "--out",
        metavar="FILE",
        type=Path,
        help="file.csv, file.json or file.mat for all readings, settings and inputs' hashes",
    )


def run(args: argparse.Namespace) -> int:
    """Read; print tables; write the file."""
    if args.out is not None and args.out.suffix.lower() not in _FORMS:
        raise InputError(
            f"--out {args.out} ends in none of .csv, .json and .mat.",
            code="output_unusable",
            remedy="Give file.csv, file.json or file.mat.",
        )
    files = first_results(args.folder, (args.folder, args.folder / "exports" / "measure"))
    asked = asked_at(args.frame, files[0])
    request = _request(args, asked)
    fields = None if args.field_out is None else FieldWriter(args.field_out, files[0].parent, request)
    readings = read_gauges(files, request, fields)
    print("\n".join(report(readings)))
    if fields is not None:
        print(f"fields written: {len(fields.written)} files in {args.field_out}")
    if args.out is not None:
        make_folder(args.out.absolute().parent)
        write_bytes(args.out, _FORMS[args.out.suffix.lower()](readings))
        print(f"written: {args.out}")
    return 0


def _request(args: argparse.Namespace, frame: Alignment | None) -> GaugeRequest:
    body: dict[str, object] = {
        "points": [
            *(_named("--point", t, lambda v: {"xy_px": v}, (2,)) for t in args.point),
            *(_named("--point-mm", t, lambda v: {"xy_mm": v}, (2,)) for t in args.point_mm),
        ],
        "extensometers": [
            *(_named("--extensometer", t, lambda v: {"a_px": v[:2], "b_px": v[2:]}, (4,)) for t in args.extensometer),
            *(_named("--extensometer-mm", t, lambda v: {"ends_mm": _pairs(v)}, (4,)) for t in args.extensometer_mm),
        ],
        "lines": [_named("--line", t, _line, (4, 5)) for t in args.line],
        "areas": [_named("--area", t, _area, None) for t in args.area],
        "variables": args.variable or None,
        "steps": args.step or None,
        "difference_from": args.difference_from,
        **coverage_from(args).model_dump(exclude_none=True),
    }
    if args.remove_rigid is not None:
        body["remove_rigid"] = {**_named("--remove-rigid", args.remove_rigid, _area, None), "robust": args.robust}
    elif args.robust:
        raise InputError("--robust is given without --remove-rigid.", code="option_conflict", remedy="Give both.")
    if args.x_direction is not None and args.align != "plane":
        raise InputError("--x-direction is given without --align plane.", code="option_conflict", remedy="Give both.")
    if args.align is not None and args.frame is not None:
        raise InputError("--align and --frame both name a frame.", code="option_conflict", remedy="Give one of them.")
    if args.align is not None:
        body["align"] = _align(args)
    elif frame is not None:
        body["align"] = frame.model_dump()
    try:
        return GaugeRequest.model_validate(body)
    except ValidationError as error:
        first = problems_in(error)[0]
        raise InputError(f"{first}", code="gauge_unusable", remedy="See stereorig gauge --help.") from error


def _align(args: argparse.Namespace) -> dict[str, object]:
    if args.align == "plane":
        direction = (
            {} if args.x_direction is None else {"x_direction": _numbers("--x-direction", args.x_direction, (3,))}
        )
        return {"kind": "plane", **direction}
    kind, _, positions = args.align.partition(":")
    if kind != "3-2-1":
        raise InputError(
            f"--align {args.align} is neither plane nor 3-2-1:X,Y,...",
            code="gauge_unusable",
            remedy="Give --align plane, or 3-2-1: and the six positions' twelve numbers.",
        )
    return {"kind": "3-2-1", "positions_px": _pairs(_numbers("--align 3-2-1", positions, (12,)))}


def _named(
    option: str, text: str, make: Callable[[list[float]], dict[str, object]], counts: tuple[int, ...] | None
) -> dict[str, object]:
    name, equals, rest = text.rpartition("=")
    named: dict[str, object] = {"name": name} if equals else {}
    if counts is None and rest == "all":
        return named
    return {**named, **make(_numbers(option, rest, counts))}


def _line(v: list[float]) -> dict[str, object]:
    count = {} if len(v) == 4 else {"count": int(v[4]) if v[4].is_integer() else v[4]}
    return {"vertices_px": _pairs(v[:4]), **count}


def _area(v: list[float]) -> dict[str, object]:
    return {"rectangle_px": v} if len(v) == 4 else {"polygon_px": _pairs(v)}


def _pairs(v: list[float]) -> list[list[float]]:
    return [v[k : k + 2] for k in range(0, len(v), 2)]


def _numbers(option: str, text: str, counts: tuple[int, ...] | None) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    n = len(numbers)
    if not numbers or not all(math.isfinite(v) for v in numbers):
        raise InputError(
            f"{option} {text!r} is not a list of finite numbers.",
            code="gauge_unusable",
            remedy="See stereorig gauge --help.",
        )
    if n not in counts if counts is not None else n < 4 or n % 2:
        wanted = "4, or an even count of 6 or more" if counts is None else " or ".join(map(str, counts))
        raise InputError(
            f"{option} {text!r} has {n} numbers; it takes {wanted}.",
            code="gauge_unusable",
            remedy="See stereorig gauge --help.",
        )
    return numbers


def report(readings: GaugeReadings) -> list[str]:
    """Return the readings as tables over the steps, one gauge after the other."""
    lines = [f"STALE: {reason} since this was measured; measure again" for reason in readings.stale_reasons]
    lines += [f"frame: {readings.frame}", f"uncertainty: {readings.statement.text}"]
    frame = readings.alignment
    if frame is not None:
        turns = ", ".join(f"{1e6 * s:.1f}" for s in frame.sigma_rad)
        lines.append(
            f"  from {frame.points} points, residual {1e3 * frame.residual_rms_mm:.2f} um rms; "
            f"sd of its turns about X, Y, Z {turns} urad"
        )
    lines += [f"step {s.n}: {s.problem.code}: {s.problem.detail}" for s in readings.steps if s.problem is not None]
    steps = readings.read
    moved = [(s, s.rigid_motion.values, "") for s in steps if s.rigid_motion is not None]
    if moved:
        lines += ["rigid motion taken out", *_table(moved)]
    if not steps:
        return lines
    for k, point in enumerate(steps[0].points):
        lines.append("point {} at ({:g}, {:g}) px".format(point.name, *point.xy_px))
        lines += _table([(s, s.points[k].values, s.points[k].missing) for s in steps])
    for k, gauge in enumerate(steps[0].extensometers):
        where = "from ({:g}, {:g}) to ({:g}, {:g}) px".format(*gauge.a_px, *gauge.b_px)
        lines.append(f"extensometer {gauge.name} {where}")
        lines += _table([(s, s.extensometers[k].values, s.extensometers[k].missing) for s in steps])
    for k, area in enumerate(steps[0].areas):
        lines.append(f"area {area.name}, mean of {area.valid} of {area.points} points in the first step read")
        areas = [(s, s.areas[k]) for s in steps]
        lines += _table([(s, {n: v.mean_number for n, v in a.values.items()}, a.missing) for s, a in areas])
    for kind, name in dict.fromkeys((one.kind, one.gauge) for s in steps for one in s.differences):
        lines.append(f"{kind} {name}, less step {readings.settings['difference_from']}")
        lines += _table(
            [(s, one.values, "") for s in steps for one in s.differences if (one.kind, one.gauge) == (kind, name)]
        )
    for k, line in enumerate(steps[0].lines):
        lines.append(f"line {line.name}, {len(line.x_px)} positions")
        lines += [_line_summary(s.n, s.lines[k]) for s in steps]
    return lines


def _line_summary(n: int, line: LineReading) -> str:
    lost = sum(bool(text) for text in line.missing)
    parts = []
    for name, v in line.values.items():
        values = [x for x in v.value if x is not None]
        parts.append(f"{name} {min(values):.6g} to {max(values):.6g}" if values else f"{name} missing")
    return f"  step {n}: {lost} missing; {', '.join(parts)}"


def _table(rows: Sequence[tuple[StepReadings, Mapping[str, Number], str]]) -> list[str]:
    names = list(dict.fromkeys(name for _, values, _ in rows for name in values))
    loaded = any(step.load_n is not None or step.label for step, _, _ in rows)
    head = ["step", *(["load_n", "label"] if loaded else []), *names]
    table = [head]
    for step, values, missing in rows:
        load = "" if step.load_n is None else f"{step.load_n:g}"
        row = [str(step.n), *([load, step.label[:24]] if loaded else [])]
        row += [f"missing ({missing})"] if missing else [_shown(values.get(name)) for name in names]
        table.append(row)
    width = [max(len(row[k]) for row in table if k < len(row) and len(row) == len(head)) for k in range(len(head))]
    return ["  " + "  ".join(cell.rjust(w) for cell, w in zip(row, width, strict=False)) for row in table]


def _shown(number: Number | None) -> str:
    """A number to the second digit of its uncertainty: of the expanded one if asked for."""
    if number is None or number.value is None:
        return "-"
    value, sigma = number.value, number.sigma if number.expanded is None else number.expanded
    if sigma is None or sigma <= 0.0:
        return f"{value:.6g}"
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), 12)
    return f"{value:.{digits}f} +- {sigma:.{digits}f}"
