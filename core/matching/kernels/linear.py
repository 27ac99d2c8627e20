"""Small dense algebra for one point: Cholesky, 3 x 3 inverse, normal equations from the nine-column form."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(nogil=True, error_model="numpy")
def factor(a, n):
    """Cholesky factor of the leading (n, n) of ``a`` in place (lower); False if not positive definite.

    The test is relative to each diagonal entry, so it does not depend on the unknowns' units.
    """
    for j in range(n):
        diagonal = a[j, j]
        s = diagonal
        for k in range(j):
            s -= a[j, k] * a[j, k]
        if not s > 1e-11 * diagonal:
            return False
        root = math.sqrt(s)
        a[j, j] = root
        inverse = 1.0 / root
        for i in range(j + 1, n):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            a[i, j] = s * inverse
    return True


@njit(nogil=True, error_model="numpy")
def solve(a, b, n):
    """Solve in place with the factor from :func:`factor`."""
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= a[i, k] * b[k]
        b[i] = s / a[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= a[k, i] * b[k]
        b[i] = s / a[i, i]


@njit(nogil=True, error_model="numpy")
def invert3(m, out):
    """Inverse of a 3 x 3 matrix; False if it has none."""
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    c01 = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    c02 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    det = m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02
    if det == 0.0 or not np.isfinite(det):
        return False
    r = 1.0 / det
    out[0, 0] = c00 * r
    out[1, 0] = c01 * r
    out[2, 0] = c02 * r
    out[0, 1] = (m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]) * r
    out[1, 1] = (m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]) * r
    out[2, 1] = (m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]) * r
    out[0, 2] = (m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]) * r
    out[1, 2] = (m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]) * r
    out[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * r
    return True


@njit(nogil=True, error_model="numpy")
def assemble(weights, blocks, offsets, hessian, images, normal, half):
    """Normal equations in (theta_0, theta_1, theta_2, e) from the nine-column Gram matrix.

    Image k's matrix M_k changes by ``M_k^-1 dM_k = blocks_k [theta_0 theta_1 theta_2] + e offsets_k``, where theta_j
    holds column j's unknowns (w_j, G_0j, G_1j, G_2j).

    Parameters
    ----------
    weights
        (images, images) joint weights of the comparisons.
    blocks
        (images, 3, 4).
    offsets
        (images, 9), row by row.
    hessian
        (9, 9) from ``reference_sums``.
    normal
        (13, 13) out.
    half
        (images, 9, 13) work space: weighted ``hessian`` times Jacobian of each image.
    """
    for k in range(images):
        for r in range(9):
            for j in range(3):
                for i in range(4):
                    half[k, r, 4 * j + i] = (
                        hessian[r, j] * blocks[k, 0, i]
                        + hessian[r, 3 + j] * blocks[k, 1, i]
                        + hessian[r, 6 + j] * blocks[k, 2, i]
                    )
            s = 0.0
            for c in range(9):
                s += hessian[r, c] * offsets[k, c]
            half[k, r, 12] = s
    for r in range(9):
        for c in range(13):
            if images == 3:
                a, b, d = half[0, r, c], half[1, r, c], half[2, r, c]
                for k in range(3):
                    half[k, r, c] = weights[k, 0] * a + weights[k, 1] * b + weights[k, 2] * d
            else:
                half[0, r, c] *= weights[0, 0]
    for r in range(13):
        for c in range(13):
            normal[r, c] = 0.0
    for k in range(images):
        for j in range(3):
            for i in range(4):
                row = normal[4 * j + i]
                a, b, d = blocks[k, 0, i], blocks[k, 1, i], blocks[k, 2, i]
                for c in range(13):
                    row[c] += a * half[k, j, c] + b * half[k, 3 + j, c] + d * half[k, 6 + j, c]
        for c in range(13):
            s = 0.0
            for r in range(9):
                s += offsets[k, r] * half[k, r, c]
            normal[12, c] += s


@njit(nogil=True, error_model="numpy")
def gradient(weights, blocks, offsets, rhs, images, out):
    """Right-hand side (13,) in (theta_0, theta_1, theta_2, e) from each image's nine sums ``rhs`` (images, 9)."""
    for r in range(13):
        out[r] = 0.0
    for k in range(images):
        for r in range(9):
            s = 0.0
            for o in range(images):
                s += weights[k, o] * rhs[o, r]
            a = r // 3
            j = r - 3 * a
            for i in range(4):
                out[4 * j + i] += blocks[k, a, i] * s
            out[12] += offsets[k, r] * s
