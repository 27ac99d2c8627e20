"""The pairs of a series: each is decoded and checked once, when its turn comes."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from pathlib import Path

from stereorig.core.errors import FileFormatError, ImageError, InputError, StereorigError
from stereorig.core.field.points.images import check_calibrated_size
from stereorig.server.cli.measurement.image_lists import ImagePair
from stereorig.server.compute.tasks import StepImages
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.images import GrayImage, decode, decode_image, read_file
from stereorig.server.results.images.quality import saturated_share
from stereorig.server.store.durable import read_json
from stereorig.server.workflows.camera_identity import check_same_cameras


def checked_pairs(
    files: Sequence[ImagePair], shapes: tuple[tuple[int, int], tuple[int, int]]
) -> tuple[list[StepImages], dict[int, StereorigError]]:
    """Check pairs; return the ones that can be measured, and the errors of the others, by number.

    Raises
    ------
    InputError
        The first of these errors, if none can be measured.
    """
    steps: list[StepImages] = []
    failed: dict[int, StereorigError] = {}
    for k, pair in enumerate(files):
        try:
            steps.append(check_pair(pair, k, shapes))
        except InputError as error:
            error.context |= {"cam1": str(pair.cam1), "cam2": str(pair.cam2)}
            failed[number_of(pair, k)] = error
    if not steps:
        raise next(iter(failed.values()))
    return steps, failed


def first_readable(files: Sequence[ImagePair]) -> ImagePair:
    """Return the first pair of images that can be read: with a projected pattern, a bad first one fails alone."""
    for pair in files:
        with contextlib.suppress(ImageError):
            for path in (pair.cam1, pair.cam2):
                decode_image(read_file(path), name=str(path))
            return pair
    return files[0]


def check_cameras(pair: ImagePair, calibration_file: Path) -> None:
    """Refuse a pair that was taken with other cameras than were calibrated, by its record."""
    record = pair.cam1.parent / "step.json"
    if record.is_file() and calibration_file.suffix == ".json":
        check_same_cameras(calibration_file, read_json(record).get("cameras"), f"{pair.cam1.parent}")


def checked_shapes(first: ImagePair, calibration: LoadedCalibration) -> tuple[tuple[int, int], tuple[int, int]]:
    """(rows, cols) of both cameras' images; the calibration's sizes, if it states them, must agree."""
    shapes = []
    for path, size in ((first.cam1, calibration.image_size1_px), (first.cam2, calibration.image_size2_px)):
        rows, cols = decode_image(read_file(path), name=str(path)).shape
        check_calibrated_size(str(path), (rows, cols), size)
        shapes.append((rows, cols))
    return shapes[0], shapes[1]


def number_of(pair: ImagePair, k: int) -> int:
    """Return the number of the k-th pair's step."""
    return k if pair.number is None else pair.number


def check_pair(pair: ImagePair, step: int, shapes: tuple[tuple[int, int], tuple[int, int]]) -> StepImages:
    """Check both images of a step."""
    return read_pair(pair, step, shapes)[0]


def read_pair(
    pair: ImagePair, step: int, shapes: tuple[tuple[int, int], tuple[int, int]]
) -> tuple[StepImages, list[GrayImage]]:
    """Read and check both images of a step.

    Raises
    ------
    ImageError, FileFormatError, InputError
        An image cannot be read or is blank, has another size or another checksum than recorded; both are the same.
    """
    pixels: list[GrayImage] = []
    hashes, greys, saturated = [], [], []
    for path, recorded, shape in ((pair.cam1, pair.sha256_1, shapes[0]), (pair.cam2, pair.sha256_2, shapes[1])):
        data = read_file(path)
        hashes.append(hashlib.sha256(data).hexdigest())
        if recorded is not None and hashes[-1] != recorded:
            raise FileFormatError(
                f"{path} does not match the checksum in its step.json.",
                code="checksum_mismatch",
                remedy="Restore the file, or leave this step out.",
            )
        decoded = decode(data, name=str(path))
        image = decoded.pixels
        if image.shape != shape:
            is_px, first_px = f"{image.shape[1]} x {image.shape[0]} px", f"{shape[1]} x {shape[0]} px"
            raise ImageError(
                f"{path} (step {step}) is {is_px}, the first image {first_px}.",
                code="image_size_mismatch",
                remedy="All images of one camera must have one size.",
            )
        if int(image.max()) == int(image.min()):
            raise ImageError(
                f"{path} (step {step}) is blank: every pixel is {int(image.max())}.",
                code="image_blank",
                remedy="Check exposure, lens cap and trigger, then take the step again.",
            )
        pixels.append(image)
        greys.append(decoded.grey_from)
        saturated.append(saturated_share(image, decoded.bit_depth))
    if hashes[0] == hashes[1]:
        raise InputError(
            f"{pair.cam1} and {pair.cam2} (step {step}) hold the same image.",
            code="same_image",
            remedy="Give each camera its own images.",
        )
    found = StepImages(
        n=number_of(pair, step),
        files=(pair.cam1, pair.cam2),
        sha256=(hashes[0], hashes[1]),
        averages=pair.averages,
        grey_from=(greys[0] or pair.grey_from[0], greys[1] or pair.grey_from[1]),
        saturated=(saturated[0], saturated[1]),
    )
    return found, pixels
