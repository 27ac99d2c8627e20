"""Calibration from grid images, for the command line and the service."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.calibration.inputs import CalibrationOptions, CalibrationView, NominalCamera
from core.calibration.prepare import check_hold_out
from core.calibration.result import CalibrationResult
from core.calibration.solve import calibrate
from core.errors import ImageError, StereorigError
from core.grid import GridOptions, GridView, Localiser, detect_grid
from core.names import CAMERAS, CameraName
from core.progress import CancelToken, Progress, no_progress, raise_if_cancelled
from core.target import GridTarget


@dataclass(frozen=True)
class ImageOfTarget:
    """One image of the target as the camera gave it.

    Attributes
    ----------
    camera, dz_mm
        The camera, and its read-back travel along its own optical axis, mm, positive away from the target.
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
    """The grids detected in the images, in their order, and the calibration from them."""

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
        See :func:`core.grid.detect_grid`. Where node corrections are estimated, the profile localiser takes each
        intersection from the lines near it: a fit over whole lines smears the nodes' errors into the cameras. On eight
        simulated 4 um grids the shape error was the same (0.40 um against 0.37), but only then was the covariance right
        (errors of the parameters 2 to 3.6 sigma with straight lines, 0.4 to 1.2 with local).
    progress, cancel
        Phases ``grid`` (one an image) and ``calibration``.

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
    if (
        localiser == "profile"
        and grid_options.line_model is None
        and target.node_tolerance_mm > 0.0
        and options.estimate_nodes is not False
    ):
        grid_options = replace(grid_options, line_model="local")
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
        shared = _coordinates_per_independent_one(grid)
        views.append(CalibrationView(image.camera, image.dz_mm, grid.xy_px, sigma, image.label, shared))
    raise_if_cancelled(cancel)
    progress("calibration", len(images), total)
    result = calibrate(views, target, nominals, options)
    progress("calibration", total, total)
    return CalibrationFromImages(tuple(grids), result)


def _coordinates_per_independent_one(grid: GridView) -> float:
    per_line = {"straight": 2, "parabola": 3}.get(grid.line_model)
    if per_line is None:
        return 1.0
    n_a, n_b = grid.xy_px.shape[:2]
    return max(float(2.0 * n_a * n_b / (per_line * (n_a + n_b))), 1.0)


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
