"""The rigid motion of a field, and the field without it.

A point X that moved by U is at X + U = c + d + R (X - c) + r. R and d minimise the sum of r^T W r, W the inverse of r's
covariance; c is the centre of the points used. If the body deforms, the residual r is more than noise; then r's
covariance is the noise's plus an isotropic variance that accounts for the residual. Else a body that only stretches
would be turned until its contraction looks like a tilt, since depth is the noisiest direction. The parameters'
covariance comes from the points' own, from the pixels that overlapping subsets share, and from their common factor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.common.budget import Budget, budgets_through
from stereorig.core.errors import InputError, MeasurementError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of
from stereorig.core.robust import BIWEIGHT_REACH, MAD_TO_SIGMA, biweight

_MIN_POINTS = 3
_ROUNDS = 50
_OUTER_ROUNDS = 30
_EXTRA_SETTLED = 1e-3
_CONVERGED = 1e-11
_LINE = 1e-6  # spread across a line of points, relative to the spread along it


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """A rigid motion with its uncertainty.

    Attributes
    ----------
    rotation
        (3, 3) R.
    rotation_vector_rad
        (3,) axis times angle of R, system frame.
    translation_mm
        (3,) d, displacement of the centre.
    centre_mm
        (3,) c.
    covariance
        (6, 6) of the rotation vector (rad) and the translation (mm).
    points
        Number of points with a weight above zero.
    residual_rms_mm
        Rms of r over these points, all three components together: deformation and noise.
    noise_ratio
        Root mean square of r in units of its expected noise; 1 for a rigid body with the stated noise.
    """

    rotation: Float
    rotation_vector_rad: Float
    translation_mm: Float
    centre_mm: Float
    covariance: Float
    points: int
    residual_rms_mm: float
    noise_ratio: float
    gain: Float
    """(r, c, 6, 3) the fit's derivative over each point's r, zero for points without weight."""
    own_covariance: Float
    """(6, 6) of the small rotation that follows R and the translation, without the common part."""
    common: Float | None
    """(6, k) common factor of the small rotation and the translation; None if the field has none."""
    sigma_common: Float
    """(6,) the common part's standard deviations, as ``covariance``; NaN where the field has none."""
    budgets: tuple[Budget, ...]
    """Budgets of the rotation vector's three components (rad) and the translation's (mm)."""
    reference_covariance: Float | None
    """(6, 6) part of ``own_covariance`` that is the reference pair's noise; None if it is not known separately."""


def skew(v: Float) -> Float:
    """Return the matrices (..., 3, 3) of the cross product v x."""
    zero = np.zeros(v.shape[:-1])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape[:-1], 3, 3)


