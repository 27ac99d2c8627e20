"""Gauss-Newton for the shape at one point: inverse depth, two slopes and the epipolar offset from one comparison."""

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

N_SHAPE_OUT = 9
_WANTED = np.array([0, 3])  # w0 and e among the four


@njit(nogil=True, error_model="numpy")
def shape_normal(weights, blocks, offsets, hessian, normal, half, reduced):
    """Normal equations of shape: w0, w1, w2, e out of the thirteen."""
    assemble(weights, blocks, offsets, hessian, 1, normal, half)
    for i in range(4):
        for j in range(4):
            reduced[i, j] = normal[4 * i, 4 * j]


@njit(nogil=True, error_model="numpy")
def shape_point(reference, gradients, image2, lens1, lens2, R, t, xy, start, setting, space, out):
    """Fit w0, w1, w2 and e of one point. ``out``: w (3), e, zncc, noise, cov(w0, e) (3), see ``fit.py``.

    Returns status and iterations.
    """
    subset, order, max_iterations, tolerance, max_sigma, max_step = setting
    (ref, p, sums, box, poly, work, sum_both, hessian, rhs, levels, weights, M, blocks, offsets, normal, half, vectors,
     reduced, _, inverse, G, _, denoised, noisy, columns) = space  # fmt: skip
    n = subset * subset
    grad_x, grad_y = gradients
    inside, xc, yc, f2 = set_up_reference(reference, grad_x, grad_y, lens1, xy[0], xy[1], subset, ref, box, poly)
    if not inside:
        return OUTSIDE_IMAGE, 0
    sum_j, sum_fj = sum_both[0], sum_both[1]
    if not f2 > 0.0:
        return LOW_TEXTURE, 0
    reference_sums(ref, n, f2, work, sum_j, sum_fj, hessian)
    roughness, weakest = texture_roughness(hessian, lens1, xc, yc, f2)
    if not 1e-6 < roughness < WHITE_ROUGHNESS:
        return LOW_TEXTURE, 0
    w = vectors[0]
    w[0], w[1], w[2] = start[0], start[1], start[2]
    if not np.isfinite(w[0] + w[1] + w[2]):
        return NOT_SEEDED, 0
    nu_x, nu_y, along = epipolar_shift(lens2, R, t, xc, yc, w[0])
    if not along > 0.0:
        return SINGULAR, 0
    e = 0.0
    levels[0, 0], levels[0, 1] = 1.0, 0.0
    step, rhs13 = vectors[1], vectors[2]
    moved, previous = np.inf, 0.0
    status = NOT_CONVERGED
    iterations = 0
    quiet = False
    while iterations < max_iterations:
        image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, 1, M)
        if not compare(image2, lens2, M[0], order, ref, n, f2, box, p, sums, sum_j, sum_fj, levels[0], rhs[0]):
            return OUTSIDE_IMAGE, iterations
        iterations += 1
        if levels[0, 3] == 0.0:
            return LOW_TEXTURE, iterations
        if iterations == CREEPING:
            variance = residual_variance(levels, 1, n, f2, 4.0, order)
            take_noise_out(hessian, lens1, xc, yc, box, subset, variance, order, denoised)
            quiet, moved = True, np.inf
        if moved > REFREEZE_PX:
            joint_weights(levels, 1, weights)
            if not jacobian_blocks(R, t, e, nu_x, nu_y, 1, M, inverse, blocks, offsets):
                return SINGULAR, iterations
            if quiet:
                shape_normal(weights, blocks, offsets, denoised, normal, half, reduced)
                quiet = factor(reduced, 4)
            if not quiet:
                shape_normal(weights, blocks, offsets, hessian, normal, half, reduced)
                if not factor(reduced, 4):
                    return LOW_TEXTURE, iterations
            moved = 0.0
        gradient(weights, blocks, offsets, rhs, 1, rhs13)
        small = vectors[3]
        small[0], small[1], small[2], small[3] = -rhs13[0], -rhs13[4], -rhs13[8], -rhs13[12]
        solve(reduced, small, 4)
        for i in range(13):
            step[i] = 0.0
        step[0], step[4], step[8], step[12] = small[0], small[1], small[2], small[3]
        motion = corner_motion(blocks, offsets, step, 1, box, lens1[1], lens1[2])
        cut = min(1.0, max_step / motion) if motion > 0.0 else 1.0
        w[0] += cut * step[0]
        w[1] += cut * step[4]
        w[2] += cut * step[8]
        e += cut * step[12]
        motion *= cut
        moved += motion
        if settled(motion, previous, tolerance):
            status = OK
            break
        previous = motion
    image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, 1, M)
    if not compare(image2, lens2, M[0], order, ref, n, f2, box, p, sums, sum_j, sum_fj, levels[0], rhs[0]):
        return OUTSIDE_IMAGE, iterations
    if not w[0] > 0.0:  # behind camera 1
        return NOT_CONVERGED, iterations
    out[0], out[1], out[2], out[3], out[4] = w[0], w[1], w[2], e, levels[0, 2]
    variance = residual_variance(levels, 1, n, f2, 4.0, order)
    share = noise_share(variance, roughness, f2, n, order)
    inflation = variance
    joint_weights(levels, 1, weights)
    if not jacobian_blocks(R, t, e, nu_x, nu_y, 1, M, inverse, blocks, offsets):
        return SINGULAR, iterations
    shape_normal(weights, blocks, offsets, hessian, normal, half, noisy)
    take_noise_out(hessian, lens1, xc, yc, box, subset, variance, order, denoised)
    shape_normal(weights, blocks, offsets, denoised, normal, half, reduced)
    if not factor(reduced, 4):  # some deformation is seen by noise alone: the mean share has to do
        inflation = variance / max(1.0 - share, 0.01) ** 2
        shape_normal(weights, blocks, offsets, hessian, normal, half, reduced)
        if not factor(reduced, 4):
            return LOW_TEXTURE, iterations
    covariance = vectors[3]
    sandwich(reduced, noisy, _WANTED, 4, columns, covariance)
    out[5] = math.sqrt(variance)
    for i in range(3):
        out[6 + i] = covariance[i if i < 2 else 3] * inflation
    c00 = out[6]
    sigma = max(math.sqrt(c00) * along, math.sqrt(out[8]))
    share = noise_share(variance, weakest, f2, n, order)
    status = texture_status(status, share, sigma, max_sigma, levels[0, 2])
    return status, iterations
