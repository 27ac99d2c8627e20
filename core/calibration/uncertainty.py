"""Uncertainty of points in the target's volume, from the parameters' covariance.

Single parameters correlate at 0.9998 and more and nearly cancel in 3-D, so that a calibration is assessed by points in
space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.inputs import AnyTarget, extent_mm, half_sides_mm
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS


@dataclass(frozen=True)
class VolumeUncertainty:
    """Predicted standard deviations over the calibrated volume, from the calibration alone.

    Attributes
    ----------
    points_mm
        (n, 3) the points, system frame.
    sigma_mm
        (n, 3) standard deviation of each triangulated point's coordinates.
    shape_rms_mm
        Root mean square over points and coordinates without the common rigid motion: the part that deforms shapes.
    relative_shape
        ``shape_rms_mm`` over the target's extent.
    scale
        Standard deviation of the common scale (1 = 100 %).
    centre_z_mm, corner_z_mm
        Standard deviation of Z at the target's centre, and the largest at its corners.
    centre_px
        Largest standard deviation of an image centre coordinate of either camera. Only the travel determines it.
    standoff_relative
        Largest standard deviation of a standoff, relative to the standoff.
    """

    points_mm: Float
    sigma_mm: Float
    shape_rms_mm: float
    relative_shape: float
    scale: float
    centre_z_mm: float
    corner_z_mm: float
    centre_px: float
    standoff_relative: float


def image_derivatives(pair: StereoPair, points_mm: Float, names: Sequence[str]) -> Float:
    """Return d(images in both cameras, x1 y1 x2 y2) / d(parameters by name), (n, 4, len(names)).

    ``names`` are names as in a calibration's covariance: ``cam1.`` or ``cam2.`` and a name of the camera's parameters.
    """
    B = np.zeros((len(points_mm), 4, len(names)))
    for c, (prefix, camera) in enumerate(zip(CAMERAS, (pair.cam1, pair.cam2), strict=True)):
        own = [(k, name.removeprefix(f"{prefix}.")) for k, name in enumerate(names) if name.startswith(f"{prefix}.")]
        known = camera.parameter_names
        jacobian = camera.parameter_jacobian(points_mm)
        B[:, 2 * c : 2 * c + 2, [k for k, _ in own]] = jacobian[..., [known.index(name) for _, name in own]]
    return B


def point_derivatives(pair: StereoPair, points_mm: Float, names: Sequence[str]) -> Float:
    """Return d(triangulated point) / d(parameters by name) at fixed image points, (n, 3, len(names))."""
    return -triangulated(pair, points_mm, image_derivatives(pair, points_mm, names))


def triangulated(pair: StereoPair, points_mm: Float, images_px: Float) -> Float:
    """Return the shifts (n, 3, q) of points (n, 3) by shifts (n, 4, q) of their images in both cameras.

    Least-squares triangulation: with A = d(images)/d(point), images moved by B move the point by (A'A)^-1 A' B.
    """
    A = np.concatenate([pair.cam1.point_jacobian(points_mm), pair.cam2.point_jacobian(points_mm)], axis=-2)
    At = np.swapaxes(A, 1, 2)
    return np.asarray(np.linalg.solve(At @ A, At @ images_px))


def _motions(points_mm: Float) -> Float:
    """Return displacements (3 n, 7) of points (n, 3): three shifts, three turns, one scale."""
    arm = points_mm - points_mm.mean(axis=0)
    motions = np.zeros((len(arm), 3, 7))
    motions[:, range(3), range(3)] = 1.0
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
    motions[:, :, 6] = arm
    return motions.reshape(-1, 7)


def shape_of(points_mm: Float, moved: Float) -> Float:
    """Return displacements (3 n, q) of points (n, 3) without the common rigid motion."""
    rigid = _motions(points_mm)[:, :6]
    return np.asarray(moved - rigid @ np.linalg.lstsq(rigid, moved, rcond=None)[0])


def volume_points_mm(target: AnyTarget) -> Float:
    """5 x 5 x 3 points over the target's points at dZ = 0 and a quarter of their extent in depth, (75, 3)."""
    half = half_sides_mm(target)
    x, y = np.linspace(-half[0], half[0], 5), np.linspace(-half[1], half[1], 5)
    z = np.array([-1.0, 0.0, 1.0]) * extent_mm(target) / 8.0
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def volume_uncertainty(
    pair: StereoPair, covariance: Float, target: AnyTarget, names: Sequence[str], points_mm: Float | None = None
) -> VolumeUncertainty:
    """Propagate the covariance of both cameras' parameters, by name, to points in the calibrated volume.

    ``points_mm`` (n, 3) are the points; by default the points from :func:`volume_points_mm`.
    """
    points = volume_points_mm(target) if points_mm is None else points_mm
    G = point_derivatives(pair, points, names)
    cov = G @ covariance @ np.swapaxes(G, 1, 2)
    sigma = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
    middle = points.mean(axis=0)
    flat = G.reshape(-1, G.shape[2])
    shape = shape_of(points, flat)
    shape_variance = float(np.einsum("ip,pq,iq->", shape, covariance, shape, optimize=True)) / len(flat)
    scale_row = np.linalg.lstsq(_motions(points), flat, rcond=None)[0][6]
    shape_rms = float(np.sqrt(max(shape_variance, 0.0)))
    by_name = dict(zip(names, np.sqrt(np.maximum(np.diagonal(covariance), 0.0)).tolist(), strict=True))
    depths = {n: c.cam_from_sys.translation_mm[2] for n, c in zip(CAMERAS, (pair.cam1, pair.cam2), strict=True)}
    nearest = int(np.argmin(np.linalg.norm(points - middle, axis=1)))
    flat_z = points[:, 2] == points[nearest, 2]
    reach = np.abs((points - middle)[:, 0] * (points - middle)[:, 1])
    corner = flat_z & (reach == reach[flat_z].max())
    return VolumeUncertainty(
        points,
        sigma,
        shape_rms,
        shape_rms / extent_mm(target),
        float(np.sqrt(max(scale_row @ covariance @ scale_row, 0.0))),
        float(sigma[nearest, 2]),
        float(sigma[corner, 2].max()),
        max(by_name[f"{n}.{axis}"] for n in CAMERAS for axis in ("cx_px", "cy_px")),
        max(by_name[f"{n}.z0_mm"] / float(depth) for n, depth in depths.items()),
    )
