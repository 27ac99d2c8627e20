"""The loops over a subset's pixels, which take most of the time.

Written in vectors of eight pixels (:mod:`stereorig.core.matching.kernels.vectors`), because row loads of four taps are
two to four times faster than the gathers that a compiler makes of the same loop. One image's comparison is one loop
that stores nothing: position of the pixel (a cubic polynomial in the offsets within the subset), spline value,
residual, and its sums with the columns of the Jacobian. The positions of the next eight pixels are computed while the
taps of these eight are loaded, so that no load waits for an address. No bounds are tested here:
:func:`stereorig.core.matching.kernels.warp.set_up_warp` proves beforehand that every tap is inside the padded image.

The reference subset is a (6, width) float32 array with the rows X and Y (offsets from the subset's centre over its half
width, -1 to 1), f (grey levels, mean taken out), weight, and the derivatives of f with respect to the pixel's position
along x and y. ``width`` is the number of pixels rounded up to eight, and eight more; the surplus is zero. A seventh
row has the grey levels of another image, where that was interpolated before.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereorig.core.matching.kernels.vectors import (
    FLOAT,
    INT,
    LANES,
    LONG,
    Vec,
    at,
    join,
    load,
    spread,
    store,
    transpose4,
)

X, Y, F, WEIGHT, GX, GY, WARPED = range(7)
N_ROWS = 6
N_WARP = 22
"""Ten coefficients of the position along x, ten along y, gain and shift of the grey levels."""
X_BENDS, Y_BENDS = 3, 13
"""First coefficients of second order, x^2, x y and y^2, of the positions along x and y."""


def monomials(degree: int) -> list[tuple[int, int]]:
    """Exponents of x and y in the order used everywhere: 1, x, y, x^2, x y, y^2, x^3, ..."""
    return [(d - j, j) for d in range(degree + 1) for j in range(d + 1)]


def _cubic_weights(t: Vec) -> list[Vec]:
    """Six times the cubic B-spline's weights at fraction ``t``."""
    s = 1.0 - t
    tt = t * t
    w0, w3 = s * s * s, tt * t
    w1 = 4.0 + tt * (3.0 * t - 6.0)
    return [w0, w1, 6.0 - (w0 + w1 + w3), w3]


def _quintic_weights(t: Vec) -> list[Vec]:
    """120 times the quintic B-spline's weights at fraction ``t``."""
    s = 1.0 - t
    tt, ss = t * t, s * s
    w0, w5 = ss * ss * s, tt * tt * t
    w2 = 66.0 + tt * (-60.0 + tt * (30.0 - 10.0 * t))
    w3 = 66.0 + ss * (-60.0 + ss * (30.0 - 10.0 * s))
    w1 = 1.0 + s * (5.0 + s * (10.0 + s * (10.0 + s * (5.0 - 5.0 * s))))
    return [w0, w1, w2, w3, 120.0 - (w0 + w1 + (w2 + w3) + w5), w5]


def _four_columns(rows: list[Any], first: list[Any], wy: list[Vec]) -> tuple[Vec, Vec, Vec, Vec]:
    """Weighted sums over the rows of four neighbouring columns of taps, each for eight pixels."""
    sums: list[Vec] = []
    for j in range(4):  # pixels j and j + 4 share a vector
        total = None
        for row, weight in zip(rows, wy, strict=True):
            builder = weight.builder
            taps = join(
                load(builder, at(builder, row, first[j]), 4), load(builder, at(builder, row, first[j + 4]), 4), range(8)
            )
            term = weight.pick([j] * 4 + [j + 4] * 4) * taps
            total = term if total is None else total + term
        assert total is not None
        sums.append(total)
    a, b, c, d = sums
    return transpose4(a, b, c, d)


def _two_columns(rows: list[Any], first: list[Any], wy: list[Vec]) -> tuple[Vec, Vec]:
    """As ``_four_columns`` for the fifth and sixth tap."""
    sums: list[Vec] = []
    for j in (0, 2):
        at_once = (j, j + 1, j + 4, j + 5)
        total = None
        for row, weight in zip(rows, wy, strict=True):
            builder = weight.builder
            a, b, c, d = (load(builder, at(builder, at(builder, row, first[m]), LONG(4)), 2) for m in at_once)
            taps = join(join(a, b, range(4)), join(c, d, range(4)), range(8))
            term = weight.pick([m for m in at_once for _ in range(2)]) * taps
            total = term if total is None else total + term
        assert total is not None
        sums.append(total)
    first_two, last_two = sums
    even, odd = [0, 2, 8, 10, 4, 6, 12, 14], [1, 3, 9, 11, 5, 7, 13, 15]
    return join(first_two, last_two, even), join(first_two, last_two, odd)


