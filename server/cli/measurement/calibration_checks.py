"""``stereorig calibration distance``, ``compare`` and ``aspect``: checks of a calibration that a user asks for."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.compare import CalibrationComparison, Difference
from stereorig.core.calibration.checks.distance import MARK_SIGMA_PX
from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS
from stereorig.server.formats.calibrations.kept_checks import keep_check
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.calibrations.target_toml import read_rig, read_target
from stereorig.server.formats.files import write_bytes
from stereorig.server.formats.images import read_image
from stereorig.server.results.calibration_checks import (
    KNOWN_DISTANCE,
    NamedImage,
    aspect_of_images,
    compare_loaded,
    distance_of_marks,
    distance_of_target,
    kept_distance,
    plain,
)

ACTIONS = ("distance", "compare", "aspect")


def add_check_actions(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the actions' arguments."""
    distance = actions.add_parser("distance", help="measure a known distance: the only check that shows a wrong pitch")
    distance.add_argument("file", metavar="FILE", type=Path, help="calibration; the finding is stored in its folder")
    distance.add_argument(
        "--points", nargs=2, metavar="X1,Y1,X2,Y2", help="both marks' positions in camera 1's image, then in camera 2's"
    )
    distance.add_argument("--mm", type=float, metavar="D", help="the marks' known distance")
    distance.add_argument(
        "--sigma-mm", type=float, default=0.0, metavar="S", help="standard deviation of the known distance (0)"
    )
    distance.add_argument(
        "--sigma-px",
        type=float,
        default=MARK_SIGMA_PX,
        metavar="S",
        help=f"standard deviation of the marks' coordinates ({MARK_SIGMA_PX})",
    )
    distance.add_argument(
        "--images", nargs=2, type=Path, metavar=("CAM1.tif", "CAM2.tif"), help="a target of known size in both cameras"
    )
    distance.add_argument(
        "--target", type=Path, metavar="OTHER.toml", help="that target; another than the one calibrated with"
    )
    compare = actions.add_parser("compare", help="compare two calibrations of one rig in space")
    compare.add_argument("file", metavar="A", type=Path, help="a calibration")
    compare.add_argument("other", metavar="B", type=Path, help="a second one of the same rig")
    compare.add_argument(
        "--independent", action="store_true", help="other targets, stages and cameras, also where declared alike"
    )
    compare.add_argument("--out", metavar="FILE.json", type=Path, help="write all numbers")
    aspect = actions.add_parser("aspect", help="measure the aspect ratio from images of a line grid at 45 degrees")
    aspect.add_argument("images", nargs="+", metavar="IMAGE", type=Path, help="cam1_*.tif, cam2_*.tif; else one camera")
    aspect.add_argument("--target", required=True, metavar="TARGET.toml", type=Path, help="the line grid")
    aspect.add_argument("--standoff-mm", type=float, metavar="D", help="distance of camera and grid, roughly")
    aspect.add_argument("--rig", metavar="RIG.toml", type=Path, help="takes standoff_mm of both cameras from there")


def run_check(args: argparse.Namespace) -> int:
    """Run one of the actions; print its findings."""
    if args.action == "distance":
        _distance(args)
    elif args.action == "compare":
        _compare(args)
    else:
        _aspect(args)
    return 0


def _distance(args: argparse.Namespace) -> None:
    if (args.points is None) == (args.images is None):
        raise InputError(
            "Either --points or --images is needed.",
            code="option_missing" if args.points is None else "option_conflict",
            remedy="Give --points with --mm, or --images with --target.",
        )
    needed = "--mm" if args.points is not None else "--target"
    if getattr(args, needed[2:]) is None:
        raise InputError(f"{needed} is missing.", code="option_missing", remedy=f"Give {needed}.")
    for option in ("sigma_mm", "sigma_px"):
        if not (math.isfinite(getattr(args, option)) and getattr(args, option) >= 0.0):
            raise InputError(
                f"--{option.replace('_', '-')} {getattr(args, option)} is no standard deviation.",
                code="option_invalid",
                remedy="Give a number, 0 or more.",
            )
    loaded = load_calibration(args.file)
    if args.points is not None:
        found = distance_of_marks(
            loaded,
            np.array([_marks(text) for text in args.points]),
            args.mm,
            distance_sigma_mm=args.sigma_mm,
            point_sigma_px=args.sigma_px,
        )
        how: Mapping[str, object] = {"points_px": dict(zip(CAMERAS, args.points, strict=True))}
    else:
        target = read_target(args.target)
        images = read_image(args.images[0]), read_image(args.images[1])
        found = distance_of_target(loaded, images, target, distance_sigma_mm=args.sigma_mm)
        how = {"images": [str(path) for path in args.images], "target": str(args.target)}
    print(found.text)
    if found.residual_mm is not None:
        print(f"the points are {1e3 * found.residual_mm:.3g} um rms off the target's description")
    kept = keep_check(args.file, loaded.sha256, KNOWN_DISTANCE, kept_distance(found, how))
    print(f"known_distance: {'agrees' if found.agrees else 'DOES NOT AGREE'}; kept in {kept}")


