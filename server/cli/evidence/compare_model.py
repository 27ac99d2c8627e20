"""``stereorig compare-model``: a measured step against a finite element result."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from pydantic import ValidationError

from stereorig.core.errors import InputError
from stereorig.server.exports.vtu import write_vtu
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.models.read import UNITS
from stereorig.server.formats.results.folder import first_results
from stereorig.server.formats.results.summary import to_json
from stereorig.server.results.models.compare import compare_files
from stereorig.server.results.models.document import FieldVerdict, ModelComparisonReply
from stereorig.server.results.models.request import CompareRequest, placement_in
from stereorig.server.results.steps import ExportSource, read_step
from stereorig.server.wording import problems_in

_SHOWN = 12  # refuted regions
_MICRO = 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Compare a measured displacement, and its strain, with a finite element result: the model is laid onto the "
        "measured shape, interpolated onto the points, filtered as the measurement is, and subtracted. Maps of the "
        "difference over its uncertainty go into a VTU file, verdicts by region into comparison.json. Ends with 1 "
        "where the model is refuted."
    )
    add = parser.add_argument
    add("folder", metavar="FOLDER", type=Path, help="results of stereorig measure, or of an analysis: step_0000.nc ...")
    add("--model", metavar="FILE", type=Path, required=True, help="VTU, XDMF (its HDF5 in the same folder), or CSV")
    add("--unit", choices=UNITS, help="unit of length of the file, if it states none")
    add(
        "--displacement",
        metavar="NAME",
        help="the nodes' displacement: an array, a table's vector, or scalars: ux,uy,uz (two of a plane model)",
    )
    add("--time", type=float, metavar="T", help="time of the state to take from a series (the last)")
    add("--step", type=int, metavar="N", help="step to compare (the last)")
    add(
        "--align",
        default="given",
        metavar="given|3-2-1:X,Y,...|markers|best-fit|JSON",
        help="placement: in the system frame; by six positions in px, three on its plane Z = 0, two on its "
        "X axis, one at X = 0; by --marker; by the shape, from the markers or the system frame; or as the API's align",
    )
    add(
        "--marker",
        action="append",
        default=[],
        metavar="PX,PY,X,Y,Z",
        help="position in camera 1's reference image (px) and the same point of the model (mm); three or more",
    )
    add("--marker-sigma", type=float, default=0.0, metavar="MM", help="standard uncertainty of finding a marker (0)")
    add("--tile", dest="tile_px", type=float, metavar="PX", help="width of a region (an eighth of the field)")
    add("--confidence", type=float, metavar="P", help="share of right models that are accepted (0.95)")
    add("--remove-rigid", action="store_true", help="take out the rigid motion between both displacements")
    add("--load-uncertainty", type=float, metavar="R", help="relative standard uncertainty of the load, as 0.005 (0)")
    add("--out", type=Path, metavar="DIR", help="folder for comparison.json and comparison.vtu")
    add("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Compare, print, write."""
    files = first_results(args.folder, (args.folder, args.folder / "exports" / "measure"))
    found = compare_files(files, args.model, _request(args))
    document = found.document
    if args.out is not None:
        make_folder(args.out)
        write_bytes(args.out / "comparison.json", to_json(document.model_dump(mode="json")))
        path = next(f for f in files if f.name in document.inputs_sha256)
        source = ExportSource(files, "comparison", about={"model": document.model.model_dump(mode="json")})
        write_vtu(args.out / "comparison.vtu", found.added_to(read_step(path)), source)
    if args.json:
        print(to_json(document.model_dump(mode="json")).decode())
    else:
        print("\n".join(report(document)))
        if args.out is not None:
            print(f"written: {args.out / 'comparison.json'}, {args.out / 'comparison.vtu'}")
    return 0 if document.accepted else 1


def _request(args: argparse.Namespace) -> CompareRequest:
    names = ("unit", "displacement", "time", "step", "tile_px", "confidence", "load_uncertainty")
    body = {name: value for name in names if (value := getattr(args, name)) is not None}
    try:
        return CompareRequest.model_validate({**body, "remove_rigid": args.remove_rigid, "align": _align(args)})
    except ValidationError as error:
        raise InputError(
            f"{problems_in(error)[0]}", code="wrong_usage", remedy="See stereorig compare-model --help."
        ) from error


