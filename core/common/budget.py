"""The budget of a quantity's uncertainty: its parts by source."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.common.factor import Causes, joined
from stereorig.core.names import ALL_PARTS, BudgetName

CALIBRATION_UNKNOWN = "calibration not included"
CAUSES_UNTOLD = "stage and target are in calibration, not told apart"
REFERENCE_UNTOLD = "reference is in matching, not told apart"


@dataclass(frozen=True)
class Budget:
    """Standard uncertainties (k = 1) of one quantity by their source; None for a source that is not known.

    Their squares add up to the square of the whole. A step's difference from another of the test has no ``reference``.

    Attributes
    ----------
    matching
        Noise of the quantity's points that is new at each step.
    reference
        Noise of the reference pair, the same in all steps of a test; None if it is not known separately and is
        contained in ``matching``.
    calibration
        Noise of the calibration's views, and the whole part of a calibration whose causes are not known separately;
        None if it is not known and not included.
    stage
        Uncertainty of the stage's steps, scale and tilt; None if ``calibration`` contains it.
    target
        Uncertainty of the target's pitch and nodes; None if ``calibration`` contains it.
    sensor
        Pull of camera 1's fixed pattern; None if no pattern was found.
    """

    matching: float | None = None
    reference: float | None = None
    calibration: float | None = None
    stage: float | None = None
    target: float | None = None
    sensor: float | None = None

    @property
    def sigma(self) -> float:
        """Root of the sum of all parts' squares; NaN if no part is known."""
        known = list(self.document().values())
        return float(np.sqrt(np.sum(np.square(known)))) if known else float("nan")

    @property
    def not_included(self) -> bool:
        """True if the calibration's part is not known."""
        return self.calibration is None

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences that name the parts which are not known separately or not included."""
        out = [] if self.reference is not None else [REFERENCE_UNTOLD]
        if self.calibration is None:
            return (*out, CALIBRATION_UNKNOWN)
        return tuple(out if self.stage is not None else [*out, CAUSES_UNTOLD])

    def document(self) -> dict[str, float]:
        """Return the known parts by name, in the order of :data:`stereorig.core.names.ALL_PARTS`."""
        values = {name: getattr(self, name) for name in ALL_PARTS}
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
        The reference pair's part of it; None if it is not known separately.
    row
        (k,) the quantity's common factor; None if it is not known.
    causes
        Causes of the factor's columns; None: all columns count as the calibration's.
    """
    if not np.isfinite(own):
        return UNKNOWN
    new = own if frozen is None else own - frozen
    parts: dict[BudgetName, float] = {"matching": float(np.sqrt(max(new, 0.0)))}
    if frozen is not None:
        parts["reference"] = float(np.sqrt(min(max(frozen, 0.0), max(own, 0.0))))
    if row is not None:
        known = Causes.unseparated(len(row)) if causes is None else causes
        parts |= {name: float(np.sqrt(square)) for name, square in known.squares(row).items()}
    return Budget(**parts)


def budget_of_difference(
    a: Budget, b: Budget, row_a: Float | None, row_b: Float | None, causes_a: Causes | None, causes_b: Causes | None
) -> Budget:
    """Return the budget of the difference of one quantity in two steps of a test.

    Errors that both steps share cancel: the reference pair's noise, and the common factor as far as it is the same. The
    variance is the sum of both steps' new noise and of the square of ``F_b - F_a``.

    Parameters
    ----------
    a, b
        The budgets in both steps.
    row_a, row_b
        (k,) the quantity's common factors of one calibration; None if they are not known.
    causes_a, causes_b
        Causes of the factors' columns; None: all columns count as the calibration's.

    Notes
    -----
    If the reference pair's noise is not known separately, it counts as new in both steps, which overestimates it.
    """
    if a.matching is None or b.matching is None:
        return UNKNOWN
    own = a.matching**2 + b.matching**2
    told_apart = a.reference is not None and b.reference is not None
    if row_a is None or row_b is None:
        return budget_of(own, 0.0 if told_apart else None, None, None)
    one = Causes.unseparated(len(row_a)) if causes_a is None else causes_a
    two = Causes.unseparated(len(row_b)) if causes_b is None else causes_b
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
        (n, k) common factor of the others, and the causes of its columns; None if it is not known.
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
