"""Pictures of a checkerboard's corner and of a dot, blurred by a Gaussian, with their derivatives.

Lens blur and the pixel's own area together are close to a Gaussian; both pictures are symmetric about the point, so
that another blur of the same symmetry moves no point.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from core.arrays import Float

CORNER_PARAMETERS = 7  # x, y, angles of the two edges, ground, amplitude, blur
DOT_PARAMETERS = 8  # x, y, three of the ellipse's inverse square root matrix, ground, amplitude, blur
_ROOT = np.sqrt(2.0 / np.pi)
_LEAST_BLUR = 0.2


def corner(parameters: Float, x: Float, y: Float) -> tuple[Float, Float]:
    """Two crossed edges: ``ground + amplitude erf(u / (sqrt 2 s)) erf(v / (sqrt 2 s))``, u and v distances to them."""
    x0, y0, first, second, ground, amplitude, blur = (parameters[:, k, None] for k in range(CORNER_PARAMETERS))
    s = np.maximum(np.abs(blur), _LEAST_BLUR)
    dx, dy = x - x0, y - y0
    cu, su, cv, sv = np.cos(first), np.sin(first), np.cos(second), np.sin(second)
    # distances to an edge along (cos, sin)
    u, v = dy * cu - dx * su, dy * cv - dx * sv
    eu, ev = erf(u / (np.sqrt(2.0) * s)), erf(v / (np.sqrt(2.0) * s))
    gu, gv = _ROOT / s * np.exp(-0.5 * (u / s) ** 2), _ROOT / s * np.exp(-0.5 * (v / s) ** 2)
    du, dv = amplitude * gu * ev, amplitude * eu * gv
    jac = np.empty((*x.shape, CORNER_PARAMETERS))
    jac[..., 0] = du * su + dv * sv
    jac[..., 1] = -du * cu - dv * cv
    jac[..., 2] = -du * (dx * cu + dy * su)
    jac[..., 3] = -dv * (dx * cv + dy * sv)
    jac[..., 4] = 1.0
    jac[..., 5] = eu * ev
    jac[..., 6] = -(du * u + dv * v) / s
    return ground + amplitude * eu * ev, jac


def dot(parameters: Float, x: Float, y: Float) -> tuple[Float, Float]:
    """Draw an ellipse with a blurred rim: ``ground + amplitude (1 - erf((rho - 1) r / (sqrt 2 s))) / 2``.

    ``rho = |M d|`` with the symmetric matrix M (a, b; b, c) in 1/px, and r the mean radius.
    """
    x0, y0, a, b, c, ground, amplitude, blur = (parameters[:, k, None] for k in range(DOT_PARAMETERS))
    s = np.maximum(np.abs(blur), _LEAST_BLUR)
    dx, dy = x - x0, y - y0
    p, q = a * dx + b * dy, b * dx + c * dy
    rho = np.maximum(np.hypot(p, q), 1e-9)
    determinant = np.maximum(np.abs(a * c - b * b), 1e-12)
    r = determinant**-0.5
    t = (rho - 1.0) * r / s
    inside = 0.5 * (1.0 - erf(t / np.sqrt(2.0)))
    slope = -amplitude * np.exp(-0.5 * t * t) / np.sqrt(2.0 * np.pi)  # by t
    by_rho = slope * r / s
    # r depends on the matrix too: dr = -r / (2 det) d det
    by_det = slope * (rho - 1.0) / s * (-0.5 * r / determinant)
    jac = np.empty((*x.shape, DOT_PARAMETERS))
    jac[..., 0] = -by_rho * (p * a + q * b) / rho
    jac[..., 1] = -by_rho * (p * b + q * c) / rho
    jac[..., 2] = by_rho * p * dx / rho + by_det * c
    jac[..., 3] = by_rho * (p * dy + q * dx) / rho - by_det * 2.0 * b
    jac[..., 4] = by_rho * q * dy / rho + by_det * a
    jac[..., 5] = 1.0
    jac[..., 6] = inside
    jac[..., 7] = -slope * t / s
    return ground + amplitude * inside, jac
