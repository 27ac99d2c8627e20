"""A displacement smoothed by a polynomial over the window about each point.

Strain and gauges take the smoothed displacement; the next step of a sequence starts from the measured one. Positions,
rotations and stretches are each point's own and stay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, steps_px
from stereorig.core.field.points.smoothing_record import Order, Smoothing, check_smoothing, whole_weights
from stereorig.core.field.region.window import connected_points, fit_terms, ways_cut, window_offsets

_AT_ONCE = 1024
_FIRM = 1e-9
_NO_NOISIER = 1.0 + 1e-9


def smoothed_displacement(field: Field, window: int, *, subset_px: float, order: Order = 2) -> Field:
    """Return the field with its displacement smoothed.

    Each valid point takes the value in the middle of a polynomial that is fitted to the displacements of its window by
    least squares, all points alike. Cuts, holes and edges end a window; if a quadratic over the points left would be
    noisier than the point itself a plane replaces it, and if the plane would be noisier too the point keeps its own
    value. Invalid points stay invalid.

    Parameters
    ----------
    field
        A displacement on a regular grid, as it was measured.
    window
        Points across the square window, odd, 3 to 51.
    subset_px
        Width of the subset that the field was measured with.
    order
        1: planes; 2: quadratics, which keep the height of a curved displacement.

    Returns
    -------
    Field
        With ``smoothing``, and with the covariance of the smoothed displacement and of it with the position: from the
        window's points, whose errors correlate by the pixels that they share.

    Raises
    ------
    InputError
        ``smoothing_window_invalid``; ``smoothing_needs_motion`` for a shape; ``smoothed_already``; ``grid_irregular``.
    """
    check_smoothing(window, order)
    if field.uvw_mm is None:
        raise InputError(
            "the field is a shape and has no displacement.",
            code="smoothing_needs_motion",
            remedy="Give the field of a later step.",
        )
    if field.smoothing is not None:
        raise InputError(
            "the field was smoothed before.", code="smoothed_already", remedy="Smooth the field as it was measured."
        )
    half, step, valid = window // 2, steps_px(field), field.valid
    offsets, _ = window_offsets(half)
    lag = (offsets[:, None, :] - offsets[None, :, :]).astype(np.float64)
    rho = SharedPixels.of(field, subset_px).correlation(lag[..., 1] * step[0], lag[..., 0] * step[1])
    xy_px = np.stack([field.x_px, field.y_px], axis=-1)
    crossed = ways_cut(valid, xy_px, field.cuts, half)
    whole = ndimage.minimum_filter(valid, size=window, mode="constant", cval=False)
    if crossed is not None:
        whole &= ~crossed.any(axis=-1)
    held = _held(field)
    found = held.copy()
    found[whole] = _over_whole(held, window, order, rho)[whole]
    rows, cols = np.nonzero(valid & ~whole)
    there = np.pad(valid, half)
    padded = np.pad(held, ((half, half), (half, half), (0, 0))).reshape(-1, held.shape[-1])
    width, alone = there.shape[1], np.zeros(field.shape, bool)
    reach = offsets @ np.array([width, 1])
    for first in range(0, len(rows), _AT_ONCE):
        r, k = rows[first : first + _AT_ONCE], cols[first : first + _AT_ONCE]
        here = (r + half) * width + k + half
        seen = connected_points(there, here, None if crossed is None else crossed[r, k], half)
        weights, raw = _reduced_weights(seen, half, order, rho)
        alone[r, k] = raw
        found[r, k] = _sums(padded.take(here[:, None] + reach, axis=0), weights, rho)
    alone |= valid & ~_positive(found[..., 12:].reshape(*field.shape, 3, 3))
    found[alone] = held[alone]
    uvw, covariance = field.uvw_mm.copy(), field.covariance.copy()
    uvw[valid] = found[valid][:, :3]
    covariance[valid, :3, 3:] = found[valid][:, 3:12].reshape(-1, 3, 3)
    covariance[valid, 3:, :3] = np.swapaxes(covariance[valid, :3, 3:], -1, -2)
    covariance[valid, 3:, 3:] = found[valid][:, 12:].reshape(-1, 3, 3)
    resolution_px = (window - 1) * step[0] + subset_px
    mm_per_px = _mm_per_px(field, step)
    n_whole, n_raw = int((whole & ~alone).sum()), int(alone.sum())
    record = Smoothing(
        window=window,
        order=order,
        spacing_px=step[0],
        subset_px=subset_px,
        resolution_px=resolution_px,
        resolution_mm=None if np.isnan(mm_per_px) else resolution_px * mm_per_px,
        whole=n_whole,
        reduced=int(valid.sum()) - n_whole - n_raw,
        raw=n_raw,
    )
    return replace(field, uvw_mm=uvw, covariance=covariance, smoothing=record)


def _held(field: Field) -> Float:
    """(r, c, 21): U V W, then the covariance's blocks of position and displacement, and of displacement; else zero."""
    assert field.uvw_mm is not None
    c = field.covariance
    parts = [field.uvw_mm, c[..., :3, 3:].reshape(*field.shape, 9), c[..., 3:, 3:].reshape(*field.shape, 9)]
    return np.where(field.valid[..., None], np.concatenate(parts, axis=-1), 0.0)


