"""Budgets of all points of a field: how much of each coordinate's and strain's uncertainty comes from where."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Bool, Float, Floats
from stereorig.core.common.factor import Causes
from stereorig.core.field.points.result import Field
from stereorig.core.names import ALL_PARTS, BudgetName, Cause
from stereorig.core.robust import median, spread_indices
from stereorig.core.strain import StrainField
from stereorig.server.formats.results.layout import COVARIANCE_NAMES
from stereorig.server.formats.results.variables import STRAIN_NAMES

_MEDIANS_OF = 2000  # points: a median of a tenth's scatter is known to a few thousandths from them


@dataclass(frozen=True, eq=False)
class PointBudget:
    """Budget of one quantity at n points.

    Attributes
    ----------
    parts
        (n,) standard uncertainty by name, of those that are known, in the order of
        :data:`stereorig.core.names.ALL_PARTS`; their squares add up to the square of the whole.
    """

    parts: Mapping[BudgetName, Float]

    @property
    def sigma(self) -> Float:
        """(n,) the whole."""
        return np.asarray(np.sqrt(np.sum([part**2 for part in self.parts.values()], axis=0)))

    @property
    def median(self) -> dict[str, float]:
        """The median of each part over the points that have it; empty without any."""
        found = {name: part[np.isfinite(part)] for name, part in self.parts.items()}
        return {name: median(part) for name, part in found.items() if part.size}

    def at(self, k: int) -> dict[str, float | None]:
        """Return one point's."""
        return {name: float(part[k]) if np.isfinite(part[k]) else None for name, part in self.parts.items()}


def spread_points(points: Bool) -> Bool:
    """Return (r, c) True at some of the points, spread over all: enough for the medians of their budgets."""
    index = np.flatnonzero(points)
    if len(index) <= _MEDIANS_OF:
        return points
    out = np.zeros(points.shape, bool)
    out.ravel()[index[spread_indices(len(index), _MEDIANS_OF)]] = True
    return out


def field_budgets(field: Field, points: Bool) -> dict[str, PointBudget]:
    """Return the budgets of positions and displacements.

    Parameters
    ----------
    field
        In the system frame.
    points
        (r, c) True at the points that are asked for.

    Returns
    -------
    dict
        By the quantity's name in result files: ``x_mm`` ...
    """
    own = _diagonal(field.covariance)[points]
    frozen = None
    if not field.has_motion:
        frozen = own  # a position's noise is the reference pair's
    elif field.frozen is not None:
        frozen = np.concatenate([own[:, :3], _diagonal(field.frozen)[points]], axis=1)
    squares = _squares(field.common, field.causes, points)
    return {
        name: _budget(
            own[:, k],
            None if frozen is None else frozen[:, k],
            {cause: square[:, k] for cause, square in squares.items()},
        )
        for k, name in enumerate(COVARIANCE_NAMES[: own.shape[-1]])
    }


def strain_budgets(field: Field, strain: StrainField, points: Bool) -> dict[str, PointBudget]:
    """Return the budgets of exx, eyy and exy; the reference's share is propagated through the strain's own derivatives.

    Parameters
    ----------
    field
        The field that the strain was computed from.
    strain
        The strain of the same points.
    points
        (r, c) True at the points that are asked for.
    """
    from stereorig.core.strain.reference import reference_share  # slow to load, and not every start needs it

    own = _diagonal(strain.covariance)[points]
    share = reference_share(field, strain, points)
    squares = _squares(strain.common, field.causes, points)
    return {
        name: _budget(
            own[:, k],
            None if share is None else share[points][:, k] * own[:, k],
            {cause: square[:, k] for cause, square in squares.items()},
        )
        for k, name in enumerate(STRAIN_NAMES)
    }


def _diagonal(covariance: Float) -> Float:
    return np.asarray(np.diagonal(covariance, axis1=-2, axis2=-1))


def _squares(common: Floats | None, causes: Causes | None, points: Bool) -> Mapping[Cause, Float]:
    """Variances (n, m) by cause at points (r, c); none where the common factor (r, c, m, k) is not known."""
    if common is None:
        return {}
    return (Causes.unseparated(common.shape[-1]) if causes is None else causes).squares(common[points])


def _budget(own: Float, frozen: Float | None, common: Mapping[Cause, Float]) -> PointBudget:
    known: dict[BudgetName, Float] = {"matching": own if frozen is None else own - frozen}
    if frozen is not None:
        known["reference"] = np.minimum(frozen, own)
    for cause, square in common.items():
        known[cause] = square
    return PointBudget({name: np.sqrt(np.maximum(known[name], 0.0)) for name in ALL_PARTS if name in known})
