"""The reference subset: grey levels, gradients, and the sums that the normal equations are made of.

A step of the unknowns displaces the patch, as any image sees it, by ``dX = a . m, dY = b . m`` in its own coordinates
(rays of camera 1 relative to the point's, ``m`` the monomials 1, X, Y or those up to second order), and an image's grey
levels by contrast times ``gX dX + gY dY`` with the *reference's* gradient (gX, gY). So the columns ``gX m_j, gY m_j``,
which know nothing of any image, make every Jacobian. Terms of higher degree, that perspective adds, are left out of the
Jacobian (not of the warp): they are some thousandths of the others, and change where Gauss-Newton goes, not where it
ends.

The gradients are expected to be the best estimate of the noise-free texture's: then the Gram matrix of the columns is
also the sensitivity of their sums to a displacement.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from core.matching.kernels.loops import F, GX, GY, WEIGHT, X, Y, data, monomials, sum_reference
from core.matching.kernels.vectors import LANES, LONG, at, load, store
from core.matching.kernels.warp import NODES, lens_jacobian, set_up_nodes, undistort


@njit(nogil=True, error_model="numpy")
def width(subset):
    """Row length of the reference subset's array."""
    return (subset * subset + LANES - 1) // LANES * LANES + LANES


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
            # the rest, overlapping what is there
            store(load(builder, at(builder, source, last)), at(builder, target, last))
        return context.get_dummy_value()

    return sig, codegen


@njit(nogil=True, error_model="numpy")
def _copy(image, top, left, subset, ref, row):
    if subset >= LANES:
        _copy_square(image, np.int64(top), np.int64(left), np.int64(subset), ref, np.int64(row))
        return
    for r in range(subset):
        for c in range(subset):
            ref[row, r * subset + c] = image[top + r, left + c]


@njit(nogil=True, error_model="numpy")
def set_up_tables(subset, ref):
    """Fill the rows that all points share: places of the pixels and weights of one; the surplus is zero."""
    half = 0.5 * (subset - 1)
    ref[:] = np.float32(0.0)
    for r in range(subset):
        for c in range(subset):
            i = r * subset + c
            ref[X, i] = (c - half) / half
            ref[Y, i] = (r - half) / half
            ref[WEIGHT, i] = 1.0


@njit(nogil=True, error_model="numpy")
def powers_of(x, y, out):
    """Monomials of one place into ``out`` (3 or 6,)."""
    out[0], out[1], out[2] = 1.0, x, y
    if len(out) == 6:
        out[3], out[4], out[5] = x * x, x * y, y * y


def _product_table(degree: int) -> np.ndarray:
    many, few = monomials(2 * degree), monomials(degree)
    return np.array([[many.index((a[0] + b[0], a[1] + b[1])) for b in few] for a in few])


