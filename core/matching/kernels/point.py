"""Common parts of the fits of shape and of motion at one point, for plane and for curved patches.

With C = [c, ex, ey, 0, ...], c = (Xc, Yc, 1), the patch is mapped into the camera images by matrices that act on its
monomials m:

    cam2 reference  M_0 = S(e) (R21 C + t21 w^T)
    cam1 current    M_1 = G
    cam2 current    M_2 = S(e) (R21 G + t21 w^T)

S(e) shifts camera 2's normalised image by e times one pixel across the epipolar line of the point.

Unknowns, in this order inside: (w_j, G_0j, G_1j, G_2j) for j = 1, 2, ..., then for j = 0, then e. So the unknowns of
the point itself come last, where their covariance can be read off the factor. A step changes image k's matrix by dM_k;
the patch then moves in its own coordinates by ``d = M_k^-1 dM_k m``, from which ``dX = d_1 - X d_0`` and ``dY = d_2 - Y
d_0``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from stereorig.core.matching.kernels.given import Equations, ReferenceSpace, WarpSpace, WorkSpace
from stereorig.core.matching.kernels.linear import QUAD, invert3, make_factor, make_product
from stereorig.core.matching.kernels.loops import (
    N_WARP,
    WARPED,
    WEIGHT,
    X_BENDS,
    Y_BENDS,
    F,
    compare_cubic,
    compare_quintic,
    compare_warped,
    monomials,
)
from stereorig.core.matching.kernels.naming import inner, kernel
from stereorig.core.matching.kernels.noise import (
    CONTRAST,
    DENSITY,
    GAIN,
    MAX_NOISE_SHARE,
    MISFIT,
    N_LEVELS,
    SHIFT,
    SMOOTHED,
    ZNCC,
    interpolated_noise,
)
from stereorig.core.matching.kernels.reference import copy, make_reference, subset_array
from stereorig.core.matching.kernels.warp import N_NODES, lens_jacobian, set_up_warp
from stereorig.core.status import PointStatus

OK = int(PointStatus.OK)
OUTSIDE_IMAGE = int(PointStatus.OUTSIDE_IMAGE)
LOW_TEXTURE = int(PointStatus.LOW_TEXTURE)
NOT_CONVERGED = int(PointStatus.NOT_CONVERGED)
SINGULAR = int(PointStatus.SINGULAR)
NOT_SEEDED = int(PointStatus.NOT_SEEDED)
LOW_CORRELATION = int(PointStatus.LOW_CORRELATION)

REFREEZE_PX = 0.5  # corner motion after which the frozen normal equations are computed again
PREDICTED_PX = 0.05  # last corner motion up to which the correlation at its end is predicted instead of compared again
FROM_PREDICTION_PX = 0.2  # corner motion up to which one step from a prediction that images were warped by will do
STEADY_FROM = 6  # iteration from which a step that passes the minimum shortens the next ones: most points end before
OVERSHOT = 0.5  # share of the last step that the next one goes back
FLAT = 1e-6  # squared contrast below which an image has no texture
WHITE = 0.86  # squared differences of neighbours over twice the variance: one for white noise, which never matches


@inner
def epipolar_shift(lens2, R, t, xc, yc, w0):
    """Camera 2's normalised shift (nu_x, nu_y) that moves the point's image by 1 px across its epipolar line.

    Positive where ``StereoPair.epipolar_residual_px`` is. Also returns the shift of the point in camera 2 by a unit of
    w0, px; zero where the epipolar line is a point.
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


@inner
def settled(motion, previous, tolerance, first_rate):
    """Return True if the remaining steps, as a geometric series, move no corner further than the tolerance.

    ``first_rate`` is the series' ratio before two steps have shown it.
    """
    if motion < tolerance:
        return True
    rate = first_rate if previous == 0.0 else motion / previous
    return rate < 0.9 and motion * rate / (1.0 - rate) < tolerance


