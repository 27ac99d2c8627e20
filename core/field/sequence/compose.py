"""Composition of motions: totals since the first reference from a motion that began at a later step.

A segment is matched against a later step's images. Its unknowns are the matching's, about camera 1's rays at that step:
inverse depth ``w'`` and the matrix ``G'``. With ``D`` the derivative of camera 1's image at the segment's reference
over its image at step 0 and ``T'`` the derivative of the current point over the image at the segment's reference, the
total has

    P = G'_0 / w'_0,    G_0 = w_0 P,    G_j = w_j P + w_0 T' D_j

which is exact for plane patches, and for curved ones in the middle of the patch, where all values are reported.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.matching.geometry import plane_from_angles, tangent_frames

_POINTS_AT_ONCE = 65536
_STRIPS = 32


@dataclass(frozen=True, eq=False)
class Totals:
    """Total motion of n points and their patches since the first reference.

    Attributes
    ----------
    rays
        (n, 3) camera 1's rays to the points at the first reference, (X, Y, 1).
    w, G
        (n, 3), (n, 3, 3) the matcher's unknowns about the points' rays at the first reference.
    """

    rays: Float
    w: Float
    G: Float

    @property
    def current_cam1_mm(self) -> Float:
        """(n, 3) the points at the step, camera 1's frame."""
        return np.asarray(self.G[:, :, 0] / self.w[:, :1])

    @property
    def seen(self) -> Float:
        """(n, 2) the points' positions in camera 1's image at the step, normalised."""
        return np.asarray(self.G[:, :2, 0] / self.G[:, 2:, 0])

    @property
    def image_slopes(self) -> Float:
        """(n, 2, 2) derivative of camera 1's image at the step over its image at the reference, normalised."""
        return image_slopes(self.G)

    @property
    def plane(self) -> Float:
        """(n, 3) inverse depth at the step over camera 1's image: its value at (x, y) is the product with (x, y, 1)."""
        tangents = point_slopes(self.w, self.G)
        normal = np.cross(tangents[:, :, 0], tangents[:, :, 1])
        return np.asarray(normal / np.sum(normal * self.current_cam1_mm, axis=1)[:, None])


def image_slopes(G: Float) -> Float:
    """Return (n, 2, 2), derivative of camera 1's current image over its reference, in the middle of the patches."""
    seen = G[:, :2, 0] / G[:, 2:, 0]
    return np.asarray((G[:, :2, 1:3] - seen[:, :, None] * G[:, 2:, 1:3]) / G[:, 2, 0, None, None])


def point_slopes(w: Float, G: Float) -> Float:
    """Return (n, 3, 2), derivative of the current point, camera 1's frame, over camera 1's reference image."""
    return np.asarray((G[:, :, 1:3] - G[:, :, :1] * (w[:, None, 1:3] / w[:, :1, None])) / w[:, :1, None])


def totals_of(field: Field, pair: StereoPair) -> Totals:
    """Return the totals of a field, NaN at points without one; the same from memory and from its file."""
    if field.uvw_mm is None or field.rotation_rad is None or field.stretch is None:
        raise ValueError("a shape has no motion")
    n = field.x_px.size
    xy = np.stack([field.x_px, field.y_px], axis=-1).reshape(n, 2)
    w, G = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    every = pair.cam1.rays_cam(xy).xyz_mm
    at = np.flatnonzero(field.valid)

    def flat(values: Float, *tail: int) -> Float:
        return np.asarray(values.reshape(n, *tail)[at], dtype=np.float64)

    with np.errstate(invalid="ignore", divide="ignore"):
        w[at] = plane_from_angles(pair, xy[at], flat(field.theta_rad), flat(field.phi_rad), flat(field.zp_mm))
        R = pair.cam1.cam_from_sys.rotation
        rays, wk = every[at], w[at]
        basis = np.zeros((len(at), 3, 2))
        basis[:, 0, 0] = basis[:, 1, 1] = 1.0
        slopes = wk[:, None, 1:] / wk[:, :1, None]
        before = R.T @ (basis - rays[:, :, None] * slopes)
        frame = tangent_frames(flat(field.normal_sys, 3))
        e11, e22, e12 = flat(field.stretch, 3).T
        right = np.stack([1.0 + e11, e12, e12, 1.0 + e22], axis=-1).reshape(-1, 2, 2)
        turned = rotations_of(flat(field.rotation_rad, 3)) @ frame
        after = turned[:, :, :2] @ right @ (np.swapaxes(frame[:, :, :2], 1, 2) @ before)
        first = rays + wk[:, :1] * (flat(field.uvw_mm, 3) @ R.T)
        G[at] = np.concatenate([first[:, :, None], R @ after + first[:, :, None] * slopes], axis=2)
    return Totals(every, w, G)


