"""Gauss-Newton for shape and motion at one point from three comparisons: 12 + 1 unknowns (stretch) or 9 + 1 (rigid)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.matching.kernels.linear import assemble, factor, gradient, solve
from core.matching.kernels.point import (
    CREEPING,
    LOW_TEXTURE,
    NOT_CONVERGED,
    NOT_SEEDED,
    OK,
    OUTSIDE_IMAGE,
    REFREEZE_PX,
    SINGULAR,
    WHITE_ROUGHNESS,
    compare,
    corner_motion,
    epipolar_shift,
    image_matrices,
    jacobian_blocks,
    joint_weights,
    noise_share,
    residual_variance,
    sandwich,
    settled,
    take_noise_out,
    texture_roughness,
    texture_status,
)
from core.matching.kernels.reference import reference_sums, set_up_reference

N_MOTION_OUT = 42
N_RIGID = 10
_STRETCH_POSE = np.array([0, 1, 2, 3, 12])  # w0, G00, G10, G20, e among the free unknowns
_RIGID_POSE = np.array([0, 1, 2, 3, N_RIGID - 1])


@njit(nogil=True, error_model="numpy")
def _frame(tangents, frame):
    """Orthonormal frame (columns) on two tangent vectors (rows): along their bisectors, so neither is preferred."""
    a, b = tangents[0], tangents[1]
    la = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    lb = math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    ls = 0.0
    ld = 0.0
    for i in range(3):
        s, d = a[i] / la + b[i] / lb, a[i] / la - b[i] / lb
        frame[i, 0], frame[i, 1] = s, d
        ls += s * s
        ld += d * d
    if not (ls > 0.0 and ld > 0.0):
        return False
    for i in range(3):
        frame[i, 0] /= math.sqrt(ls)
        frame[i, 1] /= math.sqrt(ld)
    frame[0, 2] = frame[1, 0] * frame[2, 1] - frame[2, 0] * frame[1, 1]
    frame[1, 2] = frame[2, 0] * frame[0, 1] - frame[0, 0] * frame[2, 1]
    frame[2, 2] = frame[0, 0] * frame[1, 1] - frame[1, 0] * frame[0, 1]
    return np.isfinite(ls + ld)


@njit(nogil=True, error_model="numpy")
def nearest_rotation(xc, yc, w, G, rotation):
    """Rotation that carries the reference patch's tangents closest to those in ``G``."""
    tangents, before, after = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    for j in range(2):
        r = w[1 + j] / w[0]
        tangents[j, 0], tangents[j, 1], tangents[j, 2] = -xc * r, -yc * r, -r
        tangents[j, j] += 1.0
    if not _frame(tangents, before):
        return False
    for j in range(2):
        for i in range(3):
            tangents[j, i] = G[i, 1 + j] - G[i, 0] * w[1 + j] / w[0]
    if not _frame(tangents, after):
        return False
    for i in range(3):
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += after[i, k] * before[j, k]
            rotation[i, j] = s
    return True


@njit(nogil=True, error_model="numpy")
def rotate(rotation, a, b, c):
    """Replace ``rotation`` by exp([(a, b, c)]x) ``rotation``, exactly (Rodrigues)."""
    angle = math.sqrt(a * a + b * b + c * c)
    if angle < 1e-6:  # series, so that no small angle divides by itself
        s, v = 1.0 - angle * angle / 6.0, 0.5
    else:
        s, v = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    for j in range(3):
        x, y, z = rotation[0, j], rotation[1, j], rotation[2, j]
        c1x, c1y, c1z = b * z - c * y, c * x - a * z, a * y - b * x
        c2x, c2y, c2z = b * c1z - c * c1y, c * c1x - a * c1z, a * c1y - b * c1x
        rotation[0, j] = x + s * c1x + v * c2x
        rotation[1, j] = y + s * c1y + v * c2y
        rotation[2, j] = z + s * c1z + v * c2z


@njit(nogil=True, error_model="numpy")
def rigid_columns(xc, yc, w, rotation, G):
    """Fill G's second and third column from w, the first column and the rotation."""
    for j in range(2):
        r = w[1 + j] / w[0]
        for i in range(3):
            turned = rotation[i, 0] * xc + rotation[i, 1] * yc + rotation[i, 2]
            G[i, 1 + j] = rotation[i, j] + r * (G[i, 0] - turned)


