"""The reference subset: grey levels, gradients, and the sums for the normal equations.

A step of the unknowns displaces the patch, in any image, by ``dx = a . m, dy = b . m`` px in the reference image (``m``
the monomials 1, x, y, or those up to second order, of a pixel's position in the subset), and an image's grey levels by
contrast times ``gx dx + gy dy`` with the *reference's* gradient (gx, gy). So the columns ``gx m_j, gy m_j``, which
depend on no other image, make every Jacobian. Terms of higher degree, that perspective adds, are left out of the
Jacobian (not of the warp): they are some thousandths of the others, and change the path of Gauss-Newton, not its end.

The gradients are expected to be the best estimate of the noise-free texture's: then the Gram matrix of the columns is
also the sensitivity of their sums to a displacement.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereorig.core.matching.kernels.given import Subset
from stereorig.core.matching.kernels.loops import GX, GY, WARPED, WEIGHT, F, X, Y, monomials, sum_reference
from stereorig.core.matching.kernels.naming import inner, kernel
from stereorig.core.matching.kernels.vectors import LANES, LONG, at, load, store
from stereorig.core.matching.kernels.warp import N_NODES, set_up_nodes, undistort

LARGE_MEAN = 100.0
"""Mean of a subset over its contrast from which on an image's sums start from the mean. A float32 sum of squares has
six digits and must hold the contrast's square: up to here it has two of them, which a second comparison makes whole."""


def subset_array(subset: int) -> np.ndarray:
    """Return an array for the reference subset, its rows that all points share filled; the surplus is zero."""
    width = (subset * subset + LANES - 1) // LANES * LANES + LANES
    ref = np.zeros((WARPED + 1, width), np.float32)
    coordinate = np.linspace(-1.0, 1.0, subset)
    n = subset * subset
    ref[X, :n], ref[Y, :n] = (axis.ravel() for axis in np.meshgrid(coordinate, coordinate))
    ref[WEIGHT, :n] = 1.0
    return ref


@intrinsic
def _copy_square(_typingctx: Any, image: Any, top: Any, left: Any, subset: Any, ref: Any, row: Any) -> Any:
    """Copy a square of an image, 8 px or more wide, into one row of the reference subset's array."""
    sig = types.void(image, top, left, subset, ref, row)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        array = context.make_array(sig.args[0])(context, builder, args[0])
        cols = builder.extract_value(array.shape, 1)
        out = context.make_array(sig.args[4])(context, builder, args[4])
        to = at(builder, out.data, builder.mul(args[5], builder.extract_value(out.shape, 1)))
        start = at(builder, array.data, builder.add(builder.mul(args[1], cols), args[2]))
        subset = args[3]
        last = builder.sub(subset, LONG(LANES))
        whole = builder.sdiv(subset, LONG(LANES))
        with cgutils.for_range(builder, subset) as line:
            source = at(builder, start, builder.mul(line.index, cols))
            target = at(builder, to, builder.mul(line.index, subset))
            with cgutils.for_range(builder, whole) as part:
                offset = builder.mul(part.index, LONG(LANES))
                store(load(builder, at(builder, source, offset)), at(builder, target, offset))
            # the rest, overlapping the pixels already copied
            store(load(builder, at(builder, source, last)), at(builder, target, last))
        return context.get_dummy_value()

    return sig, codegen


@inner
def copy(image, top, left, subset, ref, row):
    """Copy a square of an image into one row of the reference subset's array."""
    if subset >= LANES:
        _copy_square(image, np.int64(top), np.int64(left), np.int64(subset), ref, np.int64(row))
        return
    for r in range(subset):
        for c in range(subset):
            ref[row, r * subset + c] = image[top + r, left + c]


@inner
def first_pixel(middle_px, half):
    """First pixel, along an axis, of a subset nearest to a position."""
    return int(np.floor(middle_px - half + 0.5))


