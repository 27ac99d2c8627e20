"""The loops over a subset's pixels: where the time goes.

Everything per pixel, image and iteration happens in one loop that stores nothing: warp, interpolation and eleven sums.
Without stores the compiler needs no aliasing promise and vectorises, with gathers for the taps. The warp is relative
to the image of the subset's centre, which is set up in double precision outside, so single precision is exact to about
2e-6 px. No bounds are tested here: :func:`core.matching.kernels.warp.set_up_warp` proves beforehand that every tap lies
inside the padded image.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

FAST = {"reassoc", "contract", "arcp", "nsz"}  # not nnan/ninf: NaN must stay visible

N_SUMS = 11
# order of the sums: d, d f, d^2, then d times fx, fx X, fx Y, fy, fy X, fy Y, q X, q Y with q = fx X + fy Y


@intrinsic
def load(_typingctx: Any, array: Any, index: Any) -> Any:
    """Element of a 1-D contiguous array at an int32 index that is known to be inside.

    Plain indexing of a signed index costs a select per tap (Python's negative indices), and 64-bit indices halve the
    width of a gather.
    """
    if not isinstance(array, types.Array) or array.ndim != 1:
        return None
    signature = array.dtype(array, index)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.gep(data, [builder.sext(args[1], ir.IntType(64))], inbounds=True)
        return context.unpack_value(builder, sig.args[0].dtype, pointer)

    return signature, codegen


@intrinsic
def floor_to_int(_typingctx: Any, x: Any) -> Any:
    """Largest int32 not above a float32."""
    if x != types.float32:
        return None

    def codegen(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.FloatType(), [ir.FloatType()]), "llvm.floor.f32"
        )
        return builder.fptosi(builder.call(function, [args[0]]), ir.IntType(32))

    return types.int32(x), codegen


def _int32_operation(name: str) -> Any:
    # numba widens int32 arithmetic to 64 bits, which would double the gathers
    def typed(_typingctx: Any, a: Any, b: Any) -> Any:
        if a != types.int32 or b != types.int32:
            return None

        def codegen(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
            return getattr(builder, name)(*args, flags=("nsw",))

        return types.int32(a, b), codegen

    typed.__name__ = f"int32_{name}"
    typed.__doc__ = f"int32 {name} of two int32 that is known not to overflow."
    return intrinsic(typed)


add = _int32_operation("add")
mul = _int32_operation("mul")


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def _image_point(p, x, y):
    """Where the image shows the patch at offset (x, y), relative to the base tap; ``p`` as ``set_up_warp`` fills it."""
    one, three = np.float32(1.0), np.float32(3.0)
    # patch -> normalised image plane, relative to the centre's image
    inv = one / (one + (p[0] * x + p[1] * y))
    u = (p[2] * x + p[3] * y) * inv
    v = (p[4] * x + p[5] * y) * inv
    # lens, relative to the centre: radial factor in rho = r^2 - r0^2, then tangential terms
    uu = u * u
    vv = v * v
    uv = u * v
    rho = (p[6] * u + p[7] * v) + (uu + vv)
    dl = rho * (p[8] + rho * (p[9] + rho * p[10]))
    xd = (u + p[11]) * dl + (p[13] * u + p[14] * v) + ((p[16] + p[16]) * uv + p[17] * (three * uu + vv))
    yd = (v + p[12]) * dl + (p[14] * u + p[15] * v) + ((p[17] + p[17]) * uv + p[16] * (uu + three * vv))
    return p[21] + (p[18] * xd + p[19] * yd), p[22] + p[20] * yd


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def _cubic_weights(t):
    """Six times the cubic B-spline's weights at fraction ``t``."""
    four, three, six, one = np.float32(4.0), np.float32(3.0), np.float32(6.0), np.float32(1.0)
    s = one - t
    tt = t * t
    w0 = s * s * s
    w3 = tt * t
    w1 = four + tt * (three * t - six)
    return w0, w1, six - (w0 + w1 + w3), w3


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def _quintic_weights(t):
    """120 times the quintic B-spline's weights at fraction ``t``."""
    s = np.float32(1.0) - t
    tt = t * t
    ss = s * s
    w0 = ss * ss * s
    w5 = tt * tt * t
    w2 = np.float32(66.0) + tt * (np.float32(-60.0) + tt * (np.float32(30.0) - np.float32(10.0) * t))
    w3 = np.float32(66.0) + ss * (np.float32(-60.0) + ss * (np.float32(30.0) - np.float32(10.0) * s))
    # w1(t) = 1 + 5 s + 10 s^2 + 10 s^3 + 5 s^4 - 5 s^5
    five, ten, one = np.float32(5.0), np.float32(10.0), np.float32(1.0)
    w1 = one + s * (five + s * (ten + s * (ten + s * (five - five * s))))
    return w0, w1, w2, w3, np.float32(120.0) - (w0 + w1 + (w2 + w3) + w5), w5


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def _row4(c, k, w0, w1, w2, w3):
    i1, i2, i3 = np.int32(1), np.int32(2), np.int32(3)
    return (w0 * load(c, k) + w1 * load(c, add(k, i1))) + (w2 * load(c, add(k, i2)) + w3 * load(c, add(k, i3)))


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def _row6(c, k, w0, w1, w2, w3, w4, w5):
    i4, i5 = np.int32(4), np.int32(5)
    return _row4(c, k, w0, w1, w2, w3) + (w4 * load(c, add(k, i4)) + w5 * load(c, add(k, i5)))


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def value_cubic(c, base, stride, p, x, y):
    """36 times the image's grey level at the patch's offset (x, y)."""
    xt, yt = _image_point(p, x, y)
    ix, iy = floor_to_int(xt), floor_to_int(yt)
    k = add(add(base, mul(iy, stride)), ix)
    w0, w1, w2, w3 = _cubic_weights(xt - np.float32(ix))
    y0, y1, y2, y3 = _cubic_weights(yt - np.float32(iy))
    r0 = _row4(c, k, w0, w1, w2, w3)
    k1 = add(k, stride)
    r1 = _row4(c, k1, w0, w1, w2, w3)
    k2 = add(k1, stride)
    r2 = _row4(c, k2, w0, w1, w2, w3)
    r3 = _row4(c, add(k2, stride), w0, w1, w2, w3)
    return (y0 * r0 + y1 * r1) + (y2 * r2 + y3 * r3)


@njit(fastmath=FAST, error_model="numpy", forceinline=True)
def value_quintic(c, base, stride, p, x, y):
    """14400 times the image's grey level at the patch's offset (x, y)."""
    xt, yt = _image_point(p, x, y)
    ix, iy = floor_to_int(xt), floor_to_int(yt)
    k = add(add(base, mul(iy, stride)), ix)
    w0, w1, w2, w3, w4, w5 = _quintic_weights(xt - np.float32(ix))
    y0, y1, y2, y3, y4, y5 = _quintic_weights(yt - np.float32(iy))
    value = y0 * _row6(c, k, w0, w1, w2, w3, w4, w5)
    k = add(k, stride)
    value += y1 * _row6(c, k, w0, w1, w2, w3, w4, w5)
    k = add(k, stride)
    value += y2 * _row6(c, k, w0, w1, w2, w3, w4, w5)
    k = add(k, stride)
    value += y3 * _row6(c, k, w0, w1, w2, w3, w4, w5)
    k = add(k, stride)
    value += y4 * _row6(c, k, w0, w1, w2, w3, w4, w5)
    k = add(k, stride)
    return value + y5 * _row6(c, k, w0, w1, w2, w3, w4, w5)


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def sums_cubic(c, base, stride, p, ref, n, sums):
    """Compare one image with the reference: the eleven sums over the subset's pixels, cubic spline.

    Parameters
    ----------
    c
        Padded coefficients, flat float32.
    base
        int32 flat index of the first tap for the offset (0, 0) of the warp.
    stride
        int32 row length of ``c``.
    p
        (25,) float32 warp of :func:`core.matching.kernels.warp.set_up_warp`; the last two scale and shift grey levels.
    ref
        (5, n_max) float32: X, Y, reference grey level (mean taken out), its derivatives with respect to X and Y.
    n
        Number of pixels.
    sums
        (11,) float64 out.
    """
    rx, ry, rf, rgx, rgy = ref[0], ref[1], ref[2], ref[3], ref[4]
    gain = p[23] * np.float32(1.0 / 36.0)
    shift = p[24]
    zero = np.float32(0.0)
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = zero
    for i in range(n):
        x = rx[i]
        y = ry[i]
        f = rf[i]
        d = value_cubic(c, base, stride, p, x, y) * gain - (shift + f)
        s0 += d
        s1 += d * f
        s2 += d * d
        gx = d * rgx[i]
        gy = d * rgy[i]
        q = gx * x + gy * y
        s3 += gx
        s4 += gx * x
        s5 += gx * y
        s6 += gy
        s7 += gy * x
        s8 += gy * y
        s9 += q * x
        s10 += q * y
    sums[0] = s0
    sums[1] = s1
    sums[2] = s2
    sums[3] = s3
    sums[4] = s4
    sums[5] = s5
    sums[6] = s6
    sums[7] = s7
    sums[8] = s8
    sums[9] = s9
    sums[10] = s10


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def sums_quintic(c, base, stride, p, ref, n, sums):
    """Compare one image with the reference: the eleven sums over the subset's pixels, quintic spline.

    Parameters
    ----------
    c
        Padded coefficients, flat float32.
    base
        int32 flat index of the first tap for the offset (0, 0) of the warp.
    stride
        int32 row length of ``c``.
    p
        (25,) float32 warp of :func:`core.matching.kernels.warp.set_up_warp`; the last two scale and shift grey levels.
    ref
        (5, n_max) float32: X, Y, reference grey level (mean taken out), its derivatives with respect to X and Y.
    n
        Number of pixels.
    sums
        (11,) float64 out.
    """
    rx, ry, rf, rgx, rgy = ref[0], ref[1], ref[2], ref[3], ref[4]
    gain = p[23] * np.float32(1.0 / 14400.0)
    shift = p[24]
    zero = np.float32(0.0)
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = zero
    for i in range(n):
        x = rx[i]
        y = ry[i]
        f = rf[i]
        d = value_quintic(c, base, stride, p, x, y) * gain - (shift + f)
        s0 += d
        s1 += d * f
        s2 += d * d
        gx = d * rgx[i]
        gy = d * rgy[i]
        q = gx * x + gy * y
        s3 += gx
        s4 += gx * x
        s5 += gx * y
        s6 += gy
        s7 += gy * x
        s8 += gy * y
        s9 += q * x
        s10 += q * y
    sums[0] = s0
    sums[1] = s1
    sums[2] = s2
    sums[3] = s3
    sums[4] = s4
    sums[5] = s5
    sums[6] = s6
    sums[7] = s7
    sums[8] = s8
    sums[9] = s9
    sums[10] = s10
