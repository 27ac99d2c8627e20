"""``stereorig calibration repair``: the cameras' relative orientation again from speckle images, after a bump."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from stereorig.core.errors import InputError
from stereorig.core.orientation import RepairLimits
from stereorig.core.settings import SPACING_PX, SUBSET_PX, Region
from stereorig.server.cli.measurement.image_lists import ImagePair, pairs_of_test_folder
from stereorig.server.cli.measurement.image_pairs import check_cameras, check_pair, checked_shapes
from stereorig.server.cli.measurement.region import check_whole, parse_rectangle
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.compute.orientation_repair import repair_from_files
from stereorig.server.compute.tasks import StepImages
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.images import read_mask
from stereorig.server.formats.results.summary import to_json

_LIMITS = RepairLimits()
_AXES = ("x", "y", "z (optical axis)")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("file", metavar="CALIBRATION", type=Path, help="calibration.json, or another program's; it is only read")
    add(
        "--images",
        nargs=2,
        action="append",
        default=[],
        metavar=("CAM1", "CAM2"),
        help="both cameras' images of one step after the bump; repeatable",
    )
    add("--test", metavar="FOLDER", type=Path, help="a test's folder, in place of --images")
    add("--steps", nargs="+", type=int, metavar="N", help="steps of that test, all taken after the bump (all)")
    add("--roi", metavar="X0,Y0,X1,Y1", help="region of the points in camera 1's images (all of them)")
    add("--mask", metavar="PNG", type=Path, help="image of camera 1's size, white where points are allowed")
    add("--subset", default=str(SUBSET_PX.default), metavar="PX", help=f"subset width, odd ({SUBSET_PX.default})")
    add("--step", "--spacing", metavar="PX", help="distance of the points (as many as add information)")
    add(
        "--max-turn",
        type=float,
        default=_LIMITS.turn_deg,
        metavar="DEG",
        help=f"a larger turn is refused ({_LIMITS.turn_deg:g})",
    )
    add(
        "--max-strain",
        type=float,
        default=1e6 * _LIMITS.strain,
        metavar="MICROSTRAIN",
        help=f"a larger uncertainty of a shape's strain is refused ({1e6 * _LIMITS.strain:g})",
    )
    add("--out", type=Path, required=True, metavar="FILE", help="the new calibration.json; the old one stays")


def run(args: argparse.Namespace) -> int:
    """Repair; print the change; write the new file."""
    steps = _steps(args)
    if args.out.exists() and args.out.samefile(args.file):
        raise InputError(
            f"--out {args.out} is the calibration itself.",
            code="output_is_input",
            remedy="Give the new file another name: the old calibration is kept.",
        )
    subset = check_whole("--subset", args.subset, SUBSET_PX)
    spacing = None if args.step is None else check_whole("--step", args.step, SPACING_PX)
    for option, value in (("--max-turn", args.max_turn), ("--max-strain", args.max_strain)):
        if not value > 0.0:
            raise InputError(
                f"{option} is {value:g}; it must be positive.", code="option_out_of_range", remedy="Leave it out."
            )
    region = None if args.roi is None else Region(rectangle=parse_rectangle(args.roi))
    progress = ProgressLine()
    try:
        made = repair_from_files(
            args.file,
            steps,
            region=region,
            mask=None if args.mask is None else read_mask(args.mask),
            subset_px=subset,
            spacing_px=spacing,
            limits=RepairLimits(turn_deg=args.max_turn, strain=1e-6 * args.max_strain),
            progress=lambda phase, done, total: progress.show(phase, done / total if total > 0 else 0.0),
        )
    finally:
        progress.close()
    make_folder(args.out.absolute().parent)
    write_bytes(args.out, to_json(made.content))
    _print(made.content["repair"])
    print(f"written: {args.out}; {args.file} is kept")
    return 0


def _steps(args: argparse.Namespace) -> list[StepImages]:
    if bool(args.images) == (args.test is not None):
        raise InputError(
            "Give --images or --test, one of them.", code="option_conflict", remedy="Name images after the bump."
        )
    if args.test is None:
        pairs = [ImagePair(Path(one), Path(two)) for one, two in args.images]
    else:
        pairs = pairs_of_test_folder(args.test)
        there = {pair.number: pair for pair in pairs}
        missing = [n for n in args.steps or [] if n not in there]
        if missing:
            raise InputError(
                f"{args.test} has no step {missing[0]}.", code="step_missing", remedy="Name steps that it has."
            )
        pairs = pairs if args.steps is None else [there[n] for n in args.steps]
    shapes = checked_shapes(pairs[0], load_calibration(args.file))
    for pair in pairs:
        check_cameras(pair, args.file)
    return [check_pair(pair, k, shapes) for k, pair in enumerate(pairs)]


def _print(found: dict[str, Any]) -> None:
    turns = zip(_AXES, found["change_deg"], found["change_sigma_deg"], strict=False)
    print("camera 2 turned against camera 1, degrees: " + ", ".join(f"{a} {v:+.4f} +- {s:.4f}" for a, v, s in turns))
    (forward, sideways), (s1, s2) = found["change_deg"][3:], found["change_sigma_deg"][3:]
    print(f"baseline turned, degrees: forward {forward:+.4f} +- {s1:.4f}, sideways {sideways:+.4f} +- {s2:.4f}")
    print(f"its length is kept: {found['baseline_mm']:.6g} +- {found['baseline_sigma_mm']:.2g} mm from the bump")
    print(
        f"epipolar offset over {found['points']} points: {found['offset_before_px']:.3f} px before, "
        f"{found['offset_after_px']:.4f} px after, noise {found['noise_px']:.4f} px"
    )
    cost = found["consequence"]
    print(
        f"without the repair: {cost['shape_um']:.3g} um in shape, {cost['z_um']:.3g} um in Z, "
        f"{cost['strain_microstrain']:.3g} microstrain against steps before the bump"
    )
    print(
        f"with it, from the orientation: {cost['shape_sigma_um']:.2g} um in shape, "
        f"{cost['strain_sigma_microstrain']:.2g} microstrain (standard uncertainty)"
    )