@inner
def shortened(share, back, motion, previous, iterations):
    """Share of a step that is made: less after steps that passed the minimum, which ``back`` < 0 shows.

    A reference less sharp than the image promises too little change: each step is up to three times too long, and the
    next goes back by more. ``motion`` is of the whole step, ``previous`` of what was made of the last one.
    """
    if back < 0.0 and iterations >= STEADY_FROM and share * motion > OVERSHOT * previous:
        return share * previous / (previous + share * motion)
    return share


@inner
def texture_status(status, share, sigma_px, max_sigma_px, zncc):
    """Final status: converged or not, rejected for noise mistaken for texture or for a large standard deviation."""
    if status == OK and share < MAX_NOISE_SHARE and sigma_px < max_sigma_px:
        return OK
    if zncc > 0.5 and not share < MAX_NOISE_SHARE:
        return LOW_TEXTURE
    if status == OK:
        return LOW_TEXTURE if zncc > 0.5 else LOW_CORRELATION
    return status


@cache
def make_sum_pixels(degree: int) -> Any:
    """Compile the loop over an image's pixels for both interpolants."""
    cubic, quintic = compare_cubic[degree], compare_quintic[degree]

    @kernel(f"{degree}")
    def sum_pixels(coefficients, order, base, stride, warp, ref, blocks, sums):
        """See :mod:`stereorig.core.matching.kernels.loops`."""
        if order == 3:
            cubic(coefficients, np.int64(base), np.int64(stride), warp, ref, np.int64(blocks), sums)
        else:
            quintic(coefficients, np.int64(base), np.int64(stride), warp, ref, np.int64(blocks), sums)

    return sum_pixels


@inner
def _grey_scale(ref, subset, warp):
    """Set gain and shift that bring the row ``WARPED`` to the reference's grey levels, from a ninth of the pixels."""
    n, f, ff, g, gg = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(1, subset, 3):
        for c in range(1, subset, 3):
            i = r * subset + c
            if ref[WEIGHT, i] > 0.0:
                a, b = float(ref[F, i]), float(ref[WARPED, i])
                n += 1.0
                f += a
                ff += a * a
                g += b
                gg += b * b
    warp[20], warp[21] = 1.0, 0.0
    if n > 0.0:
        of_f, of_g = ff - f * f / n, gg - g * g / n
        if of_g > FLAT * of_f and of_f > 0.0:
            warp[20] = math.sqrt(of_f / of_g)
        warp[21] = (warp[20] * g - f) / n


