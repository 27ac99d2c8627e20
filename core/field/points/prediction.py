"""The smooth prediction of a dense field: the place of each pixel of camera 1's reference in the other images.

It is made of an ordinary field's own positions: about each point a quadratic of the positions of its window, and
between points the bicubic polynomial that has the values and slopes of these at its four corners. Windows of points end
at cuts, at empty points and at jumps, so a prediction belongs to one smooth part of the surface. It extends past the
outermost points as far as their subsets reach, and ends at a place that two parts would share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.region.window import fit_terms, steps_of, ways_cut, window_offsets

WIDTHS = (1.5, 1.0, 0.7)
"""Half widths of the windows that quadratics are fitted to, in subsets. The wider has less noise in its curvature,
which is the only part that reaches a vector: a vector's value is measured. It is taken if its curvature differs from
the narrowest one's by less than the narrowest one's noise, as the field's rms; and the narrower serve at points that it
does not fit.
"""
_MIN_HALF = 2  # points; fewer leave nothing to judge a quadratic by

_JUMP_PX, _JUMP_SD = 0.01, 6.0
_TINY_PX = 2e-4
_BEYOND_PX = 0.1  # largest difference between neighbours' predictions outside the outermost points


@dataclass(frozen=True, eq=False)
class Prediction:
    """Bicubic polynomials between the points of an ordinary field, and a rim of points beyond it.

    Attributes
    ----------
    nodes
        (r + 2 rim, c + 2 rim, m, 4) of m image coordinates, px: value, slope along columns, along rows, and mixed
        derivative, per spacing.
    seen
        (r + 2 rim - 1, c + 2 rim - 1) True between four points with a prediction that continue one another.
    cells
        (r - 1, c - 1) True if these four are measured points: only there are vectors.
    rim
        Points beyond the field on each side.
    """

    nodes: Float
    seen: Bool
    cells: Bool
    rim: int


def predict(
    xy_px: Float,
    positions: Float,
    measured: Bool,
    cuts: Cuts | None,
    *,
    subset_px: int,
    widths: tuple[float, ...] = WIDTHS,
) -> Prediction:
    """Return the prediction of a field.

    Parameters
    ----------
    xy_px
        (r, c, 2) points of a regular grid in camera 1's reference image.
    positions
        (r, c, m) their image coordinates in other images, px.
    measured
        (r, c) True at valid points.
    cuts
        Lines that no window crosses.
    subset_px
        Width of the subset; the prediction reaches half of it beyond the outermost points.
    widths
        Half widths of the windows, subsets, the widest first.
    """
    rows, cols, m = positions.shape
    spacing = min(steps_of(xy_px))
    halves = sorted({max(int(np.ceil(width * subset_px / spacing)), _MIN_HALF) for width in widths}, reverse=True)
    rim = int(np.ceil((subset_px // 2 + 1) / spacing))
    wide = ((rim, rim), (rim, rim))
    shown = np.pad(np.where(measured[..., None], positions, np.nan), (*wide, (0, 0)), constant_values=np.nan)
    coefficients = np.full((*shown.shape[:2], 6, m), np.nan)
    known = np.zeros(shown.shape[:2], bool)
    inside = np.pad(measured, rim)
    narrow, fitted = _quadratics(xy_px, positions, measured, cuts, halves[-1])
    scatter = _scatter((narrow[:, :, 0] - positions)[fitted]) / _share_left(halves[-1], spacing, subset_px)
    for half in halves:
        found, whole = (narrow, fitted) if half == halves[-1] else _quadratics(xy_px, positions, measured, cuts, half)
        if half != halves[-1] and _bends(found, narrow, (half, halves[-1]), scatter, spacing, subset_px):
            continue
        tolerance = _JUMP_PX + _JUMP_SD * scatter * _share_left(half, spacing, subset_px)
        with np.errstate(invalid="ignore"):
            fits = whole & (np.abs(found[:, :, 0] - positions) <= tolerance).all(axis=-1)
        layer = np.pad(found, (*wide, (0, 0), (0, 0)), constant_values=np.nan)
        reached = np.pad(fits, rim)
        for _ in range(half):  # to the rim, with the same quadratic
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
    tolerance = _JUMP_PX + _JUMP_SD * scatter
    seen = _continuous(c, known, np.maximum(tolerance, _BEYOND_PX))
    within = known & inside
    cells = seen & _continuous(c, within, tolerance)
    return Prediction(
        nodes=np.ascontiguousarray(np.where(known[..., None, None], nodes, 0.0)),
        seen=seen & ~(_all_four(within) & ~cells),
        cells=cells[rim : rim + rows - 1, rim : rim + cols - 1],
        rim=rim,
    )


def _all_four(points: Bool) -> Bool:
    """Cells (r - 1, c - 1) with all four corners."""
    return np.asarray(points[1:, 1:] & points[1:, :-1] & points[:-1, 1:] & points[:-1, :-1])


def _continuous(c: Float, known: Bool, tolerance: Float) -> Bool:
    """Cells (r - 1, c - 1) with all four corners, along whose sides each quadratic meets the next point's value."""

    def meet(a: Float, b: Float, x: float, y: float) -> Bool:
        with np.errstate(invalid="ignore"):
            there = np.abs(_value(a, x, y) - b[..., 0, :]) <= tolerance
            back = np.abs(_value(b, -x, -y) - a[..., 0, :]) <= tolerance
        return np.asarray((there & back).all(axis=-1))

    along = meet(c[:, :-1], c[:, 1:], 1.0, 0.0)
    down = meet(c[:-1], c[1:], 0.0, 1.0)
    return _all_four(known) & along[1:] & along[:-1] & down[:, 1:] & down[:, :-1]


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
        [
            ndimage.correlate1d(by_x[a], place**b, axis=0, mode="constant")[whole]
            for a, b in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
        ]
    )
    terms = fit_terms(window_offsets(half)[0], half, 2)
    scale = np.array([1.0, half, half, half**2, half**2, half**2])[:, None]
    solution = np.linalg.inv(terms.T @ terms) / scale
    found = np.empty((len(moments[0]), 6, m))
    for i, row in enumerate(solution):  # half of it is zero: even and odd terms do not mix
        found[:, i] = sum(row[j] * moments[j] for j in np.flatnonzero(np.abs(row) > 1e-12 * np.abs(row).max()))
    found[:, 0] += middle
    out[whole] = found
    return out, whole


