"""The reference subset: rays of its pixels, grey levels, gradients, and the sums that the Hessian is made of.

The derivative of an image's grey levels with respect to the matrix M through which it sees the patch is, at pixel
(X, Y), contrast times ``g M^-1 dM (1, X, Y)^T`` with ``g = (-X fX - Y fY, fX, fY)`` and (fX, fY) the *reference's*
gradient. So nine columns ``g_a m_j`` that know nothing of any image make every Jacobian; one of them depends on two
others, because scaling M changes nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from core.matching.kernels.loops import FAST
from core.matching.kernels.warp import lens_jacobian, undistort

N_REFERENCE = 11
# rows of the reference: X, Y, f, fX, fY, fX X, fX Y, fY X, fY Y, q X, q Y


def _polynomial_fit() -> tuple[np.ndarray, np.ndarray]:
    node = np.array([-1.0, -0.4, 0.4, 1.0])
    xi, eta = (a.ravel() for a in np.meshgrid(node, node))
    columns = [np.ones(16), xi, xi**2, xi**3, eta, eta * xi, eta * xi**2, eta**2, eta**2 * xi, eta**3]
    return np.linalg.pinv(np.stack(columns, axis=1)), np.stack([xi, eta])


_FIT, _NODES = _polynomial_fit()


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def _dot(a, b, n):
    total = np.float32(0.0)
    for i in range(n):
        total += a[i] * b[i]
    return float(total)


@njit(nogil=True, error_model="numpy")
def set_up_reference(pixels, grad_x, grad_y, lens, x_px, y_px, subset, ref, box, poly):
    """Fill the reference subset about (x_px, y_px).

    The pixels are the ``subset`` x ``subset`` nearest ones, at their own places; their rays are relative to the exact
    ray of (x_px, y_px). Undistortion is exact at 16 nodes and a cubic polynomial between them (1e-9 px on the paper's
    lens, tested below 1e-5 px).

    Parameters
    ----------
    pixels, grad_x, grad_y
        (rows, cols) float32 of camera 1 at t0.
    lens
        Camera 1's.
    ref
        (11, subset^2) float32 out, rows as listed above.
    box
        (4,) out: range of X, then of Y.
    poly
        (2, 10) work space.

    Returns
    -------
    tuple
        ``inside`` (bool), the centre's ray ``xc, yc``, and the grey levels' sum of squares about their mean.
    """
    rows, cols = pixels.shape
    left = int(np.floor(x_px - 0.5 * (subset - 1) + 0.5))
    top = int(np.floor(y_px - 0.5 * (subset - 1) + 0.5))
    if left < 0 or top < 0 or left + subset > cols or top + subset > rows:
        return False, 0.0, 0.0, 0.0
    xc, yc = undistort(lens, x_px, y_px)
    half = 0.5 * (subset - 1)
    for j in range(10):
        poly[0, j] = 0.0
        poly[1, j] = 0.0
    for i in range(16):
        u, v = undistort(lens, left + half + half * _NODES[0, i], top + half + half * _NODES[1, i])
        for j in range(10):
            poly[0, j] += _FIT[j, i] * (u - xc)
            poly[1, j] += _FIT[j, i] * (v - yc)
    if not np.isfinite(poly[0, 0] + poly[1, 0]):
        return False, 0.0, 0.0, 0.0
    j11, j12, j21, j22 = lens_jacobian(lens, xc, yc)
    h11, h12, h21, h22 = np.float32(j11), np.float32(j12), np.float32(j21), np.float32(j22)
    total = 0.0
    scale = 1.0 / half
    for r in range(subset):
        eta = r * scale - 1.0
        for c in range(subset):
            total += pixels[top + r, left + c]
        x0 = poly[0, 0] + eta * (poly[0, 4] + eta * (poly[0, 7] + eta * poly[0, 9]))
        x1 = poly[0, 1] + eta * (poly[0, 5] + eta * poly[0, 8])
        x2 = poly[0, 2] + eta * poly[0, 6]
        x3 = poly[0, 3]
        y0 = poly[1, 0] + eta * (poly[1, 4] + eta * (poly[1, 7] + eta * poly[1, 9]))
        y1 = poly[1, 1] + eta * (poly[1, 5] + eta * poly[1, 8])
        y2 = poly[1, 2] + eta * poly[1, 6]
        y3 = poly[1, 3]
        for c in range(subset):
            xi = c * scale - 1.0
            i = r * subset + c
            ref[0, i] = x0 + xi * (x1 + xi * (x2 + xi * x3))
            ref[1, i] = y0 + xi * (y1 + xi * (y2 + xi * y3))
            ref[2, i] = pixels[top + r, left + c]
            ref[3, i] = grad_x[top + r, left + c]
            ref[4, i] = grad_y[top + r, left + c]
    n = subset * subset
    mean = np.float32(total / n)
    x, y, f, gx, gy = ref[0], ref[1], ref[2], ref[3], ref[4]
    for i in range(n):
        f[i] -= mean
        a = gx[i] * h11 + gy[i] * h21
        b = gx[i] * h12 + gy[i] * h22
        gx[i] = a
        gy[i] = b
        q = a * x[i] + b * y[i]
        ref[5, i] = a * x[i]
        ref[6, i] = a * y[i]
        ref[7, i] = b * x[i]
        ref[8, i] = b * y[i]
        ref[9, i] = q * x[i]
        ref[10, i] = q * y[i]
    box[0] = min(x[0], x[n - subset])
    box[1] = max(x[subset - 1], x[n - 1])
    box[2] = min(y[0], y[subset - 1])
    box[3] = max(y[n - subset], y[n - 1])
    for i in range(subset):  # rows and columns bow by the lens: the box must hold every pixel
        box[0] = min(box[0], x[i * subset])
        box[1] = max(box[1], x[i * subset + subset - 1])
        box[2] = min(box[2], y[i])
        box[3] = max(box[3], y[n - subset + i])
    return True, xc, yc, _dot(f, f, n)


_ROW = np.array([3, 5, 6, 4, 7, 8, 9, 10])  # where the eight columns lie in the reference


@njit(nogil=True, error_model="numpy")
def nine_from_eight(eight, nine):
    """Sums over the eight columns -> over the nine ``g_a m_j``, index 3 a + j."""
    nine[0] = -(eight[1] + eight[5])
    nine[1] = -eight[6]
    nine[2] = -eight[7]
    for i in range(6):
        nine[3 + i] = eight[i]


@njit(nogil=True, error_model="numpy")
def reference_sums(ref, n, f2, work, sum_j, sum_fj, hessian):
    """Sums of the nine columns, of f times them, and their Gram matrix with gain and offset projected out.

    Parameters
    ----------
    ref, n, f2
        The reference subset, its number of pixels and its grey levels' sum of squares.
    work
        (10, 9) work space.
    sum_j, sum_fj
        (9,) out.
    hessian
        (9, 9) out.
    """
    one_dot, f_dot = work[8], work[9]
    for i in range(8):
        a = ref[_ROW[i]]
        total = np.float32(0.0)
        for k in range(n):
            total += a[k]
        one_dot[i] = total
        f_dot[i] = _dot(a, ref[2], n)
        for j in range(i, 8):
            value = _dot(a, ref[_ROW[j]], n)
            work[i, j] = value
            work[j, i] = value
    nine_from_eight(one_dot, sum_j)
    nine_from_eight(f_dot, sum_fj)
    for i in range(8):
        row = work[i]
        a, b, c = -(row[1] + row[5]), -row[6], -row[7]
        r0, r1, r2, r3, r4, r5 = row[0], row[1], row[2], row[3], row[4], row[5]
        row[0], row[1], row[2] = a, b, c
        row[3], row[4], row[5], row[6], row[7], row[8] = r0, r1, r2, r3, r4, r5
    for j in range(9):
        hessian[0, j] = -(work[1, j] + work[5, j])
        hessian[1, j] = -work[6, j]
        hessian[2, j] = -work[7, j]
        for i in range(6):
            hessian[3 + i, j] = work[i, j]
    for i in range(9):
        for j in range(9):
            hessian[i, j] -= sum_j[i] * sum_j[j] / n + sum_fj[i] * sum_fj[j] / f2
