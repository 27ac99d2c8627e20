"""Comparison of a point with its neighbours' patches, extended to the point's ray. Compiled.

Medians of up to 24 neighbours for blocks of points at a time: a sorting network, whose compare-and-exchange steps run
over the block's points in vector registers. Missing neighbours are infinite, so they sort behind the others. The
differences from the point's own value are formed in double and kept in float32, 1e-7 of themselves.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

REACH = 2
N_QUANTITIES = 4
_NEIGHBOURS = (2 * REACH + 1) ** 2 - 1
_BLOCK = 64


def sorting_network(n: int) -> NDArray[np.int32]:
    """Return (m, 2) exchanges that sort n values: Batcher's merge exchange (Knuth, volume 3, 5.2.2, algorithm M)."""
    steps = []
    top = 1 << (max(n - 1, 1).bit_length() - 1)
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while True:
            steps += [(i, i + d) for i in range(n - d) if i & p == r]
            if q == p:
                break
            d, q, r = q - p, q >> 1, p
        p >>= 1
    return np.array(steps, dtype=np.int32)


@njit(cache=True, nogil=True, error_model="numpy")
def _sort(keys, network):
    for s in range(network.shape[0]):
        low, high = keys[network[s, 0]], keys[network[s, 1]]
        for k in range(_BLOCK):
            x, y = low[k], high[k]
            # exclusive-or in place of a choice: the compiler makes a masked store of that, which takes 20 cycles
            exchange = (x ^ y) & -np.int32(y < x)
            low[k] = x ^ exchange
            high[k] = y ^ exchange


@njit(cache=True, nogil=True, error_model="numpy")
def _order(keys):
    """Turn the bits of float32 into int32 of the same order, or back.

    The bits of negative numbers are in reverse order.
    """
    for s in range(keys.shape[0]):
        for k in range(_BLOCK):
            keys[s, k] ^= (keys[s, k] >> 31) & np.int32(0x7FFFFFFF)


