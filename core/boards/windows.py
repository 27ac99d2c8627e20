"""Maximum-likelihood fit of one small picture a point: crossed edges of a checkerboard, or the rim of a dot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float

Model = Callable[[Float, Float, Float], tuple[Float, Float]]
WeightOf = Callable[[NDArray[np.intp], Float, Float], Float]

_STEPS = 40
_SETTLED_PX = 1e-6
_AT_ONCE = 2_000_000  # samples times parameters held in memory


@dataclass(frozen=True)
class FittedWindows:
    """Fits of all windows.

    Attributes
    ----------
    parameters
        (n, p), the first two the position in the image.
    sigma_px
        (n,) standard deviation of the position per axis, from the residuals of the window's own fit.
    good
        (n,) True where the window held samples enough and the fit ended at finite numbers.
    """

    parameters: Float
    sigma_px: Float
    good: Bool


def sample(image: Float, xy_px: Float) -> Float:
    """Return the grey levels (...) of the pixels nearest to positions (..., 2), of the border outside the image."""
    rows, columns = image.shape
    x = np.clip(np.rint(xy_px[..., 0]), 0, columns - 1).astype(int)
    y = np.clip(np.rint(xy_px[..., 1]), 0, rows - 1).astype(int)
    return np.asarray(image[y, x])


def fit_windows(image: Float, start: Float, radius_px: int, weight_of: WeightOf, model: Model) -> FittedWindows:
    """Fit a model to the grey levels around each start.

    Parameters
    ----------
    image
        (rows, columns).
    start
        (n, p) start parameters; the first two are x and y.
    radius_px
        Half side of the square windows, about the rounded start.
    weight_of
        From the points' indices (k,) and the samples' offsets dx, dy (k, m) to the start: weights (k, m), 0 where a
        sample is not used.
    model
        From parameters (n, p) and samples x, y (n, m): values (n, m) and derivatives (n, m, p).
    """
    n, p = start.shape
    side = 2 * radius_px + 1
    chunk = max(1, _AT_ONCE // (side * side * p))
    parts = [
        _fit_chunk(image, start[first : first + chunk], radius_px, weight_of, model, first)
        for first in range(0, n, chunk)
    ]
    if not parts:
        return FittedWindows(start.copy(), np.full(0, np.nan), np.zeros(0, dtype=bool))
    return FittedWindows(
        np.concatenate([part.parameters for part in parts]),
        np.concatenate([part.sigma_px for part in parts]),
        np.concatenate([part.good for part in parts]),
    )


def _fit_chunk(
    image: Float, start: Float, radius_px: int, weight_of: WeightOf, model: Model, first: int
) -> FittedWindows:
    n, p = start.shape
    rows, columns = image.shape
    offsets = np.arange(-radius_px, radius_px + 1, dtype=np.float64)
    dy, dx = (d.ravel() for d in np.meshgrid(offsets, offsets, indexing="ij"))
    x = np.rint(start[:, :1]) + dx
    y = np.rint(start[:, 1:2]) + dy
    inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
    grey = sample(image, np.stack([x, y], axis=-1))
    weight = np.where(inside, weight_of(np.arange(first, first + n), x - start[:, :1], y - start[:, 1:2]), 0.0)
    params = start.copy()
    damping = np.full(n, 1e-3)
    value, jac = model(params, x, y)
    cost = np.sum(weight * (grey - value) ** 2, axis=1)
    open_ = np.ones(n, dtype=bool)
    for _ in range(_STEPS):
        jw = jac * weight[..., None]
        normal = np.einsum("nmi,nmj->nij", jw, jac, optimize=True)
        gradient = np.einsum("nmi,nm->ni", jw, grey - value, optimize=True)
        diagonal = np.einsum("nii->ni", normal)
        scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-12))
        scaled = normal * scale[:, :, None] * scale[:, None, :]
        scaled[:, range(p), range(p)] += damping[:, None]
        step = np.linalg.solve(scaled, (gradient * scale)[..., None])[..., 0] * scale
        step = np.where(open_[:, None] & np.isfinite(step), step, 0.0)
        trial = params + step
        trial_value, trial_jac = model(trial, x, y)
        trial_cost = np.sum(weight * (grey - trial_value) ** 2, axis=1)
        better = trial_cost <= cost
        params = np.where(better[:, None], trial, params)
        value = np.where(better[:, None], trial_value, value)
        jac = np.where(better[:, None, None], trial_jac, jac)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping * 0.2, damping * 10.0)
        moved = np.abs(step[:, :2]).max(axis=1)
        open_ &= ~((better & (moved < _SETTLED_PX)) | (damping > 1e8))
        if not open_.any():
            break
    jw = jac * weight[..., None]
    normal = np.einsum("nmi,nmj->nij", jw, jac, optimize=True)
    count = (weight > 0.0).sum(axis=1)
    noise2 = cost / np.maximum(count - p, 1)
    diagonal = np.maximum(np.einsum("nii->ni", normal), 1e-300)
    scale = 1.0 / np.sqrt(diagonal)
    well = np.isfinite(normal).all(axis=(1, 2))
    scaled = np.where(well[:, None, None], normal * scale[:, :, None] * scale[:, None, :], np.eye(p))
    covariance = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True) * scale[:, :, None] * scale[:, None, :]
    sigma = np.sqrt(np.maximum(0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]), 0.0) * noise2)
    good = well & (count > 2 * p) & np.isfinite(params).all(axis=1) & np.isfinite(sigma)
    return FittedWindows(params, sigma, good)
