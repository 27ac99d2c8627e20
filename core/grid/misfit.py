"""Residual common to all pieces of a family after the profile's fit, separated from the noise.

A lens's blur is no Gaussian: defocus is a disc, stray light has wide skirts, coma leans to one side. The difference of
a line from the profile P(d) is the same function f(d) in all pieces of a family, scaled by their contrast. It does not
change from picture to picture, and so is no noise: taken for noise it makes the claimed variance of a line's offset up
to twice the scatter. Each piece holds too few pixels to see f; all pieces of a family together show it by averages of
their residuals over distance. With it, of every piece

* the apparent offset and slope by f at the pixels' positions are subtracted;
* the noise is the remainder without f;
* and that noise, as a function v(d) of the distance, is propagated to the offset. Photons make the ground noisier than
  a dark line, and the offset feels only the edges between.
"""

from __future__ import annotations

from math import floor, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.grid.profile import (
    GUARD_BLURS,
    MIN_BOX,
    N_SHAPE,
    OUT,
    WIDTH_SEEN,
    close_normal,
    model_row,
    solve_cholesky,
)
from stereorig.core.grid.strip import strip_bounds, strip_pixels, strip_reach

_PER_PX = 8.0  # bins
_REACH_PX = 48.0
_BINS = 2 * int(_REACH_PX * _PER_PX) + 1
_MIN_COUNT = 8  # pixels in a bin
_NOISE_SMOOTHING_PX = 0.5
_LEAST_NOISE = 0.1  # share of the mean variance; below, clipped or noise-free pixels would decide


@njit(cache=True, nogil=True)
def _residuals(image: Float32, piece: Float, fit: Float, guard_blurs: float) -> tuple[Float, Float, Float, bool, float]:
    """Residuals, distances from the fitted line, design, whether the width was fitted, and the scale of t."""
    reach = strip_reach(piece, guard_blurs)
    x0, x1, y0, y1 = strip_bounds(piece, reach[0], image.shape[0], image.shape[1])
    room = (x1 - x0) * (y1 - y0)
    ts, ds, gs = np.empty(room), np.empty(room), np.empty(room)
    n = strip_pixels(image, piece, reach, 0.0, ts, ds, gs)
    a, b = max(abs(piece[2]), MIN_BOX), max(abs(piece[3]), MIN_BOX)
    scale = 1.0 / max(piece[4], 1.0)
    par = np.array([fit[0], fit[1] / scale, fit[7], fit[8] / scale, fit[9], fit[5], fit[10], fit[11]])
    fit_width = piece[14] > WIDTH_SEEN
    J = np.empty((n, N_SHAPE))
    r, distance = np.empty(n), np.empty(n)
    for k in range(n):
        r[k] = gs[k] - model_row(par, ts[k], ds[k], scale, a, b, fit_width, J[k])
        distance[k] = ds[k] - fit[0] - fit[1] * ts[k]
    return r, distance, J, fit_width, scale


@njit(cache=True, nogil=True)
def _inverse(J: Float, fit_width: bool, width: float, variance: float, C: Float) -> tuple[bool, float]:
    """Fill in the inverse of a piece's normal matrix; return whether there is one, and the weight of the width."""
    N = J.T @ J
    prior = close_normal(N, fit_width, width, variance)
    solved = True
    for row in range(N_SHAPE):
        unit = np.zeros(N_SHAPE)
        unit[row] = 1.0
        solved = solved and solve_cholesky(N.copy(), unit, C[row])
    return solved, prior


@njit(cache=True, nogil=True)
def _pool(
    image: Float32, pieces: Float, fits: Float, family: NDArray[np.intp], good: Bool, guard_blurs: float
) -> tuple[Float, Float, Float, Float]:
    """Sums over bins of distance, (2, _BINS): pixels, the part of their noise left by the fit, residuals, squares.

    Residuals are in units of the contrast. A fit follows the noise of the pixels that it depends on, at the edges, more
    than the others' noise.
    """
    count, free = np.zeros((2, _BINS)), np.zeros((2, _BINS))
    total, squares = np.zeros((2, _BINS)), np.zeros((2, _BINS))
    C = np.zeros((N_SHAPE, N_SHAPE))
    for k in range(len(pieces)):
        if not good[k]:
            continue
        r, distance, J, fit_width, _ = _residuals(image, pieces[k], fits[k], guard_blurs)
        solved, _ = _inverse(J, fit_width, pieces[k, 14], fits[k, 12] ** 2, C)
        if not solved:
            continue
        propagated = J @ C
        for i in range(len(r)):
            at = floor((distance[i] + _REACH_PX) * _PER_PX + 0.5)
            if 0 <= at < _BINS:
                taken = 0.0
                for j in range(N_SHAPE):
                    taken += propagated[i, j] * J[i, j]
                share = r[i] / fits[k, 5]
                count[family[k], at] += 1.0
                free[family[k], at] += 1.0 - taken
                total[family[k], at] += share
                squares[family[k], at] += share * share
    return count, free, total, squares


