"""The known size of a second target, measured in one pair of images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.boards import BoardTarget, BoardView
from stereorig.core.calibration.checks.distance import DistanceCheck, check_target_scale
from stereorig.core.calibration.expect import correlation_of_lines
from stereorig.core.calibration.inputs import nodes_of, pitch_scale_sigma
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import StereorigError
from stereorig.core.grid import GridView
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget


def check_target_images(
    pair: StereoPair,
    images: tuple[NDArray[Any], NDArray[Any]],
    target: GridTarget | BoardTarget,
    *,
    covariance: Float | None = None,
    names: Sequence[str] | None = None,
    distance_sigma_mm: float = 0.0,
) -> DistanceCheck:
    """Find a target in both images, measure its points and compare its scale with the description.

    Parameters
    ----------
    pair
        The calibrated cameras.
    images
        (rows, columns) of both cameras, taken at one moment.
    target
        A target of known size, another than the one that was calibrated with.
    covariance, names
        As for :func:`stereorig.core.calibration.checks.distance.check_known_distance`.
    distance_sigma_mm
        Standard deviation of the known distance of its two outermost points, in addition to the target's own
        tolerances.

    Raises
    ------
    ImageError, TargetError
        As :func:`stereorig.core.boards.detect_target`, the camera named.
    CalibrationInputError
        As :func:`stereorig.core.calibration.checks.distance.check_target_scale`.
    """
    from stereorig.core.boards import detect_target  # slow to load, and not every start needs it

    views = []
    for name, image in zip(CAMERAS, images, strict=True):
        try:
            views.append(detect_target(image, target))
        except StereorigError as error:
            raise type(error)(
                f"{name}: {error.cause}", code=error.code, remedy=error.remedy, **{**error.context, "camera": name}
            ) from error
    nominal = nodes_of(target)
    radii = [r for r in (v.dot_radius_mm for v in views if isinstance(v, BoardView)) if r is not None]
    length = float(np.linalg.norm(np.ptp(nominal.reshape(-1, 2), axis=0)))
    return check_target_scale(
        pair,
        views[0].xy_px,
        views[1].xy_px,
        nominal,
        covariance=covariance,
        names=names,
        sigmas_px=(_sigma_px(views[0]), _sigma_px(views[1])),
        node_tolerance_mm=target.node_tolerance_mm,
        distance_sigma_mm=float(np.hypot(distance_sigma_mm, pitch_scale_sigma(target) * length)),
        dot_radius_mm=float(np.mean(radii)) if radii else None,
    )


def _sigma_px(view: GridView | BoardView) -> Float:
    """Standard deviation of each point, larger for points that share whole lines and so their errors."""
    if isinstance(view, BoardView):
        return view.sigma_px
    shared = correlation_of_lines(view.target, view.line_model)
    return np.asarray(np.sqrt(0.5 * np.trace(view.covariance_px2, axis1=-2, axis2=-1) * shared))
