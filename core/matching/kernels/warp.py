"""Geometry of one patch in one image: lens expansion about a point, undistortion, warp set-up with its bounds.

All in double precision, once per image and iteration; the pixel loop gets the float32 result.
A lens is the flat array of ``LensModel.kernel_parameters``; a thin prism or a tilted sensor make it longer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from stereorig.core.cameras.lens import N_KERNEL_PARAMETERS, SEIDEL
from stereorig.core.matching.image import PAD
from stereorig.core.matching.kernels.loops import data, monomials
from stereorig.core.matching.kernels.naming import inner, kernel, outer
from stereorig.core.matching.kernels.vectors import DOUBLE, LONG, Vec, at, load, spread, store

_NEWTON_STEPS = 20
_BISECTIONS = 30  # to 1e-9 of the branch; Newton's method does the rest


class LensExpansion(NamedTuple):
    """A lens about a normalised point.

    ``x, y`` (px), change of the radial factor with rho = r^2 - r0^2, ``(l1 rho + l2 rho^2 + l3 rho^3) / (1 + d1 rho +
    d2 rho^2 + d3 rho^3)``, and the matrix ``h11, h12, h22`` that multiplies the offset in addition: radial factor at
    the centre plus the tangential terms' slopes. The d are zero unless the lens is rational.
    """

    x: float
    y: float
    l1: float
    l2: float
    l3: float
    h11: float
    h12: float
    h22: float
    d1: float
    d2: float
    d3: float


@inner
def is_rational(lens):
    """Return True if the lens has one of OpenCV's k4, k5, k6."""
    return lens[12] != 0.0 or lens[13] != 0.0 or lens[14] != 0.0


@inner
def _plain_expansion(lens, u, v):
    """Expand a Seidel or five-term lens; the Seidel term 1 / (1 + k r^2) leaves (k rho)^4, below 1e-12 here."""
    r2 = u * u + v * v
    if lens[0] == SEIDEL:
        k = lens[6]
        l0 = 1.0 / (1.0 + k * r2)
        l1 = -k * l0 * l0
        l2 = -k * l1 * l0
        l3 = -k * l2 * l0
        p1 = 0.0
        p2 = 0.0
    else:
        k1, k2, k3 = lens[6], lens[7], lens[10]
        p1, p2 = lens[8], lens[9]
        l0 = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        l1 = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
        l2 = k2 + 3.0 * k3 * r2
        l3 = k3
    x, y, h11, h12, h22 = _expanded(lens, u, v, l0, p1, p2)
    return LensExpansion(x, y, l1, l2, l3, h11, h12, h22, 0.0, 0.0, 0.0)


@inner
def _rational_expansion(lens, u, v):
    """Expand a lens with k4, k5, k6, exactly."""
    r2 = u * u + v * v
    k1, k2, k3 = lens[6], lens[7], lens[10]
    k4, k5, k6 = lens[12], lens[13], lens[14]
    # the radial factor N / D changes by (N - l0 D) / D with l0 = N / D at the centre; all of it over the centre's D
    over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    d1 = over * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))
    d2 = over * (k5 + 3.0 * k6 * r2)
    d3 = over * k6
    l0 = over * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
    l1 = over * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)) - l0 * d1
    l2 = over * (k2 + 3.0 * k3 * r2) - l0 * d2
    l3 = over * k3 - l0 * d3
    x, y, h11, h12, h22 = _expanded(lens, u, v, l0, lens[8], lens[9])
    return LensExpansion(x, y, l1, l2, l3, h11, h12, h22, d1, d2, d3)


@inner
def _expanded(lens, u, v, l0, p1, p2):
    """Position, and the matrix of the terms without l1, l2, l3."""
    r2 = u * u + v * v
    xd = u * l0 + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    yd = v * l0 + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
    x = lens[4] + lens[1] * xd + lens[3] * yd
    y = lens[5] + lens[2] * yd
    h11 = l0 + 2.0 * p1 * v + 6.0 * p2 * u
    h12 = 2.0 * p1 * u + 2.0 * p2 * v
    h22 = l0 + 6.0 * p1 * v + 2.0 * p2 * u
    return x, y, h11, h12, h22