def rigid_motion(
    field: Field, *, shared: SharedPixels, chosen: Bool | None = None, robust: bool = False
) -> RigidMotion:
    """Fit the rigid motion of a displacement field.

    Parameters
    ----------
    field
        With displacements.
    shared
        The correlation of neighbouring points.
    chosen
        (r, c) points that take part; None for all. Failed points never do.
    robust
        Give points far off the others (Tukey's biweight) less weight, down to none.

    Raises
    ------
    InputError
        ``no_displacement`` for a shape.
    MeasurementError
        ``too_few_points`` if fewer than three valid points, or points along one line, are left.
    """
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    if field.uvw_mm is None:
        raise InputError("A shape has no motion.", code="no_displacement", remedy="Use a step with displacements.")
    used = field.valid if chosen is None else field.valid & chosen
    x, moved = field.xyz_mm[used], (field.xyz_mm + field.uvw_mm)[used]
    _check_spread(x)
    cov = field.covariance[used]
    centre = x.mean(axis=0)
    arm = x - centre
    R, d = _unweighted(arm, moved - centre)
    noise, r = _residuals(arm, moved - centre, cov, R, d)
    weight: Float = np.ones(len(x))
    extra = _deformation(r, noise, weight)
    A: Float = np.empty(0)
    W: Float = np.empty(0)
    H = np.eye(6)
    for _ in range(_OUTER_ROUNDS):
        for _ in range(_ROUNDS):
            noise, r = _residuals(arm, moved - centre, cov, R, d)
            W = np.asarray(np.linalg.inv(noise + extra * np.eye(3)), dtype=np.float64)
            weight = _robust_weight(np.einsum("na,nab,nb->n", r, W, r)) if robust else weight
            A = np.concatenate([-skew(arm @ R.T), np.broadcast_to(np.eye(3), (len(x), 3, 3))], axis=2)
            WA = weight[:, None, None] * (W @ A)
            H = np.einsum("nai,naj->ij", A, WA)
            change = np.linalg.solve(H, np.einsum("nai,na->i", WA, r))
            R, d = Rotation.from_rotvec(change[:3]).as_matrix() @ R, d + change[3:]
            if np.abs(change).max() < _CONVERGED * max(1.0, float(np.abs(arm).max())):
                break
        before, extra = extra, _deformation(r, noise, weight)
        if abs(extra - before) <= _EXTRA_SETTLED * before:
            break
    kept = weight > 0.0
    _check_spread(x[kept])
    distance2 = np.einsum("na,nab,nb->n", r, np.linalg.inv(noise), r)
    gain = np.zeros((*field.shape, 6, 3))
    gain[used] = np.linalg.solve(H, np.swapaxes(weight[:, None, None] * (W @ A), 1, 2))
    own = _fit_covariance(field, shared, gain, R)
    at_reference = field.reference_alone
    frozen = None if at_reference is None else _fit_covariance(at_reference, shared, gain, R)
    common = _fit_common(field, gain, R)
    small = own if common is None else own + common @ common.T
    vector = Rotation.from_matrix(R).as_rotvec()
    to_vector = np.eye(6)
    to_vector[:3, :3] = _vector_slope(vector)
    return RigidMotion(
        rotation=R,
        rotation_vector_rad=vector,
        translation_mm=d,
        centre_mm=centre,
        covariance=to_vector @ small @ to_vector.T,
        points=int(kept.sum()),
        residual_rms_mm=float(np.sqrt(np.mean(np.sum(r[kept] ** 2, axis=1)))),
        noise_ratio=float(np.sqrt(np.mean(distance2[kept]) / 3.0)),
        gain=gain,
        own_covariance=own,
        common=common,
        sigma_common=np.full(6, np.nan) if common is None else np.linalg.norm(to_vector @ common, axis=1),
        budgets=budgets_through(to_vector, own, frozen, common, field.causes),
        reference_covariance=frozen,
    )


def _residuals(arm: Float, moved: Float, cov: Float, R: Float, d: Float) -> tuple[Float, Float]:
    """Return the covariance (n, 3, 3) of the residuals' noise, and the residuals (n, 3)."""
    M = np.concatenate([np.eye(3) - R, np.eye(3)], axis=1)  # r's noise is (I - R) dX + dU
    return M @ cov @ M.T, moved - d - arm @ R.T


def _deformation(r: Float, noise: Float, weight: Float) -> float:
    """Return the isotropic variance that with the noise explains the residuals; zero where noise alone does."""
    from scipy.optimize import brentq  # slow to load, and not every start needs it

    spread, axes = np.linalg.eigh(noise)
    q = np.einsum("nab,na->nb", axes, r) ** 2 * weight[:, None]
    share = 3.0 * float(weight.sum())

    def over(extra: float) -> float:
        return float((q / (spread + extra)).sum()) - share

    upper = float(q.sum()) / share
    return float(brentq(over, 0.0, upper)) if upper > 0.0 and over(0.0) > 0.0 else 0.0


