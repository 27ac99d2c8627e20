"""Motion of patches from the matcher's unknowns, compiled, and the covariance of their positions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.matching.kernels.naming import entry_with_arrays, inner


@inner
def dot(a, b):
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def cross(a, b, out):
    """Fill ``out`` with the vector product of two vectors (3,)."""
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def fill_frame(normal, frame):
    """Make a normal (3,) a unit vector, and fill its unit tangents (3, 2), as :func:`.geometry.tangent_frames`."""
    size = math.sqrt(dot(normal, normal))
    for i in range(3):
        normal[i] /= size
    axis = 1 if abs(normal[0]) > 0.999 else 0
    for i in range(3):
        frame[i, 0] = (1.0 if i == axis else 0.0) - normal[i] * normal[axis]
    size = math.sqrt(dot(frame[:, 0], frame[:, 0]))
    for i in range(3):
        frame[i, 0] /= size
    cross(normal, frame[:, 0], frame[:, 1])


@inner
def _times_inverse(tangents, m, out):
    """Fill ``out`` (3, 2) with tangents (3, 2) times the inverse of ``m`` (2, 2)."""
    per = 1.0 / (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0])
    for i in range(3):
        a, b = tangents[i, 0], tangents[i, 1]
        out[i, 0], out[i, 1] = (a * m[1, 1] - b * m[1, 0]) * per, (b * m[0, 0] - a * m[0, 1]) * per


@entry_with_arrays
def _motions(rays, ws, Gs, R, uvw, rotations, stretch):
    before, after, axes, frame = np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 2))
    plane, normal, third, m = np.empty(3), np.empty(3), np.empty(3), np.empty((2, 2))
    for n in range(len(rays)):
        ray, w, G = rays[n], ws[n], Gs[n]
        plane[0], plane[1], plane[2] = w[1], w[2], w[0] - w[1] * ray[0] - w[2] * ray[1]
        before[:] = 0.0
        after[:] = 0.0
        for i in range(3):
            uvw[n, i], normal[i] = 0.0, 0.0
            for k in range(3):
                uvw[n, i] += R[k, i] * (G[k, 0] - ray[k]) / w[0]
                normal[i] += R[k, i] * plane[k]
                for j in range(2):  # in units of 1 / w0
                    slope = w[1 + j] / w[0]
                    before[i, j] += R[k, i] * ((1.0 if k == j else 0.0) - ray[k] * slope)
                    after[i, j] += R[k, i] * (G[k, 1 + j] - G[k, 0] * slope)
        fill_frame(normal, frame)
        for i in range(2):
            for j in range(2):
                m[i, j] = dot(frame[:, i], before[:, j])
        _times_inverse(after, m, before)  # derivatives of the moved patch along the frame's axes
        for i in range(2):
            for j in range(2):
                m[i, j] = dot(before[:, i], before[:, j])
        # the stretch is the root of a symmetric positive matrix (Cayley-Hamilton)
        s = math.sqrt(m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0])
        per = 1.0 / math.sqrt(m[0, 0] + m[1, 1] + 2.0 * s)
        m[0, 0], m[0, 1], m[1, 0], m[1, 1] = (m[0, 0] + s) * per, m[0, 1] * per, m[1, 0] * per, (m[1, 1] + s) * per
        stretch[n, 0], stretch[n, 1], stretch[n, 2] = m[0, 0] - 1.0, m[1, 1] - 1.0, m[0, 1]
        _times_inverse(before, m, axes)
        cross(axes[:, 0], axes[:, 1], third)
        for i in range(3):
            for j in range(3):
                rotations[n, i, j] = axes[i, 0] * frame[j, 0] + axes[i, 1] * frame[j, 1] + third[i] * normal[j]


@entry_with_arrays
def _covariances(rays, ws, Gs, R, given, out):
    J, part = np.zeros((6, 4)), np.empty((6, 4))
    for n in range(len(rays)):
        ray, w, G = rays[n], ws[n], Gs[n]
        for i in range(3):
            J[i, 0], J[3 + i, 0] = 0.0, 0.0
            for k in range(3):
                J[i, 0] -= R[k, i] * ray[k] / w[0] ** 2
                J[3 + i, 0] -= R[k, i] * (G[k, 0] - ray[k]) / w[0] ** 2
                J[3 + i, 1 + k] = R[k, i] / w[0]
        for i in range(6):
            for j in range(4):
                part[i, j] = 0.0
                for k in range(4):
                    part[i, j] += J[i, k] * given[n, k, j]
        for i in range(6):
            for j in range(6):
                total = 0.0
                for k in range(4):
                    total += part[i, k] * J[j, k]
                out[n, i, j] = total


def motions(ray: Float, w: Float, G: Float, R: Float) -> tuple[Float, Float, Float]:
    """Return displacement (n, 3), rotation matrices (n, 3, 3) and stretch less one (n, 3), in the system frame.

    Parameters
    ----------
    ray
        (n, 3) camera 1's rays (X, Y, 1).
    w, G
        (n, 3 or 6) and (n, 3, 3 or 6), see :class:`stereorig.core.matching.MotionFit`.
    R
        (3, 3) rotation from the system frame to camera 1's.
    """
    n = len(ray)
    uvw, rotations, stretch = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3))
    _motions(*(dense(a) for a in (ray, w[:, :3], G[:, :, :3], R)), uvw, rotations, stretch)
    return uvw, rotations, stretch


def covariances(ray: Float, w: Float, G: Float, R: Float, covariance: Float) -> Float:
    """Return the covariance (n, 6, 6) of X Y Z U V W from a motion fit's (n, 5, 5); else as :func:`motions`."""
    out = np.empty((len(ray), 6, 6))
    _covariances(*(dense(a) for a in (ray, w[:, :3], G[:, :, :3], R, covariance)), out)
    return out


def dense(values: Float) -> Any:
    """Return values as kernels are compiled for: contiguous, and writable."""
    values = np.ascontiguousarray(values, dtype=np.float64)
    return values if values.flags.writeable else values.copy()