@inner
def _slopes(lens, near, u, v):
    """Return d(image px) / d(normalised) at (u, v) from the expansion there: the four entries row by row."""
    l1, h11, h12, h22 = near.l1, near.h11, near.h12, near.h22
    a11 = h11 + 2.0 * l1 * u * u
    a12 = h12 + 2.0 * l1 * u * v
    a22 = h22 + 2.0 * l1 * v * v
    return lens[1] * a11 + lens[3] * a12, lens[1] * a12 + lens[3] * a22, lens[2] * a12, lens[2] * a22


@inner
def _full_image(lens, u, v):
    """Compute :func:`image_of` for a lens with a thin prism or a tilted sensor."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens[6], lens[7], lens[8], lens[9], lens[10], lens[12], lens[13], lens[14]
    s1, s2, s3, s4 = lens[15], lens[16], lens[17], lens[18]
    t0, t1, t2, t3, t4 = lens[19], lens[20], lens[21], lens[22], lens[23]
    r2 = u * u + v * v
    over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    radial = over * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
    slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))
    slope *= 2.0 * over
    xd = u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u) + r2 * (s1 + r2 * s2)
    yd = v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v + r2 * (s3 + r2 * s4)
    of_x, of_y = 2.0 * s1 + 4.0 * s2 * r2, 2.0 * s3 + 4.0 * s4 * r2
    mixed = u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v
    a11, a12 = radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u + of_x * u, mixed + of_x * v
    a21, a22 = mixed + of_y * u, radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u + of_y * v
    w = 1.0 / (1.0 + t3 * xd + t4 * yd)
    x, y = t0 * xd * w, (t1 * xd + t2 * yd) * w
    # slopes of the tilt, then slopes of the pixels
    b11, b12, b21, b22 = w * (t0 - x * t3), -w * x * t4, w * (t1 - y * t3), w * (t2 - y * t4)
    j21, j22 = b21 * a11 + b22 * a21, b21 * a12 + b22 * a22
    j11, j12 = lens[1] * (b11 * a11 + b12 * a21) + lens[3] * j21, lens[1] * (b11 * a12 + b12 * a22) + lens[3] * j22
    return lens[4] + lens[1] * x + lens[3] * y, lens[5] + lens[2] * y, j11, j12, lens[2] * j21, lens[2] * j22


@outer
def lens_jacobian(lens, u, v):
    """Return d(image px) / d(normalised) at (u, v): the four entries row by row."""
    if lens.size > N_KERNEL_PARAMETERS:
        return _full_image(lens, u, v)[2:]
    if is_rational(lens):
        return _slopes(lens, _rational_expansion(lens, u, v), u, v)
    return _slopes(lens, _plain_expansion(lens, u, v), u, v)


@inner
def _rational_image(lens, u, v):
    near = _rational_expansion(lens, u, v)
    j11, j12, j21, j22 = _slopes(lens, near, u, v)
    return near.x, near.y, j11, j12, j21, j22


@inner
def _plain_image(lens, u, v):
    near = _plain_expansion(lens, u, v)
    j11, j12, j21, j22 = _slopes(lens, near, u, v)
    return near.x, near.y, j11, j12, j21, j22


@inner
def image_of(lens, u, v):
    """Return the pixel x, y of a normalised point, and d(image px) / d(normalised) there, row by row."""
    if lens.size > N_KERNEL_PARAMETERS:
        return _full_image(lens, u, v)
    return _rational_image(lens, u, v) if is_rational(lens) else _plain_image(lens, u, v)


@inner
def _radially_undistorted(lens, xd, yd):
    """Invert the radial factor of a rational lens alone, by bisection on the branch that contains the centre."""
    r_d, r_max = math.sqrt(xd * xd + yd * yd), math.sqrt(lens[11])
    low, high, r_low = 0.0, 1.0, 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        r = middle * r_max if r_max < np.inf else middle / (1.0 - middle)
        r2 = r * r
        radial = 1.0 + r2 * (lens[6] + r2 * (lens[7] + r2 * lens[10]))
        radial /= 1.0 + r2 * (lens[12] + r2 * (lens[13] + r2 * lens[14]))
        if r * radial < r_d:
            low, r_low = middle, r
        else:
            high = middle
    factor = r_low / r_d if r_d > 0.0 else 1.0
    return xd * factor, yd * factor


def _make_newton(image: Any, made_for: str) -> Any:
    """Compile Newton's method for the lenses of one kind of image."""

    @kernel(made_for)
    def newton(lens, x, y, u, v):
        """Normalised point of a pixel from a guess (u, v); NaN outside the lens model's domain."""
        error = np.inf
        for _ in range(_NEWTON_STEPS):
            if u * u + v * v >= lens[11]:  # keep to the branch that contains the centre
                shrink = 0.999 * math.sqrt(lens[11] / (u * u + v * v))
                u *= shrink
                v *= shrink
            x_now, y_now, j11, j12, j21, j22 = image(lens, u, v)
            ex, ey = x_now - x, y_now - y
            error = max(abs(ex), abs(ey))
            det = j11 * j22 - j12 * j21
            du = (j22 * ex - j12 * ey) / det
            dv = (j11 * ey - j21 * ex) / det
            u -= du
            v -= dv
            if abs(du) + abs(dv) < 1e-14:
                break
        if error < 1e-9 * (1.0 + abs(x) + abs(y)) and u * u + v * v < lens[11]:
            return u, v
        return np.nan, np.nan

    return newton


