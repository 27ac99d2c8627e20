"""``stereorig calibration``: files in other programs' forms, checks of them, repair after a bump."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.cli.measurement import calibration_repair
from stereorig.server.cli.measurement.calibration_checks import ACTIONS, add_check_actions, run_check
from stereorig.server.formats.calibrations.export import FORMS, ConversionReport, convert_calibration
from stereorig.server.formats.calibrations.in_test import calibration_in
from stereorig.server.formats.calibrations.kept_checks import read_checks
from stereorig.server.formats.calibrations.programs.plausibility import CalibrationCheck, Residual, check_calibration
from stereorig.server.formats.calibrations.recognise import (
    UNIT_HELP,
    LoadedCalibration,
    calibration_bytes,
    load_calibration,
)
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.results.folder import first_results
from stereorig.server.formats.results.reading import read_head
from stereorig.server.results.calibration_checks import EpipolarComparison, check_against


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    known = "calibration.json, DICe XML or text, OpenCV YAML, MatchID caldat, VIC-3D XML or pyvale text"
    convert = actions.add_parser("convert", help="write a calibration in another form")
    convert.add_argument("file", metavar="IN", type=Path, help=known)
    convert.add_argument("out", metavar="OUT", type=Path, help="file to write; OUT.report.json is written too")
    convert.add_argument(
        "--to",
        required=True,
        choices=FORMS,
        help="json: this program's; paper: its eleven "
        "parameters a camera; opencv: YAML; dice: XML; matchid: caldat; vic3d: XML",
    )
    check = actions.add_parser("check", help="epipolar residuals: over the volume, and over measured points")
    check.add_argument("file", metavar="FILE", type=Path, help=known)
    calibration_repair.add_arguments(
        actions.add_parser("repair", help="estimate the cameras' orientation again after a bump, from speckle images")
    )
    for action in (convert, check):
        action.add_argument(
            "--points",
            metavar="FOLDER",
            type=Path,
            help="results of stereorig measure or of an analysis: their points are checked too",
        )
        action.add_argument(
            "--measured-with", metavar="FILE", type=Path, help="the calibration of those results (their test's)"
        )
        action.add_argument("--unit", metavar="UNIT", help=UNIT_HELP)
    add_check_actions(actions)


def run(args: argparse.Namespace) -> int:
    """Convert, check or repair; print the findings."""
    if args.action in ACTIONS:
        return run_check(args)
    if args.action == "repair":
        return calibration_repair.run(args)
    loaded = load_calibration(args.file, unit=args.unit)
    checked, points = check_calibration(loaded), None
    if args.points is not None:
        points = _against(loaded, args.points, args.measured_with)
    elif args.measured_with is not None:
        raise InputError("--measured-with is given without --points.", code="option_conflict", remedy="Give both.")
    if args.action == "convert":
        made = convert_calibration(loaded, args.to, calibration_bytes(args.file))
        make_folder(args.out.absolute().parent)
        write_bytes(args.out, made.data)
        check = asdict(checked) | ({} if points is None else {"points": asdict(points)})
        report = {**asdict(made.report), "import_check": check}
        write_bytes(args.out.with_name(f"{args.out.name}.report.json"), (json.dumps(report, indent=1) + "\n").encode())
        _print_conversion(made.report)
    _print_check(checked, points)
    for name, finding in read_checks(args.file, loaded.sha256).items():
        print(f"{name}: {finding.get('text')}")
    if args.action == "convert":
        print(f"written: {args.out}")
    return 0


def _against(loaded: LoadedCalibration, folder: Path, measured_with: Path | None) -> EpipolarComparison:
    folders = [folder, folder / "exports" / "measure", *sorted((folder / "analyses").glob("*"))]
    files = first_results(folder, folders)
    if measured_with is None:
        test = files[0].absolute().parent.parent.parent
        measured_with = calibration_in(test, read_head(files[0]).inputs_sha256.get("calibration"))
        if not measured_with.is_file():
            raise InputError(
                f"The calibration that {files[0]} was measured with is not known.",
                code="option_missing",
                remedy="Name it with --measured-with.",
            )
    return check_against(loaded, files, measured_with)


def _print_conversion(report: ConversionReport) -> None:
    for cam, fit in report.lens.items():
        left = f"fitted, residual {fit.rms_px:.3g} px rms, {fit.max_px:.3g} px at most"
        print(f"{cam}: lens {'exact' if report.exact else left}")
    back = report.read_back
    if back.points:
        print(f"read back: {_format_residual(back)}; in space {back.rms_mm:.3g} mm rms, {back.max_mm:.3g} mm at most")
    for note in report.notes:
        print(f"note: {note}")


def _format_residual(residual: Residual) -> str:
    if not residual.points:
        return "no points"
    return f"{residual.points} points, epipolar residual {residual.rms_px:.3g} px rms, {residual.max_px:.3g} px at most"


def _print_check(checked: CalibrationCheck, points: EpipolarComparison | None) -> None:
    print(f"baseline {checked.baseline_mm:.6g} mm, stereo angle {checked.stereo_angle_deg:.4g} degrees")
    print(f"volume that both cameras see: {_format_residual(checked.volume)}")
    if points is not None:
        print(
            f"measured points of {points.results}: {_format_residual(points.this_calibration)}; as they were measured: "
            f"{_format_residual(points.measured_with)}"
        )
    for warning in checked.warnings:
        print(f"warning: {warning}")
