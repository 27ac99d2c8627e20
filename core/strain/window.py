"""Slopes of positions and displacements over square windows of points, and the propagation of noise into them.

Parameters of the fits are the points' column and row in the grid. A fit is linear in the data: reference and deformed
positions are fitted by the same weights, so that rigid motion and even stretch are reproduced exactly, for any shape of
the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.region.window import (
    connected_points,
    distinct_windows,
    fit_terms,
    steps_of,
    ways_cut,
    window_offsets,
)
from stereorig.core.strain.arcs import reduced_moments, second_moments, second_weights, third_moments
from stereorig.core.strain.options import StrainOptions
from stereorig.core.strain.reduced import whole_sums, window_sums
from stereorig.core.strain.result import StrainStatus

_AT_ONCE = 1024
_VALUES_AT_ONCE = 1_000_000  # values of one quantity: large windows come in smaller batches
_RANK = 1e-14


@dataclass(frozen=True, eq=False)
class Quadratics:
    """Fits of quadratics over m windows that planes were fitted to, and the terms that the planes leave out.

    Attributes
    ----------
    status
        (m,) int8, :class:`StrainStatus`.
    slope, spread, moments, weights
        The same as in :class:`Slopes`, from quadratics.
    bent
        (m, 2, 3) sums of s^2/2, s t, t^2/2 about the point with the planes' weights: the slopes' error by second
        derivatives.
    """

    status: np.ndarray
    slope: Float
    spread: Float
    moments: Float
    weights: Float
    bent: Float


class Correlation:
    """Correlation of the errors of a window's points, by distance, so that windows are filtered along rows and columns.

    Parameters
    ----------
    shared
        The correlation of neighbouring points' errors.
    step
        Distance of neighbouring columns and rows, px.
    half
        Points to each side of a window's middle.
    """

    def __init__(self, shared: SharedPixels, step: tuple[float, float], half: int) -> None:
        lag = np.arange(-2 * half, 2 * half + 1)
        down, size, along = np.linalg.svd(shared.correlation(lag[None, :] * step[0], lag[:, None] * step[1]))
        between = np.subtract.outer(np.arange(2 * half + 1), np.arange(2 * half + 1)) + 2 * half
        self._pairs = [
            (s * down[:, i][between], along[i][between]) for i, s in enumerate(size) if s > _RANK * float(size[0])
        ]
        offsets, _ = window_offsets(half)
        self._place = (offsets + half) @ np.array([2 * half + 1, 1])

    def spread(self, weights: Float) -> Float:
        """Covariance (m, a, a) of sums with weights (m, a, n), in units of a point's."""
        m, a, n = weights.shape
        side = len(self._pairs[0][0])
        by_place = np.empty((m, a, n))
        by_place[..., self._place] = weights
        square = by_place.reshape(m, a, side, side)
        together = sum(down @ square @ along.T for down, along in self._pairs)
        return np.asarray(np.einsum("maij,mbij->mab", together, square))


