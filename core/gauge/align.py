"""Frames of the user's choice: best-fit plane, 3-2-1; and fields expressed in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float
from stereorig.core.common.budget import UNKNOWN, Budget, budgets_through
from stereorig.core.errors import MeasurementError, RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of
from stereorig.core.gauge.sampling import sample

_STRAIGHT = 1e-6
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Alignment:
    """A frame: x_new = R (x - o).

    Attributes
    ----------
    rotation
        (3, 3) R; its rows are the new axes in the old frame.
    origin_mm
        (3,) o, the new origin in the old frame.
    covariance
        (6, 6) of the frame's own errors from the points it was laid through: small rotations about the new X, Y, Z
        (rad), and the origin's error along them (mm). The user defines the frame by these points, so it is reported
        here and not added to every point's covariance.
    residual_rms_mm
        Distance of the points from the plane; 0 for 3-2-1, which goes through its points.
    points
        Number of points that defined it.
    """

    rotation: Float
    origin_mm: Float
    covariance: Float
    residual_rms_mm: float
    points: int
    budgets: tuple[Budget, ...] = (UNKNOWN,) * 6
    """Budgets of the six errors."""
    own_covariance: Float = dataclass_field(default_factory=lambda: np.zeros((6, 6)))
    """(6, 6) the points' own part of it."""
    common: Float | None = None
    """(6, k) common factor of the six errors; None if the field has none."""


def align_plane(
    field: Field, *, shared: SharedPixels, chosen: Bool | None = None, x_direction: ArrayLike = (1.0, 0.0, 0.0)
) -> Alignment:
    """Align the frame with the best-fit plane of the reference shape.

    Z is the plane's normal on the side of the old Z, X the given direction projected into the plane, the origin the
    mean of the points projected onto the plane. Distances count by their expected noise.

    Parameters
    ----------
    field
        Any field; its reference positions are used.
    shared
        The correlation of neighbouring points.
    chosen
        (r, c) True for points that take part; None for all. Invalid points never do.
    x_direction
        (3,) in the old frame.

    Raises
    ------
    MeasurementError
        ``too_few_points`` for fewer than three points or points on one line.
    RegionError
        ``gauge_unusable`` if the direction is normal to the plane.
    """
    used = field.valid if chosen is None else field.valid & chosen
    x = field.xyz_mm[used]
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False) if len(x) >= 3 else np.zeros(2)
    if spread[1] <= _STRAIGHT * spread[0]:
        raise MeasurementError(
            f"{len(x)} points are left, or they lie on one line: no plane can be laid through them.",
            code="too_few_points",
            remedy="Choose three or more valid points that span an area.",
        )
    centre = x.mean(axis=0)
    arm = x - centre
    normal = np.linalg.svd(arm, full_matrices=False)[2][2]
    normal *= 1.0 if normal[2] >= 0.0 else -1.0
    cov = field.covariance[used][:, :3, :3]
    offset = 0.0
    for _ in range(_ROUNDS):
        R = _frame(normal, np.asarray(x_direction, dtype=np.float64))
        local = arm @ R.T
        weight = 1.0 / np.einsum("a,nab,b->n", normal, cov, normal)
        A = np.column_stack([local[:, 1], -local[:, 0], np.ones(len(x))])  # z = a y - b x + offset: turns a, b
        H = (A.T * weight) @ A
        a, b, offset = np.linalg.solve(H, A.T @ (weight * local[:, 2]))
        normal = R.T @ np.array([b, -a, 1.0])
        normal /= np.linalg.norm(normal)
        if max(abs(a), abs(b)) < 1e-14:
            break
    R = _frame(normal, np.asarray(x_direction, dtype=np.float64))
    origin = centre + offset * normal
    gain = np.zeros((*field.shape, 3, 3))
    gain[used] = np.linalg.solve(H, (A * weight[:, None]).T).T[:, :, None] * R[2]
    roots = roots_of(np.where(field.valid[..., None, None], field.covariance[..., :3, :3], 0.0))
    each = gain @ roots
    three = np.einsum("rcij,rckj->ik", each, shared.positions.summed(field, each))
    own = np.zeros((6, 6))
    full, position = np.zeros((6, 6)), np.ix_([0, 1, 5], [0, 1, 5])
    own[position] = 0.5 * (three + three.T)
    row = None
    if field.common is not None:
        shift = np.einsum("rcij,rcjk->ik", gain, np.where(field.valid[..., None, None], field.common[..., :3, :], 0.0))
        three = three + shift @ shift.T
        row = np.zeros((6, shift.shape[1]))
        row[[0, 1, 5]] = shift
    full[position] = 0.5 * (three + three.T)
    # positions have the reference pair's noise alone
    budgets = budgets_through(np.eye(6), own, own, row, field.causes)
    rms = float(np.sqrt(np.mean(((x - origin) @ normal) ** 2)))
    return Alignment(R, origin, full, rms, len(x), budgets, own, row)


