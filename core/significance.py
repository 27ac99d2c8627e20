"""Tails of the distributions that tests compare with.

The same figures as ``scipy.stats`` gives, from the functions that it calls: loading it takes a third of a second of
every start, and nothing else of it is needed.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtri


def chi_square_tail(statistic: float, degrees: float) -> float:
    """Return the probability that a chi-square of so many degrees of freedom is larger; NaN without any."""
    return float(chdtrc(degrees, np.maximum(statistic, 0.0))) if degrees > 0 else float("nan")


def f_tail(statistic: float, degrees: float, degrees_left: float) -> float:
    """Return the probability that F of so many degrees of freedom, above and below, is larger; NaN without any."""
    if not (degrees > 0 and degrees_left > 0):
        return float("nan")
    return float(fdtrc(degrees, degrees_left, np.maximum(statistic, 0.0)))


def two_sided_sigmas(probability: float) -> float:
    """Return how many standard deviations a normal error is farther off with this probability, to either side."""
    return float(-ndtri(probability / 2.0))