@inner
def _count_visible(patches, which, subset, weighted, ref):
    """Set the weights of invisible pixels to zero; return the number of pixels left."""
    n = subset * subset
    if which < 0:
        if not weighted:  # the last point may have left its own
            for i in range(n):
                ref[WEIGHT, i] = 1.0
        return n
    count = 0
    for r in range(subset):
        for c in range(subset):
            if patches[which, r, c] == 0:
                ref[WEIGHT, r * subset + c] = 0.0
            else:
                count += 1
                if not weighted:
                    ref[WEIGHT, r * subset + c] = 1.0
    return count


_AFTER_SUBSET = 9  # numbers of a Subset in a row of the memory


def n_kept_reference(degree: int) -> int:
    """Numbers that the memory has of a reference subset."""
    few = len(monomials(degree))
    return _AFTER_SUBSET + 3 + few * N_NODES + few * few + 4 * few * (few + 1)


def _product_table(degree: int) -> np.ndarray:
    many, few = monomials(2 * degree), monomials(degree)
    return np.array([[many.index((a[0] + b[0], a[1] + b[1])) for b in few] for a in few])


@cache
def make_reference(degree: int) -> Any:
    """Compile the set-up of the reference subset for patches of this degree (1 plane, 2 curved)."""
    few, many = len(monomials(degree)), len(monomials(2 * degree))
    n_columns = 2 * few
    product = _product_table(degree)
    first_fg, first_g, first_gg = 4, 4 + n_columns, 4 + 2 * n_columns
    sum_all = sum_reference[degree]

    @kernel(f"{degree}")
    def set_up_reference(reference, patches, which, lens, x_px, y_px, subset, ref, space):
        """Copy the subset nearest to (x_px, y_px) and sum it; return a :class:`Subset`.

        Parameters
        ----------
        reference, patches, which
            As in :class:`stereorig.core.matching.kernels.given.Given`, of one point.
        lens
            Camera 1's.
        ref
            The subset's array, see ``loops``.
        space
            A :class:`ReferenceSpace`.
        """
        pixels, grad_x, grad_y, weights = reference
        raw, node_work, powers, basis, middle, sum_g, sum_fg, gram = space
        nothing = Subset(False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        rows, cols = pixels.shape
        half = 0.5 * (subset - 1)
        left, top = first_pixel(x_px, half), first_pixel(y_px, half)
        if left < 0 or top < 0 or left + subset > cols or top + subset > rows:
            return nothing
        xc, yc = undistort(lens, x_px, y_px)
        if not np.isfinite(xc + yc):
            return nothing
        middle[0], middle[1], middle[2] = left + half - x_px, top + half - y_px, half
        if not set_up_nodes(lens, middle[0], middle[1], half, xc, yc, node_work, powers):
            return nothing
        copy(pixels, top, left, subset, ref, np.int64(F))
        copy(grad_x, top, left, subset, ref, np.int64(GX))
        copy(grad_y, top, left, subset, ref, np.int64(GY))
        if weights.shape[0] > 0:
            copy(weights, top, left, subset, ref, np.int64(WEIGHT))
        count = subset * subset
        if patches.shape[0] > 0:
            count = _count_visible(patches, which, subset, weights.shape[0] > 0, ref)
        mean = np.float32(0.0)  # shift along the diagonal: only there to keep the sums small
        for i in range(subset):
            mean += pixels[top + i, left + i]
        for i in range(subset * subset, ref.shape[1]):  # the last pixel has no right neighbour: it differs by nothing
            ref[F, i] = pixels[top + subset - 1, left + subset - 1]
        sum_all(ref, np.int64((subset * subset + LANES - 1) // LANES), np.float32(mean / subset), raw)
        p, offset = raw[0], raw[1] / raw[0]
        f2 = raw[2] - raw[1] * offset
        for i in range(n_columns):
            sum_g[i] = raw[first_g + i]
            sum_fg[i] = raw[first_fg + i] - offset * raw[first_g + i]
        for j in range(few):
            for k in range(few):
                m = product[j, k]
                gram[j, k] = raw[first_gg + m]
                gram[j, few + k] = gram[few + j, k] = raw[first_gg + many + m]
                gram[few + j, few + k] = raw[first_gg + 2 * many + m]
        per_weight, per_f2 = 1.0 / p, 1.0 / f2
        for i in range(n_columns):
            a, b = sum_g[i] * per_weight, sum_fg[i] * per_f2
            for j in range(n_columns):
                gram[i, j] -= a * sum_g[j] + b * sum_fg[j]
        # positions -> rays: X = a0 + a1 x + a2 y, Y alike, with the lens's slope at the point
        u, v = basis[1], basis[2]
        u[1], u[2], v[1], v[2] = half * node_work[16], half * node_work[17], half * node_work[18], half * node_work[19]
        u[0] = (u[1] * middle[0] + u[2] * middle[1]) / half
        v[0] = (v[1] * middle[0] + v[2] * middle[1]) / half
        if few == 6:
            for row, s, t in ((3, u, u), (4, u, v), (5, v, v)):
                times(s, t, basis[row])
        first_shift = float(mean / subset)
        if first_shift * first_shift * p <= LARGE_MEAN * LARGE_MEAN * f2:
            first_shift = 0.0
        mean_used = np.float64(np.float32(mean / subset))
        return Subset(True, xc, yc, p, offset, f2, 0.5 * raw[3] / f2, float(count), first_shift, mean_used)

    @kernel(f"{degree}")
    def keep(seen, space, kept):
        """Write what :func:`recall_reference` needs of a whole subset to a row of the memory."""
        _, _, powers, basis, middle, sum_g, sum_fg, gram = space
        _, kept[0], kept[1], kept[2], kept[3], kept[4], kept[5], kept[6], kept[7], kept[8] = seen
        at = _AFTER_SUBSET
        for i in range(3):
            kept[at + i] = middle[i]
        at += 3
        for values in (powers, basis, gram):
            for r in range(values.shape[0]):
                for c in range(values.shape[1]):
                    kept[at] = values[r, c]
                    at += 1
        for i in range(n_columns):
            kept[at + i], kept[at + n_columns + i] = sum_g[i], sum_fg[i]

    @kernel(f"{degree}")
    def recall_reference(reference, patches, x_px, y_px, subset, kept, ref, space):
        """Set up a whole subset as ``set_up_reference`` does, with the sums of a row of the memory."""
        pixels, grad_x, grad_y, weights = reference
        _, _, powers, basis, middle, sum_g, sum_fg, gram = space
        at = _AFTER_SUBSET
        for i in range(3):
            middle[i] = kept[at + i]
        at += 3
        for values in (powers, basis, gram):
            for r in range(values.shape[0]):
                for c in range(values.shape[1]):
                    values[r, c] = kept[at]
                    at += 1
        for i in range(n_columns):
            sum_g[i], sum_fg[i] = kept[at + i], kept[at + n_columns + i]
        left, top = first_pixel(x_px, middle[2]), first_pixel(y_px, middle[2])
        copy(pixels, top, left, subset, ref, np.int64(F))
        copy(grad_x, top, left, subset, ref, np.int64(GX))
        copy(grad_y, top, left, subset, ref, np.int64(GY))
        mean = np.float32(kept[8])
        for i in range(subset * subset):
            ref[F, i] -= mean
        if weights.shape[0] > 0:
            copy(weights, top, left, subset, ref, np.int64(WEIGHT))
        elif patches.shape[0] > 0:
            for i in range(subset * subset):
                ref[WEIGHT, i] = 1.0
        return Subset(True, kept[0], kept[1], kept[2], kept[3], kept[4], kept[5], kept[6], kept[7], kept[8])

    return set_up_reference, (keep, recall_reference), n_columns, first_gg + 3 * many


@inner
def times(s, t, out):
    """Product of two linear polynomials (the first three entries of each) in x and y: six coefficients."""
    out[0] = s[0] * t[0]
    out[1] = s[0] * t[1] + s[1] * t[0]
    out[2] = s[0] * t[2] + s[2] * t[0]
    out[3] = s[1] * t[1]
    out[4] = s[1] * t[2] + s[2] * t[1]
    out[5] = s[2] * t[2]
