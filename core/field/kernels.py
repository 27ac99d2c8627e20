"""What a point's neighbours say about it: their own patches, extended to the point's ray. Compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

REACH = 2
N_QUANTITIES = 4


@njit(cache=True, nogil=True, error_model="numpy")
def _median(values, n):
    # insertion sort: at most 24 values
    for i in range(1, n):
        v = values[i]
        j = i - 1
        while j >= 0 and values[j] > v:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = v
    if n % 2 == 1:
        return values[n // 2]
    return 0.5 * (values[n // 2 - 1] + values[n // 2])


@njit(cache=True, nogil=True, error_model="numpy")
def compare_with_neighbours(ok, rays, w, G, motion, reach_norm, difference, spread, count):
    """Own value minus the median of the neighbours' predictions, and the predictions' median absolute deviation.

    Parameters
    ----------
    ok
        (r, c) bool.
    rays, w, G
        (r, c, 3), (r, c, 3), (r, c, 3, 3).
    motion
        Whether G holds a motion.
    reach_norm
        Neighbours further than this in normalised coordinates do not count.
    difference, spread
        (r, c, 4) out: inverse depth relative to itself, then displacement in units of the depth (x, y, z in camera 1).
    count
        (r, c) out: how many neighbours spoke.
    """
    rows, cols = ok.shape
    values = np.empty((4, 24))
    buffer = np.empty(24)
    for r in range(rows):
        for c in range(cols):
            n = 0
            if not ok[r, c]:
                count[r, c] = 0
                continue
            w0 = w[r, c, 0]
            for dr in range(-REACH, REACH + 1):
                for dc in range(-REACH, REACH + 1):
                    i, j = r + dr, c + dc
                    if (dr == 0 and dc == 0) or i < 0 or j < 0 or i >= rows or j >= cols or not ok[i, j]:
                        continue
                    x = rays[r, c, 0] - rays[i, j, 0]
                    y = rays[r, c, 1] - rays[i, j, 1]
                    if abs(x) > reach_norm or abs(y) > reach_norm:
                        continue
                    wp = w[i, j, 0] + w[i, j, 1] * x + w[i, j, 2] * y
                    values[0, n] = wp / w0 - 1.0
                    if motion:
                        for k in range(3):
                            now = G[i, j, k, 0] + G[i, j, k, 1] * x + G[i, j, k, 2] * y
                            # displacement times w0, so that a depth error alone does not show twice
                            values[1 + k, n] = (now - rays[r, c, k]) * w0 / wp - (G[r, c, k, 0] - rays[r, c, k])
                    n += 1
            count[r, c] = n
            for q in range(4 if motion else 1):
                if n == 0:
                    difference[r, c, q] = np.nan
                    spread[r, c, q] = np.nan
                    continue
                for k in range(n):
                    buffer[k] = values[q, k]
                middle = _median(buffer, n)
                for k in range(n):
                    buffer[k] = abs(values[q, k] - middle)
                difference[r, c, q] = -middle
                spread[r, c, q] = _median(buffer, n)
