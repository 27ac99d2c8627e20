"""The uncertainties of a report: the sentence that an auditor can quote, and the budgets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from stereorig.core.names import ALL_PARTS
from stereorig.server.formats.gauges.readings import Number, StepReadings
from stereorig.server.formats.results.uncertainty import DISTRIBUTION, NOT_INCLUDED, SYSTEMATIC, Statement, percent
from stereorig.server.report.floor import STRAINS
from stereorig.server.report.items import UM, UM_PER_M
from stereorig.server.report.steps import MeasuredSteps, StepRow

#: of gauges' numbers, the factor to a unit that reads well
_UNITS = {"mm": (1e3, UM), "1": (1e6, UM_PER_M), "rad": (1e6, "microrad")}
_ROUNDING = 1e-6  # of the whole: a smaller part is zero but for rounding
_LENGTHS = (("x_mm", "X"), ("y_mm", "Y"), ("z_mm", "Z"), ("u_mm", "U"), ("v_mm", "V"), ("w_mm", "W"))


@dataclass(frozen=True)
class BudgetRow:
    """One quantity's row of a budget table; its numbers are standard uncertainties (k = 1), None if not separated.

    Attributes
    ----------
    key
        Its id in the page.
    label
        Its name.
    unit
        Unit of its numbers.
    parts
        In the order of :data:`stereorig.core.names.ALL_PARTS`.
    total
        The whole standard uncertainty.
    stated
        The interval of the report's coverage factor.
    """

    key: str
    label: str
    unit: str
    parts: tuple[float | None, ...]
    total: float | None
    stated: float | None


def sentence(measured: MeasuredSteps) -> str:
    """Return method, coverage factor, coverage and the missing terms, as an auditor can quote it."""
    statement = measured.statement
    patch = measured.reference.patch
    shape = "quadratic-patch" if patch is not None and patch.patch == "quadratic" else "plane-patch"
    kind = "Expanded" if statement.expanded else "Standard"
    k = f"k = {statement.k:.4g}, {percent(statement.asked.share)} of a distribution taken as {DISTRIBUTION}"
    own = (
        f"{kind} uncertainties ({k}) of positions, displacements and strains measured by {shape} correlation of two "
        "cameras with exact perspective. They hold the noise of the images through each point's own covariance, with "
        "the correlation of neighbours"
    )
    if statement.included.calibration:
        common = (
            "; and the calibration's uncertainty as a common factor of all points, propagated through the "
            "measurement's own estimator from the covariance of the cameras' parameters"
        )
        return f"{own}{common}. Not included: {'; '.join(SYSTEMATIC)}."
    return (
        f"{own}. {NOT_INCLUDED.capitalize()}: the calibration's covariance is not known, as of one imported from "
        f"another program; true uncertainties are larger. Not included either: {'; '.join(SYSTEMATIC)}."
    )


def field_budgets(measured: MeasuredSteps) -> tuple[str, list[BudgetRow]]:
    """Return which step the medians over the field are of, and a row for each quantity."""
    step = measured.moved[-1] if measured.moved else measured.steps[-1]
    return f"Step {step.n}", _of_step(step, measured.statement)


def _of_step(step: StepRow, statement: Statement) -> list[BudgetRow]:
    rows = []
    for key, label in _LENGTHS:
        parts = step.summary.budget_median_mm.get(key)
        if parts:
            total = step.summary.sigma_median_mm.get(key)
            rows.append(_row(f"budget.{label}", label, UM, 1e3, parts, total, statement))
    if step.strain is not None:
        for name in STRAINS:
            parts = step.strain.budget_median_microstrain.get(name)
            if parts:
                total = step.strain.noise_floor_microstrain[name]
                rows.append(_row(f"budget.{name}", name, UM_PER_M, 1.0, parts, total, statement))
    return rows


def gauge_budgets(step: StepReadings, statement: Statement) -> list[BudgetRow]:
    """Return a row for each number of each gauge in a step that has a budget."""
    rows: list[BudgetRow] = []

    def add(kind: str, gauge: str | None, values: Mapping[str, Number]) -> None:
        for name, number in values.items():
            if number.value is not None and number.budget:
                factor, unit = _UNITS.get(number.units, (1.0, number.units))
                label = f"{kind} {gauge}, {name}"
                rows.append(_row(f"budget.{gauge}.{name}", label, unit, factor, number.budget, number.sigma, statement))

    for point in step.points:
        add("point", point.name, point.values)
    for extensometer in step.extensometers:
        add("extensometer", extensometer.name, extensometer.values)
    for area in step.areas:
        add("mean over area", area.name, {n: v.mean_number for n, v in area.values.items()})
    return rows


def _row(
    key: str,
    label: str,
    unit: str,
    factor: float,
    parts: Mapping[str, float | None],
    total: float | None,
    statement: Statement,
) -> BudgetRow:
    each: Sequence[float | None] = [parts.get(name) for name in ALL_PARTS]
    whole = None if total is None else factor * total
    floor = 0.0 if whole is None else _ROUNDING * whole
    scaled = tuple(None if part is None else factor * part if factor * part > floor else 0.0 for part in each)
    return BudgetRow(key, label, unit, scaled, whole, None if whole is None else statement.k * whole)
