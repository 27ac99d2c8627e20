"""Rays of image points: Eqs. (8), (7), (5) backwards, written for whole lattices of sample points.

The same mapping as `core.cameras.lens`, in compiled form, and checked against it by the tests.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from core.arrays import Float

_SEIDEL: Final = 0.0
_STEPS: Final = 30


@njit(cache=True, nogil=True, error_model="numpy")
def rays(lens: Float, x0: float, y0: float, step: float, nx: Float, ny: Float) -> None:
    """Write the directions (nx, ny, 1) of the points (x0 + i step, y0 + j step) into (rows, columns); NaN: no ray.

    ``lens`` is the flat form of :meth:`core.cameras.lens.LensModel.kernel_parameters`.
    """
    fx, fy, skew, cx, cy, k1 = lens[1], lens[2], lens[3], lens[4], lens[5], lens[6]
    for j in range(nx.shape[0]):
        yd = (y0 + j * step - cy) / fy
        if lens[0] == _SEIDEL:
            for i in range(nx.shape[1]):
                xd = (x0 + i * step - cx) / fx
                q = 4.0 * k1 * (xd * xd + yd * yd)
                scale = 2.0 / (1.0 + np.sqrt(1.0 - q)) if q < 1.0 else np.nan
                nx[j, i] = xd * scale
                ny[j, i] = yd * scale
        else:
            gx, gy = 0.0, 0.0
            for i in range(nx.shape[1]):
                gx, gy, ok = _undistort(lens, (x0 + i * step - cx - skew * yd) / fx, yd, gx, gy)
                nx[j, i] = gx if ok else np.nan
                ny[j, i] = gy if ok else np.nan
                if not ok:
                    gx, gy = 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _undistort(lens: Float, xd: float, yd: float, nx: float, ny: float) -> tuple[float, float, bool]:
    """Invert OpenCV's distortion by Newton's method from the guess (nx, ny)."""
    k1, k2, p1, p2, k3 = lens[6], lens[7], lens[8], lens[9], lens[10]
    k4, k5, k6 = lens[12], lens[13], lens[14]
    rational = k4 != 0.0 or k5 != 0.0 or k6 != 0.0
    for _ in range(_STEPS):
        r2 = nx * nx + ny * ny
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        if rational:
            if not r2 < lens[11]:  # stepped over a pole or fold: back onto the branch that contains the centre
                shrink = 0.999 * np.sqrt(lens[11] / r2)
                nx *= shrink
                ny *= shrink
                continue
            bottom = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
            radial /= bottom
            slope = (slope - 2.0 * radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) / bottom
        fx = nx * radial + 2.0 * p1 * nx * ny + p2 * (r2 + 2.0 * nx * nx) - xd
        fy = ny * radial + p1 * (r2 + 2.0 * ny * ny) + 2.0 * p2 * nx * ny - yd
        a = radial + nx * nx * slope + 2.0 * p1 * ny + 6.0 * p2 * nx
        b = nx * ny * slope + 2.0 * p1 * nx + 2.0 * p2 * ny
        d = radial + ny * ny * slope + 6.0 * p1 * ny + 2.0 * p2 * nx
        det = a * d - b * b
        if det <= 0.0:
            return nx, ny, False
        ex = (d * fx - b * fy) / det
        ey = (a * fy - b * fx) / det
        nx -= ex
        ny -= ey
        if abs(ex) + abs(ey) < 1e-13:
            return nx, ny, nx * nx + ny * ny < lens[11]
    return nx, ny, False