@cache
def make_compare(degree: int) -> tuple[Any, Any]:
    """Compile the comparison of one image with the reference, and that of one warped before.

    Shape and motion use the same.
    """
    sum_pixels, sum_warped = make_sum_pixels(degree), compare_warped[degree]
    n_columns = 2 * len(monomials(degree))
    made_for = f"{degree}"

    @kernel(made_for)
    def judge(known, of_reference, order, space, levels, rhs):
        """Fill ``rhs`` and ``levels`` from the sums over the pixels."""
        _, p, offset, f2 = known
        sum_g, sum_fg = of_reference.sum_g, of_reference.sum_fg
        warp, _, sums = space
        # the loop used y = gain g - shift, d = y - f, with the float32 of gain and shift
        gain, shift = float(warp[20]), float(warp[21])
        mean = sums[0] / p
        fd = sums[1] - offset * sums[0]
        y2 = sums[2] - sums[0] * mean + 2.0 * fd + f2
        if not y2 > FLAT * gain * gain * f2:
            levels[ZNCC] = 0.0
            levels[CONTRAST] = 0.0
            return
        c = math.sqrt(y2 / f2)
        for i in range(n_columns):
            rhs[i] = (sums[3 + i] - mean * sum_g[i] + sum_fg[i]) / c - sum_fg[i]
        levels[GAIN] = gain / c
        levels[SHIFT] = (shift + mean + offset) / c - offset
        levels[ZNCC] = (fd + f2) / math.sqrt(f2 * y2)
        levels[CONTRAST] = c / gain
        levels[MISFIT] = 2.0 * f2 * (1.0 - levels[ZNCC])
        half = of_reference.middle[2]
        levels[SMOOTHED] = interpolated_noise(warp, half, order)
        levels[DENSITY] = min(max(abs(warp[1] * warp[12] - warp[2] * warp[11]) / (half * half), 0.01), 100.0)

    @kernel(made_for)
    def compare(image, lens, m, order, ref, known, of_reference, space, levels, rhs):
        """Compare one image with the reference at the warp ``m``; False if the patch leaves the image.

        Fills ``rhs`` (2 M,), the sums of the zero-mean normalised residual times the columns, and updates ``levels``.
        """
        coefficients, rows, cols, stride = image
        warp, positions, sums = space
        base = set_up_warp(lens, m, of_reference.powers, rows, cols, stride, 1 if order == 3 else 2, positions, warp)
        if base < 0:
            return False
        warp[20] = levels[GAIN]
        warp[21] = levels[SHIFT]
        sum_pixels(coefficients, order, base, stride, warp, ref, known[0], sums)
        judge(known, of_reference, order, space, levels, rhs)
        return True

    @kernel(made_for)
    def compare_before(values, bends, corner, image, lens, m, order, ref, known, of_reference, space, levels, rhs):
        """Compare one image warped before, ``values`` (rows, cols); as ``compare``, whose warp is ``m``.

        ``bends`` (2, 3) of :class:`stereorig.core.matching.kernels.given.Warped`; ``corner`` the subset's first row and
        column and its width.
        """
        _, rows, cols, stride = image
        warp, positions, sums = space
        if set_up_warp(lens, m, of_reference.powers, rows, cols, stride, 2, positions, warp) < 0:
            return False
        top, left, subset = corner
        copy(values, top, left, subset, ref, np.int64(WARPED))
        _grey_scale(ref, subset, warp)
        # the prediction's motion within the patch, from px of this image to px of the reference
        half = of_reference.middle[2]
        xx, xy, yx, yy = float(warp[1]), float(warp[2]), float(warp[11]), float(warp[12])
        over = half / (xx * yy - xy * yx)
        for i in range(3):
            a, b = bends[0, i] - warp[X_BENDS + i], bends[1, i] - warp[Y_BENDS + i]
            warp[X_BENDS + i], warp[Y_BENDS + i] = over * (yy * a - xy * b), over * (xx * b - yx * a)
        sum_warped(warp, ref, known[0], sums)
        judge(known, of_reference, order, space, levels, rhs)
        return True

    return compare, compare_before


class PointKernels(NamedTuple):
    """The compiled parts of a fit, the maker of its work space, and the number of its patch's monomials."""

    set_up_reference: Any
    keep: Any
    recall_reference: Any
    work_space: Callable[[int], WorkSpace]
    compare: Any
    compare_before: Any
    image_matrices: Any
    jacobian: Any
    assemble: Any
    factor: Any
    gradient: Any
    moves_of: Any
    predict: Any
    texture: Any
    few: int