@njit(nogil=True, error_model="numpy")
def rigid_chain(xc, yc, w, rotation, G, chain):
    """d(thirteen unknowns) / d(w0, G0, w1, w2, rotation vector, e), (13, 10), at the present state."""
    for i in range(13):
        for j in range(N_RIGID):
            chain[i, j] = 0.0
    for i in range(4):
        chain[i, i] = 1.0
    chain[4, 4] = 1.0
    chain[8, 5] = 1.0
    chain[12, 9] = 1.0
    for j in range(2):
        r = w[1 + j] / w[0]
        first = 5 + 4 * j
        for i in range(3):
            turned = rotation[i, 0] * xc + rotation[i, 1] * yc + rotation[i, 2]
            chain[first + i, 0] = -r / w[0] * (G[i, 0] - turned)
            chain[first + i, 1 + i] = r
            chain[first + i, 4 + j] = (G[i, 0] - turned) / w[0]
        # rotated tangent a: d(exp(o) a) / do = -[a]x
        a0 = rotation[0, j] - r * (rotation[0, 0] * xc + rotation[0, 1] * yc + rotation[0, 2])
        a1 = rotation[1, j] - r * (rotation[1, 0] * xc + rotation[1, 1] * yc + rotation[1, 2])
        a2 = rotation[2, j] - r * (rotation[2, 0] * xc + rotation[2, 1] * yc + rotation[2, 2])
        chain[first, 7], chain[first, 8] = a2, -a1
        chain[first + 1, 6], chain[first + 1, 8] = -a2, a0
        chain[first + 2, 6], chain[first + 2, 7] = a1, -a0


@njit(nogil=True, error_model="numpy")
def _reduce(normal, chain, rigid, half, reduced):
    """Normal equations of the unknowns that are free; their number."""
    if not rigid:
        for i in range(13):
            for j in range(13):
                reduced[i, j] = normal[i, j]
        return 13
    product = half[0]  # one row of work space
    for i in range(N_RIGID):
        for c in range(13):
            s = 0.0
            for r in range(13):
                s += chain[r, i] * normal[r, c]
            product[0, c] = s
        for j in range(N_RIGID):
            s = 0.0
            for c in range(13):
                s += product[0, c] * chain[c, j]
            reduced[i, j] = s
    return N_RIGID


