"""Calibration from images of the target, for the command line and the service."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.boards import BoardTarget, BoardView, detect_board, detect_target
from stereorig.core.calibration.choice.screening import DroppedView
from stereorig.core.calibration.fit.free_start import MIN_POSES
from stereorig.core.calibration.inputs import CalibrationOptions, CalibrationView, NominalValues, check_view, place
from stereorig.core.calibration.prepare import check_both, check_hold_out
from stereorig.core.calibration.result import CalibrationResult
from stereorig.core.calibration.solve import calibrate
from stereorig.core.errors import CalibrationInputError, ImageError, StereorigError, TargetError
from stereorig.core.grid import GridOptions, GridView, Localiser
from stereorig.core.names import CAMERAS, CameraName
from stereorig.core.progress import CancelToken, Progress, no_progress, raise_if_cancelled
from stereorig.core.target import GridTarget
from stereorig.core.threads import run_ranges


@dataclass(frozen=True)
class ImageOfTarget:
    """One image of the target as the camera gave it.

    Attributes
    ----------
    camera
        The camera.
    dz_mm
        Read-back position of the stage, mm, positive if target and cameras move away from each other; None for a free
        pose.
    pixels
        (rows, columns).
    name
        Used in messages.
    frame
        Number of the free pose; None at a stage position.
    """

    camera: CameraName
    dz_mm: float | None
    pixels: NDArray[Any]
    name: str = ""
    frame: int | None = None

    @property
    def label(self) -> str:
        """Name for messages."""
        return self.name or place(self.camera, self.dz_mm, self.frame)


@dataclass(frozen=True)
class CalibrationFromImages:
    """The targets detected, in the images' order, None for a free pose without one; and the calibration from them."""

    grids: tuple[GridView | BoardView | None, ...]
    result: CalibrationResult


