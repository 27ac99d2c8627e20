"""Prediction of a quantity from its neighbours if it varies smoothly over the image, with any shape of variation.

About every point a quadratic is fitted to the neighbours within some subsets, without the point itself. Slopes and
bends have a prior, so that a fit with few neighbours on one side stays a fit, with the uncertainty that it has there.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from stereorig.core.arrays import Float, Float32

_ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_TERMS = len(_ORDERS)


class SurfacePrediction(NamedTuple):
    """Prediction of a value from its neighbours.

    Attributes
    ----------
    value
        (r, c).
    variance
        (r, c) its variance over the variance of a value of weight 1; large with few neighbours.
    """

    value: Float
    variance: Float


def predict_from_neighbours(
    values: Float, weights: Float, reach: int, *, slope_precision: float, bend_precision: float
) -> SurfacePrediction:
    """Fit a quadratic to the neighbours of each point of a grid, and evaluate it at the point.

    Parameters
    ----------
    values
        (r, c); values of weight 0 may be any finite number.
    weights
        (r, c) inverse variances, relative to a value of weight 1.
    reach
        Points to each side that count as neighbours.
    slope_precision, bend_precision
        Inverse variances of the prior of a slope and of a bend over ``reach`` points, relative to a value of weight 1.

    Returns
    -------
    Prediction
        Value and variance for each point, without its own value.
    """
    u = np.arange(-reach, reach + 1) / reach
    window = (1.0 - np.abs(u) ** 3 / 1.05) ** 3  # the tricube of local regression, which ends softly
    powers = [(window * u**k).astype(np.float32) for k in range(5)]
    w = np.asarray(weights, np.float32)
    v = np.asarray(weights * values, np.float32)

    def moment(a: Float32, i: int, j: int) -> Float:
        return np.asarray(
            cv2.sepFilter2D(a, cv2.CV_32F, powers[i], powers[j], borderType=cv2.BORDER_CONSTANT), np.float64
        ).ravel()

    moments = {(i, j): moment(w, i, j) for i in range(5) for j in range(5 - i)}
    # at the window's middle only the constant is not zero
    own = float(powers[0][reach]) ** 2
    moments[0, 0] = np.maximum(moments[0, 0] - own * w.ravel(), 0.0)
    right = [moment(v, i, j) for i, j in _ORDERS]
    right[0] = right[0] - own * v.ravel()
    prior = (1e-9, slope_precision, slope_precision, *(bend_precision,) * 3)
    value, variance = _solve_first(
        [[moments[a[0] + b[0], a[1] + b[1]] for b in _ORDERS] for a in _ORDERS], right, prior
    )
    shape = values.shape
    return SurfacePrediction(value.reshape(shape), variance.reshape(shape))


def _solve_first(matrix: list[list[Float]], right: list[Float], prior: tuple[float, ...]) -> tuple[Float, Float]:
    """Return the first unknown of many symmetric systems, and the first element of the inverse.

    Elimination from the last unknown up, over all systems at once: the remaining first row is its Schur complement.
    """
    m = {(i, j): matrix[i][j] + (prior[i] if i == j else 0.0) for i in range(_TERMS) for j in range(i + 1)}
    r = list(right)
    for k in range(_TERMS - 1, 0, -1):
        for i in range(k):
            factor = m[k, i] / m[k, k]
            for j in range(i + 1):
                m[i, j] = m[i, j] - factor * m[k, j]
            r[i] = r[i] - factor * r[k]
    first = np.maximum(m[0, 0], 1e-9)
    return r[0] / first, 1.0 / first
