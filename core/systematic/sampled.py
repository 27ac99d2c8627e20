"""Shifts that residuals of matched subsets show, seen through two filters of the reference's gradients.

At a match the residuals are orthogonal to the gradients that determined it. Through smoother gradients they show the
shift that a match of smoother images would have added.
"""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float, Float32
from stereorig.core.matching.image import PAD
from stereorig.core.matching.kernels.naming import entry_with_arrays, inner
from stereorig.core.threads import run_ranges

_SIXTH = 1.0 / 6.0
_RANGE = 64  # points: one to three milliseconds


@inner
def _cubic(t):
    """Cubic B-spline weights of the four taps about a fraction ``t``."""
    s = 1.0 - t
    first, last = s * s * s * _SIXTH, t * t * t * _SIXTH
    second = (4.0 + t * t * (3.0 * t - 6.0)) * _SIXTH
    return first, second, 1.0 - (first + second + last), last


@inner
def _quintic(t):
    """Quintic B-spline weights of the six taps about a fraction ``t``."""
    s = 1.0 - t
    tt, ss = t * t, s * s
    first, last = ss * ss * s / 120.0, tt * tt * t / 120.0
    third = (66.0 + tt * (-60.0 + tt * (30.0 - 10.0 * t))) / 120.0
    fourth = (66.0 + ss * (-60.0 + ss * (30.0 - 10.0 * s))) / 120.0
    second = (1.0 + s * (5.0 + s * (10.0 + s * (10.0 + s * (5.0 - 5.0 * s))))) / 120.0
    return first, second, third, fourth, 1.0 - (first + second + third + fourth + last), last


@inner
def _cubic_value(c, width, x, y):
    """Spline value at a place of a flat image of rows of ``width``; all its taps are inside."""
    ix, iy = int(x), int(y)
    w0, w1, w2, w3 = _cubic(x - ix)
    v0, v1, v2, v3 = _cubic(y - iy)
    a = (iy - 1) * width + ix - 1
    b, d, e = a + width, a + 2 * width, a + 3 * width
    return (
        v0 * (w0 * c[a] + w1 * c[a + 1] + w2 * c[a + 2] + w3 * c[a + 3])
        + v1 * (w0 * c[b] + w1 * c[b + 1] + w2 * c[b + 2] + w3 * c[b + 3])
        + v2 * (w0 * c[d] + w1 * c[d + 1] + w2 * c[d + 2] + w3 * c[d + 3])
        + v3 * (w0 * c[e] + w1 * c[e + 1] + w2 * c[e + 2] + w3 * c[e + 3])
    )


@inner
def _row_of_six(c, a, w0, w1, w2, w3, w4, w5):
    return w0 * c[a] + w1 * c[a + 1] + w2 * c[a + 2] + w3 * c[a + 3] + w4 * c[a + 4] + w5 * c[a + 5]


@inner
def _quintic_value(c, width, x, y):
    """As :func:`_cubic_value`."""
    ix, iy = int(x), int(y)
    w0, w1, w2, w3, w4, w5 = _quintic(x - ix)
    v0, v1, v2, v3, v4, v5 = _quintic(y - iy)
    a = (iy - 2) * width + ix - 2
    return (
        v0 * _row_of_six(c, a, w0, w1, w2, w3, w4, w5)
        + v1 * _row_of_six(c, a + width, w0, w1, w2, w3, w4, w5)
        + v2 * _row_of_six(c, a + 2 * width, w0, w1, w2, w3, w4, w5)
        + v3 * _row_of_six(c, a + 3 * width, w0, w1, w2, w3, w4, w5)
        + v4 * _row_of_six(c, a + 4 * width, w0, w1, w2, w3, w4, w5)
        + v5 * _row_of_six(c, a + 5 * width, w0, w1, w2, w3, w4, w5)
    )


@inner
def _sample(flat, width, order, x, y, map_, half, current):
    """Sample the other image over a subset about its place there; all taps are inside."""
    side = 2 * half + 1
    xx, xy, yx, yy = map_[0, 0], map_[0, 1], map_[1, 0], map_[1, 1]
    if order == 3:  # outside the loops: a choice of splines a pixel costs as much as a spline
        for i in range(side):
            for j in range(side):
                dx, dy = j - half, i - half
                current[i, j] = _cubic_value(flat, width, x + xx * dx + xy * dy, y + yx * dx + yy * dy)
    else:
        for i in range(side):
            for j in range(side):
                dx, dy = j - half, i - half
                current[i, j] = _quintic_value(flat, width, x + xx * dx + xy * dy, y + yx * dx + yy * dy)


