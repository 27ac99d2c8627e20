"""A number with its standard uncertainty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from core.arrays import Float
from core.common.budget import UNKNOWN, Budget, budget_of, budget_of_difference
from core.common.factor import Causes
from core.names import CAUSES


class Reading(NamedTuple):
    """One number read off a field.

    Attributes
    ----------
    value
        NaN where it is missing.
    sigma
        Standard uncertainty in the value's unit; NaN where it is not known.
    sigma_calibration
        The common factor's part of it; NaN where that is not known, and then not included.
    budget
        Where it comes from.
    common
        (k,) common factor of the value; None where it is not known.
    causes
        Of its columns.
    """

    value: float
    sigma: float
    sigma_calibration: float = float("nan")
    budget: Budget = UNKNOWN
    common: Float | None = None
    causes: Causes | None = None


def reading_of(value: float, own: float, frozen: float | None, common: Float | None, causes: Causes | None) -> Reading:
    """Return a reading from its own variance, the reference pair's part of it, and its common factor (k,)."""
    sigma = float(np.sqrt(max(own, 0.0)))
    budget = budget_of(own, frozen, common, causes)
    if common is None:
        return Reading(value, sigma, budget=budget)
    part = float(np.linalg.norm(common))
    return Reading(value, float(np.hypot(sigma, part)), part, budget, common, causes)


def readings_of(values: Float, own: Float, common: Float | None, causes: Causes | None) -> list[Reading]:
    """Return the readings of numbers (k,) as :func:`reading_of` does, all at once.

    ``own`` (k,) are their own variances, of which the reference's part is not told apart; ``common`` (k, c) their
    common factors.
    """
    sigma = np.sqrt(np.maximum(own, 0.0))
    if common is None:
        return [Reading(v, s, budget=Budget(matching=s)) for v, s in zip(values.tolist(), sigma.tolist(), strict=True)]
    told = Causes.untold(common.shape[1]) if causes is None else causes
    parts = {name: np.sqrt(square).tolist() for name, square in told.squares(common).items()}
    part = np.linalg.norm(common, axis=1)
    each = zip(values.tolist(), np.hypot(sigma, part).tolist(), part.tolist(), sigma.tolist(), strict=True)
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

    What both steps share cancels, see :func:`core.common.budget.budget_of_difference`.
    """
    budget = budget_of_difference(a.budget, b.budget, a.common, b.common, a.causes, b.causes)
    parts = [square for name, square in budget.document().items() if name in CAUSES]
    shared = float(np.sqrt(np.sum(np.square(parts)))) if parts else float("nan")
    return Reading(b.value - a.value, budget.sigma, shared, budget)


MISSING = Reading(float("nan"), float("nan"))