def _share_left(half: int, spacing_px: float, subset_px: int) -> float:
    """Noise left after a window's quadratic is subtracted, over a point's noise: neighbours share pixels."""
    left = -_weights(half)[0]
    left[0] += 1.0  # the middle comes first
    return _noise_of(left, half, spacing_px, subset_px)


def _weights(half: int) -> Float:
    """Weights (6, n) of a whole window's points in its coefficients, offsets in half widths."""
    terms = fit_terms(window_offsets(half)[0], half, 2)
    return np.asarray(np.linalg.solve(terms.T @ terms, terms.T))


def _noise_of(weights: Float, half: int, spacing_px: float, subset_px: int) -> float:
    """Standard deviation of a weighted sum over a window's points, of standard deviation 1, that share pixels."""
    offsets, _ = window_offsets(half)
    lag = np.abs(offsets[:, None, :] - offsets[None, :, :]) * (spacing_px / subset_px)
    shared = np.maximum(1.0 - lag, 0.0).prod(axis=-1)
    return float(np.sqrt(max(weights @ shared @ weights, 1e-6)))


def _bends(
    wide: Float, narrow: Float, halves: tuple[int, int], scatter: Float, spacing_px: float, subset_px: int
) -> bool:
    """Return True if the curvature of wide windows misses more than the noise of narrow ones' adds to a vector.

    A vector is affected by the mean of the quadratic's second-order terms over its window. The field's scatter is the
    noise of one point.
    """
    moment = (subset_px / spacing_px) ** 2 / 12.0
    apart = moment * (wide[:, :, (3, 5)] - narrow[:, :, (3, 5)]).sum(axis=2)
    apart = apart[np.isfinite(apart).all(axis=-1)]
    if len(apart) == 0:
        return False
    weights = [_weights(half)[[3, 5]].sum(axis=0) * moment / half**2 for half in halves]
    both = weights[0].copy()
    both[: len(weights[1])] -= weights[1]  # a window's inner rings come first
    noise = [_noise_of(w, half, spacing_px, subset_px) for w, half in ((both, halves[0]), (weights[1], halves[1]))]
    return bool((np.mean(apart**2, axis=0) > (noise[0] ** 2 + noise[1] ** 2) * scatter**2 + _TINY_PX**2).any())


def _scatter(values: Float) -> Float:
    """Robust standard deviation (m,) of values (n, m) about zero."""
    return np.asarray(1.4826 * np.median(np.abs(values), axis=0)) if len(values) else np.zeros(values.shape[1])


def _spread(coefficients: Float, known: Bool, shown: Float, tolerance: Float, where: Bool) -> Bool:
    """Extend the quadratics, in place, by one point each way, to points ``where``; return the points with one."""
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


def _value(c: Float, x: float, y: float) -> Float:
    """Values (..., m) of quadratics (..., 6, m) at a place ``x, y`` further on."""
    terms = np.array([1.0, x, y, x * x, x * y, y * y])
    return np.asarray(sum(c[..., i, :] * terms[i] for i in np.flatnonzero(terms)))


def _moved(c: Float, x: float, y: float) -> Float:
    """Coefficients (..., 6, m) of the same quadratics about a place ``x, y`` further on."""
    out = c.copy()
    out[..., 0, :] = _value(c, x, y)
    out[..., 1, :] += 2.0 * x * c[..., 3, :] + y * c[..., 4, :]
    out[..., 2, :] += x * c[..., 4, :] + 2.0 * y * c[..., 5, :]
    return out
