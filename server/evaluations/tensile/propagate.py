"""The uncertainty of the numbers: how each changes with every reading and with every error that the steps share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.evaluations.tensile.curve import AXIAL, LATERAL, STRESS, Curve
from stereorig.server.evaluations.tensile.numbers import Plan, numbers_of

_AT_ONCE = 2_000_000  # readings of the curves that are evaluated at once


@dataclass(frozen=True)
class Uncertain:
    """A number with its standard uncertainty by cause.

    Attributes
    ----------
    value
        The number.
    parts
        Standard uncertainty by cause.
    """

    value: float
    parts: Mapping[str, float]

    @property
    def u(self) -> float:
        """Standard uncertainty."""
        return float(np.sqrt(sum(part**2 for part in self.parts.values())))


def uncertain_numbers(curve: Curve, plan: Plan) -> dict[str, Uncertain]:
    """Return the numbers of a curve with their uncertainties, by their keys."""
    used = plan.used
    changes, causes = [], []
    # lateral strains that are not known are in no number that is
    for row, cause in ((AXIAL, "strain"), (LATERAL, "strain"), (STRESS, "load")):
        held = [int(i) for i in used if curve.own[row, i] > 0.0]
        each = np.zeros((len(held), *curve.values.shape))
        each[np.arange(len(held)), row, held] = curve.own[row, held]
        changes.append(each)
        causes += [cause] * len(held)
    for cause, columns in curve.shared.items():
        changes.append(columns)
        causes += [cause] * len(columns)
    nominal = numbers_of(curve.values, plan)
    slopes = _differences(curve.values, np.concatenate(changes), plan)
    names = list(dict.fromkeys(causes))
    of = np.array([names.index(cause) for cause in causes])
    found = {}
    for key, value in nominal.items():
        squares = np.bincount(of, slopes[key] ** 2, minlength=len(names))
        parts = {name: float(np.sqrt(square)) for name, square in zip(names, squares, strict=True) if square > 0.0}
        found[key] = Uncertain(float(value), parts)
    return found


def _differences(values: Float, changes: Float, plan: Plan) -> dict[str, Float]:
    """Return by key how each change (q, 3, n) changes the numbers, from half of it to both sides."""
    parts: list[dict[str, Float]] = []
    many = max(1, _AT_ONCE // values.size)
    for first in range(0, len(changes), many):
        half = 0.5 * changes[first : first + many]
        above, below = numbers_of(values + half, plan), numbers_of(values - half, plan)
        parts.append({key: above[key] - below[key] for key in above})
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]} if parts else {}
