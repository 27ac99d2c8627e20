"""Slopes of positions and displacements over square windows of points, and how noise goes into them.

Parameters of the fits are the points' column and row in the grid. A fit is linear in the data, so that reference and
deformed positions are fitted by the same weights: what moves rigidly, or stretches evenly, is told exactly, whatever
the surface's shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from core.field.cuts import Cuts, crosses
from core.field.shared_pixels import SharedPixels
from core.lens import Bool, Float
from core.strain.options import StrainOptions
from core.strain.result import StrainStatus

_AT_ONCE = 1024


@dataclass(frozen=True, eq=False)
class Slopes:
    """Of (r, c) points; what belongs to points whose status is not ``OK`` means nothing.

    Attributes
    ----------
    status
        (r, c) int8, :class:`StrainStatus`.
    slope
        (r, c, 6, 2) of X Y Z U V W over column and row, mm a step.
    spread
        (r, c, 2, 2) sum of c_k rho_kl c_l^T: what the slopes' covariance is in units of a point's.
    """

    status: np.ndarray
    slope: Float
    spread: Float


@lru_cache(maxsize=8)
def _offsets(half: int) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) rows and columns of a window's points, inner rings first, and (n,) each one's next towards the centre."""
    side = np.arange(-half, half + 1)
    row, col = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
    ring = np.maximum(np.abs(row), np.abs(col))
    order = np.argsort(ring, kind="stable")
    row, col, ring = row[order], col[order], ring[order]
    number = {(int(r), int(c)): k for k, (r, c) in enumerate(zip(row, col, strict=True))}
    share = np.maximum(ring - 1, 0) / np.maximum(ring, 1)
    # truncated: of two cells as near the line, the one nearer to the axes
    before_row = np.trunc(row * share + 0.5 * np.sign(row) - 1e-9 * np.sign(row)).astype(int)
    before_col = np.trunc(col * share + 0.5 * np.sign(col) - 1e-9 * np.sign(col)).astype(int)
    before = np.array([number[int(r), int(c)] for r, c in zip(before_row, before_col, strict=True)])
    return np.stack([row, col], axis=1), before


def _design(offsets: np.ndarray, half: int, order: int) -> Float:
    """(n, 3 or 6) terms of the fit, offsets as shares of the half width."""
    y, x = (offsets / half).T
    terms = [np.ones_like(x), x, y]
    if order == 2:
        terms += [x * x, x * y, y * y]
    return np.stack(terms, axis=1)


def window_slopes(
    values: Float,
    valid: Bool,
    xy_px: Float,
    cuts: Cuts | None,
    options: StrainOptions,
    *,
    subset_px: int,
    curved: bool,
) -> Slopes:
    """Fit the window about each valid point.

    Parameters
    ----------
    values
        (r, c, 6) X Y Z U V W, mm.
    valid
        (r, c) where there are values.
    xy_px
        (r, c, 2) the grid, px.
    cuts
        What no window reaches over.
    options
        Window, order, limits.
    subset_px, curved
        What the points were measured with: tells how their errors go together.
    """
    half = options.window // 2
    offsets, _ = _offsets(half)
    step = _steps(xy_px)
    apart = (offsets[:, None, :] - offsets[None, :, :]).astype(np.float64)
    rho = SharedPixels(subset_px, curved).correlation(apart[..., 1] * step[0], apart[..., 0] * step[1])
    whole = ndimage.minimum_filter(valid, size=options.window, mode="constant", cval=False)
    crossed = _crossed(valid, xy_px, cuts, half)
    whole &= ~crossed.any(axis=-1) if crossed is not None else True
    status = np.where(valid, StrainStatus.OK, StrainStatus.NO_POINT).astype(np.int8)
    slope = _whole_slopes(values, half)
    spread = np.zeros((*valid.shape, 2, 2))
    c = _plane_weights(half)
    spread[...] = c @ rho @ c.T
    rows, cols = np.nonzero(valid & ~whole)
    there = np.pad(valid, half)
    padded = np.pad(np.where(valid[..., None], values, 0.0), ((half, half), (half, half), (0, 0))).reshape(-1, 6)
    width = there.shape[1]
    reach = offsets @ np.array([width, 1])
    for first in range(0, len(rows), _AT_ONCE):
        r, k = rows[first : first + _AT_ONCE], cols[first : first + _AT_ONCE]
        here = (r + half) * width + k + half
        seen = _seen(there, here, None if crossed is None else crossed[r, k], half)
        found, weights = _weights(seen, half, options)
        # from the centre's values on, so that no digits are lost
        data = padded.take(here[:, None] + reach, axis=0) - values[r, k][:, None, :]
        status[r, k] = found
        slope[r, k] = np.einsum("man,mnb->mba", weights, data)
        # one large product instead of many small ones
        shared = (weights.reshape(-1, len(rho)) @ rho).reshape(weights.shape)
        spread[r, k] = np.einsum("man,mbn->mab", shared, weights)
    return Slopes(status, slope, spread)


