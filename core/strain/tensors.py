"""Strain tensors from displacement gradients on the surface, and the propagation of their errors.

``frame`` (..., 3, 2) holds the unit tangents of the reference surface in its columns, ``gradient`` (..., 3, 2) the
derivatives of the displacement along them. The deformed tangents are P = frame + gradient and C = P^T P.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.matching.geometry import tangent_frames
from stereorig.core.settings import StrainTensor
from stereorig.core.strain.result import principal_of


def strain_of(frame: Float, gradient: Float, tensor: StrainTensor) -> Float:
    """Strain exx, eyy, exy (..., 3) of a surface's displacement gradient.

    Built from the gradient itself and not from C - I, so that small strains keep their digits.
    """
    along = _transposed(frame) @ gradient
    small = 0.5 * (along + _transposed(along))
    if tensor == "infinitesimal":
        return _components(small)
    green = _components(small + 0.5 * _transposed(gradient) @ gradient)
    return hencky_of_green(green) if tensor == "hencky" else green


def strain_of_stretch(stretch: Float, rotation_rad: Float, normals_sys: Float, tensor: StrainTensor) -> Float:
    """Strain (n, 3) of patches whose stretch minus one (Biot strain) e11, e22, e12 and rotation vector are known.

    Parameters
    ----------
    stretch
        (n, 3) in the tangent frame.
    rotation_rad
        (n, 3) rotation vectors, system frame.
    normals_sys
        (n, 3) unit normals of the reference patch.
    tensor
        Which strain.
    """
    biot = _matrix(stretch)
    if tensor == "infinitesimal":
        frame = tangent_frames(normals_sys)[..., :2]
        moved = Rotation.from_rotvec(rotation_rad).as_matrix() @ frame
        return strain_of(frame, moved @ (np.eye(2) + biot) - frame, tensor)
    green = _components(biot + 0.5 * biot @ biot)
    return hencky_of_green(green) if tensor == "hencky" else green


def hencky_of_green(green: Float) -> Float:
    """1/2 log C (..., 3) from Green-Lagrange strain 1/2 (C - I) (..., 3)."""
    e = principal_of(green)
    with np.errstate(invalid="ignore", divide="ignore"):
        h = 0.5 * np.log1p(2.0 * e)
        difference = e[..., 0] - e[..., 1]
        # h = a I + b e with the same principal axes; where both principal values meet, b is the derivative
        slope = np.where(difference > 1e-12, (h[..., 0] - h[..., 1]) / difference, 1.0 / (1.0 + e[..., 0] + e[..., 1]))
    rest = 0.5 * (h[..., 0] + h[..., 1]) - slope * 0.5 * (e[..., 0] + e[..., 1])
    return np.stack([slope * green[..., 0] + rest, slope * green[..., 1] + rest, slope * green[..., 2]], axis=-1)


def as_tensor(small: Float, strain: Float, tensor: StrainTensor) -> Float:
    """Return the change (n, 3) of a strain (n, 3) that a small change of the Green-Lagrange strain makes.

    Infinitesimal strain changes by as much itself.
    """
    return np.einsum("nij,nj->ni", hencky_slope(strain), small) if tensor == "hencky" else small


def strain_slopes(pulls: Float, tensor: StrainTensor, per_mm: Float, strain: Float) -> Float:
    """Return (n, 3, 2, 6), derivatives of exx, eyy, exy over the slopes of X Y Z U V W over column and row.

    Parameters
    ----------
    pulls, tensor
        As in :func:`stereorig.core.strain.on_surface.strain_covariance`.
    per_mm
        (n, 2, 2) steps of column and row (first index) per mm along the frame's axes (second).
    strain
        (n, 3) the strain itself.
    """
    along = pulls[:, :, None, None, :] * np.swapaxes(per_mm, -1, -2)[:, None, :, :, None]  # (n, i, j, a, 6)
    out = np.stack([along[:, 0, 0], along[:, 1, 1], 0.5 * (along[:, 0, 1] + along[:, 1, 0])], axis=1)
    return np.einsum("nij,njab->niab", hencky_slope(strain), out) if tensor == "hencky" else out


def hencky_slope(hencky: Float) -> Float:
    """Return (..., 3, 3), the derivative of Hencky strain over Green-Lagrange strain, components exx, eyy, exy."""
    h = principal_of(hencky)
    inverse = np.exp(-2.0 * h)  # 1 / C
    difference = h[..., 0] - h[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        shear = np.where(
            difference > 1e-9, 2.0 * difference / (1.0 / inverse[..., 0] - 1.0 / inverse[..., 1]), inverse[..., 0]
        )
    angle = 0.5 * np.arctan2(2.0 * hencky[..., 2], hencky[..., 0] - hencky[..., 1])
    diagonal = np.stack([inverse[..., 0], inverse[..., 1], shear], axis=-1)
    return np.asarray(_turn(-angle) @ (diagonal[..., None] * _turn(angle)))


def pulls_of(frame: Float, gradient: Float, tensor: StrainTensor) -> Float:
    """Return A (n, 2, 6): a strain follows as de_ij = 1/2 (A_i . d_j + A_j . d_i).

    :func:`stereorig.core.strain.on_surface.strain_covariance` states the d_i.
    """
    moved = frame + gradient
    if tensor == "infinitesimal":
        of_motion = frame
        # E^T dP with P's own basis changed by dX: d(E^T P) = E^T (dF1 - P E^T dF0), both hold dX; and the frame tilts
        # with the positions, d(E)^T P = (n . dX) (n . P). The other tensors hold P^T P alone, without the frame
        normal = np.cross(frame[..., 0], frame[..., 1])[..., None]
        tilted = normal @ (_transposed(normal) @ moved)
        of_position = frame - frame @ _transposed(_transposed(frame) @ moved) + tilted
    else:
        of_motion = moved
        of_position = moved - frame @ (_transposed(moved) @ moved)
    return _transposed(np.concatenate([of_position, of_motion], axis=-2))


def _turn(angle: Float) -> Float:
    """(..., 3, 3) components in axes turned by ``angle`` from those in the old ones."""
    c, s = np.cos(angle), np.sin(angle)
    rows = [[c**2, s**2, 2.0 * c * s], [s**2, c**2, -2.0 * c * s], [-c * s, c * s, c**2 - s**2]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _transposed(m: Float) -> Float:
    return np.asarray(np.swapaxes(m, -1, -2))


def _components(m: Float) -> Float:
    return np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 0, 1]], axis=-1)


def _matrix(e: Float) -> Float:
    rows = [e[..., 0], e[..., 2], e[..., 2], e[..., 1]]
    return np.stack(rows, axis=-1).reshape(*e.shape[:-1], 2, 2)
