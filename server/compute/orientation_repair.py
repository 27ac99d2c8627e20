"""Repair of a calibration from image files: the same in the worker and on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.points.images import MeasureImage, check_calibrated_size
from stereorig.core.field.region.lay_points import lay_points
from stereorig.core.field.region.region import PointGrid, check_region
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.names import CAMERAS
from stereorig.core.orientation import RepairedPair, RepairLimits, repair_orientation
from stereorig.core.progress import CancelToken, Progress
from stereorig.core.settings import SPACING_PX, Region
from stereorig.server.compute.tasks import Plain, RepairTask, StepImages
from stereorig.server.formats.calibrations.recognise import load_calibration, parse_calibration
from stereorig.server.formats.calibrations.repaired import native_content, repaired_content
from stereorig.server.formats.files import mismatch, sha256_of
from stereorig.server.formats.images import read_file, read_image, read_mask
from stereorig.server.formats.results.summary import to_json
from stereorig.server.store.durable import write_json
from stereorig.server.worker.process import current_task

_ENOUGH_POINTS = 10_000


@dataclass(frozen=True, eq=False)
class RepairedCalibration:
    """The content of the new calibration.json, and the repair that it comes from."""

    content: Plain
    repair: RepairedPair


def repair_from_files(
    original: Path,
    steps: Sequence[StepImages],
    *,
    region: Region | None,
    mask: NDArray[np.bool_] | None = None,
    subset_px: int,
    spacing_px: int | None,
    limits: RepairLimits,
    progress: Progress | None = None,
    cancel: CancelToken | None = None,
) -> RepairedCalibration:
    """Estimate the cameras' relative orientation again from the images of some steps.

    Parameters
    ----------
    original
        The calibration's file, which is only read.
    steps
        Images, all taken after the bump.
    region
        Region of the points in camera 1's images; None: all of them.
    mask
        (rows, cols) True where points are allowed, or None.
    subset_px, spacing_px
        As for a measurement; no spacing: as many points as add information.
    limits, progress, cancel
        As for :func:`stereorig.core.orientation.repair_orientation`.

    Raises
    ------
    CalibrationError
        If the repair is refused, see :func:`stereorig.core.orientation.repair_orientation`.
    FileFormatError
        Calibration or images cannot be read.
    RegionError, ImageError, SeedError, Cancelled
        As a measurement.
    """
    loaded = load_calibration(original)
    content = native_content(loaded, read_file(original, kind="calibration"))
    pair = parse_calibration(to_json(content), name=str(original)).pair
    images = [tuple(MeasureImage(read_image(path), str(path)) for path in step.files) for step in steps]
    for one in images:
        for cam, image, size in zip(CAMERAS, one, (loaded.image_size1_px, loaded.image_size2_px), strict=True):
            check_calibrated_size(f"{image.name} of {cam}", image.shape, size)
    grid = _grid(images[0][0].shape, region, mask, subset_px, spacing_px)
    repair = repair_orientation(
        pair,
        [(one, two) for one, two in images],
        grid,
        MeasureOptions(subset_px=subset_px),
        limits=limits,
        progress=progress,
        cancel=cancel,
    )
    used: list[Plain] = [
        {
            cam: {"file": str(Path(*path.parts[-2:])), "sha256": sha256}
            for cam, path, sha256 in zip(CAMERAS, step.files, step.sha256, strict=True)
        }
        for step in steps
    ]
    return RepairedCalibration(repaired_content(content, loaded.sha256, repair, used, limits), repair)


def _grid(
    shape: tuple[int, int],
    region: Region | None,
    mask: NDArray[np.bool_] | None,
    subset_px: int,
    spacing_px: int | None,
) -> PointGrid:
    if region is None:
        rows, cols = shape
        margin = float(subset_px // 2 + 2)
        region = Region(rectangle=(margin, margin, cols - 1 - margin, rows - 1 - margin))
    if spacing_px is None:
        coarse = lay_points(region, SPACING_PX.default, mask)
        share = np.sqrt(float(coarse.allowed.sum()) / _ENOUGH_POINTS)
        spacing_px = int(np.clip(np.ceil(SPACING_PX.default * share), SPACING_PX.default, SPACING_PX.high))
    grid = lay_points(region, spacing_px, mask)
    check_region(grid, image_shape=shape, subset_px=subset_px, mask_shape=None if mask is None else mask.shape)
    return grid


def repair_calibration(task: RepairTask) -> Plain:
    """Repair a calibration in the worker; ``calibration.json`` is in the task's folder when this returns.

    Raises
    ------
    StereorigError
        As :func:`repair_from_files`.
    """
    channel = current_task()
    for step in task.steps:
        for path, recorded in zip(step.files, step.sha256, strict=True):
            if sha256_of(path) != recorded:
                raise mismatch(path.name, f"step {step.n}", path.parent.name)
    made = repair_from_files(
        task.original,
        task.steps,
        region=None if task.region is None else Region.model_validate(task.region),
        mask=None if task.mask is None else read_mask(task.mask),
        subset_px=task.subset_px,
        spacing_px=task.spacing_px,
        limits=RepairLimits(turn_deg=task.limits["turn_deg"], strain=task.limits["strain"]),
        progress=channel.progress,
        cancel=channel,
    )
    write_json(task.folder / "calibration.json", made.content, checksum=True)
    return {"verdict": made.content["verdict"], "repair": made.content["repair"]}
