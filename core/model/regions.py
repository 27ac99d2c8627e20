"""Verdict by region: chi-square of the difference's means over tiles, under their joint covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of, steps_px
from stereorig.core.robust import chi_square_tail

_MIN_SHARE = 0.4  # share of a tile's points; smaller rests at the rim join a neighbour
_SMALL = 1e-10  # share of the largest eigenvalue: rounding makes a direction without variance this large


@dataclass(frozen=True, eq=False)
class Tiles:
    """A field's points by regions.

    Attributes
    ----------
    number
        (r, c) int32 of each compared point's tile, -1 for none.
    count
        Number of tiles.
    """

    number: NDArray[np.int32]
    count: int

    def means(self, values: Float) -> Float:
        """Return the means (t, ...) of values (r, c, ...) over the tiles."""
        inside = self.number >= 0
        out = np.zeros((self.count, *values.shape[2:]))
        np.add.at(out, self.number[inside], values[inside])
        return out / self.points.reshape(-1, *([1] * (values.ndim - 2)))

    @property
    def points(self) -> NDArray[np.int64]:
        """(t,) number of points in each tile."""
        return np.bincount(self.number[self.number >= 0], minlength=self.count)


@dataclass(frozen=True)
class ChiSquare:
    """A chi-square and its probability.

    Attributes
    ----------
    chi_square, degrees
        The statistic and its degrees of freedom.
    probability
        Probability of a larger one, if the model is right; NaN without degrees of freedom.
    """

    chi_square: float
    degrees: int
    probability: float

    @staticmethod
    def of(difference: Float, covariance: Float) -> ChiSquare:
        """Return the verdict on a difference (n,) by its covariance (n, n); directions without any do not count."""
        T = whitening(covariance)
        chi, degrees = float(((T @ difference) ** 2).sum()), len(T)
        return ChiSquare(chi, degrees, chi_square_tail(chi, degrees))


def whitening(covariance: Float) -> Float:
    """Return T (q, n) with T C T' = 1, q the rank of the covariance C (n, n): T' T is its inverse, if it has one."""
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    value, vector = np.linalg.eigh(covariance / scale[:, None] / scale)
    kept = value > _SMALL * max(float(value[-1]), _SMALL)
    return np.asarray((vector[:, kept] / np.sqrt(value[kept])).T / scale)


def tiles_of(field: Field, compared: Bool, *, width_px: float) -> Tiles:
    """Divide the compared points into square tiles of about a width, px; rests at the rim join a neighbour."""
    rows, cols = np.nonzero(compared)
    number = np.full(field.shape, -1, np.int32)
    if not len(rows):
        return Tiles(number, 0)
    step_x, step_y = steps_px(field)
    ways = []
    for at, step in ((rows, step_y), (cols, step_x)):
        low, span = at.min(), at.max() - at.min() + 1
        parts = max(1, round(span * step / width_px))
        ways.append(((at - low) * parts // span).astype(np.int64))
    across = ways[1].max() + 1
    tile = ways[0] * across + ways[1]
    whole = np.bincount(tile).max()
    middle = {int(t): (rows[tile == t].mean(), cols[tile == t].mean()) for t in np.unique(tile)}
    big = [t for t in middle if (tile == t).sum() >= _MIN_SHARE * whole]
    for t in [t for t in middle if t not in big]:
        nearest = min(big, key=lambda b: (middle[b][0] - middle[t][0]) ** 2 + (middle[b][1] - middle[t][1]) ** 2)
        tile[tile == t] = nearest
    names, tile = np.unique(tile, return_inverse=True)
    number[rows, cols] = tile
    return Tiles(number, len(names))


def own_covariance_of_means(field: Field, tiles: Tiles, covariance: Float, shared: SharedPixels) -> Float:
    """Return (3 t, 3 t) covariance of the tiles' means from the points' own noise and the pixels that they share.

    Parameters
    ----------
    field
        The grid.
    tiles
        The regions.
    covariance
        (r, c, 3, 3) of each point's difference.
    shared
        The correlation of neighbouring points.

    Notes
    -----
    With S the roots of the points' covariances and rho the correlation, the covariance of tiles s and t is the sum over
    their points i and j of ``S_i rho_ij S_j / (n_s n_t)``.
    """
    index = np.full(field.shape, -1, np.int64)
    rows, cols = np.nonzero(tiles.number >= 0)
    n = len(rows)
    index[rows, cols] = np.arange(n)
    rho = _correlation(field, index, shared)
    tile = tiles.number[rows, cols]
    roots = roots_of(covariance[rows, cols]) / tiles.points[tile][:, None, None]
    out = np.zeros((3 * tiles.count, 3 * tiles.count))
    at = (3 * tile[:, None] + np.arange(3)).ravel()
    for m in range(3):
        W = csr_array((roots[:, :, m].ravel(), (at, np.repeat(np.arange(n), 3))), shape=(3 * tiles.count, n))
        out += (W @ rho @ W.T).toarray()
    return 0.5 * (out + out.T)


def _correlation(field: Field, index: NDArray[np.int64], shared: SharedPixels) -> csr_array:
    step_x, step_y = steps_px(field)
    reach_x, reach_y = int(np.ceil(shared.reach_px / step_x)), int(np.ceil(shared.reach_px / step_y))
    reach_x, reach_y = min(reach_x, field.shape[1] - 1), min(reach_y, field.shape[0] - 1)
    rows, cols = np.nonzero(index >= 0)
    lag_x, lag_y = np.arange(-reach_x, reach_x + 1), np.arange(-reach_y, reach_y + 1)
    kernel = shared.correlation(lag_x[None, :] * step_x, lag_y[:, None] * step_y)
    padded = np.pad(index, ((reach_y, reach_y), (reach_x, reach_x)), constant_values=-1)
    i, j, value = [], [], []
    for a, dy in enumerate(lag_y):
        for b, dx in enumerate(lag_x):
            if kernel[a, b] == 0.0:
                continue
            other = padded[rows + reach_y + dy, cols + reach_x + dx]
            there = np.flatnonzero(other >= 0)
            i.append(index[rows[there], cols[there]])
            j.append(other[there])
            value.append(np.full(len(there), kernel[a, b]))
    n = len(rows)
    return csr_array((np.concatenate(value), (np.concatenate(i), np.concatenate(j))), shape=(n, n))


def holm(probabilities: Float, level: float) -> Bool:
    """Return which of several hypotheses are refuted at a level for all of them together (Holm's step-down test)."""
    order = np.argsort(np.where(np.isnan(probabilities), 1.0, probabilities))
    out = np.zeros(len(probabilities), bool)
    for k, i in enumerate(order):
        if not probabilities[i] <= level / (len(probabilities) - k):
            break
        out[i] = True
    return out
