"""Derivatives of measured positions and displacements over the cameras' parameters, at the same images.

A measured point is what the estimator makes of the matches: it stays on camera 1's ray of its pixel, its image in
camera 2 may lie off that of the ray by an offset across the epipolar line, and the same offset is taken out of camera
2's current image. All three comparisons determine it, weighted as the matching weighs them: two of them share the
reference's noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.arrays import Float
from core.calibration.uncertainty import image_derivatives
from core.cameras.stereo import StereoPair

#: of the comparisons camera 2 at t0, camera 1 and camera 2 at t: the inverse of noise I plus the reference's in all
_WEIGHTS = np.eye(3) - 0.25
_NOISE = np.kron(np.eye(3) + 1.0, np.eye(2))


def measured_derivatives(
    pair: StereoPair, points_mm: Float, names: Sequence[str], displaced_mm: Float | None = None
) -> Float:
    """Return derivatives of measured points over parameters by name, all images held.

    Parameters
    ----------
    pair
        The cameras.
    points_mm
        (n, 3) points at the reference, system frame.
    names
        The parameters: ``cam1.`` or ``cam2.`` and a name of the camera's parameters.
    displaced_mm
        (n, 3) their current positions.

    Returns
    -------
    Float
        (n, 3, len(names)) of X, Y, Z; with ``displaced_mm`` (n, 6, len(names)) of X, Y, Z, U, V, W. mm a unit.
    """
    n, p = len(points_mm), len(names)
    A1, A2 = pair.cam1.point_jacobian(points_mm), pair.cam2.point_jacobian(points_mm)
    B = image_derivatives(pair, points_mm, names)
    across = _across(pair, points_mm)
    # unknowns X Y Z, offset; equations camera 1 exactly, camera 2
    first = np.zeros((n, 4, 4))
    first[:, :2, :3], first[:, 2:, :3], first[:, 2:, 3] = A1, A2, across
    alone = -np.linalg.solve(first, B)
    if displaced_mm is None:
        return np.asarray(alone[:, :3])
    # what camera 1's equations at t0 say is put in: the point moves by ray d + given
    given = -np.linalg.pinv(A1) @ B[:, :2]
    ray, A = _equations(pair, points_mm, displaced_mm)
    B_now = image_derivatives(pair, displaced_mm, names)
    known = np.concatenate([B[:, 2:] + A2 @ given, B_now], axis=1)
    solved = -_gain(A) @ known
    at_reference = ray[..., None] * solved[:, :1] + given
    out = np.empty((n, 6, p))
    out[:, :3] = alone[:, :3]
    out[:, 3:] = solved[:, 2:] - at_reference
    return out


def new_noise_share(pair: StereoPair, points_mm: Float, displaced_mm: Float) -> Float:
    """Return the share of the noise of U, V, W that is new at t; all else is the reference pair's, in all steps alike.

    The reference subset's noise is in all three comparisons, that of camera 2's match at t0 in the first.

    Parameters
    ----------
    pair
        The cameras.
    points_mm, displaced_mm
        (n, 3) points at the reference and at t, system frame.

    Returns
    -------
    Float
        (n, 3, 3) symmetric S, eigenvalues 0 to 1: of a covariance C with symmetric root R the part R S R is new.
    """
    ray, A = _equations(pair, points_mm, displaced_mm)
    to_uvw = np.zeros((len(points_mm), 3, 5))
    to_uvw[:, :, 0], to_uvw[:, :, 2:] = -ray, np.eye(3)
    gain = to_uvw @ _gain(A)
    new = gain[:, :, 2:]
    every = gain @ _NOISE @ np.swapaxes(gain, 1, 2)
    value, vector = np.linalg.eigh(every)
    half = (vector / np.sqrt(value)[:, None, :]) @ np.swapaxes(vector, 1, 2)
    part = half @ new
    return np.asarray(part @ np.swapaxes(part, 1, 2))


def _equations(pair: StereoPair, points_mm: Float, displaced_mm: Float) -> tuple[Float, Float]:
    """(n, 3) unit rays of camera 1, and (n, 6, 5) the comparisons' derivatives.

    Unknowns depth along camera 1's ray, offset, current X Y Z; equations camera 2 at t0, camera 1 and 2 at t.
    """
    A2 = pair.cam2.point_jacobian(points_mm)
    ray = points_mm - pair.cam1.centre_sys_mm
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = _across(pair, points_mm)
    now1, now2 = pair.cam1.point_jacobian(displaced_mm), pair.cam2.point_jacobian(displaced_mm)
    across_now = _carried(pair, points_mm, displaced_mm, across)
    A = np.zeros((len(points_mm), 6, 5))
    A[:, :2, 0], A[:, :2, 1] = (A2 @ ray[..., None])[..., 0], across
    A[:, 2:4, 2:], A[:, 4:, 2:], A[:, 4:, 1] = now1, now2, across_now
    return ray, A


def _gain(A: Float) -> Float:
    """(n, 5, 6) of the unknowns over what the comparisons show."""
    At = np.swapaxes(A, 1, 2) @ np.kron(_WEIGHTS, np.eye(2))
    return np.asarray(np.linalg.solve(At @ A, At))


def _across(pair: StereoPair, points_mm: Float) -> Float:
    """(n, 2) unit vectors across the epipolar lines in camera 2's image."""
    along = pair.cam2.point_jacobian(points_mm) @ (points_mm - pair.cam1.centre_sys_mm)[..., None]
    along = along[..., 0] / np.linalg.norm(along[..., 0], axis=1, keepdims=True)
    return np.stack([-along[:, 1], along[:, 0]], axis=-1)


def _carried(pair: StereoPair, points_mm: Float, displaced_mm: Float, across: Float) -> Float:
    """(n, 2) the same shift of the normalised image, in px at the current position."""

    def lens_jacobian(points: Float) -> Float:
        p = pair.cam2.cam_from_sys.apply(points)
        return pair.cam2.lens.image_jacobian(p[:, :2] / p[:, 2:])

    normalised = np.linalg.solve(lens_jacobian(points_mm), across[..., None])
    return np.asarray((lens_jacobian(displaced_mm) @ normalised)[..., 0])
