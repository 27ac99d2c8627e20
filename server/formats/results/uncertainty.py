"""The statement with every uncertainty: its coverage factor, the terms that it includes, and the missing ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as field_of
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from stereorig.core.common.budget import CALIBRATION_UNKNOWN
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.settings import Coverage, CoverageFields
from stereorig.server.formats.results.netcdf import opened

NOT_INCLUDED = CALIBRATION_UNKNOWN
#: terms that no file's uncertainties include
SYSTEMATIC = (
    "systematic terms (interpolation, order of the patch, strain window)",
    "errors of the calibration that were not declared",
)
DISTRIBUTION = "normal, infinite degrees of freedom"


@dataclass(frozen=True)
class Included:
    """The terms that a result's uncertainties include.

    Attributes
    ----------
    calibration
        False if the calibration's covariance is not known, as with another program's.
    causes
        By name (:data:`stereorig.core.names.BUDGET`), in their order; without ``reference`` it is in ``matching``,
        without ``stage`` and ``target`` these are in ``calibration``.
    """

    calibration: bool
    causes: tuple[str, ...]

    @staticmethod
    def of(dataset: Any) -> Included:
        """Read it from an open result file."""
        variables = dataset.variables
        # a shape's noise is all of the reference pair
        at_reference = "reference_covariance" in variables or getattr(dataset, "kind", "") == "shape"
        causes = ("matching", *(("reference",) if at_reference else ()))
        if "common_factor" not in variables:
            return Included(False, causes)
        told = str(getattr(variables["common_factor"], "causes", "calibration")).split()
        return Included("calibration" in told, (*causes, *told))

    @staticmethod
    def of_field(field: Field) -> Included:
        """Return the terms that the uncertainties of a field in memory include."""
        causes: tuple[str, ...] = ("matching",)
        if field.knows_reference:
            causes += ("reference",)
        if field.common is None:
            return Included(False, causes)
        told = ("calibration",) if field.causes is None else field.causes.separate
        return Included("calibration" in told, (*causes, *told))

    @staticmethod
    def in_all(each: Sequence[Included]) -> Included:
        """Return the terms that all of some results include."""
        causes = [c for c in each[0].causes if all(c in one.causes for one in each)] if each else []
        return Included(bool(each) and all(one.calibration for one in each), tuple(causes))

    @property
    def lacking(self) -> str:
        """The note with every number: empty, or that the calibration is not included."""
        return "" if self.calibration else NOT_INCLUDED

    @property
    def text(self) -> str:
        """In words."""
        return ", ".join(self.causes) if self.calibration else f"matching only; {NOT_INCLUDED}"


def read_included(path: Path) -> Included:
    """Return the terms that a result file's uncertainties include.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable``.
    """
    with opened(path) as dataset:
        return Included.of(dataset)


@dataclass(frozen=True)
class Statement:
    """The interval stated with values, and the terms that it covers.

    Parameters
    ----------
    included
        The terms that the uncertainties include.
    asked
        Coverage factor or share of the interval.
    """

    included: Included
    asked: CoverageFields = field_of(default_factory=lambda: Coverage.model_validate({}))

    @property
    def k(self) -> float:
        """The coverage factor."""
        return self.asked.factor

    @property
    def expanded(self) -> bool:
        """True if an interval other than one standard uncertainty was asked for."""
        return self.k != 1.0

    @property
    def symbol(self) -> str:
        """The uncertainty's sign with its coverage factor: u (k = 1), U (k = 1.96, 95 %)."""
        return f"U (k = {self.k:.3g}, {percent(self.asked.share)})" if self.expanded else "u (k = 1)"

    @property
    def text(self) -> str:
        """In one line, as under a picture."""
        return f"{self.symbol} includes {self.included.text}"

    @property
    def missing(self) -> list[str]:
        """The terms that are not included."""
        return [*([] if self.included.calibration else ["calibration"]), *SYSTEMATIC]

    def document(self) -> dict[str, object]:
        """Return it as plain values."""
        return {
            "k": self.k,
            "coverage": self.asked.share,
            "distribution": DISTRIBUTION,
            "includes": list(self.included.causes),
            "not_included": self.missing,
            "text": self.text,
        }


def coverage_of(k: float | None, coverage: float | None) -> Coverage:
    """Return the coverage that a query or a command line asks for.

    Raises
    ------
    InputError
        ``option_conflict`` if both are given; ``coverage_invalid`` for one out of its bounds.
    """
    if k is not None and coverage is not None:
        raise InputError(
            f"k = {k:g} and coverage = {coverage:g} are both given.",
            code="option_conflict",
            remedy="Give one of them: each follows from the other.",
        )
    try:
        return Coverage(k=k, coverage=coverage)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            f"{first['loc'][0]}: {first['msg']}, got {first['input']}.",
            code="coverage_invalid",
            remedy="Give k as 2, or the share that the interval is to hold as 0.95.",
        ) from error


def percent(share: float) -> str:
    """Write a share of a distribution: 95 %, 99.73 %."""
    return f"{100.0 * share:.4g} %"
