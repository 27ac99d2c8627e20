"""Square windows of points: the points connected to a window's middle, and the terms of a fit over it.

A window ends at cuts, holes and edges: points connected to its middle only across one do not count.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.region.cuts import Cuts, crosses


@lru_cache(maxsize=8)
def window_offsets(half: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 2) rows and columns of a window's points, inner rings first, and (n,) the next point inwards."""
    side = np.arange(-half, half + 1)
    row, col = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
    ring = np.maximum(np.abs(row), np.abs(col))
    order = np.argsort(ring, kind="stable")
    row, col, ring = row[order], col[order], ring[order]
    number = {(int(r), int(c)): k for k, (r, c) in enumerate(zip(row, col, strict=True))}
    share = np.maximum(ring - 1, 0) / np.maximum(ring, 1)
    # truncated: of two cells equally near the line, the one nearer to the axes
    before_row = np.trunc(row * share + 0.5 * np.sign(row) - 1e-9 * np.sign(row)).astype(int)
    before_col = np.trunc(col * share + 0.5 * np.sign(col) - 1e-9 * np.sign(col)).astype(int)
    before = np.array([number[int(r), int(c)] for r, c in zip(before_row, before_col, strict=True)])
    return np.stack([row, col], axis=1), before


def fit_terms(offsets: np.ndarray, half: int, order: int) -> Float:
    """Return (n, 3 or 6) terms of the fit, offsets as shares of the half width."""
    y, x = (offsets / half).T
    terms = [np.ones_like(x), x, y]
    if order == 2:
        terms += [x * x, x * y, y * y]
    return np.stack(terms, axis=1)


def ways_cut(valid: Bool, xy_px: Float, cuts: Cuts | None, half: int) -> Bool | None:
    """Return (r, c, n) True where the way from a point to one of its window meets a cut; None without cuts."""
    if not cuts:
        return None
    offsets, _ = window_offsets(half)
    step = steps_of(xy_px)
    out = np.zeros((*valid.shape, len(offsets)), bool)
    reach = half * np.array(step)
    near = np.zeros(valid.shape, bool)
    for x0, y0, x1, y1 in cuts.pieces_px:
        low, high = np.array([min(x0, x1), min(y0, y1)]) - reach, np.array([max(x0, x1), max(y0, y1)]) + reach
        near |= ((xy_px >= low) & (xy_px <= high)).all(axis=-1)
    rows, cols = np.nonzero(near & valid)
    here = xy_px[rows, cols]
    if len(here):
        ways = offsets[:, ::-1] * np.array(step)
        out[rows, cols] = crosses(here[:, None, :], here[:, None, :] + ways, cuts)
    return out


def connected_points(there: Bool, here: np.ndarray, crossed: Bool | None, half: int) -> Bool:
    """Return (m, n) True for the windows' points that are connected to their centres over valid points alone.

    ``there`` is the padded grid, ``here`` (m,) the centres' flat indices in it. The way goes from cell to cell. A
    diagonal step is allowed if one of the two cells next to it is valid: it does not cross an empty line of cells at
    any slope.
    """
    offsets, before = window_offsets(half)
    flat, width = there.ravel(), there.shape[1]
    dr, dc = offsets.T
    valid = flat.take(here[:, None] + offsets @ np.array([width, 1]))
    seen = np.ascontiguousarray((valid if crossed is None else valid & ~crossed).T)
    for k in range(1, len(offsets)):
        b = before[k]
        seen[k] &= seen[b]
        if dr[k] != dr[b] and dc[k] != dc[b]:
            seen[k] &= flat[here + dr[k] * width + dc[b]] | flat[here + dr[b] * width + dc[k]]
    return np.asarray(seen.T)


def distinct_windows(seen: Bool) -> tuple[Bool, np.ndarray]:
    """Return (k, n) the different rows of ``seen`` (m, n), and (m,) the number of each row's own.

    The rim of a field shows few ways in which a window can be cut off: its fits' weights are made once for each.
    """
    packed = np.ascontiguousarray(np.packbits(seen, axis=1))
    _, first, which = np.unique(packed.view(f"V{packed.shape[1]}").ravel(), return_index=True, return_inverse=True)
    return seen[first], which.ravel()


def steps_of(xy_px: Float) -> tuple[float, float]:
    """Return the distances of neighbouring columns and rows in px; a single one takes the other's."""
    rows, cols = xy_px.shape[:2]
    x = float(xy_px[0, 1, 0] - xy_px[0, 0, 0]) if cols > 1 else 0.0
    y = float(xy_px[1, 0, 1] - xy_px[0, 0, 1]) if rows > 1 else 0.0
    return x or y, y or x
