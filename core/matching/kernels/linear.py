"""Small dense algebra for one point: 3 x 3 inverse, weighted normal equations, Cholesky, covariance of the last few."""

from __future__ import annotations

import math

import numpy as np
from numba import njit




@njit(nogil=True, error_model="numpy")
def invert3(m, out):
    """Inverse of the leading 3 x 3 of a matrix; False if it has none."""
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
def factor(a, n):
    """Cholesky factor U, ``a = U^T U``, of the leading (n, n) in place (upper, with 1 / diagonal on the diagonal).

    False if not positive definite; the test is relative to each diagonal entry, so it does not depend on the unknowns'
    units. Row-wise updates of whole rows: entries below the diagonal are left with rubbish.
    """
    for j in range(n):
        original = a[j, j]
        for k in range(j):
            original += a[k, j] * a[k, j]
        if not a[j, j] > 1e-11 * original:
            return False
        inverse = 1.0 / math.sqrt(a[j, j])
        for c in range(j + 1, n):
            a[j, c] *= inverse
        a[j, j] = inverse
        for i in range(j + 1, n):
            f = a[j, i]
            for c in range(i, n):
                a[i, c] -= f * a[j, c]
    return True


@njit(nogil=True, error_model="numpy")
def solve(u, b, n):
    """Solve ``U^T U x = b`` in place with the factor from :func:`factor`."""
    for i in range(n):
        s = b[i] * u[i, i]
        b[i] = s
        for c in range(i + 1, n):
            b[c] -= u[i, c] * s
    for i in range(n - 1, -1, -1):
        s = b[i]
        for c in range(i + 1, n):
            s -= u[i, c] * b[c]
        b[i] = s * u[i, i]


@njit(nogil=True, error_model="numpy")
def covariance_of_last(u, n, m, work, out):
    """Inverse's trailing (m, m) block from :func:`factor`, row by row into ``out``: the others drop out by themselves."""
    first = n - m
    for j in range(m):  # columns of the trailing block's inverse, upper triangular
        for i in range(m):
            work[i, j] = 0.0
        work[j, j] = u[first + j, first + j]
        for i in range(j - 1, -1, -1):
            s = 0.0
            for k in range(i + 1, j + 1):
                s -= u[first + i, first + k] * work[k, j]
            work[i, j] = s * u[first + i, first + i]
    for i in range(m):
        for j in range(i, m):
            s = 0.0
            for k in range(j, m):
                s += work[i, k] * work[j, k]
            out[m * i + j] = s
            out[m * j + i] = s