@dataclass(frozen=True, eq=False)
class ReducedWindows:
    """Inputs for fits over windows that edges, holes or cuts have reduced.

    Attributes
    ----------
    values
        (r, c, 6) X Y Z U V W, mm.
    valid
        (r, c) True at points that have values.
    correlation
        Correlation of the errors of a window's points.
    options
        Window, order, limits.
    """

    values: Float
    valid: Bool
    correlation: Correlation
    options: StrainOptions

    def sums(self, rows: np.ndarray, cols: np.ndarray, which: np.ndarray, weights: Float) -> Float:
        """Weighted sums (m, a, 6) of the values about points (m,), see :func:`.strain.reduced.window_sums`."""
        return window_sums(self.values, rows, cols, which, weights, self.options.window // 2, from_centre=True)

    def fitted(
        self, rows: np.ndarray, cols: np.ndarray, kinds: Bool, which: np.ndarray, order: int
    ) -> tuple[np.ndarray, Float, Float, Float, Float]:
        """Status, slope, spread, third moments and weights of windows' fits, as in :class:`Slopes`.

        ``kinds`` and ``which`` are :func:`distinct_windows` of those about points (m,).
        """
        half = self.options.window // 2
        found, by_kind = _weights(kinds, half, order, self.options)
        spread, moments = self.correlation.spread(by_kind), reduced_moments(by_kind, kinds, half, order)
        slope = np.swapaxes(self.sums(rows, cols, which, by_kind), 1, 2)
        return found[which], slope, spread[which], moments[which], by_kind[which]

    def quadratics(
        self, rows: np.ndarray, cols: np.ndarray, kinds: Bool, which: np.ndarray, planes: Float
    ) -> Quadratics:
        """Return the quadratics of windows, as :meth:`fitted` takes them, with weights (m, 2, n) of planes."""
        raised = self.fitted(rows, cols, kinds, which, 2)
        return Quadratics(*raised, second_moments(planes, self.options.window // 2))


@dataclass(frozen=True, eq=False)
class Slopes:
    """Slopes at (r, c) points; values of points whose status is not ``OK`` are undefined.

    Attributes
    ----------
    status
        (r, c) int8, :class:`StrainStatus`.
    slope
        (r, c, 6, 2) of X Y Z U V W over column and row, mm a step.
    spread
        (r, c, 2, 2) sum of c_k rho_kl c_l^T: the slopes' covariance in units of a point's.
    second
        (r, c, 6, 3) second derivatives of X Y Z and of X + U, Y + V, Z + W: over column twice, both, row twice.
    moments
        (r, c, 2, 4) :func:`stereorig.core.strain.arcs.third_moments` of the weights.
    reduced
        Windows that edges, holes or cuts have reduced, in batches: rows (m,), columns (m,), and weights (m, 2, n) of
        the points of ``window_offsets`` in the slopes.
    seen
        With order ``auto`` the same batches' (m, n) True at the windows' connected points; else empty.
    windows
        Inputs for fits over reduced windows.
    second_spread
        With order ``auto`` (r, c, 3, 3) covariance of ``second`` in units of a point's, zero if undetermined.
    """

    status: np.ndarray
    slope: Float
    spread: Float
    second: Float
    moments: Float
    reduced: list[tuple[np.ndarray, np.ndarray, Float]]
    windows: ReducedWindows
    seen: list[Bool] = field(default_factory=list)
    second_spread: Float | None = None


def window_slopes(
    values: Float, valid: Bool, xy_px: Float, cuts: Cuts | None, options: StrainOptions, shared: SharedPixels
) -> Slopes:
    """Fit the window about each valid point.

    Parameters
    ----------
    values
        (r, c, 6) X Y Z U V W, mm.
    valid
        (r, c) True at points that have values.
    xy_px
        (r, c, 2) the grid, px.
    cuts
        Cuts, which no window crosses.
    options
        Window, order, limits.
    shared
        The correlation of neighbouring points' errors.
    """
    half = options.window // 2
    offsets, _ = window_offsets(half)
    step = steps_of(xy_px)
    whole = ndimage.minimum_filter(valid, size=options.window, mode="constant", cval=False)
    crossed = ways_cut(valid, xy_px, cuts, half)
    whole &= ~crossed.any(axis=-1) if crossed is not None else True
    status = np.where(valid, StrainStatus.OK, StrainStatus.NO_POINT).astype(np.int8)
    slope, second = _whole_windows(values, half)
    spread = np.zeros((*valid.shape, 2, 2))
    c = plane_weights(half)
    down, along = (np.subtract.outer(o, o).astype(np.float64) for o in offsets.T)
    rho = shared.correlation(along * step[0], down * step[1])
    del down, along
    spread[...] = c @ rho @ c.T
    moments = np.empty((*valid.shape, 2, 4))
    moments[...] = third_moments(c, half)
    second_spread = None
    if options.order == "auto":
        every = second_weights(np.ones((1, len(offsets)), bool), half)[0]
        second_spread = np.where(whole[..., None, None], every @ rho @ every.T, 0.0)
    del rho
    windows = ReducedWindows(values, valid, Correlation(shared, step, half), options)
    rows, cols = np.nonzero(valid & ~whole)
    reduced, connected = [], []
    there = np.pad(valid, half)
    at_once = min(_AT_ONCE, max(_VALUES_AT_ONCE // len(offsets), 1))
    for first in range(0, len(rows), at_once):
        r, k = rows[first : first + at_once], cols[first : first + at_once]
        here = (r + half) * there.shape[1] + k + half
        seen = connected_points(there, here, None if crossed is None else crossed[r, k], half)
        kinds, which = distinct_windows(seen)
        bending = second_weights(kinds, half)
        bent = np.swapaxes(windows.sums(r, k, which, bending), 1, 2)
        bent[:, 3:] += bent[:, :3]  # sums of the displacement, then of the deformed position
        second[r, k] = bent
        status[r, k], slope[r, k], spread[r, k], moments[r, k], weights = windows.fitted(
            r, k, kinds, which, 2 if options.order == 2 else 1
        )
        reduced.append((r, k, weights))
        if second_spread is not None:
            second_spread[r, k] = windows.correlation.spread(bending)[which]
            connected.append(seen)
    return Slopes(status, slope, spread, second, moments, reduced, windows, connected, second_spread)


def plane_weights(half: int) -> Float:
    """(2, n) weights of a whole window's points in its slopes over column and row."""
    offsets, _ = window_offsets(half)
    return np.asarray(offsets[:, ::-1].T / float((offsets[:, 0] ** 2).sum()))


def _whole_windows(values: Float, half: int) -> tuple[Float, Float]:
    """Slopes (r, c, 6, 2) of whole windows by planes or quadratics, and the second derivatives as :class:`Slopes` has.

    A line's weights one way and equal ones the other give a slope.
    """
    side = np.arange(-half, half + 1, dtype=np.float64)
    bent = side**2 - (side**2).mean()
    line, ones, twice = side / (side**2).sum(), np.full(len(side), 1.0 / len(side)), 2.0 * bent / (bent**2).sum()
    down = np.stack([ones, line, twice])
    sums = whole_sums(values, down, np.stack([line, ones, twice, line, ones]), (0, 1, 0, 1, 2))
    sums = np.moveaxis(sums, 2, 3)
    slope, second = sums[..., :2], sums[..., 2:]
    second[..., 3:, :] += second[..., :3, :]  # of the displacement, then of the deformed position
    return slope, second


def _weights(seen: Bool, half: int, order: int, options: StrainOptions) -> tuple[np.ndarray, Float]:
    """Status (m,) and weights (m, 2, n) of the points in the slopes; zero outside the window."""
    offsets, _ = window_offsets(half)
    A = fit_terms(offsets, half, order)
    n, terms = A.shape
    count = seen.sum(axis=1)
    normal = (seen.astype(np.float64) @ (A[:, :, None] * A[:, None, :]).reshape(n, -1)).reshape(-1, terms, terms)
    few = count < max(options.min_share * n, terms)
    firm = np.linalg.eigvalsh(normal)[:, 0] > 1e-9 * count
    normal = np.where((firm & ~few)[:, None, None], normal, np.eye(terms))
    inverse = np.linalg.inv(normal)
    noise = np.linalg.eigvalsh(inverse[:, 1:3, 1:3])[:, -1] * float((A[:, 1] ** 2).sum())
    one_sided = ~firm | (noise > options.max_amplification**2)
    status = np.where(few, StrainStatus.TOO_FEW, np.where(one_sided, StrainStatus.ONE_SIDED, StrainStatus.OK))
    weights = (inverse[:, 1:3].reshape(-1, terms) / half @ A.T).reshape(-1, 2, n)
    return status.astype(np.int8), np.where(seen[:, None, :], weights, 0.0)
