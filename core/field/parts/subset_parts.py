"""Effect of a part of a subset on its match: the match without it, to first order, from the residuals.

A part on another face, with another motion, or with something else in front pulls the whole subset's match towards its
own. Without the part the match then moves by more than the noise explains (Hausman's test of two estimates of which one
holds the other's data; with single rows left out it is known as DFBETA).

A thing in front of the subset's centre, as a wire, may pull it nowhere. The result then belongs to the surface behind:
the centre does not show the matched surface. The centre is compared with the match of the half of the subset that
matches best (least trimmed squares), since the thing changes gain and match, and so all residuals.

A curved patch on a fold of the surface absorbs most of it: the parabola next to |t|, -1 < t < 1, is 3/16 off in the
middle, and the remaining residuals are small in each part. Without half of the subset the rest must be extended to the
centre, which noise spoils. One more unknown, a fold through the centre, shows it: the change of the match with it is
compared with its standard deviation like the change without a part (an added variable's test).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincinv

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.subset_residuals import SubsetResiduals

_CELLS = 6  # across a subset
_MOST = 0.6  # share of a subset's cells in a part
_LEAST_SHARE = 0.02  # share of the whole's variance: the linear step is no better
_TINY_VARIANCE = 1.0 / 12.0  # variance by rounding
# half widths of a subset's centre that must show the matched surface, over the subset
_CENTRES = (1.0 / 6.0, 1.0 / 10.0)
_CENTRE_LOSS = 0.2  # share of the texture's variance
_CENTRE_SIGMAS = 5.0  # standard deviations of the mean square of so many pixels, over the half that matches best
_STEPS = 3  # towards that half
_SOLVED_AT_ONCE = 1024  # normal equations
_FOLDS = 8  # directions
_FAINT = 0.5  # share of the smallest other centre's addition to a subset's residuals: gain and match absorb some of it


class Pull(NamedTuple):
    """The part of a subset that pulls most, for m subsets in one comparison.

    Attributes
    ----------
    significance
        (m, 2) change of the match without the part, over its standard deviation by white noise; along and across.
    shift_px
        (m, 2, p) change of the match without each of the parts, or with each of the folds, px.
    sigma_px
        (m, 2) standard deviation of the whole's match by white noise as large as its residuals.
    part
        (m, 2) the most significant one.
    centre
        (m,) mean square of the residuals of the subset's centre in the match of its best half, over the largest that
        one surface with white noise has.
    """

    significance: Float
    shift_px: Float
    sigma_px: Float
    part: NDArray[np.intp]
    centre: Float


def pull_of_parts(found: SubsetResiduals, visible: Bool, degree: int, *, folds: Sequence[int] = ()) -> Pull:
    """Return the effect of the parts of subsets on their match, in one comparison.

    Parameters
    ----------
    found
        Residuals of m subsets.
    visible
        (m, s, s) True where a pixel counts.
    degree
        Degree of the patch.
    folds
        Directions (0 along, 1 across) of which a fold of the shift, through the centre, is tried too.
    """
    columns = _columns(found, degree)
    sums, counts = _sums_of_cells(columns, visible)
    k = sums.shape[-1] - 1  # the last column is the residual
    centre = [0, 6 if degree == 2 else 3]
    whole, n = sums.sum(axis=1), counts.sum(axis=1)
    size = 1e-9 * np.trace(whole[:, :k, :k], axis1=1, axis2=2)[:, None, None]
    ridge = size * np.eye(k)
    of_whole, variances = _solved(whole, ridge)
    residual = whole[:, k, k] - np.einsum("mi,mi->m", of_whole, whole[:, :k, k])
    residual = np.maximum(residual / np.maximum(n - k, 1.0), _TINY_VARIANCE)
    usual = of_whole[:, centre], variances[:, centre]
    masks = _parts()
    together = max(_SOLVED_AT_ONCE // max(len(n), 1), 1)  # parts: a few subsets are not worth a step each
    changes = []
    for first in range(0, len(masks), together):
        some = masks[first : first + together]
        kept = np.stack([whole - sums[:, mask].sum(axis=1) for mask in some])
        left = n - some.astype(np.float64) @ counts.T
        changes.append(_change(kept, left, ridge, centre, usual))
    for direction in folds:
        folded = _with_folds(columns, centre[direction], visible, whole)
        changes.append(_change(folded, n, size * np.eye(k + 1), centre, usual))
    shift, significance = (np.moveaxis(np.concatenate(each), 0, -1) for each in zip(*changes, strict=True))
    part = significance.argmax(axis=-1)
    return Pull(
        np.take_along_axis(significance, part[..., None], axis=-1)[..., 0],
        shift,
        np.sqrt(variances[:, centre] * residual[:, None]),
        part,
        _centre(found, columns, visible, sums, counts, of_whole, ridge),
    )


def _change(
    sums: Float, pixels: Float, ridge: Float, centre: list[int], usual: tuple[Float, Float]
) -> tuple[Float, Float]:
    """Change of the match by other normal equations, and its significance (p, m, 2 each).

    Parameters
    ----------
    sums, pixels
        (p, m, q, q) the products, and how many pixels (p, m) or (m,) are in them.
    ridge
        (m, q - 1, q - 1) added to them.
    centre
        Which two unknowns are the match.
    usual
        The whole subset's match and its variance by noise of one grey level, (m, 2) each.
    """
    k = sums.shape[-1] - 1
    match, variances = _solved(sums, ridge)
    scatter = sums[..., k, k] - np.einsum("pmi,pmi->pm", match, sums[..., :k, k])
    noise = np.maximum(scatter / np.maximum(pixels - k, 1.0), _TINY_VARIANCE)
    by_noise = np.maximum(variances[..., centre] - usual[1], _LEAST_SHARE * usual[1])
    shift = match[..., centre] - usual[0]
    sure = np.abs(shift) / np.sqrt(by_noise * noise[..., None])
    return shift, np.where((pixels > 3 * k)[..., None], sure, 0.0)


def _with_folds(columns: Float, folded: int, visible: Bool, whole: Float) -> Float:
    """Products (p, m, q + 1, q + 1) with a fold of a shift, over lines of each direction, before the residual.

    Parameters
    ----------
    columns
        (m, s, s, q).
    folded
        The column of that shift.
    visible
        (m, s, s).
    whole
        (m, q, q) products of the columns.
    """
    m, width, _, q = columns.shape
    v, u = (np.mgrid[:width, :width] - width // 2) / (width // 2)
    others = [*range(q - 1), q]
    out = np.zeros((_FOLDS, m, q + 1, q + 1))
    for one, angle in zip(out, np.pi / _FOLDS * np.arange(_FOLDS), strict=True):
        fold = columns[..., folded] * np.abs(np.cos(angle) * u + np.sin(angle) * v) * visible
        one[np.ix_(range(m), others, others)] = whole
        cross = (fold.reshape(m, 1, -1) @ columns.reshape(m, -1, q))[:, 0]
        one[:, q - 1, others] = one[:, others, q - 1] = cross
        one[:, q - 1, q - 1] = np.einsum("mij,mij->m", fold, fold)
    return out


def _columns(found: SubsetResiduals, degree: int) -> Float:
    """(m, s, s, q) derivatives of the residuals, then gain and offset, then the residuals."""
    width = found.residual.shape[1]
    v, u = (np.mgrid[:width, :width] - width // 2) / (width // 2)
    plane = [np.ones_like(u), u, v]
    full = [*plane, u * u, u * v, v * v] if degree == 2 else plane
    columns = [found.along * b for b in full] + [found.across * b for b in plane]
    columns += [np.ones_like(found.residual), found.reference, found.residual]
    return np.stack(columns, axis=-1)


def _sums_of_cells(columns: Float, visible: Bool) -> tuple[Float, Float]:
    """Products (m, cells, q, q) of the columns summed over the cells, and the cells' pixels (m, cells)."""
    m, width, _ = visible.shape
    table = columns if visible.all() else columns * visible[..., None]
    edges = _edges(width)
    q = table.shape[-1]
    sums, counts = np.empty((m, _CELLS, _CELLS, q, q)), visible
    for axis in (1, 2):
        counts = np.add.reduceat(counts, edges[:-1], axis=axis, dtype=np.int64)
    for i in range(_CELLS):
        for j in range(_CELLS):
            cell = (slice(None), slice(edges[i], edges[i + 1]), slice(edges[j], edges[j + 1]))
            rows = table[cell].reshape(m, -1, q)
            sums[:, i, j] = np.swapaxes(rows, 1, 2) @ rows
    return sums.reshape(m, -1, q, q), counts.reshape(m, -1).astype(np.float64)