@inner
def _inside(rows, cols, order, x, y, map_, half):
    """True if all taps of a subset are inside the padded image; the corners are an affine map's extremes."""
    lead = order // 2
    wide = half * (abs(map_[0, 0]) + abs(map_[0, 1]))
    high = half * (abs(map_[1, 0]) + abs(map_[1, 1]))
    return x - wide >= lead and y - high >= lead and x + wide < cols - 1 - lead and y + high < rows - 1 - lead


@inner
def _solved(a00, a01, a10, a11, b0, b1):
    """Shift x, y of two equations."""
    det = a00 * a11 - a01 * a10
    return -(a11 * b0 - a01 * b1) / det, -(a00 * b1 - a10 * b0) / det


@inner
def _shifts(subset, current, gx, gy, lx, ly, gain, mean_r, mean_c, out):
    """Shifts x, y that residuals of a subset show through its gradients ``gx, gy``, and through ``lx, ly``."""
    a00 = a01 = a11 = b0 = b1 = 0.0
    c00 = c01 = c10 = c11 = d0 = d1 = 0.0
    for i in range(subset.shape[0]):
        for j in range(subset.shape[1]):
            rest = gain * (current[i, j] - mean_c) - (subset[i, j] - mean_r)
            g, h, u, v = gx[i, j], gy[i, j], lx[i, j], ly[i, j]
            a00 += g * g
            a01 += g * h
            a11 += h * h
            b0 += g * rest
            b1 += h * rest
            c00 += u * g
            c01 += u * h
            c10 += v * g
            c11 += v * h
            d0 += u * rest
            d1 += v * rest
    out[0], out[1] = _solved(a00, a01, a01, a11, b0, b1)
    out[2], out[3] = _solved(c00, c01, c10, c11, d0, d1)


@entry_with_arrays
def _residual_shifts(pixels, gx, gy, lx, ly, coefficients, order, centres, images, maps, half, pad, out):
    side = 2 * half + 1
    current = np.empty((side, side))
    n = side * side
    rows, width = coefficients.shape
    flat = coefficients.ravel()
    for k in range(len(centres)):
        x0, y0 = centres[k]
        out[k, :] = np.nan
        if x0 < half or y0 < half or x0 + half >= pixels.shape[1] or y0 + half >= pixels.shape[0]:
            continue
        x, y, map_ = images[k, 0] + pad, images[k, 1] + pad, maps[k]
        if not _inside(rows, width, order, x, y, map_, half):
            continue
        _sample(flat, width, order, x, y, map_, half, current)
        down, along = slice(y0 - half, y0 + half + 1), slice(x0 - half, x0 + half + 1)
        subset = pixels[down, along]
        s_r = s_c = s_rc = s_cc = 0.0
        for i in range(side):
            for j in range(side):
                c, r = current[i, j], subset[i, j]
                s_r += r
                s_c += c
                s_rc += r * c
                s_cc += c * c
        contrast = s_cc - s_c * s_c / n
        if not contrast > 0.0:
            continue
        gain = (s_rc - s_r * s_c / n) / contrast
        _shifts(subset, current, gx[down, along], gy[down, along], lx[k], ly[k], gain, s_r / n, s_c / n, out[k])


def residual_shifts(
    pixels: Float32,
    slopes: tuple[Float32, Float32],
    smooth: tuple[Float32, Float32],
    coefficients: Float32,
    order: int,
    centres_px: Float,
    images_px: Float,
    maps: Float,
    subset_px: int,
) -> Float:
    """Return the shifts (n, 4) x, y through ``slopes`` and x, y through ``smooth``, px of the reference; NaN outside.

    Parameters
    ----------
    pixels, slopes
        (rows, cols) of the reference: grey levels and the matcher's gradients.
    smooth
        (n, subset_px, subset_px) smoother gradients of the subsets that are inside the image.
    coefficients, order
        Spline of the other image, see :class:`stereorig.core.matching.image.ImageData`.
    centres_px
        (n, 2) points of the reference.
    images_px, maps
        (n, 2) their images in the other one, and (n, 2, 2) derivative of the other image's position over the
        reference's.
    subset_px
        Width of the subset.
    """
    out = np.empty((len(centres_px), 4))
    centres = np.rint(centres_px).astype(np.int64)
    # a map is about the centre itself
    images = images_px + (maps @ (centres - centres_px)[..., None])[..., 0]
    images, maps = np.ascontiguousarray(images), np.ascontiguousarray(maps)

    def some(first: int, last: int) -> None:
        part = slice(first, last)
        _residual_shifts(
            pixels,
            *slopes,
            *(one[part] for one in smooth),
            coefficients,
            order,
            centres[part],
            images[part],
            maps[part],
            subset_px // 2,
            PAD,
            out[part],
        )

    run_ranges(some, len(centres), _RANGE)
    return out