@njit(cache=True, nogil=True)
def _apply(
    image: Float32,
    pieces: Float,
    fits: Float,
    family: NDArray[np.intp],
    good: Bool,
    guard_blurs: float,
    count: Float,
    misfit: Float,
    noise: Float,
    out: Float,
) -> None:
    C = np.zeros((N_SHAPE, N_SHAPE))
    for k in range(len(pieces)):
        if not good[k]:
            continue
        r, distance, J, fit_width, scale = _residuals(image, pieces[k], fits[k], guard_blurs)
        solved, prior = _inverse(J, fit_width, pieces[k, 14], fits[k, 12] ** 2, C)
        n = len(r)
        common, v = np.empty(n), np.empty(n)
        dof = float(n - (N_SHAPE if fit_width else N_SHAPE - 1))
        for i in range(n):
            position = min(max((distance[i] + _REACH_PX) * _PER_PX, 0.0), _BINS - 1.001)
            at = floor(position)
            w = position - at
            common[i] = fits[k, 5] * ((1.0 - w) * misfit[family[k], at] + w * misfit[family[k], at + 1])
            v[i] = (1.0 - w) * noise[family[k], at] + w * noise[family[k], at + 1]
            # the pixel's own share in the averages
            dof -= 1.0 / max(count[family[k], floor(position + 0.5)], float(_MIN_COUNT))
        if not solved or dof < 1.0:
            continue
        variance = np.sum((r - common) ** 2 / v) / dof
        S = J.T @ (J * v.reshape(-1, 1))
        S[7, 7] += prior
        V = C @ S @ C * variance
        feigned = C @ (J.T @ common)
        out[k, 0] -= feigned[0]
        out[k, 1] -= feigned[1] * scale
        out[k, 2] = V[0, 0]
        out[k, 3] = V[0, 1] * scale
        out[k, 4] = V[1, 1] * scale * scale
        out[k, 6] = V[5, 5]
        out[k, 12] = sqrt(variance * np.mean(v))


def without_misfit(image: Float32, pieces: Float, fits: Float, *, family: NDArray[np.intp], good: Bool) -> Float:
    """Take the misfit common to each family's pieces off their offsets and their noise.

    Parameters
    ----------
    image, pieces
        As :func:`stereorig.core.grid.profile.fit_pieces` had them, with no search.
    fits
        (n, :data:`stereorig.core.grid.profile.OUTPUTS`) its result.
    family
        (n,) 0 or 1 of each piece.
    good
        (n,) pieces that show the misfit; the others keep their fit as it is.

    Returns
    -------
    Float
        The fits with new values of offset, slope, their covariance, the contrast's variance and the noise ``rms``.
    """
    out = fits.copy()
    table = np.ascontiguousarray(pieces, dtype=np.float64)
    usable = good & (fits[:, OUT["ok"]] > 0.0)
    count, free, total, squares = _pool(image, table, fits, family, usable, GUARD_BLURS)
    enough = count >= _MIN_COUNT
    misfit = np.where(enough, total / np.maximum(count, 1.0), 0.0)
    within = np.where(enough, np.maximum(squares - count * misfit**2, 0.0), 0.0)
    freedom = np.where(enough, free * (1.0 - 1.0 / np.maximum(count, 1.0)), 0.0)
    # the noise changes with the grey level, which has no detail finer than the blur
    sd = _NOISE_SMOOTHING_PX * _PER_PX
    weight, smooth = (gaussian_filter1d(values, sd, axis=1, mode="constant") for values in (freedom, within))
    noise = np.ones_like(within)
    for f in range(2):
        mean = float(within[f].sum() / max(freedom[f].sum(), 1.0))
        if mean > 0.0:
            local = np.divide(smooth[f], weight[f], out=np.full(_BINS, mean), where=weight[f] > 1.0)
            noise[f] = np.maximum(local / mean, _LEAST_NOISE)
    _apply(image, table, fits, family, usable, GUARD_BLURS, count, misfit, noise, out)
    return out