def _solved(sums: Float, ridge: Float) -> tuple[Float, Float]:
    """Unknowns (..., k) of normal equations, and the diagonal (..., k) of their inverse."""
    k = sums.shape[-1] - 1
    inverse = np.linalg.inv(sums[..., :k, :k] + ridge)
    return (inverse @ sums[..., :k, k:])[..., 0], np.diagonal(inverse, axis1=-2, axis2=-1)


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


def outside_centre() -> Bool:
    """Return (p + folds,) True of the parts that hold no cell of the subset's centre; no fold is one."""
    middle = _parts().reshape(-1, _CELLS, _CELLS)[:, 2:-2, 2:-2]
    return np.concatenate([~middle.any(axis=(1, 2)), np.zeros(2 * _FOLDS, bool)])


def pixels_without(part: NDArray[np.intp], width: int) -> Bool:
    """Return (m, width, width) True at the pixels of subsets that are not in their parts (m,)."""
    cell = np.repeat(np.arange(_CELLS), np.diff(_edges(width)))
    return np.asarray(~_parts()[part][:, _CELLS * cell[:, None] + cell])


def _edges(width: int) -> NDArray[np.intp]:
    return np.round(np.linspace(0, width, _CELLS + 1)).astype(int)


def _centre(
    found: SubsetResiduals, columns: Float, visible: Bool, sums: Float, counts: Float, match: Float, ridge: Float
) -> Float:
    """(m,) loss of the centre in the match of the best half; zero where all residuals are less than it would make."""
    out = np.zeros(len(match))
    k, width = match.shape[1], visible.shape[1]
    smallest = min((2 * _reach(part, width) + 1) ** 2 for part in _CENTRES) / width**2
    whole = sums.sum(axis=1)
    some = np.flatnonzero(whole[:, k, k] > _FAINT * _CENTRE_LOSS * smallest * whole[:, k - 1, k - 1])
    if len(some):
        half = _best_half(sums[some], counts[some], match[some], ridge[some])
        part_of = SubsetResiduals(*(values[some] for values in found))
        out[some] = _centre_loss(part_of, columns[some], visible[some], *half)
    return out


