"""Weighted sums over windows, compiled: whole ones along columns and rows, reduced ones without gathering points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.region.window import window_offsets
from stereorig.core.matching.kernels.naming import entry, entry_with_arrays

Index = NDArray[Any]


@entry
def _sums(values, from_centre, at_rows, at_cols, which, weights, offsets, out):
    """Sums ``out`` (m, a, q) of values (r, c, q) over windows, with the weights ``which`` (m,) of (k, a, n)."""
    count = values.shape[2]
    for w in range(len(at_rows)):
        r, c, kind = at_rows[w], at_cols[w], which[w]
        centre = values[r, c]
        for a in range(weights.shape[1]):
            total = out[w, a]
            for j in range(count):
                total[j] = 0.0
            for p in range(len(offsets)):
                weight = weights[kind, a, p]
                if weight == 0.0:  # no point there, or none that counts
                    continue
                point = values[r + offsets[p, 0], c + offsets[p, 1]]
                if from_centre:
                    for j in range(count):
                        total[j] += weight * (point[j] - centre[j])
                else:
                    for j in range(count):
                        total[j] += weight * point[j]


@entry_with_arrays
def _whole(values, down, along, which, out):
    """Sums ``out`` (r, c, a, q) of values (r, c, q): rows by ``down`` (d, w), then columns by ``along`` (a, w)."""
    rows, cols, count = values.shape
    half = along.shape[1] // 2
    part = np.zeros((len(down), cols + 2 * half, count))  # nothing lies beside the grid
    for r in range(rows):
        first, last = max(-half, -r), min(half, rows - 1 - r)
        for d in range(len(down)):
            for c in range(cols):
                total = part[d, half + c]
                for j in range(count):
                    total[j] = 0.0
                for k in range(first, last + 1):
                    weight, point = down[d, half + k], values[r + k, c]
                    for j in range(count):
                        total[j] += weight * point[j]
        for c in range(cols):
            for a in range(len(along)):
                total, line = out[r, c, a], part[which[a]]
                for j in range(count):
                    total[j] = 0.0
                for k in range(along.shape[1]):
                    weight, point = along[a, k], line[c + k]
                    for j in range(count):
                        total[j] += weight * point[j]


def whole_sums(values: Float, down: Float, along: Float, which: Sequence[int]) -> Float:
    """Return weighted sums (r, c, a, q) over the window about each point; zero lies beside the grid.

    Parameters
    ----------
    values
        (r, c, q) on the grid.
    down
        (d, w) weights of a window's rows.
    along, which
        (a, w) weights of its columns for each sum, and (a,) the weights of its rows among ``down``.
    """
    held = [np.ascontiguousarray(a, dtype=np.float64) for a in (values, down, along)]
    out = np.empty((*values.shape[:2], len(along), values.shape[2]))
    _whole(*held, np.asarray(which, dtype=np.int64), out)
    return out


def window_sums(
    values: Float, rows: Index, cols: Index, which: Index, weights: Float, half: int, *, from_centre: bool
) -> Float:
    """Return weighted sums (m, a, q) over windows.

    Parameters
    ----------
    values
        (r, c, q) on the grid.
    rows, cols
        (m,) the windows' middles.
    which, weights
        (m,) number of each window's weights among (k, a, n) of the points of ``window_offsets``; zero where a window
        has no point. The grid's value at a weight of zero is not used.
    half
        Points to each side of a middle.
    from_centre
        Take the middle's values off the others', so that no digits are lost.
    """
    out = np.empty((len(rows), weights.shape[1], values.shape[2]))
    at = [np.ascontiguousarray(index, dtype=np.int64) for index in (rows, cols, which)]
    offsets = np.ascontiguousarray(window_offsets(half)[0], dtype=np.int64)
    held = (np.ascontiguousarray(a, dtype=np.float64) for a in (values, weights))
    given, by_kind = held
    _sums(given, from_centre, *at, by_kind, offsets, out)
    return out
