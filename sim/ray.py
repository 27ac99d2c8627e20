"""Rays against deformed surfaces: which material point does a pixel see.

For a ray through the pinhole with direction (nx, ny, 1) in the camera's frame, the material point (s, t) solves

    X_cam(s, t) - nx Z_cam(s, t) = 0,  Y_cam(s, t) - ny Z_cam(s, t) = 0,

by Newton's method with the surface's own tangents. For a plane the equations are linear and one step is exact.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.surface import PANEL, surface_point

Float = NDArray[np.float64]

_STEPS: Final = 30
# a Newton step shorter than this leaves an error of the order of curvature times its square: far below a nanometre
_STEP_MM: Final = 1e-6
_SEIDEL: Final = 0.0


@njit(cache=True, nogil=True)
def normalised(lens: Float, x: float, y: float, guess_x: float, guess_y: float) -> tuple[float, float, bool]:
    """Undistorted ray direction of an image point, Eqs. (8), (7), (5); OpenCV's lens by Newton from the guess."""
    yd = (y - lens[5]) / lens[2]
    xd = (x - lens[4] - lens[3] * yd) / lens[1]
    if lens[0] == _SEIDEL:
        q = 4.0 * lens[6] * (xd * xd + yd * yd)
        if q >= 1.0:
            return 0.0, 0.0, False
        scale = 2.0 / (1.0 + np.sqrt(1.0 - q))
        return xd * scale, yd * scale, True
    k1, k2, p1, p2, k3 = lens[6], lens[7], lens[8], lens[9], lens[10]
    nx, ny = guess_x, guess_y
    for _ in range(_STEPS):
        r2 = nx * nx + ny * ny
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        fx = nx * radial + 2.0 * p1 * nx * ny + p2 * (r2 + 2.0 * nx * nx) - xd
        fy = ny * radial + p1 * (r2 + 2.0 * ny * ny) + 2.0 * p2 * nx * ny - yd
        a = radial + nx * nx * slope + 2.0 * p1 * ny + 6.0 * p2 * nx
        b = nx * ny * slope + 2.0 * p1 * nx + 2.0 * p2 * ny
        d = radial + ny * ny * slope + 6.0 * p1 * ny + 2.0 * p2 * nx
        det = a * d - b * b
        if det <= 0.0:
            return 0.0, 0.0, False
        ex = (d * fx - b * fy) / det
        ey = (a * fy - b * fx) / det
        nx -= ex
        ny -= ey
        if abs(ex) + abs(ey) < 1e-13:
            return nx, ny, nx * nx + ny * ny < lens[11]
    return 0.0, 0.0, False


@njit(cache=True, nogil=True)
def _newton(
    kind: int,
    par: Float,
    coarse: Float,
    fine: Float,
    pose: Float,
    nx: float,
    ny: float,
    s: float,
    t: float,
    side: float,
) -> tuple[float, float, bool]:
    # rows of the ray's two planes in the body's frame
    ax = pose[0, 0] - nx * pose[2, 0]
    ay = pose[0, 1] - nx * pose[2, 1]
    az = pose[0, 2] - nx * pose[2, 2]
    a0 = pose[0, 3] - nx * pose[2, 3]
    bx = pose[1, 0] - ny * pose[2, 0]
    by = pose[1, 1] - ny * pose[2, 1]
    bz = pose[1, 2] - ny * pose[2, 2]
    b0 = pose[1, 3] - ny * pose[2, 3]
    for _ in range(_STEPS):
        x, y, z, xs, ys, zs, xt, yt, zt = surface_point(kind, par, coarse, fine, s, t, side)
        f = ax * x + ay * y + az * z + a0
        g = bx * x + by * y + bz * z + b0
        fs = ax * xs + ay * ys + az * zs
        ft = ax * xt + ay * yt + az * zt
        gs = bx * xs + by * ys + bz * zs
        gt = bx * xt + by * yt + bz * zt
        det = fs * gt - ft * gs
        ds = (gt * f - ft * g) / det
        dt = (fs * g - gs * f) / det
        s -= ds
        t -= dt
        if abs(ds) + abs(dt) < _STEP_MM:
            return s, t, pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3] > 0.0
        if not np.isfinite(s + t):
            return s, t, False
    return s, t, False


@njit(cache=True, nogil=True)
def _plane_start(pose: Float, nx: float, ny: float) -> tuple[float, float]:
    """Where the ray meets the body's plane z = 0: the start when no neighbour is known."""
    fs = pose[0, 0] - nx * pose[2, 0]
    ft = pose[0, 1] - nx * pose[2, 1]
    f = pose[0, 3] - nx * pose[2, 3]
    gs = pose[1, 0] - ny * pose[2, 0]
    gt = pose[1, 1] - ny * pose[2, 1]
    g = pose[1, 3] - ny * pose[2, 3]
    det = fs * gt - ft * gs
    return -(gt * f - ft * g) / det, -(fs * g - gs * f) / det


@njit(cache=True, nogil=True)
def hit(
    kind: int,
    par: Float,
    coarse: Float,
    fine: Float,
    pose: Float,
    nx: float,
    ny: float,
    s0: float,
    t0: float,
    known: bool,
    side0: float,
) -> tuple[float, float, float, bool]:
    """Material point (s, t), lip and success for one ray.

    ``pose`` (3, 4) is cam_from_body. With ``known`` the search starts at (s0, t0), else, or when that fails, where
    the ray meets
    z = 0. On a cracked surface both lips are tried, and a ray that passes between them hits nothing.
    """
    s, t, side = s0, t0, side0
    if kind != PANEL:
        if known:
            s, t, ok = _newton(kind, par, coarse, fine, pose, nx, ny, s, t, 1.0)
            if ok:
                return s, t, 1.0, True
        s, t = _plane_start(pose, nx, ny)
        s, t, ok = _newton(kind, par, coarse, fine, pose, nx, ny, s, t, 1.0)
        return s, t, 1.0, ok
    if not known:
        s, t = _plane_start(pose, nx, ny)
        side = 1.0 if t >= 0.0 else -1.0
    start_s, start_t = s, t
    for _ in range(2):
        s, t, ok = _newton(kind, par, coarse, fine, pose, nx, ny, start_s, start_t, side)
        if ok and (abs(s) >= par[0] or t * side >= 0.0):
            if abs(s) >= par[0]:
                side = 1.0 if t >= 0.0 else -1.0
            return s, t, side, True
        side = -side
    return s, t, side, False
