"""Geometry of one patch in one image: lens expansion about a point, warp set-up with its bounds, undistortion.

All in double precision, once per image and iteration; the pixel loop gets the float32 result.
A lens is the flat array of ``LensModel.kernel_parameters``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.lens import SEIDEL
from core.matching.image import PAD

N_WARP = 25
_NEWTON_STEPS = 20


@njit(nogil=True, error_model="numpy")
def lens_expansion(lens, u, v):
    """Expand a lens about the normalised point (u, v).

    Returns ``x, y`` (px), the radial factor's coefficients ``l1, l2, l3`` in powers of rho = r^2 - r0^2, and the
    matrix ``h11, h12, h22`` that acts on the offset besides: radial factor at the centre plus the tangential terms'
    slopes. Exact for OpenCV's polynomial; the Seidel term 1 / (1 + k r^2) leaves (k rho)^4, below 1e-12 here.
    """
    r2 = u * u + v * v
    if lens[0] == SEIDEL:
        k = lens[6]
        l0 = 1.0 / (1.0 + k * r2)
        l1 = -k * l0 * l0
        l2 = -k * l1 * l0
        l3 = -k * l2 * l0
        p1 = 0.0
        p2 = 0.0
    else:
        k1, k2, k3 = lens[6], lens[7], lens[10]
        p1, p2 = lens[8], lens[9]
        l0 = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        l1 = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
        l2 = k2 + 3.0 * k3 * r2
        l3 = k3
    xd = u * l0 + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    yd = v * l0 + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
    x = lens[4] + lens[1] * xd + lens[3] * yd
    y = lens[5] + lens[2] * yd
    h11 = l0 + 2.0 * p1 * v + 6.0 * p2 * u
    h12 = 2.0 * p1 * u + 2.0 * p2 * v
    h22 = l0 + 6.0 * p1 * v + 2.0 * p2 * u
    return x, y, l1, l2, l3, h11, h12, h22


@njit(nogil=True, error_model="numpy")
def lens_jacobian(lens, u, v):
    """d(image px) / d(normalised) at (u, v): the four entries row by row."""
    _, _, l1, _, _, h11, h12, h22 = lens_expansion(lens, u, v)
    a11 = h11 + 2.0 * l1 * u * u
    a12 = h12 + 2.0 * l1 * u * v
    a22 = h22 + 2.0 * l1 * v * v
    return lens[1] * a11 + lens[3] * a12, lens[1] * a12 + lens[3] * a22, lens[2] * a12, lens[2] * a22


@njit(nogil=True, error_model="numpy")
def undistort(lens, x, y):
    """Normalised point (u, v) of a pixel; NaN outside the lens model's domain."""
    yd = (y - lens[5]) / lens[2]
    xd = (x - lens[4] - lens[3] * yd) / lens[1]
    if lens[0] == SEIDEL:
        q = 1.0 - 4.0 * lens[6] * (xd * xd + yd * yd)
        factor = 2.0 / (1.0 + math.sqrt(q)) if q > 0.0 else np.nan
        return xd * factor, yd * factor
    u, v = xd, yd
    error = np.inf
    for _ in range(_NEWTON_STEPS):
        if u * u + v * v >= lens[11]:  # keep to the branch that contains the centre
            shrink = 0.999 * math.sqrt(lens[11] / (u * u + v * v))
            u *= shrink
            v *= shrink
        xn, yn, _, _, _, _, _, _ = lens_expansion(lens, u, v)
        j11, j12, j21, j22 = lens_jacobian(lens, u, v)
        ex, ey = xn - x, yn - y
        error = max(abs(ex), abs(ey))
        det = j11 * j22 - j12 * j21
        du = (j22 * ex - j12 * ey) / det
        dv = (j11 * ey - j21 * ex) / det
        u -= du
        v -= dv
        if abs(du) + abs(dv) < 1e-14:
            break
    if error < 1e-9 * (1.0 + abs(x) + abs(y)) and u * u + v * v < lens[11]:
        return u, v
    return np.nan, np.nan


