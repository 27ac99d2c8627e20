"""``stereorig measure``: shape and displacement from image files, without a service."""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from core.errors import FileFormatError, ImageError, InputError, MeasurementError, StereorigError
from server.cli.image_lists import ImagePair, expand, pair_up, pairs_of_test_folder
from server.cli.region import RegionRequest, check_odd, check_region, parse_rectangle
from server.cli.terminal import ProgressLine
from server.io.calibration_any import LoadedCalibration, load_calibration
from server.io.files import make_folder, sha256_of, write_bytes
from server.io.images import GrayImage, decode_image, read_file
from server.io.summary import to_json

SUBSET_RANGE_PX = (7, 301)
STEP_RANGE_PX = (1, 1000)
_RESULT = re.compile(r"step_\d{4}\.nc")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("folder", nargs="?", metavar="FOLDER", help="a test folder (steps/<nnnn>/cam1.tif cam2.tif, calibration.json)")
    parser.add_argument("--cam1", nargs="+", metavar="GLOB", help="camera 1's images: a quoted pattern or several paths")
    parser.add_argument("--cam2", nargs="+", metavar="GLOB", help="camera 2's images; files are paired in sorted order")
    parser.add_argument("--calibration", metavar="FILE", help="calibration.json, DICe XML or OpenCV YAML")
    parser.add_argument("--roi", metavar="X0,Y0,X1,Y1", help="points lie at X0 + i step, Y0 + j step up to X1, Y1")
    parser.add_argument("--mask", metavar="PNG", help="image of camera 1's size, white where points may lie")
    parser.add_argument("--subset", default="33", metavar="PX", help="subset width, odd (33)")
    parser.add_argument("--step", default="10", metavar="PX", help="distance of the points (10)")
    parser.add_argument("--patch", choices=("stretch", "rigid"), default="stretch", help="how a patch may move (stretch)")
    parser.add_argument("--interpolation", choices=("cubic", "quintic"), default="cubic", help="spline between the pixels (cubic)")
    parser.add_argument("--seed", action="append", default=[], metavar="X,Y", help="start here in camera 1's first image; may be repeated")
    parser.add_argument("--out", metavar="DIR", help="folder for step_0000.nc (shape), step_0001.nc ... (displacement), summary.json")


@dataclass(frozen=True)
class _CheckedPair:
    """One step's files, read once: their hashes are those of what will be measured."""

    files: ImagePair
    sha256: tuple[str, str]