_plain_newton = _make_newton(_plain_image, "plain")
_rational_newton = _make_newton(_rational_image, "rational")
_full_newton = _make_newton(_full_image, "full")


@inner
def undistort(lens, x, y):
    """Normalised point (u, v) of a pixel; NaN outside the lens model's domain."""
    yd = (y - lens[5]) / lens[2]
    xd = (x - lens[4] - lens[3] * yd) / lens[1]
    if lens[0] == SEIDEL:
        q = 1.0 - 4.0 * lens[6] * (xd * xd + yd * yd)
        factor = 2.0 / (1.0 + math.sqrt(q)) if q > 0.0 else np.nan
        return xd * factor, yd * factor
    full = lens.size > N_KERNEL_PARAMETERS
    if full:  # back from the tilted sensor
        xd /= lens[19]
        yd = (yd - lens[20] * xd) / lens[21]
        left = 1.0 - lens[22] * xd - lens[23] * yd
        if not left > 0.0:
            return np.nan, np.nan
        xd, yd = xd / left, yd / left
    if is_rational(lens):  # it may level off or rise to a pole, where Newton's method from afar would leave the branch
        xd, yd = _radially_undistorted(lens, xd, yd)
        if not full:
            return _rational_newton(lens, x, y, xd, yd)
    if full:
        return _full_newton(lens, x, y, xd, yd)
    return _plain_newton(lens, x, y, xd, yd)


def _nodes() -> tuple[np.ndarray, np.ndarray]:
    position = np.array([-1.0, -0.4, 0.4, 1.0])
    x, y = (a.ravel() for a in np.meshgrid(position, position))
    columns = np.stack([x**i * y**j for i, j in monomials(3)], axis=1)
    return np.stack([x, y]), np.linalg.pinv(columns)


NODES, _FIT = _nodes()
"""(2, 16) positions in the subset, -1 to 1, of the nodes of each image's warp; (10, 16) cubic polynomial from them."""
N_NODES = 16


def _any_nonzero(builder: Any, pointer: Any, places: Sequence[int]) -> Any:
    """Compare numbers of an array with zero; NaN counts as other than zero."""
    zero = ir.Constant(DOUBLE, 0.0)
    found = [builder.fcmp_unordered("!=", builder.load(at(builder, pointer, LONG(i))), zero) for i in places]
    return reduce(builder.or_, found)


