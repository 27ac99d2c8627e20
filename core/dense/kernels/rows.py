"""Whole rows of pixels, eight at a time: their products, added to the sums of columns.

Rows are float32, sums double. An intrinsic passes LLVM the fact, unknown to the compiler, that numba's arrays do not
overlap.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereorig.core.matching.kernels.vectors import DOUBLE, FLOAT, LANES, LONG, Vec, at, load, spread, store

COUNT, P, F, FF, GXX, GXY, GYY, GX, GY, FGX, FGY = range(11)
"""Sums of a column of pixels: how many count, weights, and weighted products of f and of its gradients."""
FIRST, EACH = 11, 5
G, GG, FG, GGX, GGY = range(EACH)
"""Rows of each image, from ``FIRST + EACH k`` on: weighted products of its grey levels with 1, themselves, f,
gradients.
"""


N_ROWS = 6
"""Rows of a row of pixels before the images' grey levels: whether a pixel counts (1), its weight, f, the gradients of f
along x and y times the weight, and one over the weight, zero where a pixel does not count."""


def columns_of(images: int) -> int:
    """Return the number of sums that a column of pixels has."""
    return FIRST + EACH * images


def _adding(images: int) -> Any:
    def add_row(_typingctx: Any, row: Any, sign: Any, blocks: Any, sums: Any) -> Any:
        """Add the products of one row of pixels to the sums of their columns.

        Parameters
        ----------
        row
            (N_ROWS + images, width) float32, see ``N_ROWS``.
        sign
            double, 1 to add and -1 to take off.
        blocks
            int64 number of pixels over eight.
        sums
            (columns_of(images), width) double, in place.
        """
        sig = types.void(row, sign, blocks, sums)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            source = context.make_array(sig.args[0])(context, builder, args[0])
            target = context.make_array(sig.args[3])(context, builder, args[3])
            width, wide = (builder.extract_value(a.shape, 1) for a in (source, target))
            sign = spread(builder, args[1])
            kind = ir.VectorType(DOUBLE, LANES)
            with cgutils.for_range(builder, args[2]) as loop:
                offset = builder.mul(builder.sext(loop.index, LONG), LONG(LANES))

                def get(r: int, offset: Any = offset) -> Vec:
                    there = at(builder, source.data, builder.add(builder.mul(width, LONG(r)), offset))
                    return Vec(builder, builder.fpext(load(builder, there, LANES, FLOAT).value, kind))

                def put(q: int, value: Vec, offset: Any = offset) -> None:
                    there = at(builder, target.data, builder.add(builder.mul(wide, LONG(q)), offset))
                    store(load(builder, there, LANES, DOUBLE) + value, there)

                f, gx, gy = get(2), get(3), get(4)
                weight = get(1) * sign
                by_x, by_y, wf = gx * sign, gy * sign, weight * f
                unit = get(5)
                xx = gx * unit
                put(COUNT, get(0) * sign)
                put(P, weight)
                put(F, wf)
                put(FF, wf * f)
                put(GXX, by_x * xx)
                put(GXY, by_y * xx)
                put(GYY, by_y * (gy * unit))
                put(GX, by_x)
                put(GY, by_y)
                put(FGX, by_x * f)
                put(FGY, by_y * f)
                for k in range(images):
                    g, first = get(N_ROWS + k), FIRST + EACH * k
                    wg = weight * g
                    put(first + G, wg)
                    put(first + GG, wg * g)
                    put(first + FG, wg * f)
                    put(first + GGX, by_x * g)
                    put(first + GGY, by_y * g)
            return context.get_dummy_value()

        return sig, codegen

    add_row.__name__ = f"add_row_{images}"
    return intrinsic(add_row)


add_row = {images: _adding(images) for images in (1, 3)}