def image_rows(field: Field) -> Float:
    """Return the direction (3,), of length 1, in which the reference shape runs along camera 1's image rows.

    It is the direction of the plane that the reference positions follow over the image; for a curved surface a mean.

    Raises
    ------
    MeasurementError
        ``too_few_points`` for fewer than three valid points, or points on one line of the image.
    """
    used = field.valid
    at = np.stack([field.x_px[used], field.y_px[used]], axis=-1)
    arm = at - at.mean(axis=0) if len(at) else at
    if len(at) < 3 or np.linalg.matrix_rank(arm) < 2:
        raise MeasurementError(
            f"{len(at)} points are left, or they lie on one line: the direction of the image's rows is not known.",
            code="too_few_points",
            remedy="Choose three or more valid points that span an area.",
        )
    x = field.xyz_mm[used]
    along = np.linalg.lstsq(arm, x - x.mean(axis=0), rcond=None)[0][0]
    return np.asarray(along / np.linalg.norm(along))


def align_given(rotation: ArrayLike, origin_mm: ArrayLike) -> Alignment:
    """Return a frame that is written out: its axes as rows, its origin, both in the old frame.

    Parameters
    ----------
    rotation
        (3, 3), right-handed and orthonormal to 1e-6.
    origin_mm
        (3,).

    Raises
    ------
    RegionError
        ``gauge_unusable`` for anything else than a rotation.
    """
    R, origin = np.asarray(rotation, dtype=np.float64), np.asarray(origin_mm, dtype=np.float64)
    if R.shape != (3, 3) or np.abs(R @ R.T - np.eye(3)).max() > _STRAIGHT or np.linalg.det(R) < 0.0:
        raise RegionError(
            "The rotation is no rotation: its rows must be three perpendicular axes of length 1, right-handed.",
            code="gauge_unusable",
            remedy="Give the new X, Y and Z as rows, in the system frame.",
        )
    # corrects the rounding to the six digits that were written
    u, _, vt = np.linalg.svd(R)
    return Alignment(u @ vt, origin, np.zeros((6, 6)), 0.0, 0)