def make_reference(degree: int) -> Any:
    """Compile the set-up of the reference subset for patches of this degree (1 plane, 2 curved)."""
    few, many = len(monomials(degree)), len(monomials(2 * degree))
    n_columns = 2 * few
    product = _product_table(degree)
    first_fg, first_g, first_gg = 3, 3 + n_columns, 3 + 2 * n_columns
    sum_all = sum_reference[degree]

    @njit(nogil=True, error_model="numpy")
    def to_rays(sums, basis, j11, j12, j21, j22, out):
        """Sums over gx m, gy m in the subset's places -> over gX m, gY m in rays."""
        for j in range(few):
            x, y = 0.0, 0.0
            for k in range(few):
                x += basis[j, k] * sums[k]
                y += basis[j, k] * sums[few + k]
            out[j] = j11 * x + j21 * y
            out[few + j] = j12 * x + j22 * y

    @njit(nogil=True, error_model="numpy")
    def _both_sides(block, basis, half):
        """``basis block basis^T`` in place."""
        for j in range(few):
            for k in range(few):
                s = 0.0
                for i in range(few):
                    s += basis[j, i] * block[i, k]
                half[j, k] = s
        for j in range(few):
            for k in range(few):
                s = 0.0
                for i in range(few):
                    s += half[j, i] * basis[k, i]
                block[j, k] = s

    @njit(nogil=True, error_model="numpy")
    def set_up_reference(reference, lens, x_px, y_px, subset, ref, space):
        """Copy the subset nearest to (x_px, y_px) and sum it.

        Parameters
        ----------
        reference
            Tuple of pixels, gradients along x and y, and weights, (rows, cols) float32 each; weights may be empty.
        lens
            Camera 1's.
        ref
            The subset's array, see ``loops``.
        space
            Tuple of work space: raw sums, node rays (2, 16), node monomials (M, 16), the change of basis (M, M) from
            the subset's places to rays, another (M, M), and the results: sum of each column, sum of f times it (both (2 M,)), and the
            Gram matrix (2 M, 2 M), all with gain and offset projected out but the first.

        Returns
        -------
        tuple
            ``inside`` (bool), the point's ray ``xc, yc``, the weights' sum, the mean of f that is left, and the sum of
            squares of f about it.
        """
        pixels, grad_x, grad_y, weights = reference
        raw, rays, powers, basis, half_way, sum_g, sum_fg, gram = space
        nothing = (False, 0.0, 0.0, 0.0, 0.0, 0.0)
        rows, cols = pixels.shape
        half = 0.5 * (subset - 1)
        left, top = int(np.floor(x_px - half + 0.5)), int(np.floor(y_px - half + 0.5))
        if left < 0 or top < 0 or left + subset > cols or top + subset > rows:
            return nothing
        xc, yc = undistort(lens, x_px, y_px)
        if not np.isfinite(xc + yc):
            return nothing
        if not set_up_nodes(lens, x_px, y_px, (left + half, top + half), half, xc, yc, rays):
            return nothing
        for n in range(NODES.shape[1]):
            powers_of(rays[0, n], rays[1, n], powers[:, n])
        _copy(pixels, top, left, subset, ref, F)
        _copy(grad_x, top, left, subset, ref, GX)
        _copy(grad_y, top, left, subset, ref, GY)
        if weights.shape[0] > 0:
            _copy(weights, top, left, subset, ref, WEIGHT)
        mean = np.float32(0.0)  # of a diagonal: only there to keep the sums small
        for i in range(subset):
            mean += pixels[top + i, left + i]
        for i in range(subset * subset, len(ref[F])):
            ref[F, i] = 0.0
        sum_all(ref, np.int64((subset * subset + LANES - 1) // LANES), np.float32(mean / subset), raw)
        p, offset = raw[0], raw[1] / raw[0]
        f2 = raw[2] - raw[1] * offset
        # places -> rays: m(X, Y) = basis m(place), with the lens's slope at the point
        j11, j12, j21, j22 = lens_jacobian(lens, xc, yc)
        det = j11 * j22 - j12 * j21
        a1, a2, b1, b2 = j22 / det * half, -j12 / det * half, -j21 / det * half, j11 / det * half
        dx, dy = (left + half - x_px) / half, (top + half - y_px) / half
        a0, b0 = a1 * dx + a2 * dy, b1 * dx + b2 * dy
        basis[:] = 0.0
        basis[0, 0] = 1.0
        basis[1, 0], basis[1, 1], basis[1, 2] = a0, a1, a2
        basis[2, 0], basis[2, 1], basis[2, 2] = b0, b1, b2
        if few == 6:
            u, v = basis[1], basis[2]
            for row, s, t in ((3, u, u), (4, u, v), (5, v, v)):
                basis[row, 0] = s[0] * t[0]
                basis[row, 1] = s[0] * t[1] + s[1] * t[0]
                basis[row, 2] = s[0] * t[2] + s[2] * t[0]
                basis[row, 3] = s[1] * t[1]
                basis[row, 4] = s[1] * t[2] + s[2] * t[1]
                basis[row, 5] = s[2] * t[2]
        to_rays(raw[first_g:], basis, j11, j12, j21, j22, sum_g)
        to_rays(raw[first_fg:], basis, j11, j12, j21, j22, sum_fg)
        for i in range(n_columns):
            sum_fg[i] -= offset * sum_g[i]
        # the same for the products: gX = j11 gx + j21 gy, gY = j12 gx + j22 gy
        for j in range(few):
            for k in range(few):
                xx = raw[first_gg + product[j, k]]
                xy = raw[first_gg + many + product[j, k]]
                yy = raw[first_gg + 2 * many + product[j, k]]
                gram[j, k] = j11 * j11 * xx + 2.0 * j11 * j21 * xy + j21 * j21 * yy
                gram[j, few + k] = j11 * j12 * xx + (j11 * j22 + j12 * j21) * xy + j21 * j22 * yy
                gram[few + j, few + k] = j12 * j12 * xx + 2.0 * j12 * j22 * xy + j22 * j22 * yy
        for a in range(2):
            for b in range(a, 2):
                _both_sides(gram[few * a : few * (a + 1), few * b : few * (b + 1)], basis, half_way)
        for i in range(n_columns):
            for j in range(i, n_columns):
                gram[i, j] -= sum_g[i] * sum_g[j] / p + sum_fg[i] * sum_fg[j] / f2
                gram[j, i] = gram[i, j]
        return True, xc, yc, p, offset, f2

    return set_up_reference, to_rays, n_columns, first_gg + 3 * many
