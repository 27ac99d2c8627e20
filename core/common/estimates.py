"""Estimator of a point from the three comparisons, compiled: shifts of the images into X, Y, Z, U, V, W.

Five of the six equations give the offset across the epipolar line (camera 2 at t0), the depth along camera 1's ray, and
the position at t from both images there. The sixth is a condition: camera 2's image at t is off its epipolar line by
the same offset as at t0. Any further offset is noise. It is removed together with the noise that correlates with it:
all three comparisons contain the reference's noise, so that their covariance is the unit matrix plus one in all
elements.
"""

from __future__ import annotations

import math

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.matching.kernels.naming import entry_with_arrays, inner


@inner
def _seen_at(P1, P2, ray, q, inverse, both):
    """Fill ``q`` (3,), ray in camera 2 and its length, ``inverse`` (3, 2) of camera 1, and ``both`` (2, 2)."""
    q[0] = P2[0, 0] * ray[0] + P2[0, 1] * ray[1] + P2[0, 2] * ray[2]
    q[1] = P2[1, 0] * ray[0] + P2[1, 1] * ray[1] + P2[1, 2] * ray[2]
    q[2] = math.sqrt(q[0] * q[0] + q[1] * q[1])
    a = P1[0, 0] * P1[0, 0] + P1[0, 1] * P1[0, 1] + P1[0, 2] * P1[0, 2]
    b = P1[0, 0] * P1[1, 0] + P1[0, 1] * P1[1, 1] + P1[0, 2] * P1[1, 2]
    c = P1[1, 0] * P1[1, 0] + P1[1, 1] * P1[1, 1] + P1[1, 2] * P1[1, 2]
    per = 1.0 / (a * c - b * b)
    for i in range(3):
        inverse[i, 0] = (c * P1[0, i] - b * P1[1, i]) * per
        inverse[i, 1] = (a * P1[1, i] - b * P1[0, i]) * per
    for i in range(2):
        for j in range(2):
            both[i, j] = P2[i, 0] * inverse[0, j] + P2[i, 1] * inverse[1, j] + P2[i, 2] * inverse[2, j]


@inner
def _points_of(by_parameters, rotation, out):
    """Fill ``out`` (2, 3), an image over the point, from its derivatives over the camera's parameters."""
    first = by_parameters.shape[1] - 3  # the last are the pose's shift, in the camera's own frame
    for i in range(2):
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += by_parameters[i, first + k] * rotation[k, j]
            out[i, j] = s


@entry_with_arrays
def _estimates(reference, kept, by1, by2, R1, R2, rays, depth2, by_match, whole):
    ray0, along0, across0, px0 = reference
    beside0, seen0, by_image0, normalised0 = kept
    P1, P2, inverse, both = np.empty((2, 3)), np.empty((2, 3)), np.empty((3, 2)), np.empty((2, 2))
    q, left, noise, carried = np.empty(3), np.empty(6), np.empty(6), np.empty(2)
    for n in range(len(rays)):
        _points_of(by1[n], R1, P1)
        _points_of(by2[n], R2, P2)
        ray, match, out = rays[n], by_match[n], whole[n]
        _seen_at(P1, P2, ray, q, inverse, both)
        length = q[2]
        ax, ay = q[0] / length, q[1] / length  # along the epipolar line; across it is (-ay, ax)
        last = by2.shape[2] - 3
        for i in range(2):  # the pose's shift holds the lens's slopes times the depth's inverse
            carried[i] = depth2[n] * (by2[n, i, last] * normalised0[n, 0] + by2[n, i, last + 1] * normalised0[n, 1])
        e_along = (ax * carried[0] + ay * carried[1]) / length
        e_across = ax * carried[1] - ay * carried[0]
        for i in range(3):
            for j in range(2):
                match[i, j] = -ray[i] * e_along * across0[n, j] - ray0[n, i] * along0[n, j] / px0[n]
                match[i, 2 + j] = inverse[i, j] - ray[i] * (ax * both[0, j] + ay * both[1, j]) / length
            match[i, 4], match[i, 5] = ray[i] * ax / length, ray[i] * ay / length
        for j in range(2):
            left[j] = -e_across * across0[n, j]
            left[2 + j] = ay * both[0, j] - ax * both[1, j]
        left[4], left[5] = -ay, ax
        square = 0.0
        for j in range(6):
            noise[j] = left[j] + left[j % 2] + left[2 + j % 2] + left[4 + j % 2]
            square += left[j] * noise[j]
        for i in range(3):
            s = 0.0
            for j in range(6):
                s += match[i, j] * noise[j]
            for j in range(6):
                match[i, j] -= s / square * left[j]
        for i in range(3):
            for j in range(4):
                out[i, j], out[i, 4 + j] = by_image0[n, i, j], 0.0
                out[3 + i, j] = -match[i, 0] * seen0[n, 0, j] - match[i, 1] * seen0[n, 1, j]
                out[3 + i, 4 + j] = -match[i, 2 + j]
            out[3 + i, 0] -= beside0[n, i, 0]
            out[3 + i, 1] -= beside0[n, i, 1]