def align_3_2_1(field: Field, positions_px: ArrayLike, *, shared: SharedPixels) -> Alignment:
    """Align the frame by six positions of the reference: three on the plane, two on the X axis, one at its origin.

    Z is the normal of the first three on the side of the old Z; X runs from the fourth to the fifth, projected into the
    plane; Y = 0 on that line, X = 0 at the sixth, Z = 0 in the plane. A position may be given more than once.

    Parameters
    ----------
    field
        Any field; its reference positions are used.
    positions_px
        (6, 2) in camera 1's reference image.
    shared
        The correlation of neighbouring points.

    Raises
    ------
    RegionError
        ``gauge_outside``; ``gauge_unusable`` for other than six positions, three on one line, or two that are one.
    MeasurementError
        ``too_few_points`` if a position has no valid point about it.
    """
    xy = np.asarray(positions_px, dtype=np.float64)
    if xy.shape != (6, 2):
        raise RegionError(
            f"3-2-1 takes six positions, got an array of shape {xy.shape}.",
            code="gauge_unusable",
            remedy="Give three positions on the plane, two on the line, one at the origin.",
        )
    positions = sample(field, xy)
    if not positions.found.all():
        k = int(np.argmin(positions.found))
        raise MeasurementError(
            f"Position {k + 1} of 3-2-1, ({xy[k, 0]:g}, {xy[k, 1]:g}) px, has no measured point about it: "
            f"{positions.missing[k]}.",
            code="too_few_points",
            remedy="Choose positions where the shape was measured.",
        )
    x = positions.of(field.xyz_mm)
    R, origin = three_two_one(x)
    joint = own = positions.position_covariance(shared)
    common, shift = positions.common(), None
    if common is not None:
        shift = common[:, :3].reshape(18, -1)
        joint = joint + shift @ shift.T
    slope = np.empty((6, 18))
    step = 1e-5 * float(np.abs(x - x.mean(axis=0)).max())
    for k in range(18):
        ends = []
        for sign in (1.0, -1.0):
            moved = x.copy().ravel()
            moved[k] += sign * step
            R2, o2 = three_two_one(moved.reshape(6, 3))
            turn = R @ R2.T  # rotation of the new axes, along the new axes
            ends.append(np.concatenate([[turn[2, 1], turn[0, 2], turn[1, 0]], R @ (o2 - origin)]))
        slope[:, k] = (ends[0] - ends[1]) / (2.0 * step)
    budgets = budgets_through(slope, own, own, shift, field.causes)
    return Alignment(
        R,
        origin,
        slope @ joint @ slope.T,
        0.0,
        6,
        budgets,
        slope @ own @ slope.T,
        None if shift is None else slope @ shift,
    )


def three_two_one(x: Float) -> tuple[Float, Float]:
    """Return axes (rows) and origin of the frame through six positions (6, 3), see :func:`align_3_2_1`.

    Raises
    ------
    RegionError
        ``gauge_unusable`` for three on one line, or two that are one.
    """
    normal = np.cross(x[1] - x[0], x[2] - x[0])
    size = float(np.linalg.norm(normal))
    reach = max(float(np.linalg.norm(x[1] - x[0])), float(np.linalg.norm(x[2] - x[0])))
    if size <= _STRAIGHT * reach**2:
        raise RegionError(
            "The three positions of the plane lie on one line.",
            code="gauge_unusable",
            remedy="Choose three positions that span a plane.",
        )
    normal *= (1.0 if normal[2] >= 0.0 else -1.0) / size
    R = _frame(normal, x[4] - x[3])
    along = np.array([R[0] @ x[5], R[1] @ x[3], R[2] @ x[0]])
    return R, R.T @ along


def _frame(normal: Float, direction: Float) -> Float:
    x = direction - (direction @ normal) * normal
    size = float(np.linalg.norm(x))
    if not np.isfinite(size) or size <= _STRAIGHT * float(np.linalg.norm(direction)):
        raise RegionError(
            "The direction of X is normal to the plane, or has no length.",
            code="gauge_unusable",
            remedy="Give a direction that runs along the plane.",
        )
    x /= size
    return np.stack([x, np.cross(normal, x), normal])


def aligned(field: Field, alignment: Alignment) -> Field:
    """Return the field in the new frame: positions, normals, displacements, rotations, covariances.

    Camera quantities (pixels, Eq. (12)'s angles), stretch and curvature refer to the patch and stay.
    """
    R = alignment.rotation
    n = field.covariance.shape[-1] // 3
    J = np.kron(np.eye(n), R)
    covariance = J @ field.covariance @ J.T
    k = np.arange(covariance.shape[-1])
    # a point known along a direction exactly is given a variance of -1e-20 there by rounding
    covariance[..., k, k] = np.maximum(covariance[..., k, k], 0.0)
    return replace(
        field,
        xyz_mm=(field.xyz_mm - alignment.origin_mm) @ R.T,
        normal_sys=field.normal_sys @ R.T,
        uvw_mm=None if field.uvw_mm is None else field.uvw_mm @ R.T,
        rotation_rad=None if field.rotation_rad is None else field.rotation_rad @ R.T,
        covariance=covariance,
        common=None if field.common is None else J @ field.common,
        frozen=None if field.frozen is None else R @ field.frozen @ R.T,
        starts=None,
    )
