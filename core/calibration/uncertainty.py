"""Uncertainty of points in the target's volume, from the parameters' covariance.

Single parameters correlate at 0.9998 and more and nearly cancel in 3-D, so that a calibration is assessed by points in
space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import Float
from core.calibration.fit.model import N_CAMERA
from core.calibration.inputs import TargetLike, extent_mm
from core.cameras.stereo import StereoPair


@dataclass(frozen=True)
class VolumeUncertainty:
    """Predicted standard deviations over the target's volume, from the calibration alone.

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


def point_derivatives(pair: StereoPair, points_mm: Float) -> Float:
    """Return d(triangulated point) / d(parameters of both cameras) at fixed image points, (n, 3, 24).

    Least-squares triangulation: with A = d(images)/d(point), the point moves by -(A'A)^-1 A' B. Columns of the axis
    tilts are zero, since measuring happens at dZ = 0.
    """
    A = np.concatenate([pair.cam1.point_jacobian(points_mm), pair.cam2.point_jacobian(points_mm)], axis=-2)
    B = np.zeros((len(points_mm), 4, 2 * N_CAMERA))
    B[:, :2, :10] = pair.cam1.ten_parameter_jacobian(points_mm)
    B[:, 2:, N_CAMERA : N_CAMERA + 10] = pair.cam2.ten_parameter_jacobian(points_mm)
    At = np.swapaxes(A, 1, 2)
    return np.asarray(-np.linalg.solve(At @ A, At @ B))


def volume_points_mm(target: TargetLike) -> Float:
    """5 x 5 x 3 points over the inner intersections and a quarter of their extent in depth, (75, 3)."""
    half = 0.5 * target.pitch_mm * (np.array(target.lines) - 3)
    x, y = np.linspace(-half[0], half[0], 5), np.linspace(-half[1], half[1], 5)
    z = np.array([-1.0, 0.0, 1.0]) * extent_mm(target) / 8.0
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def volume_uncertainty(pair: StereoPair, covariance: Float, target: TargetLike) -> VolumeUncertainty:
    """Propagate the (24, 24) covariance of both cameras' parameters to points in the target's volume."""
    points = volume_points_mm(target)
    G = point_derivatives(pair, points)
    cov = G @ covariance @ np.swapaxes(G, 1, 2)
    sigma = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
    motions = np.zeros((len(points), 3, 7))  # three shifts, three turns, one scale
    motions[:, range(3), range(3)] = 1.0
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], points)
    motions[:, :, 6] = points
    design = motions.reshape(-1, 7)
    flat = G.reshape(-1, G.shape[2])
    rigid = design[:, :6]
    shape = flat - rigid @ np.linalg.lstsq(rigid, flat, rcond=None)[0]
    shape_variance = float(np.einsum("ip,pq,iq->", shape, covariance, shape, optimize=True)) / len(flat)
    scale_row = np.linalg.lstsq(design, flat, rcond=None)[0][6]
    shape_rms = float(np.sqrt(max(shape_variance, 0.0)))
    sigmas = np.sqrt(np.maximum(np.diagonal(covariance), 0.0)).reshape(2, N_CAMERA)
    depths = np.array([camera.cam_from_sys.translation_mm[2] for camera in (pair.cam1, pair.cam2)])
    flat_z = points[:, 2] == 0.0
    radius = np.abs(points[:, :2]).max(axis=1) * flat_z
    corner = flat_z & (np.abs(points[:, 0] * points[:, 1]) == np.abs(points[:, 0] * points[:, 1]).max())
    return VolumeUncertainty(
        points,
        sigma,
        shape_rms,
        shape_rms / extent_mm(target),
        float(np.sqrt(max(scale_row @ covariance @ scale_row, 0.0))),
        float(sigma[flat_z & (radius == 0.0), 2].max()),
        float(sigma[corner, 2].max()),
        float(sigmas[:, 1:3].max()),
        float((sigmas[:, 9] / depths).max()),
    )
