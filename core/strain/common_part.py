"""The common factor of a strain: the points' factor through the weights of the windows, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float32, Floats
from stereorig.core.field.region.window import window_offsets
from stereorig.core.matching.kernels.naming import entry_with_arrays, inner
from stereorig.core.strain.result import StrainStatus
from stereorig.core.strain.window import Slopes


@inner
def _through(slopes, by_slope, out):
    """Strain's rows ``out`` (3, k) of slopes (2, 6 k) and the strain's derivatives over them (3, 12)."""
    k = out.shape[1]
    for i in range(3):
        for j in range(k):
            out[i, j] = 0.0
        for a in range(2):
            for q in range(6):
                d = by_slope[i, 6 * a + q]
                for j in range(k):
                    out[i, j] += d * slopes[a, q * k + j]


@entry_with_arrays
def _whole(factor, valid, by_slope, good, half, out):
    """Rows ``out`` (r, c, 3, k) of points ``good`` as if all windows were whole; ``factor`` (r, c, 6 k)."""
    rows, cols, m = factor.shape
    even, line = np.empty((cols, m), np.float32), np.empty((cols, m), np.float32)
    slopes = np.empty((2, m), np.float32)
    squares = 0
    for k in range(-half, half + 1):
        squares += k * k
    scale = np.float32(1.0 / (squares * (2 * half + 1)))
    for r in range(half, rows - half):
        for c in range(cols):
            even[c, :] = 0.0
            line[c, :] = 0.0
            for k in range(-half, half + 1):
                if valid[r + k, c]:
                    far = np.float32(k)
                    for j in range(m):
                        even[c, j] += factor[r + k, c, j]
                        line[c, j] += far * factor[r + k, c, j]
        for c in range(half, cols - half):
            if not good[r, c]:
                continue
            for j in range(m):
                slopes[0, j] = 0.0
                slopes[1, j] = line[c, j]
            for k in range(1, half + 1):
                far = np.float32(k)
                for j in range(m):
                    slopes[0, j] += far * (even[c + k, j] - even[c - k, j])
                    slopes[1, j] += line[c + k, j] + line[c - k, j]
            for j in range(m):
                slopes[0, j] *= scale
                slopes[1, j] *= scale
            _through(slopes, by_slope[r, c], out[r, c])


@entry_with_arrays
def _reduced(factor, by_slope, at_rows, at_cols, weights, offsets, out):
    """The same of windows at (n,) rows and columns with weights (n, 2, points) of their own."""
    m = factor.shape[2]
    slopes = np.empty((2, m), np.float32)
    for w in range(len(at_rows)):
        r, c = at_rows[w], at_cols[w]
        slopes[:] = 0.0
        for p in range(len(offsets)):
            along, down = np.float32(weights[w, 0, p]), np.float32(weights[w, 1, p])
            if along == 0.0 and down == 0.0:  # no point there
                continue
            point = factor[r + offsets[p, 0], c + offsets[p, 1]]
            for j in range(m):
                slopes[0, j] += along * point[j]
                slopes[1, j] += down * point[j]
        _through(slopes, by_slope[r, c], out[r, c])


def common_part(factor: Floats, valid: Bool, slopes: Slopes, by_slope: Floats, half: int) -> Float32:
    """Return the common factor (r, c, 3, k) of the strain; values of points whose status is not ``OK`` are undefined.

    In single precision, as files hold it.

    Parameters
    ----------
    factor
        (r, c, 6, k) of the points.
    valid
        (r, c) True at points that have values.
    slopes
        The windows' fits.
    by_slope
        (r, c, 3, 12) derivatives of exx, eyy, exy over the slopes of X Y Z U V W over column, then over row.
    half
        Points to each side of a window's middle.
    """
    rows, cols, _, k = factor.shape
    points = np.ascontiguousarray(factor, dtype=np.float32).reshape(rows, cols, 6 * k)
    whole = slopes.status == StrainStatus.OK
    for r, c, _ in slopes.reduced:
        whole[r, c] = False
    by_slope = np.ascontiguousarray(by_slope, dtype=np.float32)
    out = np.zeros((rows, cols, 3, k), np.float32)
    _whole(points, valid, by_slope, whole, half, out)
    offsets: NDArray[np.int64] = np.ascontiguousarray(window_offsets(half)[0], dtype=np.int64)
    for r, c, weights in slopes.reduced:
        at = np.ascontiguousarray(r, dtype=np.int64), np.ascontiguousarray(c, dtype=np.int64)
        _reduced(points, by_slope, *at, np.ascontiguousarray(weights, dtype=np.float64), offsets, out)
    return out