def _align(args: argparse.Namespace) -> dict[str, object]:
    markers = [_numbers("--marker", text, 5) for text in args.marker]
    through = {
        "kind": "markers",
        "sigma_mm": args.marker_sigma,
        "markers": [{"xy_px": v[:2], "model_mm": v[2:]} for v in markers],
    }
    if args.align == "markers":
        return through
    if args.align == "best-fit":
        return {"kind": "best-fit", **({"start": through} if markers else {})}
    if markers:
        raise InputError(
            f"--marker is given with --align {args.align}.",
            code="option_conflict",
            remedy="Give --align markers or best-fit.",
        )
    if args.align == "given":
        return {"kind": "given"}
    kind, _, positions = args.align.partition(":")
    if kind == "3-2-1":
        v = _numbers("--align 3-2-1", positions, 12)
        return {"kind": "3-2-1", "positions_px": [v[k : k + 2] for k in range(0, 12, 2)]}
    return placement_in(args.align).model_dump()


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(v) for v in numbers):
        raise InputError(
            f"{option} {text[:60]!r} is not {count} finite numbers.",
            code="wrong_usage",
            remedy="See stereorig compare-model --help.",
        )
    return numbers


def report(found: ModelComparisonReply) -> list[str]:
    """Return the comparison in lines of text."""
    model, place, factor = found.model, found.align, found.factor
    through = f", {place.points} points, residual {1e3 * place.residual_rms_mm:.2f} um" if place.points else ""
    lines = [
        f"step {found.step} against {model.file}: {model.displacement} ({model.displacement_unit}), {model.triangles} "
        f"triangles ({model.unit}){'' if model.time is None else f', time {model.time:g}'}",
        f"align: {place.kind}{through}{'' if not place.held else '; from its start: ' + ', '.join(place.held)}",
        f"compared: {found.points['compared']} of {found.points['measured']} points; shapes differ by "
        f"{1e3 * found.shape.rms_mm:.2f} um rms, {found.shape.ratio:.2f} of the points' own noise",
    ]
    if factor.value is not None and factor.sigma is not None:
        lines.append(f"measured displacement over the model's: {factor.value:.5f} +- {factor.sigma:.5f}")
    lines += _quantity("displacement", found.displacement, 1e3, "um")
    if found.strain is not None:
        lines += _quantity("strain", found.strain, _MICRO, "microstrain")
    if model.corners_only:
        lines.append(f"of {model.corners_only} cells of a higher order only the corners were taken")
    if found.left_out is not None:
        left = found.left_out.removesuffix("_mm")
        lines.append(
            f"plane model: {left} is left out of difference, chi-square and verdict; the others are in its plane"
        )
    if found.not_included:
        lines.append(f"uncertainties: {found.not_included}")
    for k in found.refuted[:_SHOWN]:
        region = found.regions[k]
        x0, y0, x1, y1 = region.rectangle_px
        worst = max(
            (
                (abs(n.value) / n.sigma, name, n)
                for name, n in region.difference.items()
                if n.value is not None and n.sigma
            ),
            key=lambda item: item[0],
        )
        scale, unit = (1e3, "um") if worst[2].units == "mm" else (_MICRO, "microstrain")
        value, sigma = scale * (worst[2].value or 0.0), scale * (worst[2].sigma or 0.0)
        lines.append(
            f"refuted: region {k}, {x0:g},{y0:g} to {x1:g},{y1:g} px, by {' and '.join(region.refuted)}: "
            f"{worst[1].removesuffix('_mm')} off by {value:.3g} +- {sigma:.2g} {unit}"
        )
    if len(found.refuted) > _SHOWN:
        lines.append(f"and {len(found.refuted) - _SHOWN} regions more")
    lines.append(f"verdict: the model is {'accepted' if found.accepted else 'REFUTED'}")
    return lines


def _quantity(name: str, one: FieldVerdict, scale: float, unit: str) -> list[str]:
    rms = ", ".join(f"{k.removesuffix('_mm')} {scale * v:.3g}" for k, v in one.rms.items() if v is not None)
    z = ", ".join(f"{v:.2f}" for v in one.rms_z.values() if v is not None)
    p = one.overall.probability
    out = [
        f"{name}: {'accepted' if one.accepted else 'refuted'}, probability {p if p is None else format(p, '.3g')}; "
        f"difference rms {rms} {unit}, over its uncertainty {z}"
    ]
    parts = (
        (one.scale, "in proportion to the model"),
        (one.pattern, "of another form"),
        (one.local, "in the region that fits worst"),
    )
    for part, said in parts:
        if part is not None and part.probability is not None and part.chi_square is not None:
            out.append(
                f"  {said}: chi-square {part.chi_square:.1f} of {part.degrees}, probability {part.probability:.3g}"
            )
    return out
