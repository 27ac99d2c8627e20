"""The reference pair's share of a strain's noise: the same in all steps of a test."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.result import Field
from stereorig.core.matching.geometry import tangent_frames
from stereorig.core.strain.result import StrainField
from stereorig.core.strain.tensors import pulls_of, strain_slopes


def reference_share(field: Field, strain: StrainField, points: Bool | None = None) -> Float | None:
    """Return the reference pair's share (r, c, 3) of the own variance of exx, eyy, exy.

    Parameters
    ----------
    field
        The displacement that the strain was computed from.
    strain
        Strain at the same points.
    points
        (r, c) True at the points that are asked for; all of them when left out.

    Returns
    -------
    Float
        NaN at points without strain and points that are not asked for; None if the reference's noise is not known
        separately.

    Notes
    -----
    The strain contains the points' noise along the deformed tangents, and the positions' noise as the motion changes
    it. Both parts are propagated as the strain is, with the same weights of the window.
    """
    if field.frozen is None or not field.has_motion:
        return None
    good = strain.valid & field.valid
    if points is not None:
        good &= points
    frame = tangent_frames(field.normal_sys[good])[..., :2]
    gradient = _moved(field, good, frame) - frame
    per_mm = np.asarray(np.linalg.inv(np.swapaxes(frame, -1, -2) @ _grid_tangents(field)[good]), dtype=np.float64)
    tensor = strain.options.tensor
    by_slope = strain_slopes(pulls_of(frame, gradient, tensor), tensor, per_mm, strain.strain[good]).reshape(-1, 6, 6)
    own = field.covariance[good]
    reference = own.copy()
    reference[:, 3:, 3:] = field.frozen[good]
    # a whole window's slopes are equally sure along columns and rows
    variance, of_reference = (
        ((by_slope @ noise) * by_slope).sum(axis=2).reshape(-1, 3, 2).sum(axis=2) for noise in (own, reference)
    )
    out = np.full((*field.shape, 3), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        out[good] = np.clip(of_reference / variance, 0.0, 1.0)
    return out


def _grid_tangents(field: Field) -> Float:
    """Tangents (r, c, 3, 2) of the grid's columns and rows, mm a step, the median's where a neighbour is missing."""
    out = np.stack([_steps(field.xyz_mm, axis) for axis in (1, 0)], axis=-1)
    known = np.isfinite(out).all(axis=(-1, -2))
    if not known.any():
        return np.broadcast_to(np.eye(3, 2), out.shape)
    if not known.all():
        out[~known] = np.median(out[known], axis=0)
    return np.asarray(out)


def _steps(values: Float, axis: int) -> Float:
    if values.shape[axis] == 1:
        return np.full(values.shape, np.nan)
    return np.asarray(np.gradient(values, axis=axis))


def _moved(field: Field, good: Bool, frame: Float) -> Float:
    """Tangents (n, 3, 2) after the deformation that the patches measured."""
    moved = frame
    if field.stretch is not None:
        e = field.stretch[good]
        moved = moved @ (np.eye(2) + np.stack([e[:, 0], e[:, 2], e[:, 2], e[:, 1]], axis=-1).reshape(-1, 2, 2))
    if field.rotation_rad is not None:
        moved = Rotation.from_rotvec(field.rotation_rad[good]).as_matrix() @ moved
    return np.asarray(moved)
