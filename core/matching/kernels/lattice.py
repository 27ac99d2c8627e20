"""An image at predicted places: rows of pixels of camera 1's reference, through bicubic polynomials between points.

The nodes of a lattice have an image's two coordinates, their slopes along columns and rows, and the mixed derivative
(:class:`stereorig.core.field.points.prediction.Prediction`).
"""

from __future__ import annotations

import math
from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereorig.core.matching.image import PAD
from stereorig.core.matching.kernels.loops import data, lanes, spline
from stereorig.core.matching.kernels.naming import inner
from stereorig.core.matching.kernels.vectors import INT, LANES, LONG, at, load, store

OFF_IMAGE = 1.0 / 4096.0
"""Weight of a pixel that another image does not show: a window's sum of the weights reveals it."""


def _interpolation(order: int) -> Any:
    def interpolate(_typingctx: Any, c: Any, stride: Any, tap: Any, tx: Any, ty: Any, blocks: Any, out: Any) -> Any:
        """Interpolate an image at a row of places.

        Parameters
        ----------
        c
            Padded coefficients, flat float32.
        stride
            int64 row length of ``c``.
        tap
            int32 flat index of the first tap of each place.
        tx, ty
            float32 fractions of the places.
        blocks
            int64 number of places over eight.
        out
            float32 out.
        """
        sig = types.void(c, stride, tap, tx, ty, blocks, out)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            image, taps, x, y, to = (data(context, builder, sig, args, i) for i in (0, 2, 3, 4, 6))
            rows = [image]
            for _ in range(order):
                rows.append(at(builder, rows[-1], args[1]))
            with cgutils.for_range(builder, args[5]) as loop:
                offset = builder.mul(builder.sext(loop.index, LONG), LONG(LANES))
                first = lanes(builder, load(builder, at(builder, taps, offset), LANES, INT).value)
                value = spline(
                    order, rows, first, load(builder, at(builder, x, offset)), load(builder, at(builder, y, offset))
                )
                store(value * (1.0 / 36.0 if order == 3 else 1.0 / 14400.0), at(builder, to, offset))
            return context.get_dummy_value()

        return sig, codegen

    interpolate.__name__ = f"interpolate_row_{order}"
    return intrinsic(interpolate)


interpolate_cubic, interpolate_quintic = _interpolation(3), _interpolation(5)


@inner
def _along_row(nodes, row, t, image, cols, line):
    """Values and slopes along x of one image's two coordinates at the points of a lattice row, ``t`` below ``row``."""
    tt = t * t
    h01 = tt * (3.0 - 2.0 * t)
    h00 = 1.0 - h01
    h10 = t * (1.0 - t) * (1.0 - t)
    h11 = tt * (t - 1.0)
    for c in range(cols):
        for i in range(2):
            top, low = nodes[row, c, 2 * image + i], nodes[row + 1, c, 2 * image + i]
            line[2 * i, c] = h00 * top[0] + h01 * low[0] + h10 * top[2] + h11 * low[2]
            line[2 * i + 1, c] = h00 * top[1] + h01 * low[1] + h10 * top[3] + h11 * low[3]


@inner
def cubic(a, b, c, e, u):
    """Value of the cubic with values a, c and slopes b, e at 0 and 1."""
    return a + u * (b + u * (3.0 * (c - a) - 2.0 * b - e + u * (2.0 * (a - c) + b + e)))


@inner
def places(y, lattice, nodes, seen, image, size, lead, lines, row, tap, tx, ty):
    """First taps and fractions of one image along a row of pixels; ``row[0]`` marks the pixels that count."""
    _, high, wide, stride = image
    k, cols = size
    along = (y - lattice.y0) / lattice.spacing + lattice.rim
    top = math.floor(along)
    n_cells = seen.shape[1]
    _along_row(nodes, top, along - top, k, n_cells + 1, lines)
    begin, per_spacing = 0, 1.0 / lattice.spacing
    for cell in range(n_cells):
        x_here = lattice.x0 + (cell - lattice.rim) * lattice.spacing
        last = min(max(math.ceil(x_here + lattice.spacing), begin), cols)
        first = min(max(math.ceil(x_here), begin), last)
        if seen[top, cell] == 0:
            first = last
        for x in range(begin, first):
            tap[x], row[0, x] = 0, 0.0
        begin = last
        ax, bx, cx, ex = lines[0, cell], lines[1, cell], lines[0, cell + 1], lines[1, cell + 1]
        ay, by, cy, ey = lines[2, cell], lines[3, cell], lines[2, cell + 1], lines[3, cell + 1]
        for x in range(first, last):
            u = (x - x_here) * per_spacing
            px, py = cubic(ax, bx, cx, ex, u), cubic(ay, by, cy, ey, u)
            if px >= 0.0 and py >= 0.0 and px <= wide - 1.0 and py <= high - 1.0:
                ix, iy = int(px), int(py)
                tap[x] = (iy + PAD - lead) * stride + ix + PAD - lead
                tx[x], ty[x] = px - ix, py - iy
            else:
                tap[x] = 0
                if row[0, x] == 1.0:
                    row[0, x] = OFF_IMAGE
    for x in range(begin, cols):
        tap[x], row[0, x] = 0, 0.0
