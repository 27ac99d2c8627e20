"""Rays of image points, written for whole lattices of sample points and for single ones.

The paper's lens, Eqs. (8), (7), (5) backwards, in closed form, and OpenCV's rational one by Newton's method; a thin
prism and a tilted sensor by a fixed point around that, as a kind of lens of its own. Checked against
`stereorig.core.cameras.lens` and OpenCV by the tests, and sharing nothing with them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit

from stereorig.core.arrays import Float

SEIDEL: Final = 0.0
RATIONAL: Final = 1.0
BENT: Final = 2.0
_STEPS: Final = 40
_LAST_STEP: Final = 1e-8  # Newton's error after a step of this length is its square times a curvature of order one
_SHRINK: Final = 0.98
_SETTLED: Final = (
    1e-13  # a prism moves rays by some thousandths of what it moves its own point by: each round gains as much
)


@njit(cache=True, nogil=True, error_model="numpy")
def rays(lens: Float, x0: float, y0: float, step: float, nx: Float, ny: Float) -> None:
    """Write the directions (nx, ny, 1) of the points (x0 + i step, y0 + j step) into (rows, columns); NaN: no ray.

    ``lens`` is the flat form of :func:`stereorig.sim.optics.lens.flat_lens`.
    """
    fx, fy, skew, cx, cy, k1 = lens[1], lens[2], lens[3], lens[4], lens[5], lens[6]
    columns = nx.shape[1]
    xd = np.empty(columns)
    for j in range(nx.shape[0]):
        yd = (y0 + j * step - cy) / fy
        if lens[0] == SEIDEL:
            for i in range(columns):
                x = (x0 + i * step - cx) / fx
                q = 4.0 * k1 * (x * x + yd * yd)
                scale = 2.0 / (1.0 + np.sqrt(1.0 - q)) if q < 1.0 else np.nan
                nx[j, i] = x * scale
                ny[j, i] = yd * scale
            continue
        for i in range(columns):
            xd[i] = (x0 + i * step - cx - skew * yd) / fx
        if lens[0] == RATIONAL and j >= 3 and _undistort_row(lens, xd, yd, nx[j - 3 : j], ny[j - 3 : j], nx[j], ny[j]):
            continue
        gx, gy = 0.0, 0.0
        for i in range(columns):
            if (
                lens[0] == BENT and j >= 3
            ):  # three rows tell the next to some 1e-12, and a prism and a tilt take a round or two from there
                x = 3.0 * (nx[j - 1, i] - nx[j - 2, i]) + nx[j - 3, i]
                y = 3.0 * (ny[j - 1, i] - ny[j - 2, i]) + ny[j - 3, i]
                if x == x and y == y:
                    gx, gy = x, y
            gx, gy, ok = _ray(lens, xd[i], yd, gx, gy)
            nx[j, i] = gx if ok else np.nan
            ny[j, i] = gy if ok else np.nan
            if not ok:
                gx, gy = 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _ray(lens: Float, xd: float, yd: float, nx: float, ny: float) -> tuple[float, float, bool]:
    """Return the direction of a point on the sensor at focal length 1 from the guess (nx, ny), and if there is one."""
    if lens[0] != BENT:
        return _undistort(lens, xd, yd, nx, ny)
    H = lens[19:28]
    w = H[6] * xd + H[7] * yd + H[8]
    if w <= 0.0:
        return nx, ny, False
    xd, yd = (H[0] * xd + H[1] * yd + H[2]) / w, (H[3] * xd + H[4] * yd + H[5]) / w
    for _ in range(_STEPS):
        r2 = nx * nx + ny * ny
        x, y, ok = _undistort(lens, xd - r2 * (lens[15] + r2 * lens[16]), yd - r2 * (lens[17] + r2 * lens[18]), nx, ny)
        moved = abs(x - nx) + abs(y - ny)
        nx, ny = x, y
        if not ok or moved < _SETTLED:
            return nx, ny, ok
    return nx, ny, False


# one step for a whole row without a branch, so that it runs on the vector unit
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _undistort_row(lens: Float, xd: Float, yd: float, before_x: Float, before_y: Float, nx: Float, ny: Float) -> bool:
    """Write a row's directions by one Newton step from those extrapolated from three rows; return if all are exact."""
    k1, k2, p1, p2, k3 = lens[6], lens[7], lens[8], lens[9], lens[10]
    k4, k5, k6, r2_max = lens[11], lens[12], lens[13], lens[14]
    wrong = 0
    for i in range(xd.size):
        x = 3.0 * (before_x[2, i] - before_x[1, i]) + before_x[0, i]
        y = 3.0 * (before_y[2, i] - before_y[1, i]) + before_y[0, i]
        r2 = x * x + y * y
        per_den = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * per_den
        den_slope = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * den_slope) * per_den
        fx = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd[i]
        fy = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
        a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        per_det = 1.0 / (a * d - b * b)
        ex, ey = (d * fx - b * fy) * per_det, (a * fy - b * fx) * per_det
        nx[i], ny[i] = x - ex, y - ey
        # written so that a NaN is wrong too
        wrong += not (abs(ex) + abs(ey) < _LAST_STEP)
        wrong += not (r2 < 0.99 * r2_max)
    return wrong == 0


@njit(cache=True, nogil=True, error_model="numpy")
def scattered_rays(lens: Float, xy_px: Float, out: Float) -> None:
    """Write the directions (n, 2) of image points (n, 2) through an OpenCV lens; NaN: no ray."""
    for k in range(xy_px.shape[0]):
        yd = (xy_px[k, 1] - lens[5]) / lens[2]
        xd = (xy_px[k, 0] - lens[4] - lens[3] * yd) / lens[1]
        x, y, ok = _ray(lens, xd, yd, 0.0, 0.0)
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