def _make_node_rays(rational: bool) -> Any:
    def node_rays(_typingctx: Any, q: Any, iterations: Any, powers: Any) -> Any:
        """Undistort the nodes by Newton's method with the Jacobian at the centre.

        Parameters
        ----------
        q
            (25,) offset of the subset's centre x, y, half its width, px; the centre's ray; the lens expansion l1, l2,
            l3, h11, h12, h22, p1, p2, fx, fy, skew; inverse Jacobian row by row; the lens expansion d1, d2, d3; out:
            largest last error, px, and largest squared radius.
        iterations
            int64.
        powers
            (M, 16) out: monomials of the nodes' rays.
        """
        sig = types.void(q, iterations, powers)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            pointer, out = (data(context, builder, sig, args, i) for i in (0, 2))
            n_numbers = 23 if rational else 20
            number = [spread(builder, builder.load(at(builder, pointer, LONG(i))), N_NODES) for i in range(n_numbers)]
            dx, dy, half, xc, yc, l1, l2, l3, h11, h12, h22, p1, p2, fx, fy, fs, i11, i12, i21, i22, *under = number
            vector = ir.VectorType(DOUBLE, N_NODES)
            x, y = (
                centre + half * Vec(builder, ir.Constant(vector, [float(c) for c in NODES[axis]]))
                for axis, centre in enumerate((dx, dy))
            )
            state = [cgutils.alloca_once(builder, vector) for _ in range(3)]

            def put(u: Vec, v: Vec, error: Vec) -> None:
                for one, value in zip(state, (u, v, error), strict=True):
                    builder.store(value.value, one)

            put(i11 * x + i12 * y, i21 * x + i22 * y, x)
            with cgutils.for_range(builder, args[1]):
                u, v = (Vec(builder, builder.load(one)) for one in state[:2])
                uu, vv, uv = u * u, v * v, u * v
                rho = 2.0 * (xc * u + yc * v) + uu + vv
                dl = rho * (l1 + rho * (l2 + rho * l3))
                if rational:
                    d1, d2, d3 = under
                    dl = dl / (1.0 + rho * (d1 + rho * (d2 + rho * d3)))
                xd = (u + xc) * dl + h11 * u + h12 * v + 2.0 * p1 * uv + p2 * (3.0 * uu + vv)
                yd = (v + yc) * dl + h12 * u + h22 * v + 2.0 * p2 * uv + p1 * (uu + 3.0 * vv)
                ex, ey = x - (fx * xd + fs * yd), y - fy * yd
                put(u + (i11 * ex + i12 * ey), v + (i21 * ex + i22 * ey), ex * ex + ey * ey)
            u, v, error = (Vec(builder, builder.load(one)) for one in state)
            one = Vec(builder, ir.Constant(vector, [1.0] * N_NODES))
            shape = context.make_array(sig.args[2])(context, builder, args[2]).shape
            curved = builder.icmp_signed("==", builder.extract_value(shape, 0), LONG(6))
            for row, value in enumerate((one, u, v)):
                store(value, at(builder, out, LONG(N_NODES * row)))
            with builder.if_then(curved):
                for row, value in enumerate((u * u, u * v, v * v)):
                    store(value, at(builder, out, LONG(N_NODES * (3 + row))))
            reach = (u + xc) * (u + xc) + (v + yc) * (v + yc)
            for position, value in ((23, error), (24, reach)):
                builder.store(value.reduce("fmax"), at(builder, pointer, LONG(position)))
            return context.get_dummy_value()

        return sig, codegen

    return intrinsic(node_rays)


def _make_set_up_nodes(rational: bool) -> Any:
    """Compile the nodes' set-up, separately for rational lenses: the others need no division and round as before."""
    expansion, node_rays = _rational_expansion if rational else _plain_expansion, _make_node_rays(rational)

    @kernel("rational" if rational else "plain")
    def set_up(lens, dx, dy, half, xc, yc, q, powers):
        """Compute the rays, see :func:`set_up_nodes`."""
        near = expansion(lens, xc, yc)
        _, _, l1, l2, l3, h11, h12, h22, d1, d2, d3 = near
        j11, j12, j21, j22 = _slopes(lens, near, xc, yc)
        det = j11 * j22 - j12 * j21
        polynomial = lens[0] != SEIDEL
        q[0], q[1], q[2], q[3], q[4] = dx, dy, half, xc, yc
        q[5], q[6], q[7], q[8], q[9], q[10] = l1, l2, l3, h11, h12, h22
        q[11], q[12] = (lens[8], lens[9]) if polynomial else (0.0, 0.0)
        q[13], q[14], q[15] = lens[1], lens[2], lens[3]
        q[16], q[17], q[18], q[19] = j22 / det, -j12 / det, -j21 / det, j11 / det
        q[20], q[21], q[22] = d1, d2, d3
        node_rays(q, 3, powers)
        if not q[23] < 1e-16:
            node_rays(q, 2 * _NEWTON_STEPS, powers)
        return q[23] < 1e-12 and q[24] < lens[11]

    return set_up