def rotations_of(vectors: Float) -> Float:
    """Return rotation matrices (n, 3, 3) of rotation vectors (n, 3)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    K = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -z, y, -x
    K -= np.swapaxes(K, 1, 2)
    half = 0.5 * angle
    # sin(a) / a and (1 - cos(a)) / a^2, finite at zero
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(half / np.pi) ** 2 * K @ K)


def follow(start: Totals, w: Float, G: Float) -> Totals:
    """Return the totals (n) after a segment's ``w`` (n, 3), ``G`` (n, 3, 3), about the points' own rays."""
    P = G[:, :, 0] / w[:, :1]
    tangents = point_slopes(w, G) @ start.image_slopes
    first = start.w[:, :1] * P
    rest = P[:, :, None] * start.w[:, None, 1:] + start.w[:, :1, None] * tangents
    return Totals(start.rays, start.w, np.concatenate([first[:, :, None], rest], axis=2))


def since(start: Totals, now: Totals, plane: Float) -> Float:
    """Return the segment's ``G`` (n, 3, 3) that leads from one state to a later one; the inverse of :func:`follow`.

    ``plane`` (n, 3) is the segment's ``w`` about the points' own rays.
    """
    P = now.current_cam1_mm
    tangents = point_slopes(now.w, now.G) @ _inverse(start.image_slopes)
    first = plane[:, :1] * P
    rest = P[:, :, None] * plane[:, None, 1:] + plane[:, :1, None] * tangents
    return np.concatenate([first[:, :, None], rest], axis=2)


def _inverse(m: Float) -> Float:
    det = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
    out = np.empty_like(m)
    out[:, 0, 0], out[:, 1, 1], out[:, 0, 1], out[:, 1, 0] = m[:, 1, 1], m[:, 0, 0], -m[:, 0, 1], -m[:, 1, 0]
    return np.asarray(out / det[:, None, None])


def follow_covariance(start: Totals, w: Float, G: Float, covariance: Float, added: Float) -> Float:
    """Return the covariance (n, 5, 5) of (w0, G00, G10, G20, epipolar offset) of a total.

    Parameters
    ----------
    start
        Totals at the segment's reference.
    w, G, covariance
        (n, 3), (n, 3, 3), (n, 5, 5) of the segment, about the points' own rays.
    added
        (n, 2, 2) covariance to be added to the points' positions in camera 1's current image, normalised.

    Notes
    -----
    The noise of the segment's reference image has moved the point's position one way when it was found there, and moves
    the segment's result the other way: the noise of the first reference's image remains, as if the segment had begun
    there. So the segment's own covariance is taken over, depth on the ray for depth on the ray, and only the part that
    does not cancel is added, along the surface.
    """
    P = G[:, :, 0] / w[:, :1]
    here = np.concatenate([start.seen, np.ones((len(w), 1))], axis=1)
    depth = np.linalg.norm(here, axis=1) / w[:, 0] ** 2  # mm along the ray per unit of w
    ray = start.w[:, 0] ** 2 * depth / np.linalg.norm(start.rays, axis=1)
    ratio = start.w[:, 0] / w[:, 0]
    J = np.zeros((len(w), 5, 5))
    J[:, 0, 0], J[:, 4, 4] = ray, 1.0
    J[:, 1:4, 0] = P * (ray - ratio)[:, None]
    for i in range(1, 4):
        J[:, i, i] = ratio
    out = J @ covariance @ np.swapaxes(J, 1, 2)
    T = start.w[:, :1, None] * (point_slopes(w, G) @ _inverse(image_slopes(G)))
    out[:, 1:4, 1:4] += T @ added @ np.swapaxes(T, 1, 2)
    return np.asarray(out)


def in_step(a: Float, b: Float) -> Float:
    """Return the covariance (n, 2, 2) of the sum of two fully correlated errors: their amplitudes add."""
    both = a + b
    trace = np.trace(both, axis1=1, axis2=2)
    cross = 2.0 * np.sqrt(np.maximum(np.trace(a, axis1=1, axis2=2) * np.trace(b, axis1=1, axis2=2), 0.0))
    return np.asarray(both * (1.0 + cross / np.maximum(trace, np.finfo(np.float64).tiny))[:, None, None])


def position_covariance(G: Float, covariance: Float) -> Float:
    """Return the covariance (n, 2, 2) of camera 1's current image positions, normalised, from (w0, G, offset)."""
    seen = G[:, :2, 0] / G[:, 2:, 0]
    J = np.zeros((len(G), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, :, 2] = -seen
    J /= G[:, 2, 0, None, None]
    return np.asarray(J @ covariance[:, 1:4, 1:4] @ np.swapaxes(J, 1, 2))


def common_share(slopes_px: Float, offset_px: Float, subset_px: int) -> tuple[Float, Float]:
    """Return the common noise of two matches that meet in one image, one ending there and one beginning: (n,), (n,).

    Parameters
    ----------
    slopes_px
        (n, 2, 2) derivative of that image over the first match's reference: its subset arrives as a parallelogram.
    offset_px
        (n, 2) from the parallelogram's middle to the middle of the second match's subset, px.
    subset_px
        Width of both subsets at their references.

    Returns
    -------
    common
        Share of the noise's covariance in the variance of either: the pixels in common over the parallelogram's pixels.
    own
        Variance of the first match from that image over the second's: 1, more if the parallelogram has fewer pixels
        than samples.
    """
    common, own = np.empty(len(slopes_px)), np.empty(len(slopes_px))
    for start in range(0, len(common), _POINTS_AT_ONCE):
        part = slice(start, start + _POINTS_AT_ONCE)
        common[part], own[part] = _common_share(slopes_px[part], offset_px[part], float(subset_px))
    return common, own


def _common_share(A: Float, offset: Float, size: float) -> tuple[Float, Float]:
    half = 0.5 * size
    det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    reach = half * (np.abs(A[:, 1, 0]) + np.abs(A[:, 1, 1]))
    middle = -offset  # edges of the parallelogram, seen from the square's middle
    low, high = np.maximum(-half, middle[:, 1] - reach), np.minimum(half, middle[:, 1] + reach)
    height = np.maximum(high - low, 0.0)
    y = low[:, None] + height[:, None] * (np.arange(_STRIPS) + 0.5) / _STRIPS - middle[:, 1, None]
    left, right = np.full(y.shape, -half), np.full(y.shape, half)
    back = _inverse(A)
    for i in range(2):  # |back_i . (x - middle)| <= half
        a = back[:, i, 0]
        a = np.where(np.abs(a) < 1e-9, 1e-9, a)[:, None]
        b = back[:, i, 1, None] * y
        ends = (np.stack([-half - b, half - b]) / a) + middle[:, 0, None]
        left, right = np.maximum(left, ends.min(axis=0)), np.minimum(right, ends.max(axis=0))
    area = np.maximum(right - left, 0.0).mean(axis=1) * height
    return area / (np.abs(det) * size**2), np.maximum(1.0, 1.0 / np.abs(det))
