"""Conversion of the matcher's unknowns to lengths and angles, with their covariances.

Camera 1's frame is ``cam1``; results are in the system frame unless a name gives another one. All arrays run over N
points; NaN in gives NaN out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair

_NEAR_HALF_TURN = -0.99  # cosine, 8 degrees: nearer, the skew part has lost a digit and more


@dataclass(frozen=True, eq=False)
class ShapeGeometry:
    """Shape at N points.

    Attributes
    ----------
    xyz_mm
        (N, 3) surface points, system frame.
    normal_sys
        (N, 3) unit normals, system frame, pointing away from camera 1 (+Z_sys on the target).
    theta_rad, phi_rad, zp_mm
        (N,) the plane of Eq. (12) in camera 1's frame: angles of its normal with X and Y, and where the optic axis
        meets it; ``zp_mm`` is negative or infinite where the axis does not meet the plane before the camera.
    """

    xyz_mm: Float
    normal_sys: Float
    theta_rad: Float
    phi_rad: Float
    zp_mm: Float


@dataclass(frozen=True, eq=False)
class MotionGeometry:
    """Motion at N points, system frame.

    Attributes
    ----------
    uvw_mm
        (N, 3) displacement.
    rotation_rad
        (N, 3) rotation vector of the patch (axis times angle).
    stretch
        (N, 3) in-plane stretch minus one (Biot strain) e11, e22, e12 in the patch's tangent frame: axis 1 is X_sys
        projected on the reference patch, axis 2 completes it with the normal.
    """

    uvw_mm: Float
    rotation_rad: Float
    stretch: Float


def shape_geometry(pair: StereoPair, xy_px: ArrayLike, w: ArrayLike) -> ShapeGeometry:
    """Return surface points, normals and the angles of Helm et al., Eq. (12).

    Parameters
    ----------
    pair
        The calibrated cameras.
    xy_px
        (N, 2) points in camera 1.
    w
        (N, 3) inverse depth, 1/mm, and its slopes; of (N, 6) the first three.
    """
    ray = pair.cam1.rays_cam(xy_px).xyz_mm
    plane = _plane(ray, np.asarray(w, dtype=np.float64))
    xyz = pair.cam1.sys_from_cam.apply(ray / np.asarray(w)[..., :1])
    length = np.linalg.norm(plane, axis=-1)
    normal = plane / length[..., None]
    # Eq. (12) takes the normal with cos(xi) >= 0
    upward = np.where(normal[..., 2:] < 0.0, -normal, normal)
    with np.errstate(divide="ignore"):
        zp = 1.0 / plane[..., 2]
    return ShapeGeometry(
        xyz_mm=xyz,
        normal_sys=normal @ pair.cam1.cam_from_sys.rotation,
        theta_rad=np.arccos(upward[..., 0]),
        phi_rad=np.arccos(upward[..., 1]),
        zp_mm=zp,
    )


def principal_curvatures(pair: StereoPair, xy_px: ArrayLike, w: ArrayLike) -> Float:
    """Return principal curvatures (N, 2) of the surface, 1/mm, the larger first; positive for a bulge to camera 1.

    Parameters
    ----------
    pair, xy_px
        As in :func:`shape_geometry`.
    w
        (N, 6) inverse depth as a second-order polynomial: ``w0 + w1 X + w2 Y + w3 X^2 + w4 X Y + w5 Y^2``.

    Notes
    -----
    The surface is P = (Xc + X, Yc + Y, 1) / w(X, Y). With w P linear in X and Y, the second fundamental form is
    -w_ij (n . P) / w, with n . P > 0 for the normal that points away from camera 1.
    """
    w = np.asarray(w, dtype=np.float64)
    ray = pair.cam1.rays_cam(xy_px).xyz_mm
    plane = _plane(ray, w)
    basis = np.zeros((*w.shape[:-1], 3, 2))
    basis[..., 0, 0] = basis[..., 1, 1] = 1.0
    tangents = (basis - ray[..., None] * (w[..., None, 1:3] / w[..., :1, None])) / w[..., :1, None]
    first = np.swapaxes(tangents, -1, -2) @ tangents
    # n . P is one over the length of the plane's vector
    scale = -1.0 / (w[..., 0] * np.linalg.norm(plane, axis=-1))
    second = np.stack([2.0 * w[..., 3], w[..., 4], w[..., 4], 2.0 * w[..., 5]], axis=-1)
    operator = _inverse2(first) @ (second * scale[..., None]).reshape(*w.shape[:-1], 2, 2)
    mean = 0.5 * (operator[..., 0, 0] + operator[..., 1, 1])
    det = operator[..., 0, 0] * operator[..., 1, 1] - operator[..., 0, 1] * operator[..., 1, 0]
    half_difference = np.sqrt(np.maximum(mean**2 - det, 0.0))
    return np.stack([mean + half_difference, mean - half_difference], axis=-1)


def plane_from_angles(
    pair: StereoPair, xy_px: ArrayLike, theta_rad: ArrayLike, phi_rad: ArrayLike, zp_mm: ArrayLike
) -> Float:
    """Return ``w`` (N, 3) of the plane that Eq. (12) gives; the inverse of :func:`shape_geometry`."""
    ray = pair.cam1.rays_cam(xy_px).xyz_mm
    a, b = np.cos(theta_rad), np.cos(phi_rad)
    c = np.sqrt(1.0 - a**2 - b**2)
    plane = np.stack([a, b, c], axis=-1) / (np.asarray(zp_mm) * c)[..., None]
    return np.stack([(ray * plane).sum(-1), plane[..., 0], plane[..., 1]], axis=-1)


def motion_geometry(pair: StereoPair, xy_px: ArrayLike, w: ArrayLike, G: ArrayLike) -> MotionGeometry:
    """Return displacement, rotation and in-plane stretch of the patches.

    Parameters
    ----------
    pair, xy_px, w
        As in :func:`shape_geometry`.
    G
        (N, 3, 3) or (N, 3, 6), see :class:`stereorig.core.matching.MotionFit`. Second-order terms have no effect in the
        middle of the patch, where all of this is reported.
    """
    from stereorig.core.matching.moved import motions  # slow to load, and not every start needs it

    ray = pair.cam1.rays_cam(xy_px).xyz_mm
    uvw, turned, stretch = motions(ray, np.asarray(w), np.asarray(G), pair.cam1.cam_from_sys.rotation)
    return MotionGeometry(uvw_mm=uvw, rotation_rad=_rotation_vectors(turned), stretch=stretch)


def covariance_xyz(pair: StereoPair, xy_px: ArrayLike, w: ArrayLike, covariance: ArrayLike) -> Float:
    """Return the covariance (N, 3, 3) of XYZ, mm^2, system frame, from a shape fit's (N, 2, 2).

    The pixel is exact by definition, so the point can only move along its ray: the matrix has rank one.
    """
    J = _xyz_jacobian(pair, xy_px, np.asarray(w, dtype=np.float64))
    return np.asarray(J[..., :, None] * J[..., None, :] * np.asarray(covariance)[..., :1, :1])


def covariance_xyzuvw(pair: StereoPair, xy_px: ArrayLike, w: ArrayLike, G: ArrayLike, covariance: ArrayLike) -> Float:
    """Return the covariance (N, 6, 6) of X Y Z u v w in mm^2, system frame, from a motion fit's (N, 5, 5)."""
    from stereorig.core.matching.moved import covariances  # slow to load, and not every start needs it

    ray = pair.cam1.rays_cam(xy_px).xyz_mm
    R = pair.cam1.cam_from_sys.rotation
    return covariances(ray, np.asarray(w), np.asarray(G), R, np.asarray(covariance))


