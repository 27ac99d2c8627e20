"""Known distances: the only check that shows a wrong pitch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.fit.dots import dot_offsets_px
from stereorig.core.calibration.result import COVARIANCE_NAMES
from stereorig.core.calibration.uncertainty import point_derivatives
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationInputError

MARK_SIGMA_PX = 0.05
_AGREE_SIGMA = 3.0
_MIN_TARGET_POINTS = 6
#: of the nearest points' distance: indices that disagree between the cameras leave more, a bent board less
_MISFIT = 0.2
#: imported calibrations miss by some tenths of a pixel; exchanged images or a camera that moved by more
_EPIPOLAR_PX = 2.0
_NODE_BOUND = float(np.sqrt(3.0))  # quotient of a bound and the standard deviation within it


@dataclass(frozen=True)
class DistanceCheck:
    """A measured against a known distance.

    Attributes
    ----------
    measured_mm, known_mm
        The distances; for a target, the distance of its two outermost points.
    ratio
        Measured over known; not 1 for a target with another pitch than declared.
    sigma_mm
        Standard uncertainty of the difference, from calibration, marks and known value.
    agrees
        True if they agree within three sigma.
    text
        The finding in one sentence.
    points
        Number of marks measured.
    residual_mm
        Rms distance of a target's points from its description, position and size fitted; None of two marks.
    covariance_known
        False if the calibration's own uncertainty is not known and does not count.
    """

    measured_mm: float
    known_mm: float
    ratio: float
    sigma_mm: float
    agrees: bool
    text: str
    points: int = 2
    residual_mm: float | None = None
    covariance_known: bool = True


def check_known_distance(
    pair: StereoPair,
    points_px: ArrayLike,
    distance_mm: float,
    *,
    covariance: Float | None = None,
    names: Sequence[str] | None = None,
    localisation_sigma_px: float = MARK_SIGMA_PX,
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
        Covariance of the calibration and its parameters' names; without names the paper's lens is assumed. Without
        covariance only the marks' localisation counts.
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
    points = _triangulated(pair, xy)
    difference = points[1] - points[0]
    measured = float(np.linalg.norm(difference))
    if not measured > 0.0:
        raise CalibrationInputError(
            "Both marks are at one position.", code="known_distance_unusable", remedy="Give two marks that lie apart."
        )
    along = difference / measured
    rows = np.stack([-along, along])
    sigma2 = np.full((2, 2), localisation_sigma_px**2)
    variance = _variance(pair, points, rows, sigma2, covariance, names) + distance_sigma_mm**2
    return _finding(measured, float(distance_mm), float(np.sqrt(variance)), known=covariance is not None)


def check_target_scale(
    pair: StereoPair,
    xy1_px: Float,
    xy2_px: Float,
    nominal_mm: Float,
    *,
    covariance: Float | None = None,
    names: Sequence[str] | None = None,
    sigmas_px: tuple[Float, Float] | None = None,
    node_tolerance_mm: float = 0.0,
    distance_sigma_mm: float = 0.0,
    dot_radius_mm: float | None = None,
) -> DistanceCheck:
    """Measure all points of a target of known size and compare its scale with the description.

    Parameters
    ----------
    pair
        The calibrated cameras.
    xy1_px, xy2_px
        (..., 2) the same points in both cameras, NaN for a point that was not found.
    nominal_mm
        (..., 2) positions on the target.
    covariance, names
        As for :func:`check_known_distance`.
    sigmas_px
        (...) standard deviation of each point's coordinates, per camera; None: 0.05 px.
    node_tolerance_mm
        The maker's bound on the error of a point, per axis.
    distance_sigma_mm
        Standard deviation of the known distance of the two outermost points.
    dot_radius_mm
        Radius of the target's dots, whose imaged centres are corrected for perspective and lens; None for corners.

    Returns
    -------
    DistanceCheck
        The distance of the two outermost points that both cameras see, from the scale of all.

    Raises
    ------
    CalibrationInputError
        ``known_distance_unusable`` with too few common points; ``known_distance_mismatch`` if the points do not have
        the shape of the target.
    """
    flat = [np.asarray(xy, dtype=np.float64).reshape(-1, 2) for xy in (xy1_px, xy2_px)]
    nominal = np.asarray(nominal_mm, dtype=np.float64).reshape(-1, 2)
    found: Bool = np.asarray(np.isfinite(np.concatenate(flat, axis=1)).all(axis=1))
    if found.sum() < _MIN_TARGET_POINTS or np.linalg.matrix_rank(nominal[found] - nominal[found].mean(axis=0)) < 2:
        raise CalibrationInputError(
            f"Both cameras see {int(found.sum())} points of the target in common; {_MIN_TARGET_POINTS} in two "
            "directions are needed.",
            code="known_distance_unusable",
            remedy="Show the target where both cameras see it.",
        )
    xy = np.stack([part[found] for part in flat])
    board = np.column_stack([nominal[found], np.zeros(int(found.sum()))])
    if sigmas_px is None:
        sigma2 = np.full(xy.shape[:2], MARK_SIGMA_PX**2)
    else:
        sigma2 = np.stack([np.asarray(s, dtype=np.float64).reshape(-1)[found] ** 2 for s in sigmas_px])
    offset = float(np.sqrt(np.mean(pair.epipolar_residual_px(xy[0], xy[1]) ** 2)))
    if offset > _EPIPOLAR_PX:
        raise CalibrationInputError(
            f"The points lie {offset:.3g} px rms off their epipolar lines; a pair that the calibration holds for has "
            f"{_EPIPOLAR_PX:g} px at most.",
            code="known_distance_mismatch",
            remedy="Check that the images are not exchanged, that both show the target at one moment, and that no "
            "camera moved since the calibration.",
        )
    points = _triangulated(pair, xy)
    scale, pose, left = _similarity(board, points)
    if dot_radius_mm is not None:
        for _ in range(2):
            offsets = [
                dot_offsets_px(Camera(c.lens, c.cam_from_sys @ pose), board * scale, dot_radius_mm * scale)
                for c in (pair.cam1, pair.cam2)
            ]
            points = _triangulated(pair, xy - np.stack(offsets))
            scale, pose, left = _similarity(board, points)
    residual = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    nearest = _nearest_mm(nominal[found])
    if residual > _MISFIT * nearest:
        raise CalibrationInputError(
            f"The points measured do not have the shape of the target: {residual:.3g} mm rms off it, where its points "
            f"lie {nearest:.3g} mm apart.",
            code="known_distance_mismatch",
            remedy="Check that the target is described rightly, that both images show it upright and at one moment, "
            "and that they are not exchanged.",
        )
    # the scale is a sum over the points: each counts by its place on the target
    about = (board - board.mean(axis=0)) @ pose.rotation.T
    rows = about / float((about**2).sum())
    variance = _variance(pair, points, rows, sigma2, covariance, names)
    variance += float((rows**2).sum()) * (node_tolerance_mm / _NODE_BOUND) ** 2
    known = _outermost_mm(nominal[found])
    sigma = float(np.sqrt(variance * known**2 + distance_sigma_mm**2))
    return _finding(
        scale * known, known, sigma, known=covariance is not None, points=int(found.sum()), residual_mm=residual
    )


def _triangulated(pair: StereoPair, xy: Float) -> Float:
    space = pair.triangulate(xy[0], xy[1])
    if not space.valid.all():
        raise CalibrationInputError(
            "The rays of a mark do not meet in front of both cameras.",
            code="known_distance_unusable",
            remedy="Check that both cameras' positions belong to the same mark.",
        )
    return space.xyz_mm


def _variance(
    pair: StereoPair, points: Float, rows: Float, sigma2: Float, covariance: Float | None, names: Sequence[str] | None
) -> float:
    """Variance of ``sum(rows * points)`` (n, 3) from marks of variance ``sigma2`` (2, n) px^2 and the calibration."""
    A = np.concatenate([pair.cam1.point_jacobian(points), pair.cam2.point_jacobian(points)], axis=-2)
    to_point = np.linalg.pinv(A)  # (n, 3, 4)
    weights = np.einsum("ni,nij->nj", rows, to_point)
    variance = float(np.einsum("nj,nj->", weights**2, np.repeat(sigma2.T, 2, axis=1)))
    if covariance is not None:
        G = point_derivatives(pair, points, COVARIANCE_NAMES if names is None else names)
        row = np.einsum("ni,nip->p", rows, G)
        variance += float(row @ covariance @ row)
    return variance


def _similarity(board: Float, points: Float) -> tuple[float, RigidTransform, Float]:
    """Scale and pose that map the board (n, 3) to the points, least squares, and the residuals (n, 3)."""
    middle_b, middle_p = board.mean(axis=0), points.mean(axis=0)
    a, b = board - middle_b, points - middle_p
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    turned = a @ R.T
    scale = float((turned * b).sum() / (a**2).sum())
    pose = RigidTransform(R, middle_p - scale * R @ middle_b)
    return scale, pose, b - scale * turned


def _nearest_mm(nominal: Float) -> float:
    from scipy.spatial import cKDTree  # slow to load, and not every start needs it

    distances = np.asarray(cKDTree(nominal).query(nominal, k=2)[0])
    return float(np.median(distances[:, 1]))


def _outermost_mm(nominal: Float) -> float:
    from scipy.spatial.distance import pdist  # slow to load, and not every start needs it

    return float(pdist(nominal).max())


def _finding(
    measured: float, known_mm: float, sigma: float, *, known: bool, points: int = 2, residual_mm: float | None = None
) -> DistanceCheck:
    ratio = measured / known_mm
    agrees = abs(measured - known_mm) <= _AGREE_SIGMA * sigma
    limit = _AGREE_SIGMA * sigma
    of = "" if points == 2 else f" over {points} points"
    text = (
        f"Measured {measured:.4f} mm against {known_mm:.4f} mm known{of}, ratio {ratio:.6f} +- {sigma / known_mm:.6f} "
        f"({100.0 * (ratio - 1.0):+.3f} %), "
    )
    if agrees:
        text += f"within 3 sigma = {limit:.4f} mm."
    else:
        text += f"beyond 3 sigma = {limit:.4f} mm: the pitch of the calibration's target may be wrong by that factor."
    if not known:
        text += " Calibration not included: its own uncertainty is not known and does not count."
    return DistanceCheck(measured, known_mm, ratio, sigma, agrees, text, points, residual_mm, known)