def without_rigid_motion(field: Field, motion: RigidMotion, *, shared: SharedPixels) -> Field:
    """Return the field with the body moved back: U' = R^T (X + U - c - d) + c - X.

    Shape, normals and stretch stay; rotations become R^T times theirs. The covariance holds the points' own noise, the
    fitted motion's, and the covariance between both.
    """
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    assert field.uvw_mm is not None
    R, valid = motion.rotation, field.valid
    back = (field.xyz_mm + field.uvw_mm - motion.centre_mm - motion.translation_mm) @ R  # rows times R: R^T applied
    uvw = back + motion.centre_mm - field.xyz_mm
    rotation = field.rotation_rad
    if rotation is not None:
        turned = np.full(rotation.shape, np.nan)
        if valid.any():
            turned[valid] = (Rotation.from_matrix(R.T) * Rotation.from_rotvec(rotation[valid])).as_rotvec()
        rotation = turned
    # dX' = dX; dU' = (R^T - I) dX + R^T dU - R^T [-(R (X - c)) x, I] dp
    J = np.block([[np.eye(3), np.zeros((3, 3))], [R.T - np.eye(3), R.T]])
    arm = (field.xyz_mm - motion.centre_mm) @ R.T
    P = np.zeros((*field.shape, 6, 6))
    P[..., 3:, :3] = R.T @ skew(arm)
    P[..., 3:, 3:] = -R.T
    M = np.concatenate([np.eye(3) - R, np.eye(3)], axis=1)

    def moved_back(covariance: Float, of_fit: Float) -> Float:
        roots = roots_of(np.where(valid[..., None, None], covariance, 0.0))
        common = shared.summed(field, motion.gain @ (M @ roots)) @ roots  # (r, c, 6, 6) of dp with dX, dU of the point
        mixed = P @ common @ J.T
        cov = J @ covariance @ J.T + mixed + np.swapaxes(mixed, -1, -2)
        cov = cov + P @ of_fit @ np.swapaxes(P, -1, -2)
        cov[~valid] = np.nan
        return np.asarray(cov)

    cov, at_reference, frozen = moved_back(field.covariance, motion.own_covariance), field.frozen_covariance, None
    if at_reference is not None and motion.reference_covariance is not None:
        frozen = moved_back(at_reference, motion.reference_covariance)[..., 3:, 3:]
    left = None if field.common is None or motion.common is None else J @ field.common + P @ motion.common
    return replace(field, uvw_mm=uvw, rotation_rad=rotation, covariance=cov, common=left, frozen=frozen, starts=None)


def _fit_covariance(field: Field, shared: SharedPixels, gain: Float, R: Float) -> Float:
    M = np.concatenate([np.eye(3) - R, np.eye(3)], axis=1)
    roots = roots_of(np.where(field.valid[..., None, None], field.covariance, 0.0))
    each = gain @ (M @ roots)  # (r, c, 6, 6): white noise to parameters
    total = np.einsum("rcij,rckj->ik", each, shared.summed(field, each))
    return np.asarray(0.5 * (total + total.T))


def _fit_common(field: Field, gain: Float, R: Float) -> Float | None:
    """(6, k): every point's share of the common factor, through the fit."""
    if field.common is None:
        return None
    M = np.concatenate([np.eye(3) - R, np.eye(3)], axis=1)
    held = np.where(field.valid[..., None, None], field.common, 0.0)
    return np.asarray(np.einsum("rcij,rcjk->ik", gain, M @ held))


def _unweighted(arm: Float, moved: Float) -> tuple[Float, Float]:
    """Kabsch's start."""
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    d = moved.mean(axis=0)
    R = Rotation.align_vectors(moved - d, arm)[0].as_matrix()
    return R, d


def _robust_weight(distance2: Float) -> Float:
    scale = MAD_TO_SIGMA * float(np.median(np.sqrt(distance2 / 3.0))) + 1e-30
    return biweight(distance2 / 3.0 / (BIWEIGHT_REACH * scale) ** 2)


def _vector_slope(v: Float) -> Float:
    """Derivative of the rotation vector of exp(w) R over a small w: the inverse left Jacobian of SO(3)."""
    angle = float(np.linalg.norm(v))
    K = skew(v)
    if angle < 1e-6:
        return np.asarray(np.eye(3) - 0.5 * K + K @ K / 12.0)
    factor = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    return np.asarray(np.eye(3) - 0.5 * K + factor * K @ K)


def _check_spread(x: Float) -> None:
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False) if len(x) >= _MIN_POINTS else np.zeros(2)
    if spread[1] <= _LINE * spread[0]:
        raise MeasurementError(
            f"{len(x)} points are left, or they lie on one line: they determine no rigid motion.",
            code="too_few_points",
            remedy="Choose three or more valid points that span an area.",
        )
