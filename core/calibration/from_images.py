"""From grid images to the calibration: one path for the command line and the service."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.calibration.inputs import CAMERAS, CalibrationOptions, CalibrationView, CameraName, NominalCamera
from core.calibration.prepare import check_hold_out
from core.calibration.result import CalibrationResult
from core.calibration.solve import calibrate
from core.errors import ImageError, StereorigError
from core.grid import GridOptions, GridView, Localiser, detect_grid
from core.progress import CancelToken, Progress, no_progress, raise_if_cancelled
from core.target import GridTarget


@dataclass(frozen=True)
class ImageOfTarget:
    """One image of the target as the camera gave it.

    Parameters
    ----------
    camera, dz_mm
        Which camera, and its read-back travel along its own optical axis, positive away from the target.
    pixels
        (rows, columns).
    name
        Used in messages.
    """

    camera: CameraName
    dz_mm: float
    pixels: NDArray[Any]
    name: str = ""

    @property
    def label(self) -> str:
        """Name for messages."""
        return self.name or f"{self.camera} at {self.dz_mm:+.3f} mm"


@dataclass(frozen=True)
class CalibrationFromImages:
    """What was found in the images, in their order, and what came of it."""

    grids: tuple[GridView, ...]
    result: CalibrationResult


def calibrate_views(
    images: Sequence[ImageOfTarget],
    target: GridTarget,
    nominals: tuple[NominalCamera, NominalCamera],
    options: CalibrationOptions | None = None,
    *,
    localiser: Localiser = "profile",
    grid_options: GridOptions | None = None,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> CalibrationFromImages:
    """Find the grid in every image and calibrate.

    Parameters
    ----------
    images
        Images of both cameras, held-out positions included.
    target, nominals, options
        See :func:`core.calibration.solve.calibrate`.
    localiser, grid_options
        See :func:`core.grid.detect_grid`. Its default of straight lines serves toleranced grids as well: measured on
        eight simulated 4 um grids at two positions, node corrections left 0.37 um of shape error with straight
        lines, 0.37 with parabolas, 0.40 with intersections from the lines near each node (less smeared, but
        noisier); straight lines also stay nearest to the nominal grid.
    progress, cancel
        Stages ``grid`` (one an image) and ``calibration``.

    Raises
    ------
    ImageError, TargetError
        The image named cannot be used; ``image_size_mismatch`` where its size is not the rig's.
    CalibrationInputError, CalibrationError
        See :func:`core.calibration.solve.calibrate`.
    """
    options = options or CalibrationOptions()
    check_hold_out([[i.dz_mm for i in images if i.camera == name] for name in CAMERAS], options)
    for image in images:
        _check_size(image, nominals[CAMERAS.index(image.camera)])
    grid_options = grid_options or GridOptions()
    grids: list[GridView] = []
    views: list[CalibrationView] = []
    total = len(images) + 1
    for k, image in enumerate(images):
        raise_if_cancelled(cancel)
        progress("grid", k, total)
        try:
            grid = detect_grid(image.pixels, target, localiser=localiser, options=grid_options)
        except StereorigError as error:
            raise type(error)(
                f"{image.label}: {error.cause}",
                code=error.code,
                remedy=error.remedy,
                **{**error.context, "view": image.label},
            ) from error
        grids.append(grid)
        # one figure for both axes: the adjustment weighs nodes, not directions
        sigma = np.sqrt(0.5 * np.trace(grid.covariance_px2, axis1=-2, axis2=-1))
        views.append(CalibrationView(image.camera, image.dz_mm, grid.xy_px, sigma, image.label))
    raise_if_cancelled(cancel)
    progress("calibration", len(images), total)
    result = calibrate(views, target, nominals, options)
    progress("calibration", total, total)
    return CalibrationFromImages(tuple(grids), result)


def _check_size(image: ImageOfTarget, nominal: NominalCamera) -> None:
    if image.pixels.ndim != 2:
        raise ImageError(
            f"{image.label} has the shape {image.pixels.shape}, not (rows, columns).",
            code="image_unsupported",
            remedy="Give one-channel images.",
            view=image.label,
        )
    rows, columns = image.pixels.shape
    if (columns, rows) != tuple(nominal.image_size_px):
        raise ImageError(
            f"{image.label} is {columns} x {rows} px, but the rig's {image.camera} has "
            f"{nominal.image_size_px[0]} x {nominal.image_size_px[1]} px.",
            code="image_size_mismatch",
            remedy="Check image_size_px of the rig and which camera took the image.",
            view=image.label,
        )
