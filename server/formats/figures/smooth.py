"""Values between the points of a grid, as the page draws them: never over a missing point or a cut.

Bilinear from four corners of a cell; from three, inside their triangle, if the fourth is missing or beyond a cut.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.region.cuts import Cuts, crosses

_ACROSS, _DOWN = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])  # of a cell's corners
_DOT = 0.25  # half the width of a point without neighbours, of a cell


def between_points(values: NDArray[np.floating], x_px: Float, y_px: Float, cuts: Cuts | None, each: int) -> Float:
    """Return values between points, ``each`` by ``each`` in a cell.

    Parameters
    ----------
    values
        (r, c), NaN for missing points; r and c at least 2.
    x_px, y_px
        (r, c) positions of the points on their regular grid.
    cuts
        Nothing is drawn across them.
    each
        Samples along a cell's side, in the middles of equal parts of it.

    Returns
    -------
    NDArray
        ((r - 1) each, (c - 1) each), from the first point to the last; NaN for missing values.
    """
    rows, cols = values.shape[0] - 1, values.shape[1] - 1
    share = (np.arange(each) + 0.5) / each
    s, t = (a.ravel() for a in np.meshgrid(share, share))  # across, down
    weight = np.where(_ACROSS, s[:, None], 1.0 - s[:, None]) * np.where(_DOWN, t[:, None], 1.0 - t[:, None])
    corner = _corners(np.asarray(values, dtype=np.float64)).reshape(-1, 4)
    good = np.isfinite(corner)
    out = np.full((rows * cols, each * each), np.nan)
    cut = _cut_cells(x_px, y_px, cuts).ravel()
    whole = good.all(axis=1) & ~cut
    out[whole] = corner[whole] @ weight.T
    for bad in range(4):
        chosen = ~good[:, bad] & (good.sum(axis=1) == 3) & ~cut
        out[chosen] = _triangle(corner[chosen][:, None, :], bad, s, t)
    chosen = cut & (good.sum(axis=1) >= 3)
    if chosen.any():
        out[chosen] = _beside_cuts(corner[chosen], _positions(x_px, y_px, chosen), cuts, s, t, weight)
    _dots(out, good, corner, s, t, cols)
    return out.reshape(rows, cols, each, each).transpose(0, 2, 1, 3).reshape(rows * each, cols * each)


def _corners(of: Float) -> Float:
    """Return (r - 1, c - 1, 4) the corners of each cell."""
    return np.stack([of[:-1, :-1], of[:-1, 1:], of[1:, :-1], of[1:, 1:]], axis=-1)


def _positions(x_px: Float, y_px: Float, cells: Bool) -> Float:
    return np.stack([_corners(x_px).reshape(-1, 4)[cells], _corners(y_px).reshape(-1, 4)[cells]], axis=-1)


def _triangle(corner: Float, bad: int, s: Float, t: Float) -> Float:
    """Return values (n, m) in the triangle opposite one corner, NaN outside; ``corner`` (n, 1 or m, 4)."""
    o = 3 - bad
    a, b = 1.0 - s if o & 1 else s, 1.0 - t if o & 2 else t
    inside = (1.0 - a - b) * corner[..., o] + a * corner[..., o ^ 1] + b * corner[..., o ^ 2]
    return np.where(a + b <= 1.0 + 1e-9, inside, np.nan)


def _cut_cells(x_px: Float, y_px: Float, cuts: Cuts | None) -> Bool:
    """Return (r - 1, c - 1) True where a cut meets a cell."""
    shape = x_px.shape[0] - 1, x_px.shape[1] - 1
    if not cuts:
        return np.zeros(shape, bool)
    at = np.stack([_corners(x_px), _corners(y_px)], axis=-1)
    # a line that enters and leaves a cell meets one of its diagonals; one that ends in it has an end within
    met = crosses(at[:, :, 0], at[:, :, 3], cuts) | crosses(at[:, :, 1], at[:, :, 2], cuts)
    x0, y0, x1, y1 = (at[..., k, axis] for k, axis in ((0, 0), (0, 1), (3, 0), (3, 1)))
    for line in cuts.lines_px:
        for x, y in line:
            met |= (x0 <= x) & (x <= x1) & (y0 <= y) & (y <= y1)
    return np.asarray(met)


def _beside_cuts(corner: Float, at: Float, cuts: Cuts | None, s: Float, t: Float, weight: Float) -> Float:
    """Return values (n, m) in cells (n, 4) that a cut meets: none from a corner beyond it."""
    first, size = at[:, :1], at[:, 3:] - at[:, :1]
    samples = first + np.stack([s, t], axis=-1) * size
    bad = ~np.isfinite(corner)[:, None, :] | crosses(samples[:, :, None, :], at[:, None, :, :], cuts)
    count = bad.sum(axis=2)
    known = np.broadcast_to(np.nan_to_num(corner)[:, None, :], bad.shape)
    out = np.where(count == 0, (known * weight).sum(axis=2), np.nan)
    for k in range(4):
        out = np.where((count == 1) & bad[..., k], _triangle(known, k, s, t), out)
    return np.asarray(out)


def _dots(out: Float, good: Bool, corner: Float, s: Float, t: Float, cols: int) -> None:
    """Draw points that belong to no cell with three corners as dots."""
    cell = np.arange(len(out))
    first = cell // cols * (cols + 1) + cell % cols
    point = first[:, None] + _ACROSS + _DOWN * (cols + 1)
    drawn = np.zeros(int(point.max()) + 1, bool)
    drawn[point[good.sum(axis=1) >= 3]] = True
    for k in range(4):
        near = (np.abs(s - _ACROSS[k]) < _DOT) & (np.abs(t - _DOWN[k]) < _DOT)
        for lone in np.flatnonzero(good[:, k] & ~drawn[point[:, k]]):
            out[lone, near] = corner[lone, k]
