"""Small dense algebra for one point: 3 x 3 inverse, weighted normal equations, Cholesky, covariance of the last few."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereorig.core.matching.kernels.loops import data
from stereorig.core.matching.kernels.naming import inner, kernel
from stereorig.core.matching.kernels.vectors import DOUBLE, LONG, Vec, at, load, spread, store

QUAD = 4


@inner
def invert3(m, out):
    """Inverse of the leading 3 x 3 of a matrix; False if it has none."""
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    c01 = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    c02 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    det = m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02
    if det == 0.0 or not np.isfinite(det):
        return False
    r = 1.0 / det
    out[0, 0] = c00 * r
    out[1, 0] = c01 * r
    out[2, 0] = c02 * r
    out[0, 1] = (m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]) * r
    out[1, 1] = (m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]) * r
    out[2, 1] = (m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]) * r
    out[0, 2] = (m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]) * r
    out[1, 2] = (m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]) * r
    out[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * r
    return True


def _vectors(builder: Any, pointer: Any, parts: int) -> list[Vec]:
    return [load(builder, at(builder, pointer, LONG(QUAD * c)), QUAD, DOUBLE) for c in range(parts)]


def make_product(row: int) -> Any:
    """Compile ``c[i, :] = sum over r of a[r, i] b[r, :]`` for rows of ``row`` doubles, a multiple of four.

    Two i at a time: with an odd number, one more row is read and written. Arguments: a, its row length; b, its row
    length; c, its row length; number of r, number of i.
    """
    parts = row // QUAD

    @intrinsic
    def product(_typingctx: Any, a: Any, a_row: Any, b: Any, b_row: Any, c: Any, c_row: Any, n_r: Any, n_i: Any) -> Any:
        sig = types.void(a, a_row, b, b_row, c, c_row, n_r, n_i)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            a, b, c = (data(context, builder, sig, args, i) for i in (0, 2, 4))
            vector = ir.VectorType(DOUBLE, QUAD)
            sums = [[cgutils.alloca_once(builder, vector) for _ in range(parts)] for _ in range(2)]
            pairs = builder.sdiv(builder.add(args[7], LONG(1)), LONG(2))
            with cgutils.for_range(builder, pairs) as outer:
                i = builder.mul(outer.index, LONG(2))
                for one in (*sums[0], *sums[1]):
                    builder.store(ir.Constant(vector, [0.0] * QUAD), one)
                with cgutils.for_range(builder, args[6]) as inner:
                    row_b = _vectors(builder, at(builder, b, builder.mul(inner.index, args[3])), parts)
                    factors = at(builder, a, builder.add(builder.mul(inner.index, args[1]), i))
                    for which in range(2):
                        f = spread(builder, builder.load(at(builder, factors, LONG(which))), QUAD)
                        for one, value in zip(sums[which], row_b, strict=True):
                            builder.store((Vec(builder, builder.load(one)) + f * value).value, one)
                for which in range(2):
                    target = at(builder, c, builder.mul(builder.add(i, LONG(which)), args[5]))
                    for part, one in enumerate(sums[which]):
                        store(Vec(builder, builder.load(one)), at(builder, target, LONG(QUAD * part)))
            return context.get_dummy_value()

        return sig, codegen

    return product


def make_factor(row: int) -> Any:
    """Compile the Cholesky factor for matrices with rows of ``row`` doubles."""
    parts = row // QUAD

    @intrinsic
    def eliminate(_typingctx: Any, a: Any, i: Any) -> Any:
        """Subtract the rows above from row i: ``a[i, :] -= a[j, i] a[j, :]`` for all j < i."""
        sig = types.void(a, i)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            a = data(context, builder, sig, args, 0)
            own = at(builder, a, builder.mul(args[1], LONG(row)))
            sums = [cgutils.alloca_once(builder, ir.VectorType(DOUBLE, QUAD)) for _ in range(parts)]
            for one, value in zip(sums, _vectors(builder, own, parts), strict=True):
                builder.store(value.value, one)
            with cgutils.for_range(builder, args[1]) as above:
                other = at(builder, a, builder.mul(above.index, LONG(row)))
                f = spread(builder, builder.load(at(builder, other, args[1])), QUAD)
                for one, value in zip(sums, _vectors(builder, other, parts), strict=True):
                    builder.store((Vec(builder, builder.load(one)) - f * value).value, one)
            for part, one in enumerate(sums):
                store(Vec(builder, builder.load(one)), at(builder, own, LONG(QUAD * part)))
            return context.get_dummy_value()

        return sig, codegen

    @intrinsic
    def scale_row(_typingctx: Any, a: Any, i: Any, factor: Any) -> Any:
        sig = types.void(a, i, factor)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            own = at(builder, data(context, builder, sig, args, 0), builder.mul(args[1], LONG(row)))
            f = spread(builder, args[2], QUAD)
            for part, value in enumerate(_vectors(builder, own, parts)):
                store(value * f, at(builder, own, LONG(QUAD * part)))
            return context.get_dummy_value()

        return sig, codegen

    @kernel(f"{row}")
    def factor(a, n):
        """Cholesky factor U, ``a = U^T U``, of the leading (n, n) in place; reads and fills the upper triangle.

        The diagonal gets its inverse. False if not positive definite; the test is relative to each diagonal entry, so
        it does not depend on the unknowns' units. Entries below the diagonal are undefined.
        """
        for i in range(n):
            original = a[i, i]
            eliminate(a, np.int64(i))
            if not a[i, i] > 1e-11 * original:
                return False
            inverse = 1.0 / math.sqrt(a[i, i])
            scale_row(a, np.int64(i), inverse)
            a[i, i] = inverse
        return True

    return factor


@inner
def solve(u, b, n):
    """Solve ``U^T U x = b`` in place with the factor from :func:`make_factor`."""
    for i in range(n):
        s = b[i] * u[i, i]
        b[i] = s
        for c in range(i + 1, n):
            b[c] -= u[i, c] * s
    for i in range(n - 1, -1, -1):
        s = b[i]
        for c in range(i + 1, n):
            s -= u[i, c] * b[c]
        b[i] = s * u[i, i]


@inner
def covariance_of_last(u, n, m, work, out):
    """Inverse's trailing (m, m) block from :func:`make_factor`'s factor, row by row into ``out``."""
    first = n - m
    for j in range(m):  # columns of the trailing block's inverse, upper triangular
        for i in range(m):
            work[i, j] = 0.0
        work[j, j] = u[first + j, first + j]
        for i in range(j - 1, -1, -1):
            s = 0.0
            for k in range(i + 1, j + 1):
                s -= u[first + i, first + k] * work[k, j]
            work[i, j] = s * u[first + i, first + i]
    for i in range(m):
        for j in range(i, m):
            s = 0.0
            for k in range(j, m):
                s += work[i, k] * work[j, k]
            out[m * i + j] = s
            out[m * j + i] = s
