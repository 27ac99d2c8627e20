"""The smooth prediction of a dense field: where each pixel of camera 1's reference is seen in the other images.

It is made of an ordinary field's own positions: about each point a quadratic of the positions of its window, and
between points the bicubic polynomial that has the values and slopes of these at its four corners. Windows of points end
at cuts, at empty points and at jumps, so a prediction belongs to one smooth part of the surface. It goes on beyond the
outermost points as far as their subsets reach; where two parts would meet there, it ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from core.arrays import Bool, Float
from core.field.region.cuts import Cuts
from core.field.region.window import connected_points, fit_terms, steps_of, ways_cut, window_offsets

HALVES = (3, 2)
"""Half widths of the windows that quadratics are fitted to, in points. The wider has the less noise in its curvature,
which is all that reaches a vector: value and slopes are measured anew. The narrower serves where it does not fit."""

_JUMP_PX, _JUMP_SD = 0.02, 6.0
_BEYOND_PX = 0.1  # by which what neighbours predict beyond the outermost points may differ


@dataclass(frozen=True, eq=False)
class Prediction:
    """Bicubic polynomials between the points of an ordinary field, and a rim of points beyond it.

    Attributes
    ----------
    nodes
        (r + 2 rim, c + 2 rim, m, 4) of m image coordinates, px: value, slope along columns, along rows, and mixed
        derivative, per spacing.
    known
        (r + 2 rim, c + 2 rim) True where there is a prediction.
    cells
        (r - 1, c - 1) True between four measured points of one smooth part: vectors lie there alone.
    rim
        Points beyond the field on each side.
    """

    nodes: Float
    known: Bool
    cells: Bool
    rim: int


def predict(xy_px: Float, positions: Float, measured: Bool, cuts: Cuts | None, *, subset_px: int) -> Prediction:
    """Return the prediction of a field.

    Parameters
    ----------
    xy_px
        (r, c, 2) points of a regular grid in camera 1's reference image.
    positions
        (r, c, m) their image coordinates in other images, px.
    measured
        (r, c) True where they are valid.
    cuts
        Lines that no window crosses.
    subset_px
        Width of the subset; the prediction reaches half of it beyond the outermost points.
    """
    rows, cols, _ = positions.shape
    spacing = min(steps_of(xy_px))
    rim = int(np.ceil((subset_px // 2 + 1) / spacing))
    coefficients = np.full((rows, cols, 6, positions.shape[2]), np.nan)
    smooth = np.zeros(measured.shape, bool)
    for half in HALVES:
        found, fits = _quadratics(xy_px, positions, measured, cuts, half)
        new = fits & ~smooth
        coefficients[new], smooth = found[new], smooth | new
    wide = ((rim, rim), (rim, rim))
    coefficients = np.pad(coefficients, (*wide, (0, 0), (0, 0)), constant_values=np.nan)
    shown = np.pad(np.where(measured[..., None], positions, np.nan), (*wide, (0, 0)), constant_values=np.nan)
    known = np.pad(smooth, rim)
    tolerance = _tolerance(coefficients[:, :, 0] - shown)
    for _ in range(max(HALVES) + rim):
        known = _spread(coefficients, known, shown, tolerance)
    c = coefficients
    nodes = np.stack([c[:, :, 0], c[:, :, 1], c[:, :, 2], c[:, :, 4]], axis=-1)
    inner = known[rim : rim + rows, rim : rim + cols] & measured
    return Prediction(
        nodes=np.ascontiguousarray(np.where(known[..., None, None], nodes, 0.0)),
        known=known,
        cells=inner[1:, 1:] & inner[1:, :-1] & inner[:-1, 1:] & inner[:-1, :-1],
        rim=rim,
    )


def _quadratics(
    xy_px: Float, positions: Float, measured: Bool, cuts: Cuts | None, half: int
) -> tuple[Float, Bool]:
    """Coefficients (r, c, 6, m) of 1, x, y, x^2, x y, y^2 (offsets in points), and where whole windows have them."""
    rows, cols, m = positions.shape
    out = np.full((rows, cols, 6, m), np.nan)
    fits = np.zeros(measured.shape, bool)
    if min(rows, cols) < 2 * half + 1:
        return out, fits
    whole = ndimage.minimum_filter(measured, size=2 * half + 1, mode="constant", cval=False)
    crossed = ways_cut(measured, xy_px, cuts, half)
    if crossed is not None:
        whole &= ~crossed.any(axis=-1)
    r, k = np.nonzero(whole)
    if len(r) == 0:
        return out, fits
    offsets, _ = window_offsets(half)
    weights = np.linalg.pinv(fit_terms(offsets, half, 2))
    weights /= np.array([1.0, half, half, half**2, half**2, half**2])[:, None]
    values = np.where(measured[..., None], positions, 0.0)
    total = np.zeros((rows, cols, 6, m))
    for (dr, dc), weight in zip(offsets, weights.T, strict=True):
        moved = np.roll(values - 0.0, (-dr, -dc), axis=(0, 1))
        total += weight[:, None] * moved[:, :, None, :]
    out[whole] = total[whole]
    miss = np.abs(out[:, :, 0] - positions)
    fits = whole & (miss <= _tolerance(out[:, :, 0] - positions)).all(axis=-1)
    return out, fits


def _tolerance(miss: Float) -> Float:
    """By how much (m,) px a point may miss what its neighbours predict: a fixed part, and the field's own scatter."""
    flat = miss.reshape(-1, miss.shape[-1])
    flat = flat[np.isfinite(flat).all(axis=-1)]
    scatter = 1.4826 * np.median(np.abs(flat), axis=0) if len(flat) else np.zeros(miss.shape[-1])
    return np.asarray(_JUMP_PX + _JUMP_SD * scatter)


def _spread(coefficients: Float, known: Bool, shown: Float, tolerance: Float) -> Bool:
    """Extend the quadratics, in place, by one point each way; return where there are some."""
    rows, cols = known.shape
    ring = ndimage.binary_dilation(known, np.ones((3, 3))) & ~known
    r, k = np.nonzero(ring)
    found = np.full((8, len(r), *coefficients.shape[2:]), np.nan)
    steps = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
    for one, (dr, dc) in zip(found, steps, strict=True):
        a, b = r + dr, k + dc
        there = (a >= 0) & (a < rows) & (b >= 0) & (b < cols)
        there[there] = known[a[there], b[there]]
        one[there] = _moved(coefficients[a[there], b[there]], -float(dc), -float(dr))
    mean = np.nanmean(found, axis=0)
    with np.errstate(invalid="ignore"):
        apart = np.nanmax(found[:, :, 0], axis=0) - np.nanmin(found[:, :, 0], axis=0)
        off = np.abs(mean[:, 0] - shown[r, k])
        agree = ~(apart > _BEYOND_PX).any(axis=-1) & ~(off > _BEYOND_PX + tolerance).any(axis=-1)
    coefficients[r[agree], k[agree]] = mean[agree]
    out = known.copy()
    out[r[agree], k[agree]] = True
    return out


def _moved(c: Float, x: float, y: float) -> Float:
    """Coefficients (n, 6, m) of the same quadratics about a place ``x, y`` further on."""
    out = c.copy()
    out[:, 0] = c[:, 0] + x * c[:, 1] + y * c[:, 2] + x * x * c[:, 3] + x * y * c[:, 4] + y * y * c[:, 5]
    out[:, 1] = c[:, 1] + 2.0 * x * c[:, 3] + y * c[:, 4]
    out[:, 2] = c[:, 2] + x * c[:, 4] + 2.0 * y * c[:, 5]
    return out