def _steps(xy_px: Float) -> tuple[float, float]:
    """Distances of neighbouring columns and rows in px; a single one has no window, and takes the other's."""
    rows, cols = xy_px.shape[:2]
    x = float(xy_px[0, 1, 0] - xy_px[0, 0, 0]) if cols > 1 else 0.0
    y = float(xy_px[1, 0, 1] - xy_px[0, 0, 1]) if rows > 1 else 0.0
    return x or y, y or x


def _plane_weights(half: int) -> Float:
    """(2, n) weights of a whole window's points in its slopes over column and row."""
    offsets, _ = _offsets(half)
    return np.asarray(offsets[:, ::-1].T / float((offsets[:, 0] ** 2).sum()))


def _whole_slopes(values: Float, half: int) -> Float:
    """Slopes (r, c, 6, 2) of whole windows, quadratic or not: a line's weights one way, equal ones the other."""
    side = np.arange(-half, half + 1, dtype=np.float64)
    line, ones = side / (side**2).sum(), np.full(2 * half + 1, 1.0 / (2 * half + 1))
    out = []
    for along, across in ((1, 0), (0, 1)):
        part = ndimage.correlate1d(values, line, axis=along, mode="constant", cval=np.nan)
        out.append(ndimage.correlate1d(part, ones, axis=across, mode="constant", cval=np.nan))
    return np.stack(out, axis=-1)


def _crossed(valid: Bool, xy_px: Float, cuts: Cuts | None, half: int) -> Bool | None:
    """(r, c, n) True where the way from a point to one of its window meets a cut; None where there is no cut."""
    if not cuts:
        return None
    offsets, _ = _offsets(half)
    step = _steps(xy_px)
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


def _seen(there: Bool, here: np.ndarray, crossed: Bool | None, half: int) -> Bool:
    """(m, n) which points of the windows can be reached from their centres over valid points alone.

    ``there`` is the padded grid, ``here`` (m,) the centres' flat places in it. The way goes from cell to cell. Over a
    corner it goes where one of the two cells beside it is valid: an empty line of cells, however it slants, is not
    passed.
    """
    offsets, before = _offsets(half)
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


def _weights(seen: Bool, half: int, options: StrainOptions) -> tuple[np.ndarray, Float]:
    """Status (m,) and weights (m, 2, n) of the points in the slopes; zero where there are none."""
    offsets, _ = _offsets(half)
    A = _design(offsets, half, options.order)
    n, terms = A.shape
    count = seen.sum(axis=1)
    normal = (seen.astype(np.float64) @ (A[:, :, None] * A[:, None, :]).reshape(n, -1)).reshape(-1, terms, terms)
    few = count < max(options.least_share * n, terms)
    firm = np.linalg.eigvalsh(normal)[:, 0] > 1e-9 * count
    normal = np.where((firm & ~few)[:, None, None], normal, np.eye(terms))
    inverse = np.linalg.inv(normal)
    noise = np.linalg.eigvalsh(inverse[:, 1:3, 1:3])[:, -1] * float((A[:, 1] ** 2).sum())
    one_sided = ~firm | (noise > options.most_amplification**2)
    status = np.where(few, StrainStatus.TOO_FEW, np.where(one_sided, StrainStatus.ONE_SIDED, StrainStatus.OK))
    weights = (inverse[:, 1:3].reshape(-1, terms) / half @ A.T).reshape(-1, 2, n)
    return status.astype(np.int8), np.where(seen[:, None, :], weights, 0.0)