def calibrate_views(
    images: Sequence[ImageOfTarget],
    target: GridTarget | BoardTarget,
    nominals: tuple[NominalValues, NominalValues],
    options: CalibrationOptions | None = None,
    *,
    localiser: Localiser = "profile",
    grid_options: GridOptions | None = None,
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> CalibrationFromImages:
    """Find the target in every image and calibrate.

    Parameters
    ----------
    images
        Images of both cameras, held-out ones included.
    target, nominals, options
        See :func:`stereorig.core.calibration.solve.calibrate`.
    localiser, grid_options
        See :func:`stereorig.core.grid.detect_grid`. If node corrections are estimated, the profile localiser takes each
        intersection from the lines near it: a fit over whole lines smears the nodes' errors into the cameras. On eight
        simulated 4 um grids the shape error was the same (0.40 um against 0.37), but only then was the covariance right
        (errors of the parameters 2 to 3.6 sigma with straight lines, 0.4 to 1.2 with local).
    progress, cancel
        Phases ``grid`` (one an image) and ``calibration``.

    Raises
    ------
    ImageError, TargetError
        The image named cannot be used; ``image_size_mismatch`` where its size is not the rig's. A free pose whose
        target is not found is left out, unless too few remain.
    CalibrationInputError, CalibrationError
        See :func:`stereorig.core.calibration.solve.calibrate`.
    """
    options = options or CalibrationOptions()
    check_both([[i for i in images if i.camera == name] for name in CAMERAS])
    staged = [[i.dz_mm for i in images if i.camera == name and i.dz_mm is not None] for name in CAMERAS]
    check_hold_out(staged, options)
    for image in images:
        _check_size(image, nominals[CAMERAS.index(image.camera)])
    grid_options = grid_options_for(target, options, localiser, grid_options or GridOptions())
    total = len(images) + 1
    detected = _detect_all(
        images,
        lambda pixels: detect_target(pixels, target, localiser=localiser, options=grid_options),
        lambda done: progress("grid", done, total),
        cancel,
    )
    detected = _found_in_part(images, detected, target)
    found = [None if isinstance(each, StereorigError) else each for each in detected]
    failed = [(i, each) for i, each in zip(images, detected, strict=True) if isinstance(each, StereorigError)]
    for image, error in failed:
        if image.frame is None:
            raise _of_view(error, image) from error
    _check_enough(images, found, failed)
    raise_if_cancelled(cancel)
    progress("calibration", len(images), total)
    radius_mm = _dot_radius_mm(target, found)
    views: list[CalibrationView] = []
    for image, grid in zip(images, found, strict=True):
        if grid is None:
            continue
        view = view_of(image, grid, radius_mm)
        try:
            check_view(view, target, nominals[CAMERAS.index(image.camera)])
        except CalibrationInputError as error:
            if image.frame is None:
                raise
            failed.append((image, error))  # if one of many poses cannot be used, the others still can
            continue
        views.append(view)
    seen, shown = {v.frame for v in views}, {i.frame for i in images}
    kept = tuple(k for k in options.held_out_frames if k in seen or k not in shown)
    result = calibrate(views, target, nominals, replace(options, held_out_frames=kept))
    lost = tuple(DroppedView(i.label, i.camera, int(i.frame or 0), error.cause) for i, error in failed)
    progress("calibration", total, total)
    return CalibrationFromImages(tuple(found), replace(result, dropped=(*lost, *result.dropped)))


def _found_in_part(
    images: Sequence[ImageOfTarget],
    detected: list[GridView | BoardView | StereorigError],
    target: GridTarget | BoardTarget,
) -> list[GridView | BoardView | StereorigError]:
    """Look again for dots in free poses that show a part of the grid, by the marks of the views that show it whole."""
    marks = [each.marks for each in detected if isinstance(each, BoardView) and each.marks]
    if not isinstance(target, BoardTarget) or not marks:
        return detected
    usual = max(marks, key=marks.count)
    out = list(detected)
    for k, image in enumerate(images):
        if isinstance(detected[k], TargetError) and image.frame is not None:
            with contextlib.suppress(StereorigError):  # its first cause stays
                out[k] = detect_board(image.pixels, target, marks=usual)
    return out


def _detect_all(
    images: Sequence[ImageOfTarget],
    detect: Callable[[NDArray[Any]], GridView | BoardView],
    progress: Callable[[int], None],
    cancel: CancelToken | None,
) -> list[GridView | BoardView | StereorigError]:
    """Find the target in all images, on all threads; for an image without it return the error."""
    out: list[GridView | BoardView | StereorigError | None] = [None] * len(images)
    done = count(1)
    reporting = threading.Lock()
    progress(0)

    def work(first: int, last: int) -> None:
        for k in range(first, last):
            raise_if_cancelled(cancel)
            try:
                out[k] = detect(images[k].pixels)
            except StereorigError as error:
                out[k] = error
            with reporting:
                progress(next(done))

    run_ranges(work, len(images), 1)
    return [each for each in out if each is not None]


def grid_options_for(
    target: GridTarget | BoardTarget, options: CalibrationOptions, localiser: Localiser, given: GridOptions
) -> GridOptions:
    """Return the options of a line grid's detection for a calibration; the given ones take precedence."""
    estimated = target.node_tolerance_mm > 0.0 and options.estimate_nodes is not False
    if localiser == "profile" and given.line_model is None and estimated and isinstance(target, GridTarget):
        return replace(given, line_model="local")
    return given


def _of_view(error: StereorigError, image: ImageOfTarget) -> StereorigError:
    return type(error)(
        f"{image.label}: {error.cause}", code=error.code, remedy=error.remedy, **{**error.context, "view": image.label}
    )


def _check_enough(
    images: Sequence[ImageOfTarget],
    found: Sequence[GridView | BoardView | None],
    failed: Sequence[tuple[ImageOfTarget, StereorigError]],
) -> None:
    """Raise the commonest cause if the target is found in too few free poses."""
    if not failed or any(i.frame is None for i in images):
        return
    seen = [{i.frame for i, g in zip(images, found, strict=True) if g is not None and i.camera == n} for n in CAMERAS]
    both = len(seen[0] & seen[1])
    if both >= MIN_POSES:
        return
    codes = [error.code for _, error in failed]
    image, error = failed[codes.index(max(codes, key=codes.count))]
    if len(failed) > len(images) // 2:
        raise _of_view(error, image) from error
    raise CalibrationInputError(
        f"The target was found by both cameras in {both} poses; {MIN_POSES} are needed. {image.label}: {error.cause}",
        code="too_few_poses",
        remedy="Take at least three sharp views that show the whole target, tilted differently; better fifteen.",
        view=image.label,
    ) from error


def _dot_radius_mm(target: GridTarget | BoardTarget, found: Sequence[GridView | BoardView | None]) -> float | None:
    if not isinstance(target, BoardTarget) or target.kind not in ("circles", "circles_asymmetric"):
        return None
    if target.dot_diameter_mm is not None:
        return 0.5 * target.dot_diameter_mm
    # one dot size for all views: each view's own estimate is good to a per cent, the correction needs no more
    radii = [view.dot_radius_mm for view in found if isinstance(view, BoardView)]
    return float(np.median([r for r in radii if r is not None]))


def view_of(image: ImageOfTarget, grid: GridView | BoardView, radius_mm: float | None) -> CalibrationView:
    """Return a detected target as the adjustment's input; ``radius_mm`` is the radius of its dots."""
    if isinstance(grid, BoardView):
        return CalibrationView(
            image.camera,
            image.dz_mm,
            grid.xy_px,
            grid.sigma_px,
            image.label,
            frame=image.frame,
            dot_radius_mm=radius_mm,
        )
    # one figure for both axes: the adjustment weighs nodes, not directions
    sigma = np.sqrt(0.5 * np.trace(grid.covariance_px2, axis1=-2, axis2=-1))
    return CalibrationView(
        image.camera,
        image.dz_mm,
        grid.xy_px,
        sigma,
        image.label,
        _coordinates_per_independent_one(grid),
        frame=image.frame,
        offsets=grid.line_offsets,
    )


def _coordinates_per_independent_one(grid: GridView) -> float:
    per_line = {"straight": 2, "parabola": 3}.get(grid.line_model)
    if per_line is None:
        return 1.0
    n_a, n_b = grid.xy_px.shape[:2]
    return max(float(2.0 * n_a * n_b / (per_line * (n_a + n_b))), 1.0)


def _check_size(image: ImageOfTarget, nominal: NominalValues) -> None:
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