@dataclass(frozen=True)
class _Job:
    calibration: LoadedCalibration
    calibration_file: Path
    pairs: list[_CheckedPair]
    region: RegionRequest
    subset_px: int
    step_px: int
    patch: str
    interpolation: str
    mask_file: Path | None
    out: Path

    def settings(self) -> dict[str, Any]:
        """What the result depends on besides its inputs."""
        x0, y0, x1, y1 = self.region.rectangle_px
        seeds = self.region.seeds_px
        return {
            "roi": [x0, y0, x1, y1], "subset_px": self.subset_px, "step_px": self.step_px, "patch": self.patch,
            "interpolation": self.interpolation, "seeds": None if seeds is None else seeds.tolist(),
            "mask": None if self.mask_file is None else str(self.mask_file),
        }  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Run the command; return the exit status."""
    progress = ProgressLine()
    try:
        job = _prepare(args, progress)
        _measure(job, progress)
    finally:
        progress.close()
    return 0


def _missing(option: str) -> InputError:
    return InputError(f"{option} is missing.", code="option_missing", remedy="See stereorig measure --help.")


def _pairs(args: argparse.Namespace, progress: ProgressLine) -> list[ImagePair]:
    if args.folder is not None:
        if args.cam1 or args.cam2:
            raise InputError("Both a test folder and --cam1/--cam2 are given.", code="option_conflict",
                             remedy="Give one or the other.")  # fmt: skip
        return pairs_of_test_folder(Path(args.folder))
    for option in ("cam1", "cam2", "calibration", "roi", "out"):
        if getattr(args, option) is None:
            raise _missing(f"--{option}")
    lists = []
    for option in ("cam1", "cam2"):
        files, note = expand(f"--{option}", getattr(args, option))
        lists.append(files)
        if note:
            progress.note(f"note: {note}")
    return pair_up(*lists)


def _prepare(args: argparse.Namespace, progress: ProgressLine) -> _Job:
    """Check everything that can be checked before anything is computed or written."""
    subset = check_odd("--subset", args.subset, low=SUBSET_RANGE_PX[0], high=SUBSET_RANGE_PX[1], odd=True)
    step = check_odd("--step", args.step, low=STEP_RANGE_PX[0], high=STEP_RANGE_PX[1], odd=False)
    rectangle = None if args.roi is None else parse_rectangle(args.roi)
    files = _pairs(args, progress)
    folder = None if args.folder is None else Path(args.folder)
    calibration_file = Path(args.calibration) if args.calibration or folder is None else folder / "calibration.json"
    calibration = load_calibration(calibration_file)
    out = Path(args.out) if args.out or folder is None else folder / "exports" / "measure"
    shapes = _checked_shapes(files[0], calibration)
    if rectangle is None:  # of a test folder: as much of camera 1's image as takes whole subsets
        rows, cols = shapes[0]
        margin = float(subset // 2 + 2)
        rectangle = (margin, margin, cols - 1 - margin, rows - 1 - margin)
    mask_file = None if args.mask is None else Path(args.mask)
    region = check_region(rectangle, image_shape=shapes[0], subset_px=subset, step_px=step,
                          mask_path=mask_file, seeds=args.seed)  # fmt: skip
    pairs = [_check_pair(pair, k, shapes) for k, pair in enumerate(files)]
    if out.exists() and not out.is_dir():
        make_folder(out)  # says what is wrong with it
    return _Job(calibration, calibration_file, pairs, region, subset, step, args.patch, args.interpolation, mask_file, out)


def _checked_shapes(first: ImagePair, calibration: LoadedCalibration) -> tuple[tuple[int, int], tuple[int, int]]:
    """(rows, cols) of both cameras' images, which the calibration must agree with where it says."""
    shapes = []
    for path, size in ((first.cam1, calibration.image_size1_px), (first.cam2, calibration.image_size2_px)):
        rows, cols = decode_image(read_file(path), name=str(path)).shape
        if size is not None and size != (cols, rows):
            raise ImageError(
                f"{path} is {cols} x {rows} px, the calibration is for {size[0]} x {size[1]} px.",
                code="image_size_mismatch",
                remedy="Give the images of the calibrated cameras, uncropped and unscaled.",
            )
        shapes.append((rows, cols))
    return shapes[0], shapes[1]


def _check_pair(pair: ImagePair, step: int, shapes: tuple[tuple[int, int], tuple[int, int]]) -> _CheckedPair:
    """Read both images of a step once, so that a bad one is found before hours of work on the others."""
    hashes, images = [], []
    for path, recorded, shape in ((pair.cam1, pair.sha256_1, shapes[0]), (pair.cam2, pair.sha256_2, shapes[1])):
        data = read_file(path)
        hashes.append(hashlib.sha256(data).hexdigest())
        if recorded is not None and hashes[-1] != recorded:
            raise FileFormatError(f"{path} does not match the checksum in its step.json.", code="checksum_mismatch",
                                  remedy="Restore the file, or leave this step out.")  # fmt: skip
        image = decode_image(data, name=str(path))
        if image.shape != shape:
            raise ImageError(
                f"{path} (step {step}) is {image.shape[1]} x {image.shape[0]} px, the first image {shape[1]} x {shape[0]} px.",
                code="image_size_mismatch",
                remedy="All images of one camera must have one size.",
            )
        if int(image.max()) == int(image.min()):
            raise ImageError(f"{path} (step {step}) is blank: every pixel is {int(image.max())}.", code="image_blank",
                             remedy="Check exposure, lens cap and trigger, then take the step again.")  # fmt: skip
        images.append(image)
    if hashes[0] == hashes[1]:
        raise InputError(f"{pair.cam1} and {pair.cam2} (step {step}) hold the same image.", code="same_image",
                         remedy="Give each camera its own images.")  # fmt: skip
    return _CheckedPair(pair, (hashes[0], hashes[1]))
