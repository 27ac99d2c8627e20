"""Robust statistics: standard deviation from the median, Tukey's biweight, spread samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal errors over the median of their absolute values."""
BIWEIGHT_REACH = 4.685
"""Standard deviations beyond which the biweight is zero: 95 % efficiency on normal errors."""
_GOLDEN_SECTION = 0.6180339887498949


def median(values: Float) -> float:
    """Return the median of numbers (n,); NaN if one of them is NaN.

    It equals ``np.median``, which takes several times as long for a thousand numbers.
    """
    n = len(values)
    parted = np.partition(values, [(n - 1) // 2, n // 2, n - 1])
    if np.isnan(parted[-1]):  # sorted last
        return float("nan")
    return 0.5 * float(parted[(n - 1) // 2] + parted[n // 2])


def biweight(squared: Float) -> Float:
    """Return Tukey's weights, from one down to zero.

    Parameters
    ----------
    squared
        (n,) squares of the residuals over ``BIWEIGHT_REACH`` times their standard deviation.
    """
    return np.where(squared < 1.0, (1.0 - squared) ** 2, 0.0)


def spread_indices(n: int, count: int) -> NDArray[np.int64]:
    """Return ``count`` indices below n, spread by multiples of the golden section; some may be equal."""
    return (n * (_GOLDEN_SECTION * np.arange(count) % 1.0)).astype(int)


# Tails of the distributions that tests compare with.
#
# The same figures as ``scipy.stats`` gives, from the functions that it calls: loading it takes a third of a second of
# every start, and nothing else of it is needed.


def chi_square_tail(statistic: float, degrees: float) -> float:
    """Return the probability that a chi-square of so many degrees of freedom is larger; NaN without any."""
    from scipy.special import chdtrc  # slow to load, and not every start needs it

    return float(chdtrc(degrees, np.maximum(statistic, 0.0))) if degrees > 0 else float("nan")


def f_tail(statistic: float, degrees: float, degrees_left: float) -> float:
    """Return the probability that F of so many degrees of freedom, above and below, is larger; NaN without any."""
    from scipy.special import fdtrc  # slow to load, and not every start needs it

    if not (degrees > 0 and degrees_left > 0):
        return float("nan")
    return float(fdtrc(degrees, degrees_left, np.maximum(statistic, 0.0)))


def two_sided_sigmas(probability: float) -> float:
    """Return how many standard deviations a normal error is farther off with this probability, to either side."""
    from scipy.special import ndtri  # slow to load, and not every start needs it

    return float(-ndtri(probability / 2.0))