def make_point(degree: int, images: int) -> PointKernels:
    """Compile the common parts of the fits, for patches of a degree (1 plane, 2 curved), one or three comparisons."""
    few = len(monomials(degree))
    each = 4 if images == 3 else 1  # unknowns a monomial: w_j, and G_0j, G_1j, G_2j
    unknowns = each * few + 1
    row = (unknowns + QUAD - 1) // QUAD * QUAD
    set_up_reference, (keep, recall_reference), n_columns, n_raw = make_reference(degree)
    compare, compare_before = make_compare(degree)
    product, factor = make_product(row), make_factor(row)
    made_for = f"{degree}_{images}"

    def work_space(subset: int) -> WorkSpace:
        ref = subset_array(subset)
        basis = np.zeros((few, few))
        basis[0, 0] = 1.0
        reference = ReferenceSpace(
            raw=np.empty(n_raw),
            node_work=np.empty(25),
            powers=np.empty((few, N_NODES)),
            basis=basis,
            middle=np.empty(3),
            sum_g=np.empty(n_columns),
            sum_fg=np.empty(n_columns),
            gram=np.empty((n_columns, n_columns)),
        )
        equations = Equations(
            weights=np.zeros((4, 4)),
            block=np.zeros((3, 5)),
            columns=np.zeros((4, n_columns, row)),
            half=np.zeros((4, n_columns, row)),
            weighted=np.zeros((4, n_columns, row)),
            normal=np.zeros((row, row)),
        )
        return WorkSpace(
            ref=ref,
            of_reference=reference,
            warp=WarpSpace(np.zeros(N_WARP, np.float32), np.empty(26), np.empty(3 + n_columns)),
            rhs=np.empty((images, n_columns)),
            levels=np.empty((images, N_LEVELS)),
            M=np.empty((images, 3, few)),
            equations=equations,
            moves=np.empty((images, n_columns)),
            vectors=np.zeros((4, row)),
            inverse=np.empty((3, 3)),
            G=np.empty((3, few)),
            rotation=np.empty((3, 3)),
            chain=np.zeros((unknowns, unknowns)),
            work=np.empty((5, 5)),
        )

    @kernel(made_for)
    def image_matrices(R, t, xc, yc, w, G, e, nu_x, nu_y, M):
        """Compute the matrices that map the patch into the images."""
        for i in range(3):
            for j in range(few):
                M[0, i, j] = t[i] * w[j]
            M[0, i, 0] += R[i, 0] * xc + R[i, 1] * yc + R[i, 2]
            M[0, i, 1] += R[i, 0]
            M[0, i, 2] += R[i, 1]
            if images == 3:
                for j in range(few):
                    M[1, i, j] = G[i, j]
                    M[2, i, j] = R[i, 0] * G[0, j] + R[i, 1] * G[1, j] + R[i, 2] * G[2, j] + t[i] * w[j]
        for k in range(0, images, 2):
            for j in range(few):
                M[k, 0, j] += e * nu_x * M[k, 2, j]
                M[k, 1, j] += e * nu_y * M[k, 2, j]

    @kernel(made_for)
    def jacobian(R, t, e, nu_x, nu_y, M, slopes, of_reference, inverse, block, columns):
        """Compute each unknown's effect on the patch, reference px, as coefficients of ``columns``; False if singular.

        ``slopes`` are d(px) / d(ray) of camera 1 at the point.
        """
        basis, middle = of_reference.basis, of_reference.middle
        last = each * few
        j11, j12, j21, j22 = slopes
        for k in range(images):
            if not invert3(M[k], inverse):
                return False
            for a in range(3):
                if k == 1:
                    for i in range(3):
                        block[a, 1 + i] = inverse[a, i]
                    block[a, 0], block[a, 4] = 0.0, 0.0
                    continue
                s0, s1 = inverse[a, 0], inverse[a, 1]
                s2 = inverse[a, 2] + e * (nu_x * s0 + nu_y * s1)  # row a of M^-1 S(e)
                block[a, 0] = s0 * t[0] + s1 * t[1] + s2 * t[2]
                for i in range(3):
                    block[a, 1 + i] = (s0 * R[0, i] + s1 * R[1, i] + s2 * R[2, i]) if k == 2 else 0.0
                block[a, 4] = nu_x * s0 + nu_y * s1
            for i in range(5):
                x, y = block[1, i], block[2, i]
                block[1, i], block[2, i] = j11 * x + j12 * y, j21 * x + j22 * y
            out = columns[k]
            for r in range(n_columns):
                for c in range(row):
                    out[r, c] = 0.0
            for j in range(few):
                at = each * (j - 1) if j > 0 else last - each
                degree_of_m = 1 if j == 0 else (3 if j < 3 else 6)  # coefficients of monomial j of the ray
                for m in range(degree_of_m):
                    b, from_e = basis[j, m], basis[j, m] * M[k, 2, j]  # dM of e is the shift times M's last row
                    for i in range(each):
                        out[m, at + i] += block[1, i] * b
                        out[few + m, at + i] += block[2, i] * b
                    out[m, last] += block[1, 4] * from_e
                    out[few + m, last] += block[2, 4] * from_e
                # - X d_0 and - Y d_0 have one degree more; X and Y in px are the pixel's position
                if j == 0 or (few == 6 and j < 3):
                    for m in range(degree_of_m):
                        b = basis[j, m]
                        if b == 0.0:
                            continue
                        by_x, by_y = (1, 2) if m == 0 else ((3, 4) if m == 1 else (4, 5))
                        for i in range(each + 1):
                            c = at + i if i < each else last
                            d = block[0, i] * b if i < each else block[0, 4] * b * M[k, 2, j]
                            out[m, c] -= d * middle[0]
                            out[by_x, c] -= d * middle[2]
                            out[few + m, c] -= d * middle[1]
                            out[few + by_y, c] -= d * middle[2]
        return True

    @kernel(made_for)
    def assemble(equations, gram):
        """Normal equations: sum over comparisons k, o of ``weights_ko columns_k^T gram columns_o``."""
        weights, _, columns, half, weighted, normal = equations
        wide = n_columns * row
        for k in range(images):
            product(gram, n_columns, columns[k], row, half[k], row, n_columns, n_columns)
        if images == 1:
            for r in range(n_columns):
                for c in range(row):
                    weighted[0, r, c] = weights[0, 0] * half[0, r, c]
        else:
            for r in range(n_columns):
                product(weights, 4, half[0, r:], wide, weighted[0, r:], wide, images, images)
        product(columns[0], row, weighted[0], row, normal, row, images * n_columns, unknowns)

    @kernel(made_for)
    def gradient(equations, rhs, out):
        """Right-hand side in the unknowns from each image's sums ``rhs``, with the sign of a step downhill."""
        weights, columns = equations.weights, equations.columns
        for c in range(row):
            out[c] = 0.0
        for k in range(images):
            for r in range(n_columns):
                s = 0.0
                for o in range(images):
                    s -= weights[k, o] * rhs[o, r]
                for c in range(row):
                    out[c] += columns[k, r, c] * s

    @kernel(made_for)
    def moves_of(columns, step, moves):
        """Compute each image's motion of the patch for a step; return the largest corner motion, camera 1 px.

        The sum of the coefficients' sizes bounds it.
        """
        max_squared = 0.0
        for k in range(images):
            x, y = 0.0, 0.0
            for j in range(few):
                a, b = 0.0, 0.0
                for c in range(unknowns):
                    a += columns[k, j, c] * step[c]
                    b += columns[k, few + j, c] * step[c]
                moves[k, j], moves[k, few + j] = a, b
                x += abs(a)
                y += abs(b)
            max_squared = max(max_squared, x * x + y * y)
        return math.sqrt(max_squared)

    @kernel(made_for)
    def predict(moves, rhs, gram, f2, levels):
        """Correlations after a small last step, from the quadratic form that the step was found with."""
        for k in range(images):
            change = 0.0
            for r in range(n_columns):
                s = 2.0 * rhs[k, r]
                for c in range(n_columns):
                    s += gram[r, c] * moves[k, c]
                change += s * moves[k, r]
            levels[k, MISFIT] = max(levels[k, MISFIT] + change, 0.0)
            levels[k, ZNCC] = 1.0 - 0.5 * levels[k, MISFIT] / f2

    @kernel(made_for)
    def texture(gram):
        """Squared gradients (per px): mean over directions, and in the weakest direction."""
        xx, xy, yy = gram[0, 0], gram[0, few], gram[few, few]
        mean = 0.5 * (xx + yy)
        return mean, mean - math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)

    return PointKernels(
        set_up_reference=set_up_reference,
        keep=keep,
        recall_reference=recall_reference,
        work_space=work_space,
        compare=compare,
        compare_before=compare_before,
        image_matrices=image_matrices,
        jacobian=jacobian,
        assemble=assemble,
        factor=factor,
        gradient=gradient,
        moves_of=moves_of,
        predict=predict,
        texture=texture,
        few=few,
    )
