"""The budget of a quantity's uncertainty: how much of it comes from where."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from core.arrays import Float
from core.common.factor import Causes, joined
from core.names import BUDGET, BudgetName

CALIBRATION_UNKNOWN = "calibration not included"
CAUSES_UNTOLD = "stage and target are in calibration, not told apart"
REFERENCE_UNTOLD = "reference is in matching, not told apart"


@dataclass(frozen=True)
class Budget:
    """Standard uncertainties (k = 1) of one quantity by where they come from; None where that is not known.

    Their squares add up to the square of the whole. A step's difference from another of the test has no ``reference``.

    Attributes
    ----------
    matching
        Noise of the quantity's points that is new at each step.
    reference
        Noise of the reference pair, the same in all steps of a test; None: not told apart, in ``matching``.
    calibration
        Noise of the calibration's views, and everything of a calibration whose causes are not told apart; None: not
        known, and not included.
    stage
        What was known of the stage's steps, scale and tilt; None: in ``calibration``.
    target
        What was known of the target's pitch and nodes; None: in ``calibration``.
    """

    matching: float | None = None
    reference: float | None = None
    calibration: float | None = None
    stage: float | None = None
    target: float | None = None

    @property
    def sigma(self) -> float:
        """The whole; NaN where nothing is known."""
        known = list(self.document().values())
        return float(np.sqrt(np.sum(np.square(known)))) if known else float("nan")

    @property
    def not_included(self) -> bool:
        """True if the calibration's part is not known."""
        return self.calibration is None

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not told apart, and what is not included."""
        out = [] if self.reference is not None else [REFERENCE_UNTOLD]
        if self.calibration is None:
            return (*out, CALIBRATION_UNKNOWN)
        return tuple(out if self.stage is not None else [*out, CAUSES_UNTOLD])

    def document(self) -> dict[str, float]:
        """Return what is known by name, in the order of :data:`core.names.BUDGET`."""
        values = {name: getattr(self, name) for name in BUDGET}
        return {name: float(value) for name, value in values.items() if value is not None and math.isfinite(value)}

    def scaled(self, factor: float) -> Budget:
        """Return the budget of the quantity times a number."""
        return Budget(**{name: abs(factor) * value for name, value in self.document().items()})


UNKNOWN = Budget()


def budget_of(own: float, frozen: float | None, row: Float | None, causes: Causes | None) -> Budget:
    """Return the budget of one quantity.

    Parameters
    ----------
    own
        Variance from the points' own noise.
    frozen
        The reference pair's part of it; None where it is not told apart.
    row
        (k,) the quantity's common factor; None where it is not known.
    causes
        Of its columns; None: all of the calibration.
    """
    if not np.isfinite(own):
        return UNKNOWN
    new = own if frozen is None else own - frozen
    parts: dict[BudgetName, float] = {"matching": float(np.sqrt(max(new, 0.0)))}
    if frozen is not None:
        parts["reference"] = float(np.sqrt(min(max(frozen, 0.0), max(own, 0.0))))
    if row is not None:
        told = Causes.untold(len(row)) if causes is None else causes
        parts |= {name: float(np.sqrt(square)) for name, square in told.squares(row).items()}
    return Budget(**parts)


def budget_of_difference(
    a: Budget, b: Budget, row_a: Float | None, row_b: Float | None, causes_a: Causes | None, causes_b: Causes | None
) -> Budget:
    """Return the budget of the difference of one quantity in two steps of a test.

    What the steps share cancels: the reference pair's noise, and the common factor where it is the same. The variance
    is that of both steps' new noise, and of ``F_b - F_a``.

    Parameters
    ----------
    a, b
        The budgets in both steps.
    row_a, row_b
        (k,) the quantity's common factors of one calibration; None where they are not known.
    causes_a, causes_b
        Of their columns; None: all of the calibration.

    Notes
    -----
    Where the reference pair's noise is not told apart it counts as new in both steps, which is more than there is.
    """
    if a.matching is None or b.matching is None:
        return UNKNOWN
    own = a.matching**2 + b.matching**2
    told_apart = a.reference is not None and b.reference is not None
    if row_a is None or row_b is None:
        return budget_of(own, 0.0 if told_apart else None, None, None)
    one = Causes.untold(len(row_a)) if causes_a is None else causes_a
    two = Causes.untold(len(row_b)) if causes_b is None else causes_b
    both = joined(one, two)
    return budget_of(own, 0.0 if told_apart else None, two.aligned(row_b, one) - one.aligned(row_a, two), both)


def budgets_through(
    slope: Float, own: Float, frozen: Float | None, common: Float | None, causes: Causes | None
) -> tuple[Budget, ...]:
    """Return the budgets of m numbers that change by ``slope`` (m, n) with n others.

    Parameters
    ----------
    slope
        (m, n).
    own, frozen
        (n, n) covariance of the others from the points' own noise, and the reference pair's part of it.
    common, causes
        (n, k) their common factor, and the causes of its columns; None where it is not known.
    """
    variance = np.einsum("mi,ij,mj->m", slope, own, slope)
    at_reference = None if frozen is None else np.einsum("mi,ij,mj->m", slope, frozen, slope)
    rows = None if common is None else slope @ common
    return tuple(
        budget_of(
            float(variance[k]),
            None if at_reference is None else float(at_reference[k]),
            None if rows is None else rows[k],
            causes,
        )
        for k in range(len(slope))
    )
