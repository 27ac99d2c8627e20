"""The known-distance check: the only one that shows a wrong pitch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from core.arrays import Float
from core.calibration.result import COVARIANCE_NAMES
from core.calibration.uncertainty import point_derivatives
from core.cameras.stereo import StereoPair
from core.errors import CalibrationInputError


@dataclass(frozen=True)
class DistanceCheck:
    """A measured against a known distance.

    Attributes
    ----------
    measured_mm, known_mm
        The distances.
    ratio
        Measured over known; not 1 for a target with another pitch than declared.
    sigma_mm
        Standard uncertainty of the difference, from calibration and known value.
    agrees
        True if they agree within three sigma.
    text
        The finding in one sentence.
    """

    measured_mm: float
    known_mm: float
    ratio: float
    sigma_mm: float
    agrees: bool
    text: str


def check_known_distance(
    pair: StereoPair,
    points_px: ArrayLike,
    distance_mm: float,
    *,
    covariance: Float | None = None,
    names: Sequence[str] | None = None,
    localisation_sigma_px: float = 0.05,
    distance_sigma_mm: float = 0.0,
) -> DistanceCheck:
    """Measure the distance of two marks and compare it with the known one.

    Parameters
    ----------
    pair
        The calibrated cameras.
    points_px
        (2, 2, 2): which camera, which mark, (x, y).
    distance_mm
        The known distance.
    covariance, names
        Covariance of the calibration and its parameters' names, those of the paper's lens without them; None counts the
        marks' localisation only.
    localisation_sigma_px, distance_sigma_mm
        Standard deviations of the marks' image coordinates and of the known distance.

    Raises
    ------
    CalibrationInputError
        Code ``known_distance_unusable`` if the points or the distance are not usable.
    """
    xy = np.asarray(points_px, dtype=np.float64)
    if xy.shape != (2, 2, 2) or not np.isfinite(xy).all() or not (np.isfinite(distance_mm) and distance_mm > 0.0):
        raise CalibrationInputError(
            f"A known distance needs two marks in both cameras, (2, 2, 2), and a positive length; got {xy.shape} and "
            f"{distance_mm}.",
            code="known_distance_unusable",
            remedy="Give both marks' image positions in both cameras and their distance in millimetres.",
        )
    space = pair.triangulate(xy[0], xy[1])
    if not space.valid.all():
        raise CalibrationInputError(
            "The rays of a mark do not meet in front of both cameras.",
            code="known_distance_unusable",
            remedy="Check that both cameras' positions belong to the same mark.",
        )
    difference = space.xyz_mm[1] - space.xyz_mm[0]
    measured = float(np.linalg.norm(difference))
    along = difference / measured
    variance = distance_sigma_mm**2
    A = np.concatenate([pair.cam1.point_jacobian(space.xyz_mm), pair.cam2.point_jacobian(space.xyz_mm)], axis=-2)
    per_point = np.linalg.inv(np.swapaxes(A, 1, 2) @ A) * localisation_sigma_px**2
    variance += float(along @ per_point.sum(axis=0) @ along)
    if covariance is not None:
        G = point_derivatives(pair, space.xyz_mm, COVARIANCE_NAMES if names is None else names)
        row = along @ (G[1] - G[0])
        variance += float(row @ covariance @ row)
    sigma = float(np.sqrt(variance))
    ratio = measured / distance_mm
    agrees = abs(measured - distance_mm) <= 3.0 * sigma
    text = f"Measured {measured:.4f} mm against {distance_mm:.4f} mm known ({100.0 * (ratio - 1.0):+.2f} %), " + (
        f"within 3 sigma = {3.0 * sigma:.4f} mm."
        if agrees
        else f"beyond 3 sigma = {3.0 * sigma:.4f} mm: the target's pitch may be wrong by that factor."
    )
    return DistanceCheck(measured, float(distance_mm), ratio, sigma, agrees, text)