@inner
def _set_up_full_nodes(lens, dx, dy, half, xc, yc, q, powers):
    """Compute the rays of a lens with a thin prism or a tilted sensor, node by node."""
    x0, y0, j11, j12, j21, j22 = _full_image(lens, xc, yc)
    det = j11 * j22 - j12 * j21
    q[16], q[17], q[18], q[19] = j22 / det, -j12 / det, -j21 / det, j11 / det
    for n in range(N_NODES):
        x, y = dx + half * NODES[0, n], dy + half * NODES[1, n]
        u, v = _full_newton(lens, x0 + x, y0 + y, xc + q[16] * x + q[17] * y, yc + q[18] * x + q[19] * y)
        if math.isnan(u):
            return False
        u -= xc
        v -= yc
        powers[0, n], powers[1, n], powers[2, n] = 1.0, u, v
        if powers.shape[0] == 6:
            powers[3, n], powers[4, n], powers[5, n] = u * u, u * v, v * v
    return True


_set_up_plain_nodes, _set_up_rational_nodes = _make_set_up_nodes(False), _make_set_up_nodes(True)


@outer
def set_up_nodes(lens, dx, dy, half, xc, yc, q, powers):
    """Rays of the nodes in camera 1, relative to the point's.

    Parameters
    ----------
    lens
        Camera 1's.
    dx, dy
        Middle of the subset's pixels from the point, px; within half a pixel.
    half
        Half the distance of the outermost pixels.
    xc, yc
        The point's ray.
    q
        (25,) work space; 16 to 19 out: the inverse Jacobian at the point, row by row.
    powers
        (M, 16) out: the monomials of the rays.

    Returns
    -------
    bool
        False if the subset leaves the lens model's domain.
    """
    if lens.size > N_KERNEL_PARAMETERS:
        return _set_up_full_nodes(lens, dx, dy, half, xc, yc, q, powers)
    if is_rational(lens):
        return _set_up_rational_nodes(lens, dx, dy, half, xc, yc, q, powers)
    return _set_up_plain_nodes(lens, dx, dy, half, xc, yc, q, powers)


@intrinsic
def _polynomials(_typingctx: Any, lens: Any, m: Any, powers: Any, out: Any) -> Any:
    """Compute the polynomials of the nodes' positions in one image.

    Parameters
    ----------
    lens
        The image's.
    m
        (3, M) homogeneous camera coordinates = m times the monomials.
    powers
        (M, 16) the monomials of the nodes' rays.
    out
        (26,) out: ten coefficients of x, two zeros, ten of y, two zeros; a node's smallest depth and largest squared
        radius.
    """
    sig = types.void(lens, m, powers, out)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lens, matrix, powers, out = (data(context, builder, sig, args, i) for i in range(4))
        size = builder.extract_value(context.make_array(sig.args[0])(context, builder, args[0]).shape, 0)
        columns = context.make_array(sig.args[1])(context, builder, args[1])
        n_columns = builder.extract_value(columns.shape, 1)

        def number(pointer: Any, index: Any) -> Vec:
            return spread(builder, builder.load(at(builder, pointer, index)), N_NODES)

        zero = ir.Constant(ir.VectorType(DOUBLE, N_NODES), [0.0] * N_NODES)
        sums = [cgutils.alloca_once(builder, zero.type) for _ in range(3)]
        for one in sums:
            builder.store(zero, one)
        with cgutils.for_range(builder, n_columns) as loop:
            column = builder.sext(loop.index, LONG) if loop.index.type != LONG else loop.index
            power = load(builder, at(builder, powers, builder.mul(column, LONG(N_NODES))), N_NODES, DOUBLE)
            for i, one in enumerate(sums):
                entry = number(matrix, builder.add(builder.mul(n_columns, LONG(i)), column))
                builder.store((Vec(builder, builder.load(one)) + entry * power).value, one)
        q0, q1, q2 = (Vec(builder, builder.load(one)) for one in sums)
        inverse = 1.0 / q2
        u, v = q0 * inverse, q1 * inverse
        a, uv = [number(lens, LONG(i)) for i in range(12)], u * v
        uu, vv = u * u, v * v
        r2 = uu + vv
        # both lens models at once: a polynomial over a polynomial, one of which is 1
        seidel = builder.fcmp_ordered("==", builder.load(lens), ir.Constant(DOUBLE, float(SEIDEL)))

        def if_seidel(yes: Vec | float, no: Vec) -> Vec:
            kind = no.value.type
            other = yes.value if isinstance(yes, Vec) else ir.Constant(kind, [yes] * N_NODES)
            return Vec(builder, builder.select(seidel, other, no.value))

        top = 1.0 + r2 * (a[6] + r2 * (a[7] + r2 * a[10]))
        kept = cgutils.alloca_once_value(builder, if_seidel(1.0 / (1.0 + a[6] * r2), top).value)
        with builder.if_then(_any_nonzero(builder, lens, (12, 13, 14))):
            k4, k5, k6 = (number(lens, LONG(i)) for i in (12, 13, 14))
            builder.store((top / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))).value, kept)
        radial = Vec(builder, builder.load(kept))
        p1, p2 = if_seidel(0.0, a[8]), if_seidel(0.0, a[9])
        xd = u * radial + 2.0 * p1 * uv + p2 * (3.0 * uu + vv)
        yd = v * radial + 2.0 * p2 * uv + p1 * (uu + 3.0 * vv)
        on_sensor = [cgutils.alloca_once_value(builder, one.value) for one in (xd, yd)]
        with builder.if_then(builder.icmp_signed(">", size, size.type(N_KERNEL_PARAMETERS))):
            s1, s2, s3, s4, t0, t1, t2, t3, t4 = (number(lens, LONG(i)) for i in range(15, 24))
            xf, yf = xd + r2 * (s1 + r2 * s2), yd + r2 * (s3 + r2 * s4)
            w = 1.0 / (1.0 + t3 * xf + t4 * yf)
            for one, value in zip(on_sensor, (t0 * xf * w, (t1 * xf + t2 * yf) * w), strict=True):
                builder.store(value.value, one)
        xd, yd = (Vec(builder, builder.load(one)) for one in on_sensor)
        for row, position in enumerate((a[4] + a[1] * xd + a[3] * yd, a[5] + a[2] * yd)):
            total = None
            for n in range(N_NODES):
                fit = ir.Constant(ir.VectorType(DOUBLE, 12), [*(float(c) for c in _FIT[:, n]), 0.0, 0.0])
                term = position.pick([n] * 12) * Vec(builder, fit)
                total = term if total is None else total + term
            assert total is not None
            store(total, at(builder, out, LONG(12 * row)))
        builder.store(q2.reduce("fmin"), at(builder, out, LONG(24)))
        builder.store(r2.reduce("fmax"), at(builder, out, LONG(25)))
        return context.get_dummy_value()

    return sig, codegen


