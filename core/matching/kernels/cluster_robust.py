"""Cluster-robust covariance of a fitted point, from its residuals of any origin.

The fit's own covariance assumes residuals of white noise. A texture that changed, paint that flaked, an object in front
of a corner of the subset or a different view leave residuals that are correlated over some pixels and have more effect
on the solution. So the subset is cut into blocks about as wide as a speckle; the score of each block is summed, and the
covariance of the solution follows from the covariance of these sums (a sandwich covariance with clustered errors, Liang
and Zeger 1986, doi:10.1093/biomet/73.1.13). The scores of the three comparisons are added block by block: residuals
that are equal in camera 2's reference and current images do not count in the displacement.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereorig.core.matching.kernels.given import ClusterRobustSpace
from stereorig.core.matching.kernels.linear import solve
from stereorig.core.matching.kernels.loops import GX, GY, N_ROWS, WEIGHT
from stereorig.core.matching.kernels.naming import kernel
from stereorig.core.matching.kernels.noise import (
    CONTRAST,
    GAIN,
    SHIFT,
    ZNCC,
    best_correlation,
    noise_from_residuals,
    share_correction,
)
from stereorig.core.matching.kernels.point import (
    LOW_TEXTURE,
    OK,
    OUTSIDE_IMAGE,
    SINGULAR,
    PointKernels,
    epipolar_shift,
    make_sum_pixels,
)
from stereorig.core.matching.kernels.rigid import N_RIGID, nearest_rotation, rigid_chain
from stereorig.core.matching.kernels.vectors import LANES
from stereorig.core.matching.kernels.warp import lens_jacobian, set_up_warp

BLOCK_PX = 5.5  # about a good speckle; smaller blocks miss part of the correlation
MIN_BLOCKS, MAX_BLOCKS = 3, 7  # across the subset


def blocks_across(subset_px: int) -> int:
    """Return the number of blocks across a subset."""
    return int(min(max(round(subset_px / BLOCK_PX), MIN_BLOCKS), MAX_BLOCKS))


def make_cluster_robust(degree: int, images: int, parts: PointKernels, freeze: Any) -> tuple[Any, Any]:
    """Compile the cluster-robust covariance for the fit that ``parts`` and ``freeze`` belong to.

    Parameters
    ----------
    degree, images
        Degree of the patch, and number of comparisons: 1 (shape) or 3 (motion).
    parts
        Result of :func:`stereorig.core.matching.kernels.point.make_point`.
    freeze
        The fit's set-up of the normal equations.
    """
    set_up_reference, make_space, few = parts.set_up_reference, parts.work_space, parts.few
    compare, image_matrices, gradients_of = parts.compare, parts.image_matrices, parts.texture
    n_columns = 2 * few
    last = 5 if images == 3 else 2
    unknowns = (4 if images == 3 else 1) * few + 1
    sum_pixels = make_sum_pixels(degree)

    def work_space(subset: int) -> ClusterRobustSpace:
        across = blocks_across(subset)
        max_side = -(-subset // across) + 1
        width = (max_side * max_side + LANES - 1) // LANES * LANES + LANES
        return ClusterRobustSpace(
            fit=make_space(subset),
            part=np.zeros((N_ROWS, width), np.float32),
            scores=np.empty((images, across * across, n_columns)),
            pull=np.empty((last, images, n_columns)),
            z=np.empty((across * across, last)),
            sums=np.empty(3 + n_columns),
        )

    @kernel(f"{degree}_{images}")
    def cut_out(ref, subset, top, bottom, left, right, part):
        """Copy a block's pixels; return their number over eight, rounded up, and their squared gradients' sum."""
        n, texture = 0, 0.0
        for r in range(top, bottom):
            for c in range(left, right):
                i = r * subset + c
                for row in range(N_ROWS):
                    part[row, n] = ref[row, i]
                texture += ref[WEIGHT, i] * (ref[GX, i] * ref[GX, i] + ref[GY, i] * ref[GY, i])
                n += 1
        blocks = (n + LANES - 1) // LANES
        for i in range(n, min(blocks * LANES + LANES, part.shape[1])):
            for row in range(N_ROWS):
                part[row, i] = 0.0
        return blocks, texture

    @kernel(f"{degree}_{images}")
    def sum_blocks(coefficients, subset, order, ref, base, stride, warp, part, sums, scores):
        """Sum one image's residuals times the columns in each block; return the equivalent number of even blocks."""
        across = int(math.sqrt(scores.shape[0]) + 0.5)
        total, squares = 0.0, 0.0
        for a in range(across):
            for b in range(across):
                blocks, texture = cut_out(
                    ref,
                    subset,
                    a * subset // across,
                    (a + 1) * subset // across,
                    b * subset // across,
                    (b + 1) * subset // across,
                    part,
                )
                total += texture
                squares += texture * texture
                sum_pixels(coefficients, order, base, stride, warp, part, blocks, sums)
                for i in range(n_columns):
                    scores[a * across + b, i] = sums[3 + i]
        return total * total / squares

    @kernel(f"{degree}_{images}", inline="always")
    def cluster_robust_point(
        reference, patches, which, shown, lens1, lens2, R, t, xy, w, g, e, _values, _bends, _kept, setting, space, out
    ):
        """Compute the covariance of a fitted point's last unknowns; return status, and 0.

        ``out`` has two of ``last`` squared numbers: with independent blocks, and with neighbouring blocks correlated.
        """
        subset, order, variances, rigid = setting.subset, setting.order, setting.variances, setting.rigid
        fit_space, part, scores, pull, z, sums = space
        ref, of_reference, warp_space, rhs, levels, M, equations, _, vectors, inverse, G, rotation, chain, _ = fit_space
        seen = set_up_reference(reference, patches, which, lens1, xy[0], xy[1], subset, ref, of_reference)
        xc, yc, p, offset, f2 = seen.xc, seen.yc, seen.p, seen.offset, seen.f2
        if not seen.inside:
            return OUTSIDE_IMAGE, 0
        if not (f2 > 0.0 and p > 0.0):
            return LOW_TEXTURE, 0
        gradients, _ = gradients_of(of_reference.gram)
        nu_x, nu_y, along = epipolar_shift(lens2, R, t, xc, yc, w[0])
        if not along > 0.0:
            return SINGULAR, 0
        slopes = lens_jacobian(lens1, xc, yc)
        known = (np.int64((subset * subset + LANES - 1) // LANES), p, offset, f2)
        warp = warp_space.warp
        if images == 3:
            for j in range(few):
                for i in range(3):
                    G[i, j] = g[i, j]
        image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, M)
        worth = 0.0
        for k in range(images):
            lens = lens1 if k == 1 else lens2
            levels[k, GAIN], levels[k, SHIFT] = 1.0, seen.first_shift
            if not compare(shown[k], lens, M[k], order, ref, known, of_reference, warp_space, levels[k], rhs[k]):
                return OUTSIDE_IMAGE, 0
            if levels[k, CONTRAST] == 0.0 or not levels[k, ZNCC] > 0.0:
                return LOW_TEXTURE, 0
            # residuals orthogonal to the reference: its mean and its contrast are taken out
            correlation = levels[k, ZNCC]
            warp[20] = levels[k, GAIN] / correlation
            warp[21] = (levels[k, SHIFT] + offset) / correlation - offset
            coefficients, rows, cols, stride = shown[k]
            base = set_up_warp(
                lens, M[k], of_reference.powers, rows, cols, stride, 1 if order == 3 else 2, warp_space.positions, warp
            )
            worth = sum_blocks(coefficients, subset, order, ref, base, stride, warp, part, sums, scores[k])
        # all contrasts are assumed to be the best one's: a lower correlation is the image's own noise
        best = best_correlation(levels, images)
        n = unknowns
        if images == 3 and few == 3 and rigid:
            n = N_RIGID
            if not nearest_rotation(xc, yc, w, G, rotation, chain):
                return SINGULAR, 0
            rigid_chain(xc, yc, w, rotation, G, chain)
        result = freeze(
            R, t, e, nu_x, nu_y, M, slopes, levels, variances, of_reference, inverse, equations, chain, rigid
        )
        if result != OK:
            return result, 0
        weights, _, columns, _, _, normal = equations
        unit = vectors[0]
        for i in range(last):
            for c in range(n):
                unit[c] = 0.0
            unit[n - last + i] = 1.0
            solve(normal, unit, n)
            for o in range(images):
                for r in range(n_columns):
                    s = 0.0
                    for k in range(images):
                        along_k = 0.0
                        for c in range(n):
                            along_k += columns[k, r, c] * unit[c]
                        s += weights[k, o] * along_k
                    pull[i, o, r] = s
        for i in range(2 * last * last):
            out[i] = 0.0
        for b in range(scores.shape[1]):
            for i in range(last):
                s = 0.0
                for o in range(images):
                    for r in range(n_columns):
                        s += pull[i, o, r] * scores[o, b, r]
                z[b, i] = best * s
            for i in range(last):
                for j in range(last):
                    out[last * i + j] += z[b, i] * z[b, j]
        across = int(math.sqrt(scores.shape[1]) + 0.5)
        for b in range(scores.shape[1]):
            row, col = b // across, b % across
            for other_row in range(max(row - 1, 0), min(row + 2, across)):
                for other_col in range(max(col - 1, 0), min(col + 2, across)):
                    # triangular weights along both axes keep the sum positive (Newey and West; Conley)
                    near = (1.0 - 0.5 * abs(row - other_row)) * (1.0 - 0.5 * abs(col - other_col))
                    for i in range(last):
                        for j in range(last):
                            out[last * (last + i) + j] += near * z[b, i] * z[across * other_row + other_col, j]
        # the fit has removed mean and slopes of the residuals from the blocks
        factor_on = 1.0 / max(1.0 - few / worth, 0.2)
        variance = (
            variances[0] if setting.known_noise else noise_from_residuals(levels, images, seen.n_pixels, float(n))
        )
        factor_on *= share_correction(gradients, variance, p, setting.slope_noise, setting.slope_share)
        # mean and slopes that were removed, as they weigh with triangular weights of one block to each side
        level, slope = 2.0 - 1.0 / across, 2.0 - 3.0 / across
        removed = level * level + 2.0 * level * slope
        factor_beyond = factor_on * max(1.0 - few / worth, 0.2) / max(1.0 - removed / (across * across), 0.2)
        for i in range(last * last):
            out[i] *= factor_on
            out[last * last + i] *= factor_beyond
        return OK, 0

    return cluster_robust_point, work_space