def estimates(
    reference: tuple[Float, Float, Float, Float],
    kept: tuple[Float, Float, Float, Float],
    by_parameters: tuple[Float, Float],
    rotations: tuple[Float, Float],
    rays: Float,
    depth2_mm: Float,
) -> tuple[Float, Float]:
    """Return the estimator of n points, mm/px.

    Parameters
    ----------
    reference
        At the reference, as of :class:`stereorig.core.common.derivatives.ReferenceView`: (n, 3) ``ray``, (n, 2)
        ``along`` and ``across``, (n,) ``px_per_mm``.
    kept
        (n, 3, 2) ``off_ray``, (n, 2, 4) ``seen``, (n, 3, 4) ``by_image`` of the reference view, and (n, 2) the unit
        offset across the epipolar line as a shift of camera 2's normalised image.
    by_parameters
        (n, 2, p) of either camera's image of the current positions over its parameters, the pose's shift last.
    rotations
        (3, 3) of either camera, from the system's frame.
    rays
        (n, 3) unit vectors from camera 1 to the current positions, system frame.
    depth2_mm
        (n,) the current positions' depth in camera 2.

    Returns
    -------
    by_match
        (n, 3, 6) of U, V, W over the shifts that the three comparisons find.
    by_image
        (n, 6, 8) of X, Y, Z, U, V, W over the images that the cameras' parameters predict.
    """
    n = len(rays)
    by_match, whole = np.empty((n, 3, 6)), np.empty((n, 6, 8))
    first, second = (tuple(_dense(a) for a in part) for part in (reference, kept))
    by1, by2, R1, R2 = (_dense(a) for a in (*by_parameters, *rotations))
    _estimates(first, second, by1, by2, R1, R2, _dense(rays), _dense(depth2_mm), by_match, whole)
    return by_match, whole


@entry_with_arrays
def _new_noise(by_match, own, out):
    L, shifts, new = np.empty((3, 3)), np.empty((3, 4)), np.empty((3, 4))
    for n in range(len(by_match)):
        B = by_match[n]
        for i in range(3):
            for j in range(i + 1):
                # the comparisons' noise has the unit matrix plus one in all elements
                s = (B[i, 0] + B[i, 2] + B[i, 4]) * (B[j, 0] + B[j, 2] + B[j, 4])
                s += (B[i, 1] + B[i, 3] + B[i, 5]) * (B[j, 1] + B[j, 3] + B[j, 5])
                for k in range(6):
                    s += B[i, k] * B[j, k]
                for k in range(j):
                    s -= L[i, k] * L[j, k]
                L[i, j] = math.sqrt(s) if i == j else s / L[j, j]
        for i in range(3):
            for j in range(4):
                s = B[i, 2 + j]
                for k in range(i):
                    s -= L[i, k] * shifts[k, j]
                shifts[i, j] = s / L[i, i]
        for i in range(3):
            for j in range(4):
                new[i, j] = own[n, i, 0] * shifts[0, j] + own[n, i, 1] * shifts[1, j] + own[n, i, 2] * shifts[2, j]
        for i in range(3):
            for j in range(3):
                out[n, i, j] = 0.0
                for k in range(4):
                    out[n, i, j] += new[i, k] * new[j, k]


def new_noise(by_match: Float, own: Float) -> Float:
    """Return the part (n, 3, 3) of displacements' noise that the current images add.

    Parameters
    ----------
    by_match
        (n, 3, 6) as :func:`estimates` returns it.
    own
        (n, 3, 3) lower triangle of the displacements' covariance.
    """
    out = np.empty((len(own), 3, 3))
    _new_noise(_dense(by_match), _dense(own), out)
    return out


def _dense(values: Float) -> Float:
    """As the kernel is compiled for: contiguous, and writable."""
    values = np.ascontiguousarray(values, dtype=np.float64)
    return values if values.flags.writeable else values.copy()
