"""Least-squares fit of one small picture a point: crossed edges of a checkerboard, or the rim of a dot.

Corner: ``I = B + G d + A E(u, v)`` with u and v the distances to two edges that the lens bends by a known amount, and E
the mean of sgn(u) sgn(v) under a Gaussian of standard deviation s: erf(u / (sqrt 2 s)) erf(v / (sqrt 2 s)) for
perpendicular edges, and for edges at an angle, whose distances are correlated by r = cos of it, Plackett's integral of
the bivariate normal density over r is added. On a ChArUco board the white squares hold markers, whose dark border
begins at a known distance from both edges. Dot: ``I = B + G d + A (1 - E(rho)) / 2`` with the distance rho to an
ellipse.

d is the distance from the point, so that a slope of the lighting moves no point. But for this slope all terms are even
about the point and its position is odd: another blur, or markers a little larger than described, move no point either.
"""

from __future__ import annotations

from math import cos, erf, exp, hypot, sin, sqrt

import numpy as np
from numba import njit

from stereorig.core.arrays import Float, Float32
from stereorig.core.grid.profile import solve_cholesky

CORNER, DOT = 0, 1
# by kind: x, y; angles of the two edges | three of the ellipse's inverse square root matrix; then ground, amplitude,
# blur and slopes of the ground
N_CORNER, N_DOT = 9, 10
# geometry of a corner: inverse axes (4), reach in pitches, bends of the edges (2) in 1/px, the distances of a marker
# from both edges in px (0: none), one unused; of a dot: unused, widths of the band outside and inside its rim.
# Last, of both: standard deviation of the slopes of the ground about their start, as part of the amplitude, 1/px, and
# the slopes of the amplitude (2), as part of it, 1/px
N_GEOMETRY = 13
_STEPS = 30
_LEAST_BLUR = 0.2
_BAND_BLURS = 4.0
_BAND_PX = 1.5
_RIM_BLURS = 2.0
_LEAST_FREE_PX = 0.5
_R2 = 0.7071067811865476
_ROOT = 0.7978845608028654
_TWO_PI = 6.283185307179586
_PERPENDICULAR = 0.01
# Gauss and Legendre's five points on [0, 1]
_GAUSS_X = (0.046910077030668, 0.230765344947158, 0.5, 0.769234655052842, 0.953089922969332)
_GAUSS_W = (0.118463442528095, 0.239314335249683, 0.284444444444444, 0.239314335249683, 0.118463442528095)


@njit(cache=True, nogil=True, inline="always")
def _edge(u: float, s: float) -> tuple[float, float]:
    z = u * _R2 / s
    if z > 4.0:
        return 1.0, 0.0
    if z < -4.0:
        return -1.0, 0.0
    return erf(z), _ROOT / s * exp(-z * z)


@njit(cache=True, nogil=True)
def _density(h: float, k: float, r: float) -> float:
    """Bivariate normal density with correlation r."""
    q = 1.0 - r * r
    return exp(-0.5 * (h * h - 2.0 * r * h * k + k * k) / q) / (_TWO_PI * sqrt(q))


@njit(cache=True, nogil=True)
def _corner(p: Float, g: Float, x: float, y: float, J: Float) -> float:
    s = max(abs(p[6]), _LEAST_BLUR)
    dx, dy = x - p[0], y - p[1]
    cu, su, cv, sv = cos(p[2]), sin(p[2]), cos(p[3]), sin(p[3])
    tu, tv = dx * cu + dy * su, dx * cv + dy * sv
    u, v = dy * cu - dx * su - g[5] * tu * tu, dy * cv - dx * sv - g[6] * tv * tv
    eu, gu = _edge(u, s)
    ev, gv = _edge(v, s)
    amplitude = p[5] * (1.0 + g[11] * dx + g[12] * dy)
    picture = eu * ev
    by_u, by_v, by_r = gu * ev, eu * gv, 0.0
    r, skew = cu * cv + su * sv, cu * sv - su * cv
    if gu > 0.0 and gv > 0.0 and abs(r) > _PERPENDICULAR and abs(skew) > 0.05:
        by_u = gu * _edge((v - r * u) / abs(skew), s)[0]
        by_v = gv * _edge((u - r * v) / abs(skew), s)[0]
        for k in range(5):
            picture += 4.0 * r * _GAUSS_W[k] * _density(u / s, v / s, r * _GAUSS_X[k])
        by_r = 4.0 * _density(u / s, v / s, r)
    by_s = -(by_u * u + by_v * v) / s
    if g[7] > 0.0 and amplitude * u * v > 0.0:
        # a white square: its marker's border is as dark as the dark squares
        a, b = abs(u) - g[7], abs(v) - g[8]
        ea, ga = _edge(a, s)
        eb, gb = _edge(b, s)
        ha, hb = 0.5 * (1.0 + ea), 0.5 * (1.0 + eb)
        sign = 1.0 if amplitude > 0.0 else -1.0
        picture -= 2.0 * sign * ha * hb
        du = -sign * ga * hb * (1.0 if u > 0.0 else -1.0)
        dv = -sign * ha * gb * (1.0 if v > 0.0 else -1.0)
        by_u += du
        by_v += dv
        by_s += sign * (ga * a * hb + ha * gb * b) / s
    du, dv = amplitude * by_u, amplitude * by_v
    J[0] = du * su + dv * sv - p[7]
    J[1] = -du * cu - dv * cv - p[8]
    J[2] = -du * tu + amplitude * by_r * skew
    J[3] = -dv * tv - amplitude * by_r * skew
    J[4] = 1.0
    J[5] = picture * (1.0 + g[11] * dx + g[12] * dy)
    J[6] = amplitude * by_s
    J[7] = dx
    J[8] = dy
    return float(p[4] + amplitude * picture + p[7] * dx + p[8] * dy)