def _reach(part: float, width: int) -> int:
    return max(round(part * width), 2)


def _best_half(sums: Float, counts: Float, match: Float, ridge: Float) -> tuple[Float, Float]:
    """Match (m, k) of the half of the cells with the least residuals, and (m,) all residuals' mean square from it.

    Parameters
    ----------
    sums, counts
        Sums and numbers of pixels of the cells.
    match
        (m, k) where to start.
    ridge
        (m, k, k) added to normal equations.
    """
    k = match.shape[1]
    half = sums.shape[1] // 2
    for _ in range(_STEPS):
        square = (
            sums[:, :, k, k]
            - 2.0 * np.einsum("mck,mk->mc", sums[:, :, k, :k], match)
            + np.einsum("mcij,mi,mj->mc", sums[:, :, :k, :k], match, match)
        )
        order = np.argsort(np.where(counts > 0, square / np.maximum(counts, 1.0), np.inf), axis=1)[:, :half]
        best = np.take_along_axis(sums, order[..., None, None], axis=1).sum(axis=1)
        match = np.linalg.solve(best[:, :k, :k] + ridge, best[:, :k, k:])[..., 0]
    n = np.take_along_axis(counts, order, axis=1).sum(axis=1)
    left = np.maximum(best[:, k, k] - np.einsum("mi,mi->m", match, best[:, :k, k]), 0.0)
    # the best half of white noise has less than its share
    a = 0.5 * np.maximum(counts.sum(axis=1) / counts.shape[1], 1.0)
    share = 2.0 * gammainc(a + 1.0, gammaincinv(a, 0.5))
    return match, np.maximum(left / np.maximum(n - k, 1.0), _TINY_VARIANCE) / share


def _centre_loss(found: SubsetResiduals, columns: Float, visible: Bool, match: Float, usual: Float) -> Float:
    """(m,) mean square of the centre's residuals in a match, over the most that is to be expected of ``usual``."""

    def energy(values: Float, seen: Bool) -> Float:
        return np.asarray((values**2 * seen).sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1))

    width, k = visible.shape[1], match.shape[1]
    texture = energy(found.reference, visible)
    out = np.zeros(len(texture))
    for part in _CENTRES:
        reach = _reach(part, width)
        middle = (slice(None), *(slice(width // 2 - reach, width // 2 + reach + 1),) * 2)
        seen = visible[middle]
        by_chance = 1.0 + _CENTRE_SIGMAS * np.sqrt(2.0 / np.maximum(seen.sum(axis=(1, 2)), 1))
        left = columns[middle][..., k] - np.einsum("mijk,mk->mij", columns[middle][..., :k], match)
        out = np.maximum(out, energy(left, seen) / np.maximum(_CENTRE_LOSS * texture, by_chance * usual))
    return out