@njit(nogil=True, error_model="numpy")
def motion_point(reference, gradients, image2, image1t, image2t, lens1, lens2, R, t, xy, start_w, start_g, setting,
                 space, out):  # fmt: skip
    """Fit one point. ``out``: w (3), G (9), e, zncc (3), noise, covariance (25) of (w0, G00, G10, G20, e).

    Returns status and iterations.
    """
    subset, order, max_iterations, tolerance, max_sigma, max_step, rigid = setting
    (ref, p, sums, box, poly, work, sum_both, hessian, rhs, levels, weights, M, blocks, offsets, normal, half, vectors,
     reduced, chain, inverse, G, rotation, denoised, noisy, columns) = space  # fmt: skip
    n = subset * subset
    grad_x, grad_y = gradients
    inside, xc, yc, f2 = set_up_reference(reference, grad_x, grad_y, lens1, xy[0], xy[1], subset, ref, box, poly)
    if not inside:
        return OUTSIDE_IMAGE, 0
    if not f2 > 0.0:
        return LOW_TEXTURE, 0
    sum_j, sum_fj = sum_both[0], sum_both[1]
    reference_sums(ref, n, f2, work, sum_j, sum_fj, hessian)
    roughness, weakest = texture_roughness(hessian, lens1, xc, yc, f2)
    if not 1e-6 < roughness < WHITE_ROUGHNESS:
        return LOW_TEXTURE, 0
    w, step, rhs13, small = vectors[0], vectors[1], vectors[2], vectors[3]
    total = 0.0
    for i in range(3):
        w[i] = start_w[i]
        total += w[i]
        for j in range(3):
            G[i, j] = start_g[i, j]
            total += G[i, j]
    if not np.isfinite(total):
        return NOT_SEEDED, 0
    nu_x, nu_y, along = epipolar_shift(lens2, R, t, xc, yc, w[0])
    if not along > 0.0:
        return SINGULAR, 0
    if rigid:
        if not nearest_rotation(xc, yc, w, G, rotation):
            return SINGULAR, 0
        rigid_columns(xc, yc, w, rotation, G)
    e = 0.0
    for k in range(3):
        levels[k, 0], levels[k, 1] = 1.0, 0.0
    moved, previous = np.inf, 0.0
    free = 13
    status = NOT_CONVERGED
    iterations = 0
    last = False
    quiet = False
    while True:
        image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, 3, M)
        inside = compare(image2, lens2, M[0], order, ref, n, f2, box, p, sums, sum_j, sum_fj, levels[0], rhs[0])
        inside = inside and compare(
            image1t, lens1, M[1], order, ref, n, f2, box, p, sums, sum_j, sum_fj, levels[1], rhs[1]
        )
        inside = inside and compare(
            image2t, lens2, M[2], order, ref, n, f2, box, p, sums, sum_j, sum_fj, levels[2], rhs[2]
        )
        if not inside:
            return OUTSIDE_IMAGE, iterations
        if levels[0, 3] == 0.0 or levels[1, 3] == 0.0 or levels[2, 3] == 0.0:
            return LOW_TEXTURE, iterations
        last = status == OK or iterations == max_iterations
        if iterations == CREEPING and not last:
            variance = residual_variance(levels, 3, n, f2, float(free), order)
            take_noise_out(hessian, lens1, xc, yc, box, subset, variance, order, denoised)
            quiet, moved = True, np.inf
        if last or moved > REFREEZE_PX:
            joint_weights(levels, 3, weights)
            if not jacobian_blocks(R, t, e, nu_x, nu_y, 3, M, inverse, blocks, offsets):
                return SINGULAR, iterations
            if rigid:
                rigid_chain(xc, yc, w, rotation, G, chain)
            if quiet and not last:
                assemble(weights, blocks, offsets, denoised, 3, normal, half)
                free = _reduce(normal, chain, rigid, half, reduced)
                quiet = factor(reduced, free)
            if last or not quiet:
                assemble(weights, blocks, offsets, hessian, 3, normal, half)
                free = _reduce(normal, chain, rigid, half, reduced)
                for i in range(free):
                    for j in range(free):
                        noisy[i, j] = reduced[i, j]
                if not factor(reduced, free):
                    return LOW_TEXTURE, iterations
            moved = 0.0
        if last:
            break
        iterations += 1
        gradient(weights, blocks, offsets, rhs, 3, rhs13)
        if rigid:
            for i in range(N_RIGID):
                s = 0.0
                for r in range(13):
                    s -= chain[r, i] * rhs13[r]
                small[i] = s
            solve(reduced, small, free)
            for r in range(13):
                s = 0.0
                for i in range(N_RIGID):
                    s += chain[r, i] * small[i]
                step[r] = s
        else:
            for i in range(13):
                step[i] = -rhs13[i]
            solve(reduced, step, free)
        motion = corner_motion(blocks, offsets, step, 3, box, lens1[1], lens1[2])
        cut = min(1.0, max_step / motion) if motion > 0.0 else 1.0
        for j in range(3):
            w[j] += cut * step[4 * j]
            for i in range(3):
                G[i, j] += cut * step[4 * j + 1 + i]
        if rigid:
            rotate(rotation, cut * small[6], cut * small[7], cut * small[8])
            rigid_columns(xc, yc, w, rotation, G)
        e += cut * step[12]
        motion *= cut
        moved += motion
        if settled(motion, previous, tolerance):
            status = OK
        previous = motion
    if not w[0] > 0.0:  # behind camera 1
        return NOT_CONVERGED, iterations
    for j in range(3):
        out[j] = w[j]
        out[13 + j] = levels[j, 2]
        for i in range(3):
            out[3 + 3 * i + j] = G[i, j]
    out[12] = e
    variance = residual_variance(levels, 3, n, f2, float(free), order)
    share = noise_share(variance, roughness, f2, n, order)
    out[16] = math.sqrt(variance)
    inflation = variance
    take_noise_out(hessian, lens1, xc, yc, box, subset, variance, order, denoised)
    assemble(weights, blocks, offsets, denoised, 3, normal, half)
    _reduce(normal, chain, rigid, half, reduced)
    if not factor(reduced, free):  # some deformation is seen by noise alone: the mean share has to do
        inflation = variance / max(1.0 - share, 0.01) ** 2
        for i in range(free):
            for j in range(free):
                reduced[i, j] = noisy[i, j]
        factor(reduced, free)
    sandwich(reduced, noisy, _RIGID_POSE if rigid else _STRETCH_POSE, free, columns, out[17:42])
    for i in range(17, 42):
        out[i] *= inflation
    # px: along and across camera 2's epipolar line, and both ways in camera 1 at t
    sigma = max(math.sqrt(out[17]) * along, math.sqrt(out[41]))
    sigma = max(sigma, math.sqrt(max(out[23], out[29])) * lens1[1] / G[2, 0])
    share = noise_share(variance, weakest, f2, n, order)
    status = texture_status(status, share, sigma, max_sigma, min(levels[0, 2], levels[1, 2], levels[2, 2]))
    return status, iterations