def _marks(text: str) -> Float:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(math.isfinite(v) for v in numbers):
        raise InputError(
            f"--points {text!r} is not X1,Y1,X2,Y2.",
            code="known_distance_unusable",
            remedy="Give four numbers a camera: both marks' columns and rows.",
        )
    return np.array(numbers).reshape(2, 2)


def _compare(args: argparse.Namespace) -> None:
    found = compare_loaded(load_calibration(args.file), load_calibration(args.other), independent=args.independent)
    print("\n".join(comparison_lines(found)))
    if args.out is not None:
        write_bytes(args.out, (json.dumps(plain(found), indent=1, allow_nan=False) + "\n").encode())
        print(f"written: {args.out}")


def comparison_lines(found: CalibrationComparison) -> list[str]:
    """Return a comparison as text, its verdict last."""
    rows: list[tuple[str, Difference, float, str]] = [
        ("shape, rms", found.shape_rms_mm, 1e3, "um"),
        ("shape, largest", found.shape_max_mm, 1e3, "um"),
        ("scale", found.scale, 1e6, "ppm"),
        ("epipolar offset, rms", found.epipolar_rms_px, 1.0, "px"),
        ("epipolar offset, largest", found.epipolar_max_px, 1.0, "px"),
    ]
    lines = [f"B against A at {found.points} points of the common volume, a rigid motion taken out"]
    for label, difference, factor, unit in rows:
        text = f"{label:<26}{factor * difference.value:>11.4g} {unit}"
        if difference.sigma is not None and difference.ratio is not None:
            text += f", predicted {factor * difference.sigma:.3g} {unit}: {difference.ratio:.2f} of it"
        lines.append(text)
    for change in found.changes.numbers:
        if change.name != "scale_ppm":
            sigma = "" if change.sigma is None else f" +- {change.sigma:.2g}"
            lines.append(f"{change.name:<26}{change.value:>+11.4g}{sigma}")
    if found.chi_square is not None:
        lines.append(f"chi-square {found.chi_square:.4g} of {found.degrees} degrees of freedom")
    return [*lines, found.text]


def _aspect(args: argparse.Namespace) -> None:
    if args.standoff_mm is not None and args.rig is not None:
        raise InputError("--standoff-mm and --rig are both given.", code="option_conflict", remedy="Give one of them.")
    if args.standoff_mm is not None and not (math.isfinite(args.standoff_mm) and args.standoff_mm > 0.0):
        raise InputError(
            f"--standoff-mm {args.standoff_mm} is no distance.", code="option_invalid", remedy="Give millimetres."
        )
    target = read_target(args.target)
    rig = None if args.rig is None else read_rig(args.rig)
    by_camera: dict[str, list[Path]] = {}
    for path in args.images:
        camera = path.name[:4].lower()
        by_camera.setdefault(camera if camera in CAMERAS else "camera", []).append(path)
    for camera, paths in sorted(by_camera.items()):
        standoff: Any = args.standoff_mm
        if rig is not None and camera in CAMERAS:
            standoff = (rig.cam1 if camera == "cam1" else rig.cam2).standoff_mm
        images = [NamedImage(str(path), read_image(path)) for path in paths]
        print(f"{camera}: {aspect_of_images(images, target, standoff_mm=standoff).text}")
