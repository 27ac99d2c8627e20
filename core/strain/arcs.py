"""Curvature correction of strain: the bias of a window's fit on a surface that bends.

Along a surface whose metric is even, the third derivatives of the position have tangential parts that follow from the
second fundamental form b alone: from d_s d_s (x_s . x_s) = 0 comes x_sss . x_s = -b_ss^2, and so on. In a fit of planes
or quadratics they add to the slope, by the third moments of its weights. With b from quadratics over the window they
are subtracted. On a surface that keeps its shape they are the same before and after, and cancel.
"""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.region.window import fit_terms, window_offsets

_FIRM = 1e-6
_FACTORS = np.array([1.0 / 6.0, 0.5, 0.5, 1.0 / 6.0])  # factors of s^3, s^2 t, s t^2, t^3 in a Taylor series


def third_moments(weights: Float, half: int) -> Float:
    """Return (..., 2, 4) sums of slope weights (..., 2, n) times s^3/6, s^2 t/2, s t^2/2, t^3/6; s column, t row."""
    t, s = window_offsets(half)[0].T.astype(np.float64)
    return np.asarray(weights @ _thirds(s, t))


def reduced_moments(weights: Float, seen: Bool, half: int, order: int) -> Float:
    """Return the same (m, 2, 4) of windows that edges, holes or cuts have reduced.

    Planes give the slope in the middle of a window's connected points, quadratics that in the window's middle; the
    moments are about that position, where the second order has no effect on the slope.
    """
    if order == 2:
        return third_moments(weights, half)
    count = np.maximum(seen.sum(axis=1, keepdims=True), 1)
    t, s = (a - (a * seen).sum(axis=1, keepdims=True) / count for a in window_offsets(half)[0].T.astype(np.float64))
    return np.asarray(weights @ _thirds(s, t))


def second_moments(weights: Float, half: int) -> Float:
    """Return (m, 2, 3) sums of slope weights (m, 2, n) times s^2/2, s t, t^2/2 about the windows' middles."""
    t, s = window_offsets(half)[0].T.astype(np.float64)
    return np.asarray(weights @ np.stack([0.5 * s * s, s * t, 0.5 * t * t], axis=-1))


def _thirds(s: Float, t: Float) -> Float:
    """(..., n, 4) terms of a Taylor series."""
    ss, tt = s * s, t * t
    out = np.stack([ss * s, ss * t, s * tt, tt * t], axis=-1)
    out *= _FACTORS
    return np.asarray(out)


def second_weights(seen: Bool, half: int) -> Float:
    """Return weights (m, 3, n) of the windows' connected points in these derivatives; zero where undetermined."""
    A = fit_terms(window_offsets(half)[0], half, 2)
    n, terms = A.shape
    normal = (seen.astype(np.float64) @ (A[:, :, None] * A[:, None, :]).reshape(n, -1)).reshape(-1, terms, terms)
    firm = np.linalg.eigvalsh(normal)[:, 0] > _FIRM * n
    inverse = np.linalg.inv(np.where(firm[:, None, None], normal, np.eye(terms)))[:, 3:]
    weights = inverse.reshape(-1, terms) @ A.T * np.tile([2.0, 1.0, 2.0], len(seen))[:, None] / half**2
    return np.where(seen[:, None, :] & firm[:, None, None], weights.reshape(-1, 3, n), 0.0)
