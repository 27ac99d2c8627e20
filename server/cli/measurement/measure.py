"""``stereorig measure``: shape and displacement from image files, without a service."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from stereorig.core.errors import FileFormatError, InputError, RegionError
from stereorig.core.field.settings import check_prefilter
from stereorig.core.settings import (
    DEFAULT_INTERPOLATION,
    DEFAULT_MAX_SIGMA_PX,
    DEFAULT_PATCH,
    DEFAULT_REFERENCE_UPDATE,
    DENSE_STEP_PX,
    INTERPOLATIONS,
    MAX_SIGMA_PX,
    PATCH_SETTINGS,
    REFERENCE_UPDATES,
    SMOOTHING_WINDOW,
    SPACING_PX,
    STRAIN_ORDERS,
    STRAIN_TENSORS,
    STRAIN_WINDOW,
    SUBSET_PX,
    Outline,
    StoredSettings,
)
from stereorig.server.cli.measurement.image_lists import ImagePair, expand, pair_up, pairs_of_test_folder
from stereorig.server.cli.measurement.image_pairs import check_cameras, checked_pairs, checked_shapes, first_readable
from stereorig.server.cli.measurement.region import (
    SPECIMEN_FILE,
    check_region,
    check_whole,
    found_specimen,
    parse_outline,
)
from stereorig.server.cli.measurement.sequence import MeasureJob, measure_sequence
from stereorig.server.cli.recipe import mask_of, notes_on, with_recipe
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.compute.seeds import check_positions
from stereorig.server.formats.calibrations.in_test import calibration_in
from stereorig.server.formats.calibrations.programs.plausibility import length_warning
from stereorig.server.formats.calibrations.recognise import (
    UNIT_HELP,
    LoadedCalibration,
    calibration_bytes,
    imported_content,
    load_calibration,
    parse_calibration,
)
from stereorig.server.formats.files import write_bytes
from stereorig.server.formats.images import read_mask
from stereorig.server.formats.noise_json import load_noise
from stereorig.server.formats.object_storage import copied
from stereorig.server.formats.results.reading import read_head
from stereorig.server.formats.results.summary import to_json
from stereorig.server.results.gauges import FRAME_HELP
from stereorig.server.results.images.projected_pattern import check_settings
from stereorig.server.store.durable import known_json

if TYPE_CHECKING:
    from stereorig.server.results.gauges.request import Alignment


#: a calibration with additions that its own file lacks, in the folder of the results
CARRIED_FILE = "calibration_used.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("folder", nargs="?", metavar="FOLDER", help="a test's folder: steps/<nnnn>/cam1.tif ..., calibration.json")
    add("--cam1", nargs="+", metavar="GLOB", help="camera 1's images: a quoted pattern, several paths, or s3://...")
    add("--cam2", nargs="+", metavar="GLOB", help="camera 2's images; files are paired in sorted order")
    add(
        "--calibration",
        metavar="FILE",
        help="calibration.json, or another program's: see stereorig calibration convert",
    )
    add("--unit", metavar="UNIT", help=UNIT_HELP)
    add(
        "--roi",
        action="append",
        metavar="X0,Y0,X1,Y1|circle:X,Y,RADIUS|polygon:X0,Y0,...|auto",
        help="points at X0 + i step, Y0 + j step up to X1, Y1, or likewise in a circle or a polygon; given several "
        "times, in any of them; auto: on the specimen, found by its texture and shown in specimen.png (auto, without a "
        "mask)",
    )
    add(
        "--recipe",
        metavar="FILE",
        help="recipe of the page or the API: region and settings, unless an option here gives another",
    )
    add("--mask", metavar="PNG", help="image of camera 1's size, white where points are allowed")
    add(
        "--crack",
        action="append",
        default=[],
        metavar="X0,Y0,X1,Y1[,...]",
        help="a line over which nothing reaches, through these positions in camera 1's first image",
    )
    add(
        "--hole",
        action="append",
        default=[],
        metavar="X0,Y0,X1,Y1,X2,Y2[,...]|circle:X,Y,RADIUS",
        help="a polygon or a circle inside which nothing is measured",
    )
    add("--subset", metavar="PX", help=f"subset width, odd ({SUBSET_PX.default})")
    add("--step", "--spacing", metavar="PX", help=f"distance of the points ({SPACING_PX.default})")
    add(
        "--patch",
        choices=PATCH_SETTINGS,
        help="affine, rigid: plane patches; quadratic: second-order shape and motion, about twice the noise; auto: "
        f"affine or quadratic, the one with the smaller total error, with the reason ({DEFAULT_PATCH})",
    )
    add("--interpolation", choices=INTERPOLATIONS, help=f"spline between the pixels ({DEFAULT_INTERPOLATION})")
    add(
        "--prefilter",
        metavar="SD",
        help="blur all images with a Gaussian of this sd in px: less bias, more noise (0: none)",
    )
    add(
        "--max-sigma",
        type=float,
        metavar="PX",
        help=f"reject points whose match, in depth too, has a larger standard deviation ({DEFAULT_MAX_SIGMA_PX:g})",
    )
    add(
        "--keep-rejected",
        action="store_true",
        help="keep the values of rejected points, in variables of their own: rejected_*",
    )
    add(
        "--seed",
        action="append",
        default=[],
        metavar="X,Y[,X2,Y2]",
        help="start here in camera 1's first image, and there in camera 2's; repeatable",
    )
    add("--noise", metavar="FILE", help="noise.json of stereorig noise: pixels count by their noise")
    add(
        "--strain",
        metavar="WINDOW|off",
        help=f"points across the virtual strain gauge, odd; it is (WINDOW - 1) step + subset wide "
        f"({STRAIN_WINDOW.default})",
    )
    add(
        "--strain-order",
        choices=[str(order) for order in STRAIN_ORDERS],
        help="fit planes (1) or quadratics (2) over the gauge; auto: planes, but quadratics where an edge, a hole or a "
        "cut leaves points on one side and the planes' bias there outweighs their noise (auto)",
    )
    add("--strain-tensor", choices=STRAIN_TENSORS, help="strain tensor (green_lagrange)")
    add(
        "--dense",
        metavar="STEP",
        nargs="?",
        const=str(DENSE_STEP_PX.default),
        help=f"also a dense field of each step, a vector every STEP px ({DENSE_STEP_PX.default}), in DIR/dense: shared "
        "windows, one step from the ordinary field; neighbours correlate",
    )
    add("--smooth", metavar="WINDOW|off", help="smooth displacements by a quadratic over WINDOW x WINDOW points (off)")
    add(
        "--reference-update",
        choices=REFERENCE_UPDATES,
        help="never: match every step against the first (total); always: against the step before (incremental); auto: "
        "against the first, or a later reference if that fails, with a note; displacements are totals in any case "
        f"({DEFAULT_REFERENCE_UPDATE})",
    )
    add(
        "--projected",
        action="store_true",
        help="the pattern is projected and does not move with the surface: the shape of each pair is measured by "
        "itself, no displacement",
    )
    add("--frame", metavar="FRAME", help=f"{FRAME_HELP}; the files are written in it")
    add("--out", metavar="DIR", help="for step_0000.nc (shape), step_0001.nc ... (displacement) and summary.json")


SOME_FAILED = 3
"""Exit status where some steps failed and others were measured: neither 0, all done, nor 1, nothing was."""


def run(args: argparse.Namespace) -> int:
    """Run the command; return the exit status."""
    progress = ProgressLine()
    try:
        asked = _frame(args)
        job = _prepare(args, progress)
        summary = measure_sequence(job, progress)
        files = [job.out / one["file"] for one in summary["steps"]]
        frame = read_head(files[-1]).frame if asked is None else _put_into(asked, files)
        if asked is not None and job.settings.dense_step_px is not None:
            progress.note("note: dense fields stay in the system frame")
        write_bytes(job.out / "summary.json", to_json({**summary, "frame": frame}))
        progress.note(f"frame of the files: {frame}")
    finally:
        progress.close()
    return SOME_FAILED if summary["steps_failed"] else 0


def _frame(args: argparse.Namespace) -> Alignment | None:
    """Return the frame that is asked for; None: the system frame."""
    if args.frame is None:
        return None
    from stereorig.server.results.gauges.frames import frame_asked, frame_of_test  # gauges are slow to load

    kept = None if args.folder is None else known_json(Path(args.folder) / "test.json").get("frame")
    return frame_asked(args.frame, frame_of_test(kept if isinstance(kept, dict) else None))


def _put_into(asked: Alignment, files: list[Path]) -> str:
    from stereorig.server.results.gauges.framed import put_into_frame

    return put_into_frame(files, asked)


def _missing(option: str) -> InputError:
    return InputError(f"{option} is missing.", code="option_missing", remedy="See stereorig measure --help.")


def _strain(args: argparse.Namespace) -> dict[str, object] | None:
    if args.strain == "off" or (args.strain is None and args.projected):
        return None
    window = check_whole("--strain", str(STRAIN_WINDOW.default) if args.strain is None else args.strain, STRAIN_WINDOW)
    return {
        "window": window,
        "order": next(order for order in STRAIN_ORDERS if str(order) == (args.strain_order or "auto")),
        "tensor": args.strain_tensor or "green_lagrange",
    }


def _smoothing_window(args: argparse.Namespace) -> int | None:
    return None if args.smooth in (None, "off") else check_whole("--smooth", args.smooth, SMOOTHING_WINDOW)


def _dense_step_px(args: argparse.Namespace, spacing_px: int) -> int | None:
    if args.dense is None:
        return None
    step_px = check_whole("--dense", args.dense, DENSE_STEP_PX)
    if step_px > spacing_px:
        raise InputError(
            f"--dense {step_px} is more than --step {spacing_px}: it would be no denser.", code="option_conflict"
        )
    return step_px


def _max_sigma_px(args: argparse.Namespace) -> float:
    value = DEFAULT_MAX_SIGMA_PX if args.max_sigma is None else float(args.max_sigma)
    if not 0.0 < value <= MAX_SIGMA_PX:
        raise InputError(
            f"--max-sigma {value:g} must be above 0 and at most {MAX_SIGMA_PX:g}.", code="option_out_of_range"
        )
    return value


def _prefilter_px(args: argparse.Namespace, subset_px: int) -> float:
    try:
        prefilter_px = 0.0 if args.prefilter is None else float(args.prefilter)
    except ValueError as error:
        raise InputError(
            f"--prefilter {args.prefilter} is not a number.",
            code="prefilter_invalid",
            remedy="Give a standard deviation in px, or 0 for none.",
        ) from error
    check_prefilter(prefilter_px, subset_px)
    return prefilter_px


def _pairs(args: argparse.Namespace, progress: ProgressLine) -> list[ImagePair]:
    if args.folder is not None:
        if args.cam1 or args.cam2:
            raise InputError(
                "Both a test folder and --cam1/--cam2 are given.",
                code="option_conflict",
                remedy="Give one or the other.",
            )
        return pairs_of_test_folder(Path(args.folder))
    for option in ("cam1", "cam2", "calibration", "out"):
        if getattr(args, option) is None:
            raise _missing(f"--{option}")
    lists = []
    for option in ("cam1", "cam2"):
        items = copied(f"--{option}", getattr(args, option), Path(args.out) / "images" / option)
        files, note = expand(f"--{option}", items)
        lists.append(files)
        if note:
            progress.note(f"note: {note}")
    return pair_up(*lists)


def _prepare(args: argparse.Namespace, progress: ProgressLine) -> MeasureJob:
    """Check everything that can be checked before anything is computed or written."""
    given = args
    args, recipe = with_recipe(given)
    subset = check_whole("--subset", str(SUBSET_PX.default) if args.subset is None else args.subset, SUBSET_PX)
    step = check_whole("--step", str(SPACING_PX.default) if args.step is None else args.step, SPACING_PX)
    asked = args.roi or []
    outlines = [parse_outline("--roi", text) for text in asked if text != "auto"]
    if outlines and len(outlines) < len(asked):
        raise RegionError("--roi auto does not go with another --roi.", remedy="Give auto alone, or leave it out.")
    strain, prefilter_px = _strain(args), _prefilter_px(args, subset)
    files = _pairs(args, progress)
    folder = None if args.folder is None else Path(args.folder)
    calibration_file = Path(args.calibration) if args.calibration or folder is None else calibration_in(folder)
    calibration = load_calibration(calibration_file, unit=args.unit)
    if folder is not None and not args.calibration:
        _check_calibration(folder, calibration)
    for pair in files:
        check_cameras(pair, calibration_file)
    doubt = length_warning(calibration)
    if doubt is not None:
        progress.note(f"warning: {doubt}")
    out = Path(args.out) if args.out or folder is None else folder / "exports" / "measure"
    carried = _carried(calibration, calibration_file, args.unit)
    if carried is not None:
        calibration_file = out / CARRIED_FILE
        calibration = parse_calibration(carried, name=str(calibration_file))
    first = first_readable(files) if args.projected else files[0]
    shapes = checked_shapes(first, calibration)
    if recipe is not None:
        recipe.check_fits(shapes[0][1], shapes[0][0])
        for note in notes_on(recipe):
            progress.note(f"note: {note}")
    mask_file = mask_of(recipe, given, out) if args.mask is None else Path(args.mask)
    specimen = None
    if not outlines and (asked or mask_file is None):
        specimen = found_specimen(first, calibration, subset, None if mask_file is None else read_mask(mask_file))
        progress.note(f"region: {specimen.text}")
        box = Outline.model_construct(rectangle=specimen.rectangle_px(subset), polygon=None, circle=None)
        outlines, mask_file = [box], out / SPECIMEN_FILE
    noise = None if args.noise is None else load_noise(args.noise)
    region, seeds = check_region(
        outlines,
        image_shape=shapes[0],
        subset_px=subset,
        spacing_px=step,
        mask_path=mask_file,
        seeds=args.seed,
        cracks=args.crack,
        holes=args.hole,
        mask=None if specimen is None else specimen.mask,
    )
    check_positions(calibration.pair, seeds or (), (shapes[1][1], shapes[1][0]))
    steps, failed = checked_pairs(files if args.projected else files[:1], shapes)
    settings = StoredSettings.model_validate(
        {
            "region": region,
            "subset_px": subset,
            "spacing_px": step,
            "patch": args.patch or DEFAULT_PATCH,
            "interpolation": args.interpolation or DEFAULT_INTERPOLATION,
            "prefilter_px": prefilter_px,
            "max_sigma_px": _max_sigma_px(args),
            "keep_rejected": args.keep_rejected,
            "seeds": None if seeds is None else [seed.xy_px for seed in seeds],
            "seeds_cam2": None if seeds is None else [seed.xy2_px for seed in seeds],
            "smoothing_window": _smoothing_window(args),
            "dense_step_px": _dense_step_px(args, step),
            "pattern": "projected" if args.projected else "surface",
            "reference_update": args.reference_update or ("never" if args.projected else DEFAULT_REFERENCE_UPDATE),
            "strain": strain,
            "reference": steps[0].n,
            "noise": None if noise is None else noise.record(),
        }
    )
    check_settings(settings, displacement=False)
    return MeasureJob(
        calibration=calibration,
        calibration_file=calibration_file,
        steps=steps,
        later=[] if args.projected else list(enumerate(files))[1:],
        shapes=shapes,
        settings=settings,
        mask_file=mask_file,
        out=out,
        noise=noise,
        failed=failed,
        specimen=specimen,
        gauges=None if recipe is None else recipe.gauges,
        carried=carried,
    )


def _carried(calibration: LoadedCalibration, file: Path, unit: str | None) -> bytes | None:
    """Return a calibration.json with additions that the file lacks: its unit, or its other half; else None."""
    data = calibration_bytes(file)
    if not calibration.imported or (unit is None and data == file.read_bytes()):
        return None
    return to_json(imported_content(data, name=str(file), unit=unit))


def _check_calibration(folder: Path, calibration: LoadedCalibration) -> None:
    """Refuse a test's calibration that is not the one its record names."""
    try:
        record = json.loads((folder / "test.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return  # a folder put together by hand has none
    made_with = record.get("calibration_sha256") if isinstance(record, dict) else None
    if made_with is not None and made_with != calibration.sha256:
        raise FileFormatError(
            f"{folder / 'calibration.json'} is not the calibration that test.json names.",
            code="calibration_changed",
            remedy="Restore the file, or name the calibration that is meant with --calibration.",
        )
