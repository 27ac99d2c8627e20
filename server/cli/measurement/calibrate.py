"""``stereorig calibrate``: from a folder of grid images to calibration.json."""

from __future__ import annotations

import argparse
from math import isfinite
from pathlib import Path

from stereorig.core.calibration import CalibrationResult, Measures
from stereorig.core.errors import InputError
from stereorig.core.names import CAMERAS
from stereorig.server.cli.measurement.image_lists import expand, pair_up
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.formats.calibrations.from_folder import calibrate_folder
from stereorig.server.formats.calibrations.views import ViewFile, views_of_pairs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--by-hand",
        action="store_true",
        help="take views of a target held by hand on a running service: see --by-hand --help",
    )
    parser.add_argument(
        "views",
        nargs="?",
        metavar="VIEWS",
        type=Path,
        help="folder with cam1_+0.000mm.tif, cam2_+5.000mm.tif and so on (dZ in the name); of free poses cam1_000.tif, "
        "cam2_000.tif and so on; of both for mixtures",
    )
    parser.add_argument(
        "--cam1",
        nargs="+",
        metavar="GLOB",
        help="instead of VIEWS: camera 1's images of free poses, a quoted pattern or several paths",
    )
    parser.add_argument(
        "--cam2", nargs="+", metavar="GLOB", help="camera 2's; files are paired in sorted order and numbered from 0"
    )
    parser.add_argument(
        "--target",
        required=True,
        metavar="TARGET.toml",
        type=Path,
        help="kind (line_grid, checkerboard, charuco, circles, circles_asymmetric), pitch_mm, lines or size, and so on",
    )
    parser.add_argument(
        "--rig",
        required=True,
        metavar="RIG.toml",
        type=Path,
        help="[cam1] and [cam2]: image_size_px, phd_px, standoff_mm, angle_deg, aspect; [calibration]: moves (cameras, "
        "both_cameras, target, free), lens (auto, paper, opencv5, opencv8, opencv12, opencv14)",
    )
    parser.add_argument(
        "--hold-out",
        default="",
        metavar="2,4",
        help="positions in mm, or numbers of free poses, to leave out of the fit and check with; left out: each "
        "position but the first and the last in turn, or a fifth of the free poses at a time",
    )
    parser.add_argument(
        "--localiser",
        choices=("profile", "paper"),
        default="profile",
        help="how intersections are found (default: profile)",
    )
    parser.add_argument("--out", required=True, metavar="calibration.json", type=Path, help="file to write")


def run(args: argparse.Namespace) -> int:
    """Calibrate; print a table; write the file unless the verdict is failed."""
    held_out = parse_hold_out(args.hold_out)
    views = args.views if args.cam1 is None and args.cam2 is None else _paired(args)
    if views is None:
        raise InputError(
            "No views were given.", code="views_missing", remedy="Give the folder of views, or --cam1 and --cam2."
        )
    if args.out.is_dir():
        raise InputError(f"The output {args.out} is a folder.", code="output_unusable", remedy="Give a file's name.")
    line = ProgressLine()
    try:
        found = calibrate_folder(
            views,
            args.target,
            args.rig,
            hold_out=held_out,
            localiser=args.localiser,
            progress=lambda phase, done, total: line.show(phase, done / total),
        )
    finally:
        line.close()
    print(report(found.result))
    found.write(args.out)
    print(f"written: {args.out}")
    return 0


def _paired(args: argparse.Namespace) -> list[ViewFile]:
    """Return the views that --cam1 and --cam2 name, paired as ``measure`` pairs its images."""
    if args.cam1 is None or args.cam2 is None or args.views is not None:
        raise InputError(
            "Views come from one folder, or from --cam1 and --cam2 together.",
            code="views_missing",
            remedy="Give the folder of views alone, or both options without it.",
        )
    lists = []
    for option, items in (("--cam1", args.cam1), ("--cam2", args.cam2)):
        files, note = expand(option, items)
        if note is not None:
            print(f"note: {note}")
        lists.append(files)
    pairs = pair_up(*lists)
    return views_of_pairs([p.cam1 for p in pairs], [p.cam2 for p in pairs])


def parse_hold_out(text: str) -> tuple[float, ...]:
    """Read ``2,4``.

    Raises
    ------
    InputError
        Code ``hold_out_malformed``.
    """
    try:
        values = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        values = (float("nan"),)
    if not all(isfinite(v) for v in values):
        raise InputError(
            f"--hold-out {text!r} is no list of positions.", code="hold_out_malformed", remedy="Write it as 2,4 (mm)."
        )
    return values


def report(result: CalibrationResult) -> str:
    """Write the calibration as a short table."""
    sigma = result.sigma
    one, two = result.pair.cam1.values(), result.pair.cam2.values()
    lines = [f"{'':15}{'cam1':>24}{'cam2':>26}"]
    for key in one:
        cells = []
        for name, values in (("cam1", one), ("cam2", two)):
            full = f"{name}.{key}"
            spread = f" +- {sigma[full]:.1g}" if full in sigma else " given"
            cells.append(f"{values[key]:14.6g}{spread:<11}")
        lines.append(f"{key:15}" + " ".join(cells).rstrip())
    lines.append("")
    lines.append(f"{'':15}{'RBE px':>10}{'RAZ um':>10}{'NSCE':>10}")
    for label, check in (("fitted", result.fitted), ("held out", result.held_out)):
        if check is not None:
            lines.append(_row(label, check.mean))
            lines.extend(_row(f"  {n}", m) for n, m in zip(CAMERAS, check.per_camera, strict=True))
            if result.node_corrections_mm is not None:
                lines.append(_row("  nominal grid", check.nominal_mean))
    lines.append("")
    lines.append(
        f"predicted shape uncertainty in the target's volume: {1e3 * result.uncertainty.shape_rms_mm:.3f} um rms"
    )
    lines.extend(_found(result))
    lines.extend(f"{'checked' if c.made else 'NOT checked'}: {c.name}: {c.text}" for c in result.checks)
    lines.append(f"verdict: {result.verdict.level}")
    lines.extend(f"  {reason}" for reason in result.verdict.reasons)
    return "\n".join(lines)


def _found(result: CalibrationResult) -> list[str]:
    """Lines about the lens model, the stage, the pitch and the views left out."""
    lines = [f"lens model: {result.lens.model}"]
    lines.extend(f"  {reason}" for reason in result.lens.reasons)
    stage = result.stage
    if stage.direction_sys is not None and stage.direction_sigma_rad is not None:
        x, y, z = stage.direction_sys
        spread = 1e3 * float(max(stage.direction_sigma_rad))
        lines.append(f"the stage moves along ({x:.5f}, {y:.5f}, {z:.5f}) in the system frame, +- {spread:.2g} mrad")
    for axis, (scale, sigma) in enumerate(zip(stage.scale, stage.scale_sigma, strict=True)):
        if sigma > 0.0:
            lines.append(f"scale of stage axis {axis + 1}: {1e6 * scale:+.0f} +- {1e6 * sigma:.0f} ppm")
    if result.pitch_scale_sigma > 0.0:
        lines.append(f"scale of the pitch: {1e6 * result.pitch_scale:+.0f} +- {1e6 * result.pitch_scale_sigma:.0f} ppm")
    lines.extend(f"left out: {view.name}: {view.reason}" for view in result.dropped)
    return lines


def _row(label: str, m: Measures) -> str:
    return f"{label:15}{m.rbe_px:10.4f}{1e3 * m.raz_mm:10.3f}{m.nsce:10.4f}"
