"""Rays of image points, written for whole lattices of sample points and for single ones.

The paper's lens, Eqs. (8), (7), (5) backwards, in closed form, and OpenCV's rational one by Newton's method; checked
against `core.cameras.lens` and OpenCV by the tests, and sharing nothing with them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from core.arrays import Float

SEIDEL: Final = 0.0
RATIONAL: Final = 1.0
_STEPS: Final = 40
_LAST_STEP: Final = 1e-8  # Newton's error after a step of this length is its square times a curvature of order one
_SHRINK: Final = 0.98


@njit(cache=True, nogil=True, error_model="numpy")
def rays(lens: Float, x0: float, y0: float, step: float, nx: Float, ny: Float) -> None:
    """Write the directions (nx, ny, 1) of the points (x0 + i step, y0 + j step) into (rows, columns); NaN: no ray.

    ``lens`` is the flat form of :func:`sim.lens.flat_lens`.
    """
    fx, fy, skew, cx, cy, k1 = lens[1], lens[2], lens[3], lens[4], lens[5], lens[6]
    for j in range(nx.shape[0]):
        yd = (y0 + j * step - cy) / fy
        if lens[0] == SEIDEL:
            for i in range(nx.shape[1]):
                xd = (x0 + i * step - cx) / fx
                q = 4.0 * k1 * (xd * xd + yd * yd)
                scale = 2.0 / (1.0 + np.sqrt(1.0 - q)) if q < 1.0 else np.nan
                nx[j, i] = xd * scale
                ny[j, i] = yd * scale
        else:
            known = 0  # points of this row just before, in line with which the next is guessed
            for i in range(nx.shape[1]):
                xd = (x0 + i * step - cx - skew * yd) / fx
                if known >= 3:
                    gx = 3.0 * (nx[j, i - 1] - nx[j, i - 2]) + nx[j, i - 3]
                    gy = 3.0 * (ny[j, i - 1] - ny[j, i - 2]) + ny[j, i - 3]
                else:
                    gx, gy = (nx[j, i - 1], ny[j, i - 1]) if known else (0.0, 0.0)
                gx, gy, ok = _undistort(lens, xd, yd, gx, gy)
                nx[j, i] = gx if ok else np.nan
                ny[j, i] = gy if ok else np.nan
                known = known + 1 if ok else 0


@njit(cache=True, nogil=True, error_model="numpy")
def scattered_rays(lens: Float, xy_px: Float, out: Float) -> None:
    """Write the directions (n, 2) of image points (n, 2) through an OpenCV lens; NaN: no ray."""
    for k in range(xy_px.shape[0]):
        yd = (xy_px[k, 1] - lens[5]) / lens[2]
        xd = (xy_px[k, 0] - lens[4] - lens[3] * yd) / lens[1]
        x, y, ok = _undistort(lens, xd, yd, 0.0, 0.0)
        out[k, 0] = x if ok else np.nan
        out[k, 1] = y if ok else np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _undistort(lens: Float, xd: float, yd: float, nx: float, ny: float) -> tuple[float, float, bool]:
    """Invert OpenCV's distortion by Newton's method from the guess (nx, ny), kept where the radius grows."""
    k1, k2, p1, p2, k3 = lens[6], lens[7], lens[8], lens[9], lens[10]
    k4, k5, k6, r2_max = lens[11], lens[12], lens[13], lens[14]
    for _ in range(_STEPS):
        r2 = nx * nx + ny * ny
        if r2 >= r2_max:
            shrink = _SHRINK * np.sqrt(r2_max / r2)
            nx *= shrink
            ny *= shrink
            r2 = nx * nx + ny * ny
        num = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        num_slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
        per_den = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        den_slope = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
        radial = num * per_den
        slope = 2.0 * (num_slope - radial * den_slope) * per_den
        fx = nx * radial + 2.0 * p1 * nx * ny + p2 * (r2 + 2.0 * nx * nx) - xd
        fy = ny * radial + p1 * (r2 + 2.0 * ny * ny) + 2.0 * p2 * nx * ny - yd
        a = radial + nx * nx * slope + 2.0 * p1 * ny + 6.0 * p2 * nx
        b = nx * ny * slope + 2.0 * p1 * nx + 2.0 * p2 * ny
        d = radial + ny * ny * slope + 6.0 * p1 * ny + 2.0 * p2 * nx
        det = a * d - b * b
        if det <= 0.0:
            return nx, ny, False
        per_det = 1.0 / det
        ex = (d * fx - b * fy) * per_det
        ey = (a * fy - b * fx) * per_det
        nx -= ex
        ny -= ey
        if abs(ex) + abs(ey) < _LAST_STEP:
            return nx, ny, nx * nx + ny * ny < r2_max
    return nx, ny, False