@njit(cache=True, nogil=True)
def _dot(p: Float, g: Float, x: float, y: float, J: Float) -> float:
    s = max(abs(p[7]), _LEAST_BLUR)
    a, b, c = p[2], p[3], p[4]
    dx, dy = x - p[0], y - p[1]
    m, n = a * dx + b * dy, b * dx + c * dy
    rho = max(hypot(m, n), 1e-9)
    # distance to the ellipse, to first order: (rho - 1) over the slope of rho
    steep = max(hypot(a * m + b * n, b * m + c * n), 1e-12) / rho
    e, slope = _edge((rho - 1.0) / steep, s)
    inside = 0.5 * (1.0 - e) * (1.0 + g[11] * dx + g[12] * dy)
    by_rho = -0.5 * p[6] * slope / steep
    J[0] = -by_rho * (m * a + n * b) / rho - p[8]
    J[1] = -by_rho * (m * b + n * c) / rho - p[9]
    J[2] = by_rho * m * dx / rho
    J[3] = by_rho * (m * dy + n * dx) / rho
    J[4] = by_rho * n * dy / rho
    J[5] = 1.0
    J[6] = inside
    J[7] = 0.5 * p[6] * slope * (rho - 1.0) / steep / s
    J[8] = dx
    J[9] = dy
    return float(p[5] + p[6] * inside + p[8] * dx + p[9] * dy)


@njit(cache=True, nogil=True)
def _used(kind: int, p: Float, g: Float, x: float, y: float) -> bool:
    """Return True for a pixel in the model's range that depends on the point or its levels."""
    dx, dy = x - p[0], y - p[1]
    if kind == DOT:
        m, n = p[2] * dx + p[3] * dy, p[3] * dx + p[4] * dy
        rho = max(hypot(m, n), 1e-9)
        steep = max(hypot(p[2] * m + p[3] * n, p[3] * m + p[4] * n), 1e-12) / rho
        off = (rho - 1.0) / steep
        return bool(-g[2] < off < g[1])
    s = max(abs(p[6]), _LEAST_BLUR)
    along, down = abs(g[0] * dx + g[1] * dy), abs(g[2] * dx + g[3] * dy)
    if along > g[4] or down > g[4]:
        return False
    cu, su, cv, sv = cos(p[2]), sin(p[2]), cos(p[3]), sin(p[3])
    u, v = dy * cu - dx * su, dy * cv - dx * sv
    near = min(abs(u), abs(v))
    if near > _BAND_BLURS * s + _BAND_PX:
        return False
    if g[7] > 0.0 and p[5] * u * v > 0.0:
        # up to the rim of the marker: where perspective or lens put it is not known as well as the point itself
        free = min(g[7], g[8])
        return bool(min(abs(u) - g[7], abs(v) - g[8]) < max(-_RIM_BLURS * s, _LEAST_FREE_PX - free))
    return True


@njit(cache=True, nogil=True)
def _model(kind: int, p: Float, g: Float, x: float, y: float, J: Float) -> float:
    return _dot(p, g, x, y, J) if kind == DOT else _corner(p, g, x, y, J)