@outer
def set_up_warp(lens, m, powers, rows, cols, stride, lead, work, p):
    """Prepare the pixel loop for one image, into which ``m`` maps the patch.

    The warp from the subset to the image, perspective and both lenses included, is a cubic polynomial through sixteen
    exact positions. For a subset of half width h at focal length f (both px) and tilt t it is good to some h (h / f tan
    t)^3 / 8: 1e-9 px with the paper's cameras, 1e-5 px with h = 16, f = 1200 and 45 degrees.

    Parameters
    ----------
    lens
        The image's lens.
    m
        (3, M) homogeneous camera coordinates = m times the monomials of the ray.
    powers
        (M, 16) these monomials at the nodes.
    rows, cols, stride
        Size of the image and row length of the padded coefficients.
    lead
        Taps before the pixel: 1 for cubic, 2 for quintic.
    work
        (26,) work space.
    p
        (22,) float32 out; entries 20 and 21 (grey levels) are left unchanged.

    Returns
    -------
    int
        Flat index of the base tap, or -1 if the patch may leave the image, the lens model's domain or the half-space
        before the camera. The polynomial's bound is the sum of its coefficients' sizes, so it holds at every pixel.
    """
    _polynomials(lens, m, powers, work)
    if not (m[2, 0] > 0.0 and work[24] > 0.05 * m[2, 0] and work[25] < lens[11]):
        return -1
    x, y = work[0], work[12]
    dx, dy = 0.0, 0.0
    for j in range(1, 10):
        dx += abs(work[j])
        dy += abs(work[12 + j])
    if not (x - dx >= 0.0 and x + dx <= cols - 1.0 and y - dy >= 0.0 and y + dy <= rows - 1.0):
        return -1
    ix, iy = math.floor(x), math.floor(y)
    p[0], p[10] = x - ix, y - iy
    for j in range(1, 10):
        p[j], p[10 + j] = work[j], work[12 + j]
    return (iy + PAD - lead) * stride + ix + PAD - lead
