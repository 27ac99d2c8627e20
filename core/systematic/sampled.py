"""Shifts that residuals of matched subsets show, seen through two filters of the reference's gradients.

At a match the residuals are orthogonal to the gradients that determined it. Through smoother gradients they show the
shift that a match of smoother images would have added.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereorig.core.arrays import Float, Float32
from stereorig.core.matching.image import PAD
from stereorig.core.matching.kernels import loops, vectors
from stereorig.core.matching.kernels.loops import N_WARP, sample_cubic, sample_quintic
from stereorig.core.matching.kernels.naming import entry_with_arrays, inner, stamp_of
from stereorig.core.matching.kernels.reference import subset_array
from stereorig.core.threads import run_ranges

_RANGE = 64  # points: one to three milliseconds


@inner
def _inside(rows, cols, order, x, y, map_, half):
    """True if all taps of a subset are inside the padded image; the corners are an affine map's extremes."""
    lead = order // 2
    wide = half * (abs(map_[0, 0]) + abs(map_[0, 1]))
    high = half * (abs(map_[1, 0]) + abs(map_[1, 1]))
    return x - wide >= lead and y - high >= lead and x + wide < cols - 1 - lead and y + high < rows - 1 - lead


@inner
def _sample(flat, width, order, x, y, map_, half, offsets, warp, current):
    """Sample the other image over a subset about its place there; all taps are inside."""
    ix, iy, lead = int(x), int(y), order // 2
    for axis in range(2):
        warp[10 * axis + 1], warp[10 * axis + 2] = half * map_[axis, 0], half * map_[axis, 1]
    warp[0], warp[10] = x - ix, y - iy
    base, blocks = np.int64((iy - lead) * width + ix - lead), np.int64(len(current) // 8)
    if order == 3:
        sample_cubic(flat, base, np.int64(width), warp, offsets, blocks, current)
    else:
        sample_quintic(flat, base, np.int64(width), warp, offsets, blocks, current)


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
            rest = gain * (current[i * subset.shape[1] + j] - mean_c) - (subset[i, j] - mean_r)
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


def _entry(stamp: int):  # type: ignore[no-untyped-def]
    @entry_with_arrays
    def _residual_shifts(pixels, gx, gy, lx, ly, coefficients, order, centres, images, maps, half, pad, offsets, out):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        side = 2 * half + 1
        n = side * side
        current, warp = np.empty((n + 7) // 8 * 8, np.float32), np.zeros(N_WARP, np.float32)
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
            _sample(flat, width, order, x, y, map_, half, offsets, warp, current)
            down, along = slice(y0 - half, y0 + half + 1), slice(x0 - half, x0 + half + 1)
            subset = pixels[down, along]
            s_r = s_c = s_rc = s_cc = 0.0
            for i in range(side):
                for j in range(side):
                    c, r = float(current[i * side + j]), float(subset[i, j])
                    s_r += r
                    s_c += c
                    s_rc += r * c
                    s_cc += c * c
            contrast = s_cc - s_c * s_c / n
            if not contrast > 0.0:
                continue
            gain = (s_rc - s_r * s_c / n) / contrast
            _shifts(subset, current, gx[down, along], gy[down, along], lx[k], ly[k], gain, s_r / n, s_c / n, out[k])

    return _residual_shifts


_residual_shifts = _entry(stamp_of([Path(loops.__file__), Path(vectors.__file__)]))


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
    offsets = subset_array(subset_px // 2 * 2 + 1)

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
            offsets,
            out[part],
        )

    run_ranges(some, len(centres), _RANGE)
    return out