def _xyz_jacobian(pair: StereoPair, xy_px: ArrayLike, w: Float) -> Float:
    ray = pair.cam1.rays_cam(xy_px).xyz_mm
    return np.asarray(-(ray / w[..., :1] ** 2) @ pair.cam1.cam_from_sys.rotation)


def _plane(ray: Float, w: Float) -> Float:
    """Vector n with n . P = 1 on the plane, camera 1's frame."""
    return np.stack([w[..., 1], w[..., 2], w[..., 0] - w[..., 1] * ray[..., 0] - w[..., 2] * ray[..., 1]], axis=-1)


def tangent_frames(normals: Float) -> Float:
    """Columns: X_sys projected on the patch (Y_sys where the patch is normal to X_sys), its partner, the normal."""
    n = _unit(np.ascontiguousarray(np.moveaxis(normals, -1, 0)))  # one component of all points after another
    steep = np.abs(n[0]) > 0.999
    axis = np.stack([~steep, steep, np.zeros_like(steep)]).astype(np.float64)
    a = _unit(axis - n * (axis * n).sum(axis=0))
    frames = np.stack([a, np.cross(n, a, axis=0), n], axis=1)
    return np.ascontiguousarray(np.moveaxis(frames, (0, 1), (-2, -1)))


def _unit(vectors: Float) -> Float:
    """(3, ...) of length one."""
    return np.asarray(vectors / np.sqrt((vectors**2).sum(axis=0)))


def _inverse2(m: Float) -> Float:
    det = m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0]
    out = np.empty_like(m)
    out[..., 0, 0], out[..., 1, 1] = m[..., 1, 1], m[..., 0, 0]
    out[..., 0, 1], out[..., 1, 0] = -m[..., 0, 1], -m[..., 1, 0]
    return np.asarray(out / det[..., None, None])


def _rotation_vectors(rotation: Float) -> Float:
    """Axis times angle: from the skew part, or from the quaternion near half a turn (zero skew part)."""
    r = rotation
    skew = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], axis=-1)
    trace = np.trace(r, axis1=-2, axis2=-1)
    sine = 0.5 * np.linalg.norm(skew, axis=-1)
    angle = np.arctan2(sine, 0.5 * (trace - 1.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(sine > 1e-8, 0.5 * angle / sine, 0.5)
        half_turn = 0.5 * (trace - 1.0) < _NEAR_HALF_TURN
    out = np.asarray(skew * factor[..., None])
    if half_turn.any():
        out[half_turn] = Rotation.from_matrix(r[half_turn]).as_rotvec()
    return out
