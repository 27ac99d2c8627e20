"""A number with its standard uncertainty."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.common.budget import UNKNOWN, Budget, budget_of, budget_of_difference
from stereorig.core.common.factor import Causes
from stereorig.core.names import CAUSES


class Reading(NamedTuple):
    """One number read off a field.

    Attributes
    ----------
    value
        NaN if it is missing.
    sigma
        Standard uncertainty in the value's unit; NaN if it is not known.
    sigma_calibration
        The calibration's part of it; NaN if that is not known and not included.
    budget
        Its parts by source.
    common
        (k,) common factor of the value; None if it is not known.
    causes
        Causes of the factor's columns.
    """

    value: float
    sigma: float
    sigma_calibration: float = float("nan")
    budget: Budget = UNKNOWN
    common: Float | None = None
    causes: Causes | None = None

    def __repr__(self) -> str:
        """Return value and uncertainty, this with two digits, as ``Reading(0.000849 +- 0.000012)``."""
        if not (math.isfinite(self.value) and math.isfinite(self.sigma) and self.sigma > 0.0):
            return f"Reading({self.value:.6g} +- {self.sigma:.2g})"
        decimals = max(1 - math.floor(math.log10(self.sigma)), 0)
        return f"Reading({self.value:.{decimals}f} +- {self.sigma:.{decimals}f})"


def reading_of(value: float, own: float, frozen: float | None, common: Float | None, causes: Causes | None) -> Reading:
    """Return a reading from its own variance, the reference pair's part of it, and its common factor (k,)."""
    sigma = float(np.sqrt(max(own, 0.0)))
    budget = budget_of(own, frozen, common, causes)
    if common is None:
        return Reading(value, sigma, budget=budget)
    known = Causes.unseparated(len(common)) if causes is None else causes
    whole = float(np.hypot(sigma, np.linalg.norm(common)))
    return Reading(value, whole, float(known.of_calibration(common)), budget, common, causes)


def readings_of(values: Float, own: Float, common: Float | None, causes: Causes | None) -> list[Reading]:
    """Return the readings of numbers (k,) as :func:`reading_of` does, all at once.

    ``own`` (k,) are their own variances, without a separate reference's part; ``common`` (k, c) their common factors.
    """
    sigma = np.sqrt(np.maximum(own, 0.0))
    if common is None:
        return [Reading(v, s, budget=Budget(matching=s)) for v, s in zip(values.tolist(), sigma.tolist(), strict=True)]
    known = Causes.unseparated(common.shape[1]) if causes is None else causes
    parts = {name: np.sqrt(square).tolist() for name, square in known.squares(common).items()}
    whole = np.hypot(sigma, np.linalg.norm(common, axis=1))
    part = known.of_calibration(common)
    each = zip(values.tolist(), whole.tolist(), part.tolist(), sigma.tolist(), strict=True)
    return [
        Reading(
            value,
            whole,
            calibration,
            Budget(matching=matching, **{name: squares[k] for name, squares in parts.items()}),
            common[k],
            causes,
        )
        for k, (value, whole, calibration, matching) in enumerate(each)
    ]


def difference(a: Reading, b: Reading) -> Reading:
    """Return b - a, of one quantity in two steps of a test; NaN without either value.

    Errors that both steps share cancel, see :func:`stereorig.core.common.budget.budget_of_difference`.
    """
    budget = budget_of_difference(a.budget, b.budget, a.common, b.common, a.causes, b.causes)
    parts = [square for name, square in budget.document().items() if name in CAUSES]
    shared = float(np.sqrt(np.sum(np.square(parts)))) if parts else float("nan")
    return Reading(b.value - a.value, budget.sigma, shared, budget)


MISSING = Reading(float("nan"), float("nan"))
