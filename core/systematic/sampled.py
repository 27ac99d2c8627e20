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


@entry
def _residual_shifts(pixels, gx, gy, lx, ly, coefficients, order, centres, images, maps, half, pad, out):
    rows, cols = coefficients.shape
    taps = order + 1
    lead = order // 2
    wx, wy = np.empty(6), np.empty(6)
    sums = np.empty((4, 3))
    gram = np.empty((4, 2))
    for k in range(len(centres)):
        x0, y0 = centres[k]
        out[k, :] = np.nan
        if x0 < half or y0 < half or x0 + half >= pixels.shape[1] or y0 + half >= pixels.shape[0]:
            continue
        sums[:, :] = 0.0
        gram[:, :] = 0.0
        s_r = s_c = s_rc = s_cc = 0.0
        inside = True
        for dy in range(-half, half + 1):
            for dx in range(-half, half + 1):
                x = images[k, 0] + maps[k, 0, 0] * dx + maps[k, 0, 1] * dy + pad
                y = images[k, 1] + maps[k, 1, 0] * dx + maps[k, 1, 1] * dy + pad
                ix, iy = int(np.floor(x)), int(np.floor(y))
                if ix < lead or iy < lead or ix - lead + taps > cols or iy - lead + taps > rows:
                    inside = False
                    break
                _weights(x - ix, order, wx)
                _weights(y - iy, order, wy)
                value = 0.0
                for i in range(taps):
                    row = 0.0
                    for j in range(taps):
                        row += wx[j] * coefficients[iy - lead + i, ix - lead + j]
                    value += wy[i] * row
                r, c = pixels[y0 + dy, x0 + dx], value
                s_r += r
                s_c += c
                s_rc += r * c
                s_cc += c * c
                g0, g1 = gx[y0 + dy, x0 + dx], gy[y0 + dy, x0 + dx]
                for f in range(4):
                    if f == 0:
                        a = g0
                    elif f == 1:
                        a = g1
                    elif f == 2:
                        a = lx[y0 + dy, x0 + dx]
                    else:
                        a = ly[y0 + dy, x0 + dx]
                    sums[f, 0] += a
                    sums[f, 1] += a * r
                    sums[f, 2] += a * c
                    gram[f, 0] += a * g0
                    gram[f, 1] += a * g1
            if not inside:
                break
        n = (2 * half + 1) ** 2
        contrast = s_cc - s_c * s_c / n
        if not inside or not contrast > 0.0:
            continue
        gain = (s_rc - s_r * s_c / n) / contrast
        for f in range(2):
            a00, a01, a10, a11 = gram[2 * f, 0], gram[2 * f, 1], gram[2 * f + 1, 0], gram[2 * f + 1, 1]
            det = a00 * a11 - a01 * a10
            if det == 0.0:
                continue
            b0 = gain * (sums[2 * f, 2] - s_c / n * sums[2 * f, 0]) - (sums[2 * f, 1] - s_r / n * sums[2 * f, 0])
            g = 2 * f + 1
            b1 = gain * (sums[g, 2] - s_c / n * sums[g, 0]) - (sums[g, 1] - s_r / n * sums[g, 0])
            out[k, 2 * f] = -(a11 * b0 - a01 * b1) / det
            out[k, 2 * f + 1] = -(a00 * b1 - a10 * b0) / det


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
    pixels, slopes, smooth
        (rows, cols) of the reference: grey levels, the matcher's gradients, and smoother ones.
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
