"""The common factor of a field: a few columns that all its points share, for unit causes.

The covariance of points i and j is that of their own matching, where they share pixels, plus F_i F_j'. Pushed through
the weights of a mean, a distance or a strain and then squared, F does not shrink when points are averaged and cancels
where it must.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import Float
from core.cameras.stereo import StereoPair
from core.common.derivatives import measured_derivatives
from core.errors import CalibrationInputError

KEPT = 0.999
"""Share of each point's common variance that the columns hold at least."""
_NEGATIVE = 1e-9  # of the largest eigenvalue: what rounding leaves of a covariance that is positive
_AT_ONCE = 20_000


@dataclass(frozen=True, eq=False)
class ParameterCovariance:
    """Covariance of the cameras' parameters, by name.

    Attributes
    ----------
    pair
        The cameras.
    names
        ``cam1.`` or ``cam2.`` and a name of the camera's parameters.
    covariance
        (p, p), units of the parameters.
    """

    pair: StereoPair
    names: Sequence[str]
    covariance: Float

    def root(self) -> Float:
        """Return L (p, q) with L L' the covariance, without directions of no variance.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive``.
        """
        sd = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        scale = np.where(sd > 0.0, sd, 1.0)  # px, rad and 1/px^2 beside one another
        value, vector = np.linalg.eigh(self.covariance / scale[:, None] / scale)
        if value[0] < -_NEGATIVE * max(value[-1], 1.0):
            raise CalibrationInputError(
                f"The covariance of the cameras' parameters has an eigenvalue of {value[0]:.3g} (of correlations).",
                code="covariance_not_positive",
                remedy="Calibrate anew, or take the covariance out of the file; results then do not include it.",
            )
        kept = value > 0.0
        return np.asarray(scale[:, None] * vector[:, kept] * np.sqrt(value[kept]))


def common_factor(source: ParameterCovariance, points_mm: Float, displaced_mm: Float | None = None) -> Float:
    """Return the common factor of points, with as few columns as hold :data:`KEPT` of each point's common variance.

    Parameters
    ----------
    source
        What is common.
    points_mm
        (n, 3) points at the reference, system frame, all finite.
    displaced_mm
        (n, 3) their current positions.

    Returns
    -------
    Float
        (n, 3, k) of X, Y, Z, or (n, 6, k) of X, Y, Z, U, V, W: mm for unit causes.

    Raises
    ------
    CalibrationInputError
        ``covariance_not_positive``.
    """
    L, size = source.root(), 3 if displaced_mm is None else 6
    whole = np.empty((len(points_mm), size, L.shape[1]))
    for first in range(0, len(points_mm), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        now = None if displaced_mm is None else displaced_mm[part]
        whole[part] = measured_derivatives(source.pair, points_mm[part], source.names, now) @ L
    return fewest_columns(whole)


def fewest_columns(factor: Float, kept: float = KEPT) -> Float:
    """Turn a factor (n, m, q) into one of fewer columns that keeps at least a share of each component's variance.

    Columns may be mixed by any rotation: F R has the same F F'. Singular vectors of the rows, each divided by its own
    standard deviation, put most variance into the first ones.
    """
    n, m, q = factor.shape
    rows = factor.reshape(n * m, q)
    variance = (rows**2).sum(axis=1)
    if n == 0 or not (variance > 0.0).any():
        return np.zeros((n, m, 0))
    weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0.0)
    _, vector = np.linalg.eigh(rows.T @ (weight[:, None] * rows))
    turned = rows @ vector[:, ::-1]
    share = np.cumsum(turned**2, axis=1) * weight[:, None]
    worst = np.where(variance[:, None] > 0.0, share, 1.0).min(axis=0)
    count = int(np.argmax(worst >= kept)) + 1 if worst[-1] >= kept else q
    return np.asarray(turned[:, :count].reshape(n, m, count))
