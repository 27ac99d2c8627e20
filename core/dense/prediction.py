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
from core.field.region.window import fit_terms, steps_of, ways_cut, window_offsets

_WIDTHS = (1.5, 1.0, 0.7)
"""Half widths of the windows that quadratics are fitted to, in subsets. The wider has the less noise in its curvature,
which is what reaches a vector: its value is measured anew. The narrower serve where it does not fit."""
_MIN_HALF = 2  # points; fewer leave nothing to judge a quadratic by

_JUMP_PX, _JUMP_SD = 0.01, 6.0
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
    rows, cols, m = positions.shape
    spacing = min(steps_of(xy_px))
    halves = sorted({max(int(np.ceil(width * subset_px / spacing)), _MIN_HALF) for width in _WIDTHS}, reverse=True)
    rim = int(np.ceil((subset_px // 2 + 1) / spacing))
    wide = ((rim, rim), (rim, rim))
    shown = np.pad(np.where(measured[..., None], positions, np.nan), (*wide, (0, 0)), constant_values=np.nan)
    coefficients = np.full((*shown.shape[:2], 6, m), np.nan)
    known = np.zeros(shown.shape[:2], bool)
    inside = np.pad(measured, rim)
    narrow, whole = _quadratics(xy_px, positions, measured, cuts, halves[-1])
    scatter = _scatter((narrow[:, :, 0] - positions)[whole]) / _share_left(halves[-1], spacing, subset_px)
    for half in halves:
        found, whole = (narrow, whole) if half == halves[-1] else _quadratics(xy_px, positions, measured, cuts, half)
        tolerance = _JUMP_PX + _JUMP_SD * scatter * _share_left(half, spacing, subset_px)
        with np.errstate(invalid="ignore"):
            fits = whole & (np.abs(found[:, :, 0] - positions) <= tolerance).all(axis=-1)
        layer = np.pad(found, (*wide, (0, 0), (0, 0)), constant_values=np.nan)
        reached = np.pad(fits, rim)
        for _ in range(half):  # to the rim, where the same quadratic goes on
            reached = _spread(layer, reached, shown, _JUMP_PX + _JUMP_SD * scatter, inside)
        new = reached & ~known
        coefficients[new] = layer[new]
        known |= new
        if known[inside].all():
            break
    for _ in range(rim):
        known = _spread(coefficients, known, shown, _JUMP_PX + _JUMP_SD * scatter, ~inside)
    c = coefficients
    nodes = np.stack([c[:, :, 0], c[:, :, 1], c[:, :, 2], c[:, :, 4]], axis=-1)
    inner = known[rim : rim + rows, rim : rim + cols] & measured
    return Prediction(
        nodes=np.ascontiguousarray(np.where(known[..., None, None], nodes, 0.0)),
        known=known,
        cells=inner[1:, 1:] & inner[1:, :-1] & inner[:-1, 1:] & inner[:-1, :-1],
        rim=rim,
    )


def _quadratics(xy_px: Float, positions: Float, measured: Bool, cuts: Cuts | None, half: int) -> tuple[Float, Bool]:
    """Coefficients (r, c, 6, m) of 1, x, y, x^2, x y, y^2, offsets in points, and where whole windows have them."""
    rows, cols, m = positions.shape
    out = np.full((rows, cols, 6, m), np.nan)
    if min(rows, cols) < 2 * half + 1:
        return out, np.zeros(measured.shape, bool)
    whole = ndimage.minimum_filter(measured, size=2 * half + 1, mode="constant", cval=False)
    crossed = ways_cut(measured, xy_px, cuts, half)
    if crossed is not None:
        whole &= ~crossed.any(axis=-1)
    if not whole.any():
        return out, whole
    place = np.arange(-half, half + 1) / half
    middle = np.nanmean(np.where(measured[..., None], positions, np.nan), axis=(0, 1))
    values = np.where(measured[..., None], positions - middle, 0.0)
    by_x = [ndimage.correlate1d(values, place**a, axis=1, mode="constant") for a in range(3)]
    moments = np.stack(
        [ndimage.correlate1d(by_x[a], place**b, axis=0, mode="constant")[whole]
         for a, b in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))], axis=1
    )  # fmt: skip
    terms = fit_terms(window_offsets(half)[0], half, 2)
    scale = np.array([1.0, half, half, half**2, half**2, half**2])[:, None]
    found = np.einsum("ij,njm->nim", np.linalg.inv(terms.T @ terms) / scale, moments)
    found[:, 0] += middle
    out[whole] = found
    return out, whole


def _share_left(half: int, spacing_px: float, subset_px: int) -> float:
    """What a quadratic leaves of its middle point's noise, as a standard deviation: neighbours share pixels."""
    offsets, _ = window_offsets(half)
    lag = np.abs(offsets[:, None, :] - offsets[None, :, :]) * (spacing_px / subset_px)
    shared = np.maximum(1.0 - lag, 0.0).prod(axis=-1)
    terms = fit_terms(offsets, half, 2)
    left = -np.linalg.solve(terms.T @ terms, terms.T)[0]
    left[0] += 1.0  # the middle comes first
    return float(np.sqrt(max(left @ shared @ left, 1e-6)))


def _scatter(values: Float) -> Float:
    """Robust standard deviation (m,) of values (n, m) about zero."""
    return np.asarray(1.4826 * np.median(np.abs(values), axis=0)) if len(values) else np.zeros(values.shape[1])


def _spread(coefficients: Float, known: Bool, shown: Float, tolerance: Float, where: Bool) -> Bool:
    """Extend the quadratics, in place, by one point each way, to points ``where``; return where there are some."""
    rows, cols = known.shape
    r, k = np.nonzero(ndimage.binary_dilation(known, np.ones((3, 3), bool)) & ~known & where)
    if len(r) == 0:
        return known
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
        agree = ~(apart > _BEYOND_PX).any(axis=-1) & ~(off > tolerance).any(axis=-1)
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
