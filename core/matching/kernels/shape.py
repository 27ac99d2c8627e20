"""Gauss-Newton for the shape at one point: inverse depth, its slopes and the epipolar offset from one comparison."""

from __future__ import annotations

import math

import numpy as np

from stereorig.core.matching.kernels.cluster_robust import make_cluster_robust
from stereorig.core.matching.kernels.given import FitKernels
from stereorig.core.matching.kernels.linear import covariance_of_last, solve
from stereorig.core.matching.kernels.naming import kernel
from stereorig.core.matching.kernels.noise import (
    CONTRAST,
    GAIN,
    SHIFT,
    ZNCC,
    joint_weights,
    noise_from_residuals,
    share_correction,
)
from stereorig.core.matching.kernels.point import (
    LOW_TEXTURE,
    NOT_CONVERGED,
    NOT_SEEDED,
    OK,
    OUTSIDE_IMAGE,
    PREDICTED_PX,
    REFREEZE_PX,
    SINGULAR,
    WHITE,
    epipolar_shift,
    make_point,
    settled,
    shortened,
    texture_status,
)
from stereorig.core.matching.kernels.vectors import LANES
from stereorig.core.matching.kernels.warp import lens_jacobian


def n_shape_out(terms: int) -> int:
    """Numbers a point: ``terms`` of w, e, zncc, noise, covariance of (w0, e) as 00, 01, 11."""
    return terms + 6


def make_shape(degree: int) -> FitKernels:
    """Compile the fit for plane (degree 1) or curved (2) patches."""
    parts = make_point(degree, 1)
    set_up_reference, compare, image_matrices = parts.set_up_reference, parts.compare, parts.image_matrices
    jacobian, assemble, factor = parts.jacobian, parts.assemble, parts.factor
    gradient, moves_of, predict = parts.gradient, parts.moves_of, parts.predict
    texture, few = parts.texture, parts.few
    n = few + 1  # unknowns: w1, w2, ..., w0, e

    @kernel(f"{degree}")
    def freeze(R, t, e, nu_x, nu_y, M, slopes, levels, variances, of_reference, inverse, equations, _chain, _rigid):
        """Set up and factor the normal equations; status."""
        weights, block, columns, _, _, normal = equations
        joint_weights(levels, variances, 1, weights)
        if not jacobian(R, t, e, nu_x, nu_y, M, slopes, of_reference, inverse, block, columns):
            return SINGULAR
        assemble(equations, of_reference.gram)
        return OK if factor(normal, n) else LOW_TEXTURE

    @kernel(f"{degree}", inline="always")
    def shape_point(
        reference,
        patches,
        which,
        images,
        lens1,
        lens2,
        R,
        t,
        xy,
        start,
        _G,
        _e,
        _values,
        _bends,
        _kept,
        setting,
        space,
        out,
    ):
        """Fit one point, ``out`` as in ``n_shape_out``. Returns status and iterations."""
        order, tolerance, variances = setting.order, setting.tolerance, setting.variances
        ref, of_reference, warp_space, rhs, levels, M, equations, moves, vectors, inverse, G, rotation, _, work = space
        gram, columns, normal = of_reference.gram, equations.columns, equations.normal
        subset = setting.subset
        seen = set_up_reference(reference, patches, which, lens1, xy[0], xy[1], subset, ref, of_reference)
        xc, yc, p, offset, f2 = seen.xc, seen.yc, seen.p, seen.offset, seen.f2
        if not seen.inside:
            return OUTSIDE_IMAGE, 0
        if not (f2 > 0.0 and p > 0.0):
            return LOW_TEXTURE, 0
        gradients, weakest = texture(gram)
        if not (seen.white < WHITE and gradients > 1e-6 * f2):
            return LOW_TEXTURE, 0
        w, step, small, taken = vectors[0], vectors[1], vectors[2], vectors[3]
        total = 0.0
        image2 = images[0]
        for i in range(few):
            w[i] = start[i]
            total += w[i]
        if not np.isfinite(total):
            return NOT_SEEDED, 0
        nu_x, nu_y, along = epipolar_shift(lens2, R, t, xc, yc, w[0])
        if not along > 0.0:
            return SINGULAR, 0
        slopes = lens_jacobian(lens1, xc, yc)
        blocks_of_pixels = np.int64((subset * subset + LANES - 1) // LANES)
        known = (blocks_of_pixels, p, offset, f2)
        e = 0.0
        levels[0, GAIN], levels[0, SHIFT] = 1.0, seen.first_shift
        moved, previous, last, share = np.inf, 0.0, np.inf, 1.0
        status = NOT_CONVERGED
        iterations = 0
        while iterations < setting.max_iterations:
            image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, M)
            if not compare(image2, lens2, M[0], order, ref, known, of_reference, warp_space, levels[0], rhs[0]):
                return OUTSIDE_IMAGE, iterations
            iterations += 1
            if levels[0, CONTRAST] == 0.0:
                return LOW_TEXTURE, iterations
            if moved > REFREEZE_PX:
                result = freeze(
                    R, t, e, nu_x, nu_y, M, slopes, levels, variances, of_reference, inverse, equations, rotation, False
                )
                if result != OK:
                    return result, iterations
                moved = 0.0
            gradient(equations, rhs, step)
            back = 0.0
            for i in range(n):
                back += step[i] * taken[i]
            solve(normal, step, n)
            motion = moves_of(columns, step, moves)
            share = shortened(share, back, motion, previous, iterations)
            cut = min(share, setting.max_step / motion) if motion > 0.0 else 1.0
            for i in range(n):
                taken[i] = step[i]
            for j in range(1, few):
                w[j] += cut * step[j - 1]
            w[0] += cut * step[few - 1]
            e += cut * step[few]
            last = cut * motion
            moved += last
            if settled(last, previous, tolerance, setting.first_rate):
                status = OK
                break
            previous = last
        if last < PREDICTED_PX:
            predict(moves, rhs, gram, f2, levels)
        else:
            image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, M)
            if not compare(image2, lens2, M[0], order, ref, known, of_reference, warp_space, levels[0], rhs[0]):
                return OUTSIDE_IMAGE, iterations
        if not w[0] > 0.0:  # behind camera 1
            return NOT_CONVERGED, iterations
        for j in range(few):
            out[j] = w[j]
        out[few], out[few + 1] = e, levels[0, ZNCC]
        variance = noise_from_residuals(levels, 1, seen.n_pixels, float(n))
        out[few + 2] = math.sqrt(variance)
        if setting.known_noise:
            variance = variances[0]
        covariance_of_last(normal, n, 2, work, small)
        factor_on = share_correction(gradients, variance, p, setting.slope_noise, setting.slope_share)
        factor_on *= 1.0 if setting.known_noise else variance
        out[few + 3], out[few + 4], out[few + 5] = factor_on * small[0], factor_on * small[1], factor_on * small[3]
        sigma = max(math.sqrt(out[few + 3]) * along, math.sqrt(out[few + 5]))
        noise_share = setting.slope_noise * variance * p / weakest
        return texture_status(status, noise_share, sigma, setting.max_sigma, levels[0, ZNCC]), iterations

    return FitKernels(shape_point, parts.work_space, *make_cluster_robust(degree, 1, parts, freeze))