@njit(cache=True, nogil=True, error_model="numpy")
def _medians(values, network, n, out):
    """Sort the columns of (24, block) ``values``; medians of the first ``n`` (block,), 0 for an empty column."""
    keys = values.view(np.int32)
    _order(keys)
    _sort(keys, network)
    _order(keys)
    for k in range(_BLOCK):
        m = n[k]
        if m == 0:
            out[k] = 0.0
        elif m % 2 == 1:
            out[k] = values[m // 2, k]
        else:
            out[k] = np.float32(0.5) * (values[m // 2 - 1, k] + values[m // 2, k])


@njit(cache=True, nogil=True, error_model="numpy")
def compare_with_neighbours(first, last, network, ok, separated, rays, w, G, motion, difference, spread, count):
    """Compute own value minus median of the neighbours' predictions, and the predictions' median absolute deviation.

    Parameters
    ----------
    first, last
        Range of rows.
    network
        ``sorting_network(24)``.
    ok
        (r, c) bool.
    separated
        (r, c) uint32, as :func:`stereorig.core.field.region.line_crossings.separated_neighbours`; empty without cuts
        and mask.
    rays, w, G
        (r, c, 3), (r, c, 3 or more), (r, c, 3, 3 or more).
    motion
        True if G holds a motion.
    difference, spread
        (r, c, 4) out: inverse depth relative to itself, then displacement in units of the depth (x, y, z in camera 1).
        Elements not known are left unchanged.
    count
        (r, c) out: number of neighbours compared.
    """
    rows, cols = ok.shape
    quantities = 4 if motion else 1
    values = np.empty((4, _NEIGHBOURS, _BLOCK), np.float32)
    n = np.empty(_BLOCK, np.int32)
    middle, deviation = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    for r in range(first, last):
        for start in range(0, cols, _BLOCK):
            stop = min(start + _BLOCK, cols)
            for k in range(_BLOCK):
                n[k] = 0
            for q in range(quantities):
                for s in range(_NEIGHBOURS):
                    for k in range(_BLOCK):
                        values[q, s, k] = np.inf
            slot = 0
            for dr in range(-REACH, REACH + 1):
                for dc in range(-REACH, REACH + 1):
                    i = r + dr
                    if dr == 0 and dc == 0:
                        continue
                    if 0 <= i < rows:
                        for c in range(max(start, -dc), min(stop, cols - dc)):
                            j = c + dc
                            if not ok[r, c] or not ok[i, j]:
                                continue
                            if separated.shape[0] > 0 and (separated[r, c] >> np.uint32(slot)) & np.uint32(1):
                                continue
                            k = c - start
                            n[k] += 1
                            w0 = w[r, c, 0]
                            x = rays[r, c, 0] - rays[i, j, 0]
                            y = rays[r, c, 1] - rays[i, j, 1]
                            wp = w[i, j, 0] + w[i, j, 1] * x + w[i, j, 2] * y
                            values[0, slot, k] = wp / w0 - 1.0
                            if motion:
                                # displacement times w0, so that a depth error alone does not count twice
                                scale = w0 / wp
                                for q in range(3):
                                    now = G[i, j, q, 0] + G[i, j, q, 1] * x + G[i, j, q, 2] * y
                                    own = G[r, c, q, 0] - rays[r, c, q]
                                    values[1 + q, slot, k] = (now - rays[r, c, q]) * scale - own
                    slot += 1
            for q in range(quantities):
                v = values[q]
                _medians(v, network, n, middle)
                for s in range(_NEIGHBOURS):
                    for k in range(_BLOCK):
                        v[s, k] = abs(v[s, k] - middle[k])
                _medians(v, network, n, deviation)
                for c in range(start, stop):
                    if n[c - start] > 0:
                        difference[r, c, q] = -middle[c - start]
                        spread[r, c, q] = deviation[c - start]
            for c in range(start, stop):
                count[r, c] = n[c - start]


@njit(cache=True, nogil=True, error_model="numpy")
def least_median(first, last, x, v, triplets, flat_below, residual, medians):
    """Find the linear map through three of a position's samples with the least median residual over all of them.

    Parameters
    ----------
    first, last
        Range of positions.
    x, v
        (m, k, 2) positions of the samples, and (m, k, d) their values.
    triplets
        (s, 3) indices of three samples to try.
    flat_below
        Triplets that span a triangle of less than half this area give no slopes.
    residual
        (m, k) out: residuals under the best map; not finite without one.
    medians
        (m,) out: its median, inf without a map.
    """
    samples, dimensions = v.shape[1], v.shape[2]
    r, ordered = np.empty(samples), np.empty(samples)
    half = samples // 2
    for m in range(first, last):
        medians[m] = np.inf
        for n in range(samples):
            residual[m, n] = np.inf
        for s in range(triplets.shape[0]):
            i, j, k = triplets[s, 0], triplets[s, 1], triplets[s, 2]
            xi, yi = x[m, i, 0], x[m, i, 1]
            xj, yj = x[m, j, 0] - xi, x[m, j, 1] - yi
            xk, yk = x[m, k, 0] - xi, x[m, k, 1] - yi
            det = xj * yk - xk * yj
            if abs(det) < flat_below:
                continue
            for n in range(samples):
                dx, dy = x[m, n, 0] - xi, x[m, n, 1] - yi
                a, b = (dx * yk - xk * dy) / det, (xj * dy - dx * yj) / det
                total = 0.0
                for q in range(dimensions):
                    there = v[m, i, q] + a * (v[m, j, q] - v[m, i, q]) + b * (v[m, k, q] - v[m, i, q])
                    total += (there - v[m, n, q]) ** 2
                r[n] = np.sqrt(total)
                value, slot = r[n], n
                while slot > 0 and ordered[slot - 1] > value:
                    ordered[slot] = ordered[slot - 1]
                    slot -= 1
                ordered[slot] = value
            middle = ordered[half] if samples % 2 == 1 else 0.5 * (ordered[half - 1] + ordered[half])
            if middle < medians[m]:
                medians[m] = middle
                for n in range(samples):
                    residual[m, n] = r[n]
