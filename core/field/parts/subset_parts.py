"""What a part of a subset does to its match: the match without it, to first order, from the residuals.

A part that lies on another face, moves otherwise, or shows something else pulls the whole subset's match towards its
own. Without the part the match then moves by more than the noise explains (Hausman's test of two estimates of which
one holds the other's data; with single rows left out it is known as DFBETA).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.field.parts.subset_residuals import SubsetResiduals

_CELLS = 6  # across a subset
_MOST = 0.6  # of a subset's cells in a part
_LEAST_SHARE = 0.02  # of the whole's variance: the linear step is no better
_TINY_VARIANCE = 1.0 / 12.0  # of rounding
_CENTRES = (1.0 / 6.0, 1.0 / 10.0)  # half of a subset's centre that must be what it seems, over the subset
_CENTRE_LOSS = 0.2  # of the texture's variance
_CENTRE_SIGMAS = 5.0  # of the mean square of so many pixels, over the whole subset's


class Pull(NamedTuple):
    """The part of a subset that pulls most, for m subsets in one comparison.

    Attributes
    ----------
    significance
        (m, 2) change of the match without the part, over its standard deviation by white noise; along and across.
    shift_px
        (m, 2, p) change of the match without each of the parts, px.
    sigma_px
        (m, 2) standard deviation of the whole's match by white noise as large as its residuals.
    part
        (m, 2) the most significant one.
    other_centre
        (m,) True where the subset's centre shows something else than its surroundings' match.
    """

    significance: Float
    shift_px: Float
    sigma_px: Float
    part: NDArray[np.intp]
    other_centre: Bool


def pull_of_parts(found: SubsetResiduals, visible: Bool, degree: int) -> Pull:
    """Return what the parts of subsets do to their match, in one comparison.

    Parameters
    ----------
    found
        Residuals of m subsets.
    visible
        (m, s, s) True where a pixel counts.
    degree
        Of the patch.
    """
    sums, counts = _sums_of_cells(found, visible, degree)
    k = sums.shape[-1] - 1  # the last column is the residual
    centre = [0, 6 if degree == 2 else 3]
    whole, n = sums.sum(axis=1), counts.sum(axis=1)
    ridge = 1e-9 * np.trace(whole[:, :k, :k], axis1=1, axis2=2)[:, None, None] * np.eye(k)
    of_whole, variances = _solved(whole, ridge)
    residual = whole[:, k, k] - np.einsum("mi,mi->m", of_whole, whole[:, :k, k])
    residual = np.maximum(residual / np.maximum(n - k, 1.0), _TINY_VARIANCE)
    masks = _parts()
    shift = np.empty((len(n), 2, len(masks)))
    significance = np.empty_like(shift)
    for p, mask in enumerate(masks):
        kept = whole - sums[:, mask].sum(axis=1)
        left = n - counts[:, mask].sum(axis=1)
        of_rest, of_rests = _solved(kept, ridge)
        scatter = kept[:, k, k] - np.einsum("mi,mi->m", of_rest, kept[:, :k, k])
        noise = np.maximum(scatter / np.maximum(left - k, 1.0), _TINY_VARIANCE)
        by_noise = np.maximum(of_rests[:, centre] - variances[:, centre], _LEAST_SHARE * variances[:, centre])
        shift[:, :, p] = (of_rest - of_whole)[:, centre]
        enough = left > 3 * k
        significance[:, :, p] = np.where(
            enough[:, None], np.abs(shift[:, :, p]) / np.sqrt(by_noise * noise[:, None]), 0.0
        )
    part = significance.argmax(axis=-1)
    return Pull(
        np.take_along_axis(significance, part[..., None], axis=-1)[..., 0],
        shift,
        np.sqrt(variances[:, centre] * residual[:, None]),
        part,
        _other_centre(found, visible),
    )


def _sums_of_cells(found: SubsetResiduals, visible: Bool, degree: int) -> tuple[Float, Float]:
    """Products (m, cells, q, q) of the columns summed over the cells, and the cells' pixels (m, cells)."""
    m, width, _ = found.residual.shape
    v, u = (np.mgrid[:width, :width] - width // 2) / (width // 2)
    plane = [np.ones_like(u), u, v]
    full = [*plane, u * u, u * v, v * v] if degree == 2 else plane
    columns = [found.along * b for b in full] + [found.across * b for b in plane]
    columns += [np.ones_like(found.residual), found.reference, found.residual]
    table = np.stack(columns, axis=-1) * visible[..., None]
    edges = np.round(np.linspace(0, width, _CELLS + 1)).astype(int)
    q = table.shape[-1]
    sums, counts = np.empty((m, _CELLS, _CELLS, q, q)), np.empty((m, _CELLS, _CELLS))
    for i in range(_CELLS):
        for j in range(_CELLS):
            cell = (slice(None), slice(edges[i], edges[i + 1]), slice(edges[j], edges[j + 1]))
            rows = table[cell].reshape(m, -1, q)
            sums[:, i, j] = np.swapaxes(rows, 1, 2) @ rows
            counts[:, i, j] = visible[cell].sum(axis=(1, 2))
    return sums.reshape(m, -1, q, q), counts.reshape(m, -1)


def _solved(sums: Float, ridge: Float) -> tuple[Float, Float]:
    """Unknowns (m, k) of normal equations, and the diagonal (m, k) of their inverse."""
    k = sums.shape[-1] - 1
    inverse = np.linalg.inv(sums[:, :k, :k] + ridge)
    return (inverse @ sums[:, :k, k:])[..., 0], np.diagonal(inverse, axis1=1, axis2=2)


@lru_cache(maxsize=1)
def _parts() -> NDArray[np.bool_]:
    """(p, cells) the parts: strips from each side, corners, bands across."""
    a, b = np.mgrid[:_CELLS, :_CELLS]
    last = _CELLS - 1
    parts = []
    for k in range(1, _CELLS // 2 + 1):
        parts += [a < k, a > last - k, b < k, b > last - k]
    for k in range(1, _CELLS + 1):
        parts += [a + b < k, a + b > 2 * last - k, a - b > last - k, b - a > last - k]
    for k in range(1, last):
        parts += [a == k, b == k]
    for k in (1, 2):
        parts += [row & col for row in (a <= k, a >= last - k) for col in (b <= k, b >= last - k)]
    small = [part.ravel() for part in parts if part.mean() <= _MOST]
    return np.asarray(np.unique(np.array(small), axis=0))


def _other_centre(found: SubsetResiduals, visible: Bool) -> Bool:
    def energy(values: Float, seen: Bool) -> Float:
        return np.asarray((values**2 * seen).sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1))

    width = found.residual.shape[1]
    texture, usual = energy(found.reference, visible), energy(found.residual, visible)
    out = np.zeros(len(texture), bool)
    for part in _CENTRES:
        reach = max(round(part * width), 2)
        middle = (slice(None), *(slice(width // 2 - reach, width // 2 + reach + 1),) * 2)
        seen = visible[middle]
        by_chance = 1.0 + _CENTRE_SIGMAS * np.sqrt(2.0 / np.maximum(seen.sum(axis=(1, 2)), 1))
        out |= energy(found.residual[middle], seen) > np.maximum(_CENTRE_LOSS * texture, by_chance * usual)
    return out