def spline(order: int, rows: list[Any], first: list[Any], tx: Vec, ty: Vec) -> Vec:
    """36 (cubic) or 14400 (quintic) times the spline's value."""
    weights = _cubic_weights if order == 3 else _quintic_weights
    wx, wy = weights(tx), weights(ty)
    a, b, c, d = _four_columns(rows, first, wy)
    value = (wx[0] * a + wx[1] * b) + (wx[2] * c + wx[3] * d)
    if order == 5:
        e, f = _two_columns(rows, first, wy)
        value = value + (wx[4] * e + wx[5] * f)
    return value


def _position(c: list[Vec], x: Vec, y: Vec) -> Vec:
    """Cubic polynomial with coefficients in the order of :func:`monomials`."""
    along_x = c[0] + x * (c[1] + x * (c[3] + x * c[6]))
    return along_x + y * ((c[2] + x * (c[4] + x * c[7])) + y * ((c[5] + x * c[8]) + y * c[9]))


def lanes(builder: Any, indices: Any) -> list[Any]:
    """Eight int32 lanes as 64-bit scalars, two at a time."""
    pairs = builder.bitcast(indices, ir.VectorType(LONG, LANES // 2))
    scalars = []
    for j in range(LANES // 2):
        pair = builder.extract_element(pairs, INT(j))
        scalars += [builder.sext(builder.trunc(pair, INT), LONG), builder.ashr(pair, LONG(32))]
    return scalars


def _taps_from(context: Any, builder: Any, sig: Any, args: Any, order: int) -> list[Any]:
    """Pointers to the first tap for position (0, 0) in each row of taps; arguments as of ``compare_pixels``."""
    rows = [at(builder, data(context, builder, sig, args, 0), args[1])]
    for _ in range(order):
        rows.append(at(builder, rows[-1], args[2]))
    return rows


def _place(builder: Any, warp: list[Vec], stride: Any, x: Vec, y: Vec) -> tuple[Any, Vec, Vec]:
    """Index of the first tap of eight pixels, and their fractions, at offsets ``x``, ``y`` in the subset."""
    xt, yt = _position(warp[:10], x, y), _position(warp[10:20], x, y)
    xf, yf = xt.floor(), yt.floor()
    k = builder.add(builder.mul(yf.to_int(), stride, flags=("nsw",)), xf.to_int(), flags=("nsw",))
    return k, xt - xf, yt - yf


def _sum_up(builder: Any, count: Any, n_sums: int, terms: Callable[[Any], list[Vec]], out: Any, slot: int) -> None:
    """Loop over ``count`` blocks; ``terms(offset)`` gives the block's summands; totals go to ``out`` as float64."""
    zero = ir.Constant(ir.VectorType(FLOAT, LANES), [0.0] * LANES)
    sums = [cgutils.alloca_once(builder, zero.type) for _ in range(n_sums)]  # LLVM keeps them in registers
    for one in sums:
        builder.store(zero, one)
    with cgutils.for_range(builder, count) as loop:
        offset = builder.mul(builder.sext(loop.index, LONG), LONG(LANES))
        for one, term in zip(sums, terms(offset), strict=True):
            builder.store((Vec(builder, builder.load(one)) + term).value, one)
    for i, one in enumerate(sums):
        total = builder.fpext(Vec(builder, builder.load(one)).sum(), ir.DoubleType())
        builder.store(total, at(builder, out, LONG(slot + i)))


def data(context: Any, builder: Any, sig: Any, args: Any, i: int) -> Any:
    """Pointer to the first element of the array that is argument ``i``."""
    return context.make_array(sig.args[i])(context, builder, args[i]).data


def _reference_rows(context: Any, builder: Any, sig: Any, args: Any, i: int, count: int = N_ROWS) -> list[Any]:
    array = context.make_array(sig.args[i])(context, builder, args[i])
    width = builder.extract_value(array.shape, 1)
    return [at(builder, array.data, builder.mul(width, LONG(r))) for r in range(count)]


def _comparison(order: int, degree: int) -> Any:
    def compare_pixels(
        _typingctx: Any, c: Any, base: Any, stride: Any, warp: Any, ref: Any, blocks: Any, out: Any
    ) -> Any:
        """Compare one image with the reference subset.

        Parameters
        ----------
        c
            Padded coefficients, flat float32.
        base
            int64 flat index of the first tap for position (0, 0).
        stride
            int64 row length of ``c``.
        warp
            (22,) float32, see :func:`stereorig.core.matching.kernels.warp.set_up_warp`.
        ref
            The reference subset.
        blocks
            int64 number of its pixels over eight, rounded up.
        out
            float64 out: sums of a, a f, a d with d the residual and a its product with the weight, then of a gx and of
            a gy times each monomial up to ``degree``.
        """
        sig = types.void(c, base, stride, warp, ref, blocks, out)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            p = data(context, builder, sig, args, 3)
            warp = [spread(builder, builder.load(at(builder, p, LONG(i)))) for i in range(N_WARP)]
            gain = warp[20] * (1.0 / 36.0 if order == 3 else 1.0 / 14400.0)
            stride = spread(builder, builder.trunc(args[2], INT)).value
            rows, ref = _taps_from(context, builder, sig, args, order), _reference_rows(context, builder, sig, args, 4)
            vector = ir.VectorType(FLOAT, LANES)
            k_next = cgutils.alloca_once(builder, ir.VectorType(INT, LANES))
            tx_next, ty_next = (cgutils.alloca_once(builder, vector) for _ in range(2))

            def find_position(offset: Any) -> None:
                x, y = (load(builder, at(builder, ref[r], offset)) for r in (X, Y))
                k, tx, ty = _place(builder, warp, stride, x, y)
                builder.store(k, k_next)
                builder.store(tx.value, tx_next)
                builder.store(ty.value, ty_next)

            def terms(offset: Any) -> list[Vec]:
                first = lanes(builder, builder.load(k_next))
                tx, ty = Vec(builder, builder.load(tx_next)), Vec(builder, builder.load(ty_next))
                find_position(builder.add(offset, LONG(LANES)))
                x, y, f, weight, gx, gy = (load(builder, at(builder, row, offset)) for row in ref)
                d = spline(order, rows, first, tx, ty) * gain - (warp[21] + f)
                return _summands(x, y, f, weight * d, d, (gx, gy), degree)

            find_position(LONG(0))
            _sum_up(builder, args[5], 3 + 2 * len(monomials(degree)), terms, data(context, builder, sig, args, 6), 0)
            return context.get_dummy_value()

        return sig, codegen

    compare_pixels.__name__ = f"compare_{'cubic' if order == 3 else 'quintic'}_{degree}"
    return intrinsic(compare_pixels)


def _sampling(order: int) -> Any:
    def sample_pixels(
        _typingctx: Any, c: Any, base: Any, stride: Any, warp: Any, ref: Any, blocks: Any, out: Any
    ) -> Any:
        """Sample an image over a subset into ``out``, float32; the others as of ``compare_pixels``."""
        sig = types.void(c, base, stride, warp, ref, blocks, out)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            p, out = data(context, builder, sig, args, 3), data(context, builder, sig, args, 6)
            warp = [spread(builder, builder.load(at(builder, p, LONG(i)))) for i in range(N_WARP)]
            stride = spread(builder, builder.trunc(args[2], INT)).value
            rows, ref = _taps_from(context, builder, sig, args, order), _reference_rows(context, builder, sig, args, 4)
            with cgutils.for_range(builder, args[5]) as loop:
                offset = builder.mul(builder.sext(loop.index, LONG), LONG(LANES))
                x, y = (load(builder, at(builder, ref[r], offset)) for r in (X, Y))
                k, tx, ty = _place(builder, warp, stride, x, y)
                value = spline(order, rows, lanes(builder, k), tx, ty)
                store(value * (1.0 / 36.0 if order == 3 else 1.0 / 14400.0), at(builder, out, offset))
            return context.get_dummy_value()

        return sig, codegen

    sample_pixels.__name__ = f"sample_{'cubic' if order == 3 else 'quintic'}"
    return intrinsic(sample_pixels)


def _warped_comparison(degree: int) -> Any:
    def compare_warped(_typingctx: Any, warp: Any, ref: Any, blocks: Any, out: Any) -> Any:
        """Compare the grey levels in the row ``WARPED`` with the reference subset.

        They were interpolated at the place of the pixel plus a motion of second order, which is taken off with the
        reference's gradient.

        Parameters
        ----------
        warp
            (22,) float32: that motion of x and of y, reference px, from ``X_BENDS`` and ``Y_BENDS`` on; gain and shift.
        ref, blocks, out
            As in ``compare_pixels``.
        """
        sig = types.void(warp, ref, blocks, out)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            p = data(context, builder, sig, args, 0)
            warp = [spread(builder, builder.load(at(builder, p, LONG(i)))) for i in range(N_WARP)]
            ref = _reference_rows(context, builder, sig, args, 1, WARPED + 1)

            def terms(offset: Any) -> list[Vec]:
                x, y, f, weight, gx, gy, g = (load(builder, at(builder, row, offset)) for row in ref)
                dx, dy = (x * (warp[i] * x + warp[i + 1] * y) + warp[i + 2] * (y * y) for i in (X_BENDS, Y_BENDS))
                d = (g * warp[20] - (warp[21] + f)) - (gx * dx + gy * dy)
                return _summands(x, y, f, weight * d, d, (gx, gy), degree)

            n_sums = 3 + 2 * len(monomials(degree))
            _sum_up(builder, args[2], n_sums, terms, data(context, builder, sig, args, 3), 0)
            return context.get_dummy_value()

        return sig, codegen

    compare_warped.__name__ = f"compare_warped_{degree}"
    return intrinsic(compare_warped)


def _summands(x: Vec, y: Vec, f: Vec, a: Vec, d: Vec, gradient: tuple[Vec, Vec], degree: int) -> list[Vec]:
    """Summands of a comparison: a, a f, a d, and a times each gradient times each monomial up to the degree."""
    bx, by = (a * g for g in gradient)
    columns = _powers(x, y, degree)
    return [a, a * f, a * d, *(bx * m if m else bx for m in columns), *(by * m if m else by for m in columns)]


def _powers(x: Vec, y: Vec, degree: int) -> list[Vec | None]:
    """Monomials up to the degree; None for the constant."""
    known: dict[tuple[int, int], Vec | None] = {(0, 0): None, (1, 0): x, (0, 1): y}
    for i, j in monomials(degree):
        if (i, j) not in known:
            lower = known[(i - 1, j)] if i else known[(0, j - 1)]
            assert lower is not None
            known[(i, j)] = lower * (x if i else y)
    return [known[m] for m in monomials(degree)]


def _reference_sums(degree: int) -> Any:
    def sum_reference(_typingctx: Any, ref: Any, blocks: Any, mean: Any, out: Any) -> Any:
        """Subtract ``mean`` from the reference's grey levels and compute the sums for the normal equations.

        Parameters
        ----------
        ref
            The reference subset; its row f is changed in place.
        blocks
            int64 number of pixels over eight, rounded up.
        mean
            float32.
        out
            float64 out. With p the weight: sums of p, p f, p f^2, p (f - its right neighbour)^2; of p f gx and p f gy
            times each monomial up to ``degree``; of p gx and p gy times the same; of p gx^2, p gx gy and p gy^2 times
            each monomial up to twice the degree.
        """
        sig = types.void(ref, blocks, mean, out)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            rows = _reference_rows(context, builder, sig, args, 0)
            mean = spread(builder, args[2])
            out = data(context, builder, sig, args, 3)

            def get(offset: Any, *which: int) -> list[Vec]:
                return [load(builder, at(builder, rows[r], offset)) for r in which]

            def times(factors: list[Vec], columns: list[Vec | None]) -> list[Vec]:
                return [factor if m is None else factor * m for factor in factors for m in columns]

            def with_grey(offset: Any) -> list[Vec]:
                x, y, f, p, gx, gy = get(offset, *range(N_ROWS))
                difference = load(builder, at(builder, rows[F], builder.add(offset, LONG(1)))) - f
                f = f - mean
                store(f, at(builder, rows[F], offset))
                pf = p * f
                return [p, pf, pf * f, p * difference * difference, *times([pf * gx, pf * gy], _powers(x, y, degree))]

            def columns_alone(offset: Any) -> list[Vec]:
                x, y, p, gx, gy = get(offset, X, Y, WEIGHT, GX, GY)
                return times([p * gx, p * gy], _powers(x, y, degree))

            def products(a: int, b: int) -> Callable[[Any], list[Vec]]:
                def terms(offset: Any) -> list[Vec]:
                    x, y, p = get(offset, X, Y, WEIGHT)
                    g, h = get(offset, a, b)
                    return times([p * g * h], _powers(x, y, 2 * degree))

                return terms

            few, many = len(monomials(degree)), len(monomials(2 * degree))
            slot = 0
            for terms, n in (
                (with_grey, 4 + 2 * few),
                (columns_alone, 2 * few),
                (products(GX, GX), many),
                (products(GX, GY), many),
                (products(GY, GY), many),
            ):
                _sum_up(builder, args[1], n, terms, out, slot)
                slot += n
            return context.get_dummy_value()

        return sig, codegen

    sum_reference.__name__ = f"sum_reference_{degree}"
    return intrinsic(sum_reference)


compare_cubic = {degree: _comparison(3, degree) for degree in (1, 2)}
compare_quintic = {degree: _comparison(5, degree) for degree in (1, 2)}
sample_cubic, sample_quintic = _sampling(3), _sampling(5)
compare_warped = {degree: _warped_comparison(degree) for degree in (1, 2)}
sum_reference = {degree: _reference_sums(degree) for degree in (1, 2)}
