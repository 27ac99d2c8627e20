"""Gauss-Newton for shape and motion at one point from three comparisons.

12 + 1 unknowns (stretch), 9 + 1 (rigid) or 24 + 1 (curved).
"""

from __future__ import annotations

import math

import numpy as np

from stereorig.core.matching.kernels.cluster_robust import make_cluster_robust
from stereorig.core.matching.kernels.given import FitKernels
from stereorig.core.matching.kernels.linear import covariance_of_last, solve
from stereorig.core.matching.kernels.loops import monomials
from stereorig.core.matching.kernels.naming import kernel
from stereorig.core.matching.kernels.noise import (
    CONTRAST,
    GAIN,
    N_LEVELS,
    SHIFT,
    ZNCC,
    joint_weights,
    noise_from_residuals,
    share_correction,
    unlike_noise,
)
from stereorig.core.matching.kernels.point import (
    FROM_PREDICTION_PX,
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
from stereorig.core.matching.kernels.reference import first_pixel, n_kept_reference
from stereorig.core.matching.kernels.rigid import N_RIGID, nearest_rotation, rigid_chain, rigid_columns, rotate
from stereorig.core.matching.kernels.vectors import LANES
from stereorig.core.matching.kernels.warp import lens_jacobian


def n_motion_out(terms: int) -> int:
    """Numbers a point: ``terms`` of w, 3 x ``terms`` of G, e, zncc (3), noise, covariance (25) of (w0, G0, e).

    Then the variance assumed in the covariance if the noise is not known, and last the rate of convergence: the last
    step's motion over the motion of the step before, not set after a single step.
    """
    return 4 * terms + 32


def n_kept(degree: int) -> int:
    """Numbers of a row of the memory of :class:`stereorig.core.matching.kernels.given.Warped`."""
    return n_kept_reference(degree) + N_LEVELS + 2 * len(monomials(degree))


def make_motion(degree: int) -> FitKernels:
    """Compile the fit for plane (degree 1, stretch or rigid) or curved (2) patches."""
    parts = make_point(degree, 3)
    set_up_reference, compare, image_matrices = parts.set_up_reference, parts.compare, parts.image_matrices
    compare_before, keep, recall_reference = parts.compare_before, parts.keep, parts.recall_reference
    jacobian, assemble, factor = parts.jacobian, parts.assemble, parts.factor
    gradient, moves_of, predict = parts.gradient, parts.moves_of, parts.predict
    texture, few = parts.texture, parts.few
    unknowns = 4 * few + 1
    n_reference = n_kept_reference(degree)

    @kernel(f"{degree}")
    def compare_all(images, lenses, M, order, ref, known, of_reference, warp_space, levels, rhs):
        """All three comparisons; status."""
        for k in range(3):
            lens = lenses[0] if k == 1 else lenses[1]
            if not compare(images[k], lens, M[k], order, ref, known, of_reference, warp_space, levels[k], rhs[k]):
                return OUTSIDE_IMAGE
        for k in range(3):
            if levels[k, CONTRAST] == 0.0:
                return LOW_TEXTURE
        return OK

    @kernel(f"{degree}")
    def compare_all_before(
        values, bends, corner, first, images, lenses, M, order, ref, known, of_reference, warp_space, levels, rhs
    ):
        """The comparisons from ``first`` on with images warped before; status."""
        for k in range(first, 3):
            lens = lenses[0] if k == 1 else lenses[1]
            if not compare_before(
                values[k],
                bends[k],
                corner,
                images[k],
                lens,
                M[k],
                order,
                ref,
                known,
                of_reference,
                warp_space,
                levels[k],
                rhs[k],
            ):
                return OUTSIDE_IMAGE
            if levels[k, CONTRAST] == 0.0:
                return LOW_TEXTURE
        return OK

    @kernel(f"{degree}")
    def freeze(R, t, e, nu_x, nu_y, M, slopes, levels, variances, of_reference, inverse, equations, chain, rigid):
        """Set up and factor the normal equations; status."""
        weights, block, columns, half, _, normal = equations
        joint_weights(levels, variances, 3, weights)
        if not jacobian(R, t, e, nu_x, nu_y, M, slopes, of_reference, inverse, block, columns):
            return SINGULAR
        n = unknowns
        if few == 3 and rigid:
            n = N_RIGID
            for k in range(3):
                for r in range(2 * few):
                    free = half[0, 0]
                    for i in range(n):
                        s = 0.0
                        for c in range(unknowns):
                            s += columns[k, r, c] * chain[c, i]
                        free[i] = s
                    for i in range(unknowns):
                        columns[k, r, i] = free[i] if i < n else 0.0
        assemble(equations, of_reference.gram)
        return OK if factor(normal, n) else LOW_TEXTURE

    @kernel(f"{degree}", inline="always")
    def motion_point(
        reference,
        patches,
        which,
        images,
        lens1,
        lens2,
        R,
        t,
        xy,
        start_w,
        start_g,
        start_e,
        values,
        bends,
        kept,
        setting,
        space,
        out,
    ):
        """Fit one point, ``out`` as in ``n_motion_out``. Returns status and iterations.

        With images warped before, it is one step from the prediction, and the correlations after it are predicted.
        """
        order, tolerance, variances = setting.order, setting.tolerance, setting.variances
        ref, of_reference, warp_space, rhs, levels, M, equations, moves, vectors, inverse, G, rotation, chain, work = (
            space
        )
        gram, columns, normal = of_reference.gram, equations.columns, equations.normal
        subset = setting.subset
        before = values[0].shape[0] > 0
        known_before = before and kept[0] == kept[0]  # not NaN
        if known_before:
            seen = recall_reference(reference, patches, xy[0], xy[1], subset, kept, ref, of_reference)
        else:
            seen = set_up_reference(reference, patches, which, lens1, xy[0], xy[1], subset, ref, of_reference)
        xc, yc, p, offset, f2 = seen.xc, seen.yc, seen.p, seen.offset, seen.f2
        if not seen.inside:
            return OUTSIDE_IMAGE, 0
        rigid = setting.rigid
        if not (f2 > 0.0 and p > 0.0):
            return LOW_TEXTURE, 0
        gradients, weakest = texture(gram)
        if not (seen.white < WHITE and gradients > 1e-6 * f2):
            return LOW_TEXTURE, 0
        w, step, small, taken = vectors[0], vectors[1], vectors[2], vectors[3]
        total = 0.0
        for j in range(few):
            w[j] = start_w[j]
            total += w[j]
            for i in range(3):
                G[i, j] = start_g[i, j]
                total += G[i, j]
        if not np.isfinite(total):
            return NOT_SEEDED, 0
        nu_x, nu_y, along = epipolar_shift(lens2, R, t, xc, yc, w[0])
        if not along > 0.0:
            return SINGULAR, 0
        n = unknowns
        if few == 3 and rigid:
            n = N_RIGID
            if not nearest_rotation(xc, yc, w, G, rotation, chain):
                return SINGULAR, 0
            rigid_columns(xc, yc, w, rotation, G)
        lenses = (lens1, lens2)
        slopes = lens_jacobian(lens1, xc, yc)
        blocks_of_pixels = np.int64((subset * subset + LANES - 1) // LANES)
        known = (blocks_of_pixels, p, offset, f2)
        half = 0.5 * (subset - 1)
        corner = first_pixel(xy[1], half), first_pixel(xy[0], half), subset
        e = start_e if before else 0.0
        for k in range(3):
            levels[k, GAIN], levels[k, SHIFT] = 1.0, seen.first_shift
        moved, previous, last, share = np.inf, 0.0, np.inf, 1.0
        status = NOT_CONVERGED
        iterations = 0
        while iterations < setting.max_iterations:
            image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, M)
            if before:
                first = 0
                if known_before:
                    first = 1
                    for i in range(N_LEVELS):
                        levels[0, i] = kept[n_reference + i]
                    for i in range(2 * few):
                        rhs[0, i] = kept[n_reference + N_LEVELS + i]
                result = compare_all_before(
                    values,
                    bends,
                    corner,
                    first,
                    images,
                    lenses,
                    M,
                    order,
                    ref,
                    known,
                    of_reference,
                    warp_space,
                    levels,
                    rhs,
                )
                if result == OK and not known_before:
                    keep(seen, of_reference, kept)
                    for i in range(N_LEVELS):
                        kept[n_reference + i] = levels[0, i]
                    for i in range(2 * few):
                        kept[n_reference + N_LEVELS + i] = rhs[0, i]
            else:
                result = compare_all(images, lenses, M, order, ref, known, of_reference, warp_space, levels, rhs)
            if result != OK:
                return result, iterations
            iterations += 1
            if moved > REFREEZE_PX:
                if few == 3 and rigid:
                    rigid_chain(xc, yc, w, rotation, G, chain)
                result = freeze(
                    R, t, e, nu_x, nu_y, M, slopes, levels, variances, of_reference, inverse, equations, chain, rigid
                )
                if result != OK:
                    return result, iterations
                moved = 0.0
            gradient(equations, rhs, small)
            back = 0.0
            for i in range(n):
                back += small[i] * taken[i]
            solve(normal, small, n)
            motion = moves_of(columns, small, moves)
            share = shortened(share, back, motion, previous, iterations)
            cut = min(share, setting.max_step / motion) if motion > 0.0 else 1.0
            for i in range(n):
                taken[i] = small[i]
            if few == 3 and rigid:
                for r in range(unknowns):
                    s = 0.0
                    for i in range(N_RIGID):
                        s += chain[r, i] * small[i]
                    step[r] = s
            else:
                for i in range(unknowns):
                    step[i] = small[i]
            for j in range(few):
                at = 4 * (j - 1) if j > 0 else 4 * (few - 1)
                w[j] += cut * step[at]
                for i in range(3):
                    G[i, j] += cut * step[at + 1 + i]
            if few == 3 and rigid:
                rotate(rotation, cut * small[2], cut * small[3], cut * small[4])
                rigid_columns(xc, yc, w, rotation, G)
            e += cut * step[unknowns - 1]
            last = cut * motion
            moved += last
            if before or settled(last, previous, tolerance, setting.first_rate):
                status = OK if last < FROM_PREDICTION_PX or not before else NOT_CONVERGED
                break
            previous = last
        if before or last < PREDICTED_PX:
            predict(moves, rhs, gram, f2, levels)
        else:
            image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, M)
            result = compare_all(images, lenses, M, order, ref, known, of_reference, warp_space, levels, rhs)
            if result != OK:
                return result, iterations
        if not w[0] > 0.0:  # behind camera 1
            return NOT_CONVERGED, iterations
        at = 4 * few
        for j in range(few):
            out[j] = w[j]
            for i in range(3):
                out[few + few * i + j] = G[i, j]
        out[at] = e
        worst = 1.0
        for k in range(3):
            out[at + 1 + k] = levels[k, ZNCC]
            worst = min(worst, levels[k, ZNCC])
        variance = noise_from_residuals(levels, 3, seen.n_pixels, float(n))
        out[at + 4] = math.sqrt(variance)
        above = unlike_noise(levels, 3, seen.n_pixels, float(n))
        out[at + 30] = variance + above
        if previous > 0.0:
            out[at + 31] = last / previous
        if setting.known_noise:
            variance = variances[0]
        covariance = out[at + 5 : at + 30]
        covariance_of_last(normal, n, 5, work, covariance)
        factor_on = share_correction(gradients, variance, p, setting.slope_noise, setting.slope_share)
        factor_on *= 1.0 if setting.known_noise else variance + above
        for i in range(25):
            covariance[i] *= factor_on
        # px: along and across camera 2's epipolar line, and both ways in camera 1's current image
        sigma = max(math.sqrt(covariance[0]) * along, math.sqrt(covariance[24]))
        sigma = max(sigma, math.sqrt(max(covariance[6], covariance[12])) * lens1[1] / G[2, 0])
        noise_share = setting.slope_noise * variance * p / weakest
        return texture_status(status, noise_share, sigma, setting.max_sigma, worst), iterations

    return FitKernels(motion_point, parts.work_space, *make_cluster_robust(degree, 3, parts, freeze))