@njit(cache=True, nogil=True)
def _fit_one(image: Float32, kind: int, p: Float, g: Float, half: int, settled_px: float, out: Float) -> None:
    n = N_DOT if kind == DOT else N_CORNER
    blur_at, amplitude_at = (7, 6) if kind == DOT else (6, 5)
    out[:] = np.nan
    rows, columns = image.shape
    x0, x1 = max(int(p[0] + 0.5) - half, 0), min(int(p[0] + 0.5) + half + 1, columns)
    y0, y1 = max(int(p[1] + 0.5) - half, 0), min(int(p[1] + 0.5) + half + 1, rows)
    if x1 <= x0 or y1 <= y0:
        return
    room = (x1 - x0) * (y1 - y0)
    xs, ys, grey = np.empty(room), np.empty(room), np.empty(room)
    count = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            if _used(kind, p, g, float(x), float(y)):
                xs[count], ys[count], grey[count] = x, y, image[y, x]
                count += 1
    if count < 2 * n:
        return
    trial, best = p.copy(), p.copy()
    N, kept, C = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    gradient, kept_gradient, J, step = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    cost, damping, settled = np.inf, 1e-3, False
    prior = 0.0
    for _ in range(_STEPS):
        N[:] = 0.0
        gradient[:] = 0.0
        total = 0.0
        for k in range(count):
            r = grey[k] - _model(kind, trial, g, xs[k], ys[k], J)
            total += r * r
            for i in range(n):
                gradient[i] += J[i] * r
                for j in range(i + 1):
                    N[i, j] += J[i] * J[j]
        if not np.isfinite(total):
            return
        if total <= cost * (1.0 + 1e-12):
            fall = cost - total
            cost = total
            best[:] = trial
            prior = cost / (count - n) / (g[10] * max(abs(best[amplitude_at]), 1e-6)) ** 2
            for i in range(n):
                for j in range(i):
                    N[j, i] = N[i, j]
            for i in range(n - 2, n):
                N[i, i] += prior
                gradient[i] -= prior * (best[i] - p[i])
            kept[:] = N
            kept_gradient[:] = gradient
            damping *= 0.1
            if settled or fall < 1e-9 * cost:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
        M = kept.copy()
        for i in range(n):
            if not M[i, i] > 0.0:
                M[i, i] = 1.0
            M[i, i] *= 1.0 + damping
        if not solve_cholesky(M, kept_gradient, step):
            damping = max(damping, 1e-6) * 100.0
            trial[:] = best
            if damping > 1e6:
                break
            continue
        for i in range(n):
            trial[i] = best[i] + step[i]
        trial[blur_at] = min(max(abs(trial[blur_at]), _LEAST_BLUR), 2.0 * abs(best[blur_at]) + 0.5)
        settled = max(abs(step[0]), abs(step[1])) < settled_px
    variance = cost / (count - n)
    for j in range(2):
        M = kept.copy()
        for i in range(n):
            M[i, i] *= 1.0 + 1e-9
        J[:] = 0.0
        J[j] = 1.0
        if not solve_cholesky(M, J, step):
            return
        C[:, j] = step
    out[:n] = best
    out[n] = C[0, 0] * variance
    out[n + 1] = C[0, 1] * variance
    out[n + 2] = C[1, 1] * variance
    out[n + 3] = sqrt(variance)


@njit(cache=True, nogil=True)
def _fit_all(
    image: Float32, kind: int, start: Float, geometry: Float, half: int, settled_px: float, out: Float
) -> None:
    for k in range(start.shape[0]):
        _fit_one(image, kind, start[k], geometry[k], half, settled_px, out[k])


def fit_points(
    image: Float32, kind: int, start: Float, geometry: Float, half_px: int, *, settled_px: float = 1e-5
) -> Float:
    """Fit every point.

    Parameters
    ----------
    image
        (rows, columns) grey levels.
    kind
        :data:`CORNER` or :data:`DOT`.
    start, geometry
        (n, :data:`N_CORNER` or :data:`N_DOT`) and (n, :data:`N_GEOMETRY`), see the module.
    half_px
        Half side of the windows.
    settled_px
        Step of a point below which its fit ends after one more.

    Returns
    -------
    Float
        (n, p + 4): parameters, variance of x, covariance of x and y, variance of y in px^2, and the noise in grey
        levels; NaN where a window holds too little.
    """
    out = np.empty((len(start), start.shape[1] + 4))
    table = np.ascontiguousarray(start, dtype=np.float64)
    _fit_all(image, kind, table, np.ascontiguousarray(geometry, dtype=np.float64), half_px, settled_px, out)
    return out


def model_values(kind: int, parameters: Float, geometry: Float, x: Float, y: Float) -> tuple[Float, Float]:
    """Return the model's grey levels (m,) at pixels and their derivatives (m, p), for tests and drawings."""
    J = np.zeros((len(x), len(parameters)))
    values = np.array([_model(kind, parameters, geometry, x[k], y[k], J[k]) for k in range(len(x))])
    return values, J
