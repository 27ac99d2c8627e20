"""What the fits of shape and of motion share at one point.

Unknowns, in this order inside: (w0, G00, G10, G20), (w1, G01, ...), (w2, G02, ...), e. Camera images see the patch
through

    cam2 at t0   M_0 = S(e) (R21 C + t21 w^T),   C = [c, ex, ey], c = (Xc, Yc, 1)
    cam1 at t    M_1 = G
    cam2 at t    M_2 = S(e) (R21 G + t21 w^T)

S(e) shifts camera 2's normalised image by e times one pixel across the epipolar line of the point.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.matching.kernels.linear import invert3, solve
from core.matching.kernels.loops import N_SUMS, sums_cubic, sums_quintic
from core.matching.kernels.reference import N_REFERENCE, nine_from_eight
from core.matching.kernels.warp import N_WARP, lens_jacobian, set_up_warp
from core.status import PointStatus

OK = int(PointStatus.OK)
OUTSIDE_IMAGE = int(PointStatus.OUTSIDE_IMAGE)
LOW_TEXTURE = int(PointStatus.LOW_TEXTURE)
NOT_CONVERGED = int(PointStatus.NOT_CONVERGED)
SINGULAR = int(PointStatus.SINGULAR)
NOT_SEEDED = int(PointStatus.NOT_SEEDED)
LOW_CORRELATION = int(PointStatus.LOW_CORRELATION)

REFREEZE_PX = 0.5  # corner motion after which the frozen Hessian is set up anew
CREEPING = 8  # iterations after which the noise is taken out of the Hessian that makes the steps
FIRST_RATE = 0.3  # convergence rate assumed before two steps have shown it
MAX_NOISE_SHARE = 0.7  # of the squared gradients; above it the texture is noise
# white noise of variance 1 behind a spline: variance of the value, mean over all sub-pixel places, and of the
# derivative at pixel centres (integrals of the cardinal splines' squares); cubic, quintic
VALUE_NOISE = (0.764, 0.843)
SLOPE_NOISE = (1.392, 1.894)
WHITE_ROUGHNESS = 1.2  # mean squared gradient over variance that only white noise has


@njit(nogil=True, error_model="numpy")
def work_space(subset, images):
    """Everything one thread needs, so that no point allocates."""
    return (
        np.empty((N_REFERENCE, subset * subset), np.float32),  # 0 ref
        np.zeros(N_WARP, np.float32),  # 1 p
        np.empty(N_SUMS),  # 2 sums
        np.empty(4),  # 3 box
        np.empty((2, 10)),  # 4 poly
        np.empty((10, 9)),  # 5 work
        np.empty((2, 9)),  # 6 sum_j, sum_fj
        np.empty((9, 9)),  # 7 hessian
        np.empty((images, 9)),  # 8 rhs
        np.empty((images, 4)),  # 9 gain, shift, zncc, contrast
        np.empty((images, images)),  # 10 weights
        np.empty((images, 3, 3)),  # 11 M
        np.empty((images, 3, 4)),  # 12 blocks
        np.empty((images, 9)),  # 13 offsets
        np.empty((13, 13)),  # 14 normal
        np.empty((images, 9, 13)),  # 15 half
        np.empty((4, 13)),  # 16 vectors
        np.empty((13, 13)),  # 17 reduced
        np.zeros((13, 13)),  # 18 chain
        np.empty((3, 3)),  # 19 inverse
        np.empty((3, 3)),  # 20 G
        np.empty((3, 3)),  # 21 rotation
        np.empty((9, 9)),  # 22 denoised
        np.empty((13, 13)),  # 23 noisy
        np.empty((5, 13)),  # 24 columns
    )


@njit(nogil=True, error_model="numpy")
def compare(image, lens, m, order, ref, n, f2, box, p, sums, sum_j, sum_fj, levels, rhs):
    """Compare one image with the reference at the warp ``m``; False if the patch leaves the image.

    Fills ``rhs`` (9,), the sums of the zero-mean normalised residual times the nine columns, and updates ``levels``:
    gain and shift that normalise this image's grey levels, zncc, contrast.
    """
    coefficients, rows, cols, stride = image
    base = set_up_warp(lens, m, box, rows, cols, stride, 1 if order == 3 else 2, p)
    if base < 0:
        return False
    p[23] = levels[0]
    p[24] = levels[1]
    if order == 3:
        sums_cubic(coefficients, np.int32(base), np.int32(stride), p, ref, n, sums)
    else:
        sums_quintic(coefficients, np.int32(base), np.int32(stride), p, ref, n, sums)
    # the loop used y = gain g - shift, d = y - f, with the float32 of gain and shift
    gain, shift = float(p[23]), float(p[24])
    mean = sums[0] / n
    y2 = sums[2] + 2.0 * sums[1] + f2 - sums[0] * mean
    if not y2 > 1e-12 * f2:
        levels[2] = 0.0
        levels[3] = 0.0
        for i in range(9):
            rhs[i] = 0.0
        return True
    c = math.sqrt(y2 / f2)
    nine_from_eight(sums[3:], rhs)
    for i in range(9):
        rhs[i] = (rhs[i] - mean * sum_j[i] + sum_fj[i]) / c - sum_fj[i]
    levels[0] = gain / c
    levels[1] = (shift + mean) / c
    levels[2] = (sums[1] + f2) / math.sqrt(f2 * y2)
    levels[3] = c / gain
    return True


@njit(nogil=True, error_model="numpy")
def epipolar_shift(lens2, R, t, xc, yc, w0):
    """Camera 2's normalised shift (nu_x, nu_y) that moves the point's image by 1 px across its epipolar line.

    Positive where ``StereoPair.epipolar_residual_px`` is. Also returns how many px of camera 2 a unit of w0 moves the
    point; zero where the epipolar line is a point.
    """
    q0 = R[0, 0] * xc + R[0, 1] * yc + R[0, 2]
    q1 = R[1, 0] * xc + R[1, 1] * yc + R[1, 2]
    q2 = R[2, 0] * xc + R[2, 1] * yc + R[2, 2]
    line_x = t[1] * q2 - t[2] * q1
    line_y = t[2] * q0 - t[0] * q2
    z = q2 + t[2] * w0
    u, v = (q0 + t[0] * w0) / z, (q1 + t[1] * w0) / z
    j11, j12, j21, j22 = lens_jacobian(lens2, u, v)
    det = j11 * j22 - j12 * j21
    i11, i12, i21, i22 = j22 / det, -j12 / det, -j21 / det, j11 / det
    gx, gy = i11 * line_x + i21 * line_y, i12 * line_x + i22 * line_y  # J^-T line
    length = math.sqrt(gx * gx + gy * gy)
    if not length > 1e-30:
        return 0.0, 0.0, 0.0
    gx, gy = gx / length, gy / length
    du, dv = (t[0] - u * t[2]) / z, (t[1] - v * t[2]) / z
    along = math.sqrt((j11 * du + j12 * dv) ** 2 + (j21 * du + j22 * dv) ** 2)
    return i11 * gx + i12 * gy, i21 * gx + i22 * gy, along


@njit(nogil=True, error_model="numpy")
def image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, images, M):
    """The matrices through which the images see the patch."""
    for i in range(3):
        M[0, i, 0] = R[i, 0] * xc + R[i, 1] * yc + R[i, 2] + t[i] * w[0]
        M[0, i, 1] = R[i, 0] + t[i] * w[1]
        M[0, i, 2] = R[i, 1] + t[i] * w[2]
        if images == 3:
            for j in range(3):
                M[1, i, j] = G[i, j]
                M[2, i, j] = R[i, 0] * G[0, j] + R[i, 1] * G[1, j] + R[i, 2] * G[2, j] + t[i] * w[j]
    for k in range(0, images, 2):
        for j in range(3):
            M[k, 0, j] += e * nu_x * M[k, 2, j]
            M[k, 1, j] += e * nu_y * M[k, 2, j]


@njit(nogil=True, error_model="numpy")
def jacobian_blocks(R, t, e, nu_x, nu_y, images, M, inverse, blocks, offsets):
    """``M^-1 dM`` per unknown, see :func:`core.matching.kernels.linear.assemble`; False if an M is singular."""
    for k in range(images):
        if not invert3(M[k], inverse):
            return False
        for a in range(3):
            if k == 1:
                blocks[k, a, 0] = 0.0
                for i in range(3):
                    blocks[k, a, 1 + i] = inverse[a, i]
                for j in range(3):
                    offsets[k, 3 * a + j] = 0.0
                continue
            s0, s1 = inverse[a, 0], inverse[a, 1]
            s2 = inverse[a, 2] + e * (nu_x * s0 + nu_y * s1)  # row a of M^-1 S(e)
            blocks[k, a, 0] = s0 * t[0] + s1 * t[1] + s2 * t[2]
            for i in range(3):
                blocks[k, a, 1 + i] = (s0 * R[0, i] + s1 * R[1, i] + s2 * R[2, i]) if k == 2 else 0.0
            shift = nu_x * s0 + nu_y * s1
            for j in range(3):
                offsets[k, 3 * a + j] = shift * M[k, 2, j]
    return True


@njit(nogil=True, error_model="numpy")
def joint_weights(levels, images, weights):
    """Inverse covariance of the comparisons' residuals, in units of 1 / sigma^2.

    Residual k is (noise of image k) / contrast_k minus the reference's noise, which all share: covariance
    sigma^2 (diag(1 / contrast^2) + 1 1^T).
    """
    total = 1.0
    for k in range(images):
        s = min(max(levels[k, 3], 0.05), 20.0)
        total += s * s
    for k in range(images):
        a = min(max(levels[k, 3], 0.05), 20.0) ** 2
        for o in range(images):
            b = min(max(levels[o, 3], 0.05), 20.0) ** 2
            weights[k, o] = (a if k == o else 0.0) - a * b / total


@njit(nogil=True, error_model="numpy")
def corner_motion(blocks, offsets, step, images, box, scale_x, scale_y):
    """Largest motion of a corner of the subset over the images for a step (13,), in camera 1 px."""
    largest = 0.0
    for k in range(images):
        for ix in range(2):
            for iy in range(2, 4):
                x, y = box[ix], box[iy]
                d0 = d1 = d2 = 0.0
                for j in range(3):
                    m = 1.0 if j == 0 else (x if j == 1 else y)
                    for a in range(3):
                        s = offsets[k, 3 * a + j] * step[12]
                        for i in range(4):
                            s += blocks[k, a, i] * step[4 * j + i]
                        if a == 0:
                            d0 += s * m
                        elif a == 1:
                            d1 += s * m
                        else:
                            d2 += s * m
                largest = max(largest, math.hypot((d1 - x * d0) * scale_x, (d2 - y * d0) * scale_y))
    return largest


@njit(nogil=True, error_model="numpy")
def residual_variance(levels, images, n, f2, unknowns, order):
    """Variance of one image's noise, in reference grey levels squared, from the residuals.

    Of three comparisons the quietest counts: what raises the others' residuals are small differences of the views,
    which do not pull the solution as noise does.
    """
    value_noise = VALUE_NOISE[0] if order == 3 else VALUE_NOISE[1]
    smallest = np.inf
    for k in range(images):
        s = min(max(levels[k, 3], 0.05), 20.0)
        smallest = min(smallest, 2.0 * f2 * (1.0 - levels[k, 2]) / (1.0 + value_noise / (s * s)))
    return max(smallest, 0.0) / max(n - 2.0 - unknowns / images, 1.0)


@njit(nogil=True, error_model="numpy")
def noise_share(variance, roughness, f2, n, order):
    """Share of noise in the reference's squared gradients of this roughness, hence in the Hessian.

    The Hessian H is larger than the sensitivity H (1 - share) that turns a shift into its right-hand side, so the
    covariance is sigma^2 H^-1 / (1 - share)^2: the sandwich.
    """
    slope_noise = SLOPE_NOISE[0] if order == 3 else SLOPE_NOISE[1]
    return slope_noise * variance * n / (roughness * f2)


@njit(nogil=True, error_model="numpy")
def take_noise_out(hessian, lens1, xc, yc, box, subset, variance, order, denoised):
    """The Gram matrix less the share that white noise of this variance in the reference has in it.

    What is left is how far a shift really pulls the right-hand side. The noise's share is largest in the patch's
    least certain deformations, where Gauss-Newton with the noisy matrix creeps and its inverse is too small.

    Parameters
    ----------
    hessian, denoised
        (9, 9) from ``reference_sums``, and the result.
    box
        Range of X and of Y, for the moments of the subset's pixels.
    variance
        Of the noise, grey levels squared.
    """
    j11, j12, j21, j22 = lens_jacobian(lens1, xc, yc)
    n = subset * subset
    noise = (SLOPE_NOISE[0] if order == 3 else SLOPE_NOISE[1]) * variance * n
    vx, vy = noise * (j11 * j11 + j21 * j21), noise * (j12 * j12 + j22 * j22)
    s2 = float(n)
    dx2, dy2 = ((box[1] - box[0]) / (subset - 1)) ** 2, ((box[3] - box[2]) / (subset - 1)) ** 2
    m2, m4 = (s2 - 1.0) / 12.0, (s2 - 1.0) * (3.0 * s2 - 7.0) / 240.0
    x2, y2, x4, y4 = m2 * dx2, m2 * dy2, m4 * dx2 * dx2, m4 * dy2 * dy2
    for i in range(9):
        for j in range(9):
            denoised[i, j] = hessian[i, j]
    denoised[0, 0] -= vx * x2 + vy * y2
    denoised[1, 1] -= vx * x4 + vy * x2 * y2
    denoised[2, 2] -= vx * x2 * y2 + vy * y4
    for j in range(3):
        moment = 1.0 if j == 0 else (x2 if j == 1 else y2)
        denoised[3 + j, 3 + j] -= vx * moment
        denoised[6 + j, 6 + j] -= vy * moment
    for i, j, v in ((0, 4, vx * x2), (1, 3, vx * x2), (0, 8, vy * y2), (2, 6, vy * y2)):
        denoised[i, j] += v
        denoised[j, i] += v


@njit(nogil=True, error_model="numpy")
def sandwich(factor_s, noisy, wanted, free, columns, out):
    """``S^-1 H S^-1`` for some unknowns, from the Cholesky factor of S and H itself.

    ``wanted`` (m,) are their indices, ``columns`` (m, free) work space, ``out`` (m * m,) the result.
    """
    m = len(wanted)
    for a in range(m):
        for b in range(free):
            columns[a, b] = 0.0
        columns[a, wanted[a]] = 1.0
        solve(factor_s, columns[a], free)
    for a in range(m):
        for b in range(a, m):
            s = 0.0
            for i in range(free):
                t = 0.0
                for j in range(free):
                    t += noisy[i, j] * columns[b, j]
                s += columns[a, i] * t
            out[m * a + b] = s
            out[m * b + a] = s


@njit(nogil=True, error_model="numpy")
def texture_roughness(hessian, lens1, xc, yc, f2):
    """Squared gradient (per px) over the grey levels' variance: mean over directions, and in the weakest direction."""
    j11, j12, j21, j22 = lens_jacobian(lens1, xc, yc)
    xx, yy = j11 * j11 + j21 * j21, j12 * j12 + j22 * j22
    gxx, gyy = hessian[3, 3] / xx, hessian[6, 6] / yy
    gxy = hessian[3, 6] / math.sqrt(xx * yy)
    mean = 0.5 * (gxx + gyy)
    return mean / f2, (mean - math.sqrt(0.25 * (gxx - gyy) ** 2 + gxy * gxy)) / f2


@njit(nogil=True, error_model="numpy")
def settled(motion, previous, tolerance):
    """Whether the steps still to come, as a geometric series, move no corner further than the tolerance."""
    if motion < 0.1 * tolerance:
        return True
    rate = FIRST_RATE if previous == 0.0 else motion / previous
    return rate < 0.9 and motion * rate / (1.0 - rate) < tolerance


@njit(nogil=True, error_model="numpy")
def texture_status(status, share, sigma_px, max_sigma_px, zncc):
    """Final status: a point that settled, or did not, on noise taken for texture or on a match that scatters."""
    if status == OK and share < MAX_NOISE_SHARE and sigma_px < max_sigma_px:
        return OK
    if zncc > 0.5 and not share < MAX_NOISE_SHARE:
        return LOW_TEXTURE
    if status == OK:
        return LOW_TEXTURE if zncc > 0.5 else LOW_CORRELATION
    return status
