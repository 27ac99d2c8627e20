"""One error, its uncertainty and its limit, and the joint judgement of all errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Annotated, Literal

from pydantic import Field

from stereorig.core.settings import Real, Settings, Whole

Outcome = Literal["pass", "conditional", "fail"]
Group = Literal["static", "displacement", "strain", "rotation", "length"]
_ORDER: tuple[Outcome, ...] = ("pass", "conditional", "fail")


@dataclass(frozen=True)
class Comparison:
    """An error.

    Attributes
    ----------
    group, name
        The kind of comparison, and its place.
    n
        The step; None for a length that belongs to no step.
    measured, known
        In the unit; the error is their difference.
    u
        Standard uncertainty of the error: of the measurement and of the known value.
    unit
        ``mm``, ``rad`` or ``1``.
    limit
        Maximum permissible error; None if none was stated.
    """

    group: Group
    name: str
    n: int | None
    measured: float
    known: float
    u: float
    unit: str
    limit: float | None = None

    @property
    def error(self) -> float:
        """Measured less known."""
        return self.measured - self.known


@dataclass(frozen=True)
class Judged:
    """A comparison with its expanded uncertainty.

    Attributes
    ----------
    comparison
        The error.
    expanded
        k u.
    outcome
        ``pass``; ``conditional`` beyond the expanded uncertainty and within the limit; ``fail``.
    """

    comparison: Comparison
    expanded: float
    outcome: Outcome


def worst_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Return the worst; ``pass`` of none."""
    return max(outcomes, key=_ORDER.index, default="pass")


def coverage_factor(count: int, false_alarm: float) -> float:
    """Return k such that, with this probability, one of so many independent normal errors exceeds k u (Sidak)."""
    each = 1.0 - (1.0 - false_alarm) ** (1.0 / max(count, 1))
    return NormalDist().inv_cdf(1.0 - 0.5 * each)


def judged(comparison: Comparison, k: float) -> Judged:
    """Judge one error; one that is no number fails."""
    expanded, size = k * comparison.u, abs(comparison.error)
    within = size <= expanded
    outcome: Outcome = "pass" if within else "fail"
    if comparison.limit is not None:
        outcome = "fail" if not size <= comparison.limit else "pass" if within else "conditional"
    return Judged(comparison, expanded, outcome)


# Requirements of a certificate on a measuring system, and the certainty of its judgement.

Above = Annotated[Real, Field(gt=0.0, le=1e9)]
NotNegative = Annotated[Real, Field(ge=0.0, le=1e9)]
ClassName = Literal["0.2", "0.5", "1", "2"]


class CertificateLimits(Settings):
    """Maximum permissible errors, and the extent that a certificate needs.

    An error with a limit passes within it; beyond its own expanded uncertainty it is then a condition. An error without
    a limit must be within its expanded uncertainty.
    """

    false_alarm: Annotated[Real, Field(gt=0.0, le=0.1)] = Field(
        0.01,
        description="Probability that a system without a fault fails: it is shared out among all comparisons, which "
        "gives the coverage factor of their expanded uncertainties.",
    )
    length_mpe_um: NotNegative | None = Field(
        None, description="Maximum permissible error of a length, the part that is the same for all lengths."
    )
    length_mpe_um_per_m: NotNegative = Field(0.0, description="The part that grows with the length.")
    displacement_mpe_um: Above | None = Field(
        None, description="Maximum permissible error of a displacement, also of a drift over the whole procedure."
    )
    strain_mpe_microstrain: Above | None = Field(
        None, description="Maximum permissible strain of a body that only moves, mean over the field."
    )
    rotation_mpe_mrad: Above | None = Field(None, description="Maximum permissible error of a rotation's angle.")
    noise_ratio: Annotated[Real, Field(ge=1.0, le=10.0)] = Field(
        1.5, description="Largest permissible ratio of the observed to the stated noise."
    )
    extensometer_class: ClassName | None = Field(
        None, description="Class that the virtual extensometer must reach, by the limits of ISO 9513."
    )
    static_steps: Annotated[Whole, Field(ge=0, le=1000)] = Field(3, description="Static pairs that are needed.")
    translations: Annotated[Whole, Field(ge=0, le=1000)] = Field(3, description="Known translations that are needed.")
    lengths: Annotated[Whole, Field(ge=0, le=1000)] = Field(5, description="Known lengths that are needed.")
    rotations: Annotated[Whole, Field(ge=0, le=1000)] = Field(1, description="Rotations that are needed.")

    def length_mpe_mm(self, length_mm: float) -> float | None:
        """Return the maximum permissible error of a length; None if none is stated."""
        if self.length_mpe_um is None:
            return None
        return 1e-3 * self.length_mpe_um + 1e-6 * self.length_mpe_um_per_m * length_mm