@njit(nogil=True, error_model="numpy")
def set_up_warp(lens, m, box, rows, cols, stride, lead, p):
    """Prepare the pixel loop for one image that sees the patch through ``m``.

    Parameters
    ----------
    lens
        The image's lens.
    m
        (3, 3) homogeneous camera coordinates = m (1, X, Y).
    box
        (4,) smallest and largest X, then Y, of the subset.
    rows, cols, stride
        Size of the image and row length of the padded coefficients.
    lead
        Taps before the pixel: 1 for cubic, 2 for quintic.
    p
        (25,) float32 out; entries 23 and 24 (grey levels) are left alone.

    Returns
    -------
    int
        Flat index of the base tap, or -1 if the patch may leave the image, the lens model's domain or the half-space
        before the camera. All four need only the corners: projective maps keep the subset's convexity, and the lens
        departs from its linear part by a bounded remainder.
    """
    m00, m10, m20 = m[0, 0], m[1, 0], m[2, 0]
    if not m20 > 0.0:
        return -1
    w = 1.0 / m20
    u0, v0 = m00 * w, m10 * w
    d1, d2 = m[2, 1] * w, m[2, 2] * w
    a11, a12 = (m[0, 1] - u0 * m[2, 1]) * w, (m[0, 2] - u0 * m[2, 2]) * w
    a21, a22 = (m[1, 1] - v0 * m[2, 1]) * w, (m[1, 2] - v0 * m[2, 2]) * w
    x, y, l1, l2, l3, h11, h12, h22 = lens_expansion(lens, u0, v0)
    p1, p2 = 0.0, 0.0
    if lens[0] != SEIDEL:
        p1, p2 = lens[8], lens[9]
    fx, fy, fs = lens[1], lens[2], lens[3]
    j11 = h11 + 2.0 * l1 * u0 * u0
    j12 = h12 + 2.0 * l1 * u0 * v0
    j22 = h22 + 2.0 * l1 * v0 * v0
    x_min, x_max, y_min, y_max = x, x, y, y
    u_max, v_max, r2_max = 0.0, 0.0, u0 * u0 + v0 * v0
    for i in range(2):
        for j in range(2, 4):
            depth = 1.0 + d1 * box[i] + d2 * box[j]
            if not depth > 0.05:
                return -1
            u = (a11 * box[i] + a12 * box[j]) / depth
            v = (a21 * box[i] + a22 * box[j]) / depth
            u_max, v_max = max(u_max, abs(u)), max(v_max, abs(v))
            r2_max = max(r2_max, (u0 + u) ** 2 + (v0 + v) ** 2)
            xd, yd = j11 * u + j12 * v, j12 * u + j22 * v
            xi, yi = x + fx * xd + fs * yd, y + fy * yd
            x_min, x_max, y_min, y_max = min(x_min, xi), max(x_max, xi), min(y_min, yi), max(y_max, yi)
    square = u_max * u_max + v_max * v_max
    rho = 2.0 * (abs(u0) * u_max + abs(v0) * v_max) + square
    curved = abs(l2) * rho * rho + abs(l3) * rho**3
    change = abs(l1) * rho + curved
    curved += abs(l1) * square
    tangential = 4.0 * (abs(p1) + abs(p2)) * square
    dx = abs(u0) * curved + u_max * change + tangential
    dy = abs(v0) * curved + v_max * change + tangential
    dx, dy = abs(fx) * dx + abs(fs) * dy, abs(fy) * dy
    if not (
        x_min - dx >= 0.0 and x_max + dx <= cols - 1.0 and y_min - dy >= 0.0 and y_max + dy <= rows - 1.0
        and r2_max < lens[11]
    ):  # fmt: skip
        return -1
    ix, iy = math.floor(x), math.floor(y)
    p[0], p[1], p[2], p[3], p[4], p[5] = d1, d2, a11, a12, a21, a22
    p[6], p[7], p[8], p[9], p[10] = 2.0 * u0, 2.0 * v0, l1, l2, l3
    p[11], p[12], p[13], p[14], p[15] = u0, v0, h11, h12, h22
    p[16], p[17], p[18], p[19], p[20] = p1, p2, fx, fs, fy
    p[21], p[22] = x - ix, y - iy
    return (iy + PAD - lead) * stride + ix + PAD - lead