def _positive(covariance: Float) -> Bool:
    """(r, c) True where a sum's covariance is one: among points of very unlike noise the formula may leave none."""
    C = covariance
    minor = C[..., 0, 0] * C[..., 1, 1] - C[..., 0, 1] * C[..., 1, 0]
    return np.asarray((C[..., 0, 0] > 0.0) & (minor > 0.0) & (np.linalg.det(C) > 0.0))


def _over_whole(held: Float, window: int, order: int, rho: Float) -> Float:
    """Sums (r, c, 21) over whole windows."""
    from scipy.signal import oaconvolve  # slow to load, and not every start needs it

    half = window // 2
    row, col = window_offsets(half)[0].T
    c = whole_weights(window, order)

    def over(weights: Float, values: Float) -> Float:
        kernel = np.zeros((window, window))
        kernel[row + half, col + half] = weights
        return np.asarray(oaconvolve(values, kernel[..., None], mode="same", axes=(0, 1)))  # even both ways

    parts = (c, held[..., :3]), (c * rho[0], held[..., 3:12]), (c * (rho @ c), held[..., 12:])
    return np.concatenate([over(weights, values) for weights, values in parts], axis=-1)


def _sums(values: Float, weights: Float, rho: Float) -> Float:
    """Sums (m, 21) over windows with weights of their own, ``values`` (m, n, 21) and ``weights`` (m, n)."""
    uvw = np.einsum("mn,mna->ma", weights, values[..., :3] - values[:, :1, :3]) + values[:, 0, :3]
    own = np.einsum("mn,mna->ma", weights * rho[0], values[..., 3:12])
    both = np.einsum("mn,mna->ma", weights * (weights @ rho), values[..., 12:])
    return np.concatenate([uvw, own, both], axis=-1)


def _reduced_weights(seen: Bool, half: int, order: int, rho: Float) -> tuple[Float, Bool]:
    """Weights (m, n) of a window's connected points, and (m,) True for windows left with their middle alone."""
    weights = np.zeros(seen.shape)
    weights[:, 0] = 1.0  # the window's middle comes first
    open_ = np.ones(len(seen), bool)
    for degree in range(order, 0, -1):
        index = np.flatnonzero(open_)
        tried, firm = _fitted(seen[index], half, degree)
        calm = firm & (((tried @ rho) * tried).sum(axis=1) <= _NO_NOISIER)
        weights[index[calm]] = tried[calm]
        open_[index[calm]] = False
    return weights, open_


def _fitted(seen: Bool, half: int, order: int) -> tuple[Float, Bool]:
    """Weights (m, n) of a fit's value in the middle, and (m,) True where the points determine the fit."""
    A = fit_terms(window_offsets(half)[0], half, order)
    n, terms = A.shape
    normal = (seen.astype(np.float64) @ (A[:, :, None] * A[:, None, :]).reshape(n, -1)).reshape(-1, terms, terms)
    firm = np.linalg.eigvalsh(normal)[:, 0] > _FIRM * n
    normal = np.where(firm[:, None, None], normal, np.eye(terms))
    return np.where(seen, np.linalg.inv(normal)[:, 0] @ A.T, 0.0), firm


def _mm_per_px(field: Field, step: tuple[float, float]) -> float:
    """Median length of a pixel on the surface, along rows and columns; NaN where no two neighbours are valid."""
    found = []
    for axis, distance_px in ((1, step[0]), (0, step[1])):
        length = np.linalg.norm(np.diff(field.xyz_mm, axis=axis), axis=-1) / distance_px
        found.append(length[np.isfinite(length)])
    every = np.concatenate(found)
    return float(np.median(every)) if len(every) else float("nan")
