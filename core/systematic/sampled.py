"""Shifts that residuals of matched subsets show, seen through two filters of the reference's gradients.

At a match the residuals stand on the gradients that made it. Through smoother gradients they show the shift that a
match of smoother images would have added.
"""

from __future__ import annotations

import numpy as np

from core.arrays import Float, Float32
from core.matching.image import PAD
from core.matching.kernels.naming import entry, inner


@inner
def _weights(t, order, w):
    """B-spline weights of the ``order + 1`` taps about a fraction ``t``."""
    s = 1.0 - t
    if order == 3:
        w[0], w[3] = s * s * s / 6.0, t * t * t / 6.0
        w[1] = (4.0 + t * t * (3.0 * t - 6.0)) / 6.0
        w[2] = 1.0 - (w[0] + w[1] + w[3])
        return
    tt, ss = t * t, s * s
    w[0], w[5] = ss * ss * s / 120.0, tt * tt * t / 120.0
    w[2] = (66.0 + tt * (-60.0 + tt * (30.0 - 10.0 * t))) / 120.0
    w[3] = (66.0 + ss * (-60.0 + ss * (30.0 - 10.0 * s))) / 120.0
    w[1] = (1.0 + s * (5.0 + s * (10.0 + s * (10.0 + s * (5.0 - 5.0 * s))))) / 120.0
    w[4] = 1.0 - (w[0] + w[1] + w[2] + w[3] + w[5])


@inner
def _value(coefficients, order, x, y, wx, wy):
    """Spline value; NaN where a tap lies outside the padded image."""
    lead, taps = order // 2, order + 1
    ix, iy = int(np.floor(x)), int(np.floor(y))
    x0, y0 = ix - lead, iy - lead
    if x0 < 0 or y0 < 0 or x0 + taps > coefficients.shape[1] or y0 + taps > coefficients.shape[0]:
        return np.nan
    _weights(x - ix, order, wx)
    _weights(y - iy, order, wy)
    total = 0.0
    if order == 5:
        for i in range(6):
            row = coefficients[y0 + i]
            total += wy[i] * (
                wx[0] * row[x0]
                + wx[1] * row[x0 + 1]
                + wx[2] * row[x0 + 2]
                + wx[3] * row[x0 + 3]
                + wx[4] * row[x0 + 4]
                + wx[5] * row[x0 + 5]
            )
    else:
        for i in range(4):
            row = coefficients[y0 + i]
            total += wy[i] * (wx[0] * row[x0] + wx[1] * row[x0 + 1] + wx[2] * row[x0 + 2] + wx[3] * row[x0 + 3])
    return total


@inner
def _shift(pixels, current, gx, gy, ax, ay, left, top, x0, y0, half, gain, mean_r, mean_c):
    """Shift x, y that residuals show through the gradients ``ax, ay``, the subset's from ``left, top`` on."""
    a00 = a01 = a10 = a11 = b0 = b1 = 0.0
    for i in range(2 * half + 1):
        for j in range(2 * half + 1):
            y, x = y0 - half + i, x0 - half + j
            rest = gain * (current[i, j] - mean_c) - (pixels[y, x] - mean_r)
            u, v, g, h = ax[top + i, left + j], ay[top + i, left + j], gx[y, x], gy[y, x]
            a00 += u * g
            a01 += u * h
            a10 += v * g
            a11 += v * h
            b0 += u * rest
            b1 += v * rest
    det = a00 * a11 - a01 * a10
    return -(a11 * b0 - a01 * b1) / det, -(a00 * b1 - a10 * b0) / det


@entry
def _residual_shifts(pixels, gx, gy, lx, ly, coefficients, order, centres, images, maps, half, pad, out):
    wx, wy = np.empty(6), np.empty(6)
    side = 2 * half + 1
    current = np.empty((side, side))
    n = side * side
    for k in range(len(centres)):
        x0, y0 = centres[k]
        out[k, :] = np.nan
        if x0 < half or y0 < half or x0 + half >= pixels.shape[1] or y0 + half >= pixels.shape[0]:
            continue
        s_r = s_c = s_rc = s_cc = 0.0
        for i in range(side):
            for j in range(side):
                dx, dy = j - half, i - half
                x = images[k, 0] + maps[k, 0, 0] * dx + maps[k, 0, 1] * dy + pad
                y = images[k, 1] + maps[k, 1, 0] * dx + maps[k, 1, 1] * dy + pad
                c, r = _value(coefficients, order, x, y, wx, wy), pixels[y0 + dy, x0 + dx]
                current[i, j] = c
                s_r += r
                s_c += c
                s_rc += r * c
                s_cc += c * c
        contrast = s_cc - s_c * s_c / n
        if not contrast > 0.0:
            continue
        gain = (s_rc - s_r * s_c / n) / contrast
        known = gain, s_r / n, s_c / n
        out[k, 0], out[k, 1] = _shift(pixels, current, gx, gy, gx, gy, x0 - half, y0 - half, x0, y0, half, *known)
        out[k, 2], out[k, 3] = _shift(pixels, current, gx, gy, lx[k], ly[k], 0, 0, x0, y0, half, *known)


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
        (n, subset_px, subset_px) smoother ones, of the subsets that lie in the image.
    coefficients, order
        Spline of the other image, see :class:`core.matching.image.ImageData`.
    centres_px
        (n, 2) points of the reference.
    images_px, maps
        (n, 2) their images in the other one, and (n, 2, 2) how a px of the reference lies there.
    subset_px
        Width of the subset.
    """
    out = np.empty((len(centres_px), 4))
    centres = np.rint(centres_px).astype(np.int64)
    # a map is about the centre itself
    images = images_px + (maps @ (centres - centres_px)[..., None])[..., 0]
    _residual_shifts(
        pixels,
        *slopes,
        *smooth,
        coefficients,
        order,
        centres,
        np.ascontiguousarray(images),
        np.ascontiguousarray(maps),
        subset_px // 2,
        PAD,
        out,
    )
    return out
