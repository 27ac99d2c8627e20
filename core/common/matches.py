"""Effect of the three comparisons' errors on a measured point: the estimator's derivative over its matches.

A comparison's error is a shift on the surface, stated in px of camera 1's reference image, in which the subset is laid:
of camera 2's reference, of camera 1's current and of camera 2's current image. The position comes from the first alone,
as the shape does; the displacement from all three, weighted as the matching weighs them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.derivatives import WEIGHTS, ReferenceView
from stereorig.core.matching.geometry import tangent_frames


class Matches(NamedTuple):
    """Images of points and their local maps.

    Attributes
    ----------
    images_px
        (n, k, 2) where the model has the points: camera 2 at the reference and, with displacements, camera 1 and camera
        2 now.
    maps
        (n, k, 2, 2) derivatives of these over camera 1's reference image, along the surface.
    across
        (n, k, 2) change of these images for a unit of the epipolar offset: zero in camera 1.
    gain
        (n, 3, 2) derivative of X, Y, Z over the shift of the one comparison, or (n, 6, 6) of X, Y, Z, U, V, W over the
        shifts of all three, mm per px of camera 1's reference image.
    laid
        (n, 2, 2) mm along the surface's tangents per px of camera 1's reference image.
    """

    images_px: Float
    maps: Float
    across: Float
    gain: Float
    laid: Float


def match_gain(
    pair: StereoPair,
    points_mm: Float,
    normals_sys: Float,
    displaced_mm: Float | None = None,
    tangents_now: Float | None = None,
) -> Matches:
    """Return the effect of shifts of the comparisons on measured points.

    Parameters
    ----------
    pair
        The cameras.
    points_mm
        (n, 3) points at the reference, system frame.
    normals_sys
        (n, 3) unit normals of the surface there.
    displaced_mm
        (n, 3) their current positions.
    tangents_now
        (n, 3, 2) current tangents, of :func:`stereorig.core.matching.geometry.tangent_frames` at the reference;
        unchanged if None.
    """
    n = len(points_mm)
    tangents = tangent_frames(normals_sys)[..., :2]
    seen = ReferenceView.of(pair, points_mm)
    ray, across, A2 = seen.ray, seen.across, seen.by_point2
    laid = np.linalg.inv(seen.by_point1 @ tangents)
    first = A2 @ tangents @ laid
    back = np.linalg.inv(first)
    depth, sideways = (back @ A2 @ ray[..., None])[..., 0], (back @ across[..., None])[..., 0]
    solved = np.linalg.inv(np.stack([depth, sideways], axis=-1))  # derivatives of depth and offset over the shift
    alone = ray[..., None] * solved[:, :1]
    image2 = pair.cam2.project(points_mm).xy
    if displaced_mm is None:
        return Matches(image2[:, None], first[:, None], across[:, None], alone, np.asarray(laid))
    moved = tangents if tangents_now is None else tangents_now
    now1, now2 = pair.cam1.point_jacobian(displaced_mm), pair.cam2.point_jacobian(displaced_mm)
    maps = [now1 @ moved @ laid, now2 @ moved @ laid]
    inverse = [np.linalg.inv(m) for m in maps]
    across_now = seen.carried(displaced_mm)
    # unknowns depth along camera 1's ray, offset, current X Y Z; all equations in px of camera 1's reference image
    A = np.zeros((n, 6, 5))
    A[:, :2, 0], A[:, :2, 1] = depth, sideways
    A[:, 2:4, 2:], A[:, 4:, 2:] = inverse[0] @ now1, inverse[1] @ now2
    A[:, 4:, 1] = (inverse[1] @ across_now[..., None])[..., 0]
    At = np.swapaxes(A, 1, 2) @ np.kron(WEIGHTS, np.eye(2))
    joint = np.linalg.solve(At @ A, At)
    gain = np.zeros((n, 6, 6))
    gain[:, :3, :2] = alone
    gain[:, 3:] = joint[:, 2:] - ray[..., None] * joint[:, :1]
    images = np.stack([image2, pair.cam1.project(displaced_mm).xy, pair.cam2.project(displaced_mm).xy], axis=1)
    offsets = np.stack([across, np.zeros_like(across), across_now], axis=1)
    return Matches(images, np.stack([first, *maps], axis=1), offsets, gain, np.asarray(laid))


def noise_covariances(gain: Float, laid: Float, variance_px2: float) -> tuple[Float, Float]:
    """Return the covariance of matched points in two parts, by the pair of images whose noise causes it, mm^2.

    Parameters
    ----------
    gain, laid
        Values of :func:`match_gain`.
    variance_px2
        Variance of a shift from one image's noise, mean of both directions' inverse: the pattern is alike in all
        directions on the surface, so that a camera that sees it foreshortened sees steeper gradients.

    Returns
    -------
    tuple
        (n, 3, 3) or (n, 6, 6) from the reference pair's noise, which is common to all steps of a test, and from the
        current pair's; the second is zero for a shape.
    """
    metric = np.swapaxes(laid, 1, 2) @ laid
    metric /= 0.5 * np.trace(metric, axis1=1, axis2=2)[:, None, None]
    root = np.linalg.cholesky(np.linalg.inv(metric))
    n, m, k = gain.shape
    gain = (gain.reshape(n, m, k // 2, 2) @ root[:, None]).reshape(n, m, k)
    if k == 2:
        own = 2.0 * variance_px2 * gain @ np.swapaxes(gain, 1, 2)
        return own, np.zeros_like(own)
    # camera 1's reference is in all three comparisons, camera 2's in the first
    of_reference = np.kron(np.ones((3, 3)) + np.diag([1.0, 0.0, 0.0]), np.eye(2))
    of_step = np.kron(np.diag([0.0, 1.0, 1.0]), np.eye(2))
    gain_t = np.swapaxes(gain, 1, 2)
    return variance_px2 * gain @ of_reference @ gain_t, variance_px2 * gain @ of_step @ gain_t
