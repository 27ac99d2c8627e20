"""One error, its uncertainty and its limit, and the joint judgement of all errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

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
