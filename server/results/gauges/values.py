"""Variables of one step at points, along lines, in extensometers and in areas, with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.common.budget import UNKNOWN, Budget, budget_of
from stereorig.core.gauge.area import area_statistics, points_within
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.gauge.reading import Reading
from stereorig.core.gauge.sampling import Samples, positions_along, sample
from stereorig.core.names import ALL_PARTS
from stereorig.core.strain.result import StrainField
from stereorig.server.formats.gauges.readings import (
    AreaReading,
    AreaStatistics,
    ExtensometerReading,
    LineReading,
    Number,
    Numbers,
    PointReading,
)
from stereorig.server.formats.results.variables import STRAIN_NAMES
from stereorig.server.results.gauges.differences import KeptReading, finite, number, plain
from stereorig.server.results.gauges.request import LineGauge
from stereorig.server.results.gauges.variables import Variables, component_of

_EXTENSOMETER_UNITS = {"length0_mm": "mm", "length_mm": "mm", "elongation_mm": "mm", "strain": "1", "true_strain": "1"}


def _at_positions(
    variables: Variables, names: Sequence[str], positions: Samples, first: dict[str, Reading] | None = None
) -> dict[str, Numbers]:
    """Read variables at positions; ``first`` takes the readings at the first one."""
    own = np.arange(len(positions.xy_px))
    variance = np.diagonal(positions.covariance(variables.shared, own, own), axis1=-2, axis2=-1)
    at_reference = positions.reference_alone()
    frozen = (
        None
        if at_reference is None
        else np.diagonal(at_reference.covariance(variables.shared, own, own), axis1=-2, axis2=-1)
    )
    common, causes = positions.common(), variables.field.causes
    shared = np.full(variance.shape, np.nan) if common is None else (common**2).sum(axis=-1)
    of_calibration = shared if common is None or causes is None else causes.of_calibration(common) ** 2
    out = {}
    for name in names:
        variable, sigma = variables.get(name)
        k = component_of(name)
        if k is not None:
            s = np.sqrt(variance[:, k] + np.nan_to_num(shared[:, k]))
        elif sigma is not None:
            s = positions.of(sigma)  # as if the errors of the points about it were one
        else:
            s = np.full(len(own), np.nan)
        part = np.full(len(own), np.nan) if k is None else np.sqrt(of_calibration[:, k])
        budgets: Sequence[Budget] = [UNKNOWN] * len(own)
        rows = None if common is None or k is None else common[:, k]
        if k is not None:
            budgets = [
                budget_of(
                    float(variance[i, k]),
                    None if frozen is None else float(frozen[i, k]),
                    None if common is None else common[i, k],
                    causes,
                )
                for i in own
            ]
        elif name in STRAIN_NAMES and variables.strain is not None:
            budgets, part, rows = _of_strain(variables, variables.strain, STRAIN_NAMES.index(name), positions, s)
        values = positions.of(variable.values)
        if first is not None:
            row = None if rows is None else rows[0]
            first[name] = Reading(float(values[0]), float(s[0]), float(part[0]), budgets[0], row, causes)
        out[name] = Numbers(_list(values), _list(s), variable.units, _list(part), _by_part(budgets))
    return out


def _of_strain(
    variables: Variables, strain: StrainField, axis: int, positions: Samples, sigma: Float
) -> tuple[list[Budget], Float, Float | None]:
    """Budgets of a strain at positions, common parts and factors."""
    from stereorig.core.strain.reference import reference_share  # slow to load, and not every start needs it

    common = None if strain.common is None else positions.of(strain.common[..., axis, :])
    part = np.full(len(sigma), np.nan) if common is None else np.linalg.norm(common, axis=-1)
    own = np.maximum(sigma**2 - np.nan_to_num(part) ** 2, 0.0)
    field = variables.field
    at_points = reference_share(variables.measured, strain)
    share = None if at_points is None else positions.of(at_points[..., axis])
    budgets = [
        budget_of(
            float(own[i]),
            None if share is None else float(share[i] * own[i]),
            None if common is None else common[i],
            field.causes,
        )
        for i in range(len(own))
    ]
    return budgets, np.asarray(part), common


def _by_part(budgets: Sequence[Budget]) -> dict[str, list[float | None]] | None:
    """Return budgets of positions as a list a part; None if no part is known."""
    found = [one.document() for one in budgets]
    names = [name for name in ALL_PARTS if any(name in one for one in found)]
    return {name: [one.get(name) for one in found] for name in names} or None


def _at(budget: Mapping[str, Sequence[float | None]] | None, i: int) -> dict[str, float] | None:
    found = {} if budget is None else {name: values[i] for name, values in budget.items()}
    return {name: value for name, value in found.items() if value is not None} or None


def of_point(
    variables: Variables, kept: list[KeptReading], names: Sequence[str], name: str | None, xy: tuple[float, float]
) -> PointReading:
    """Return variables at a point; `kept` collects the readings that differences need."""
    positions = sample(variables.field, [xy])
    rows: dict[str, Reading] = {}
    found = _at_positions(variables, names, positions, rows)
    kept += [KeptReading(name, "point", n, found[n].units, reading) for n, reading in rows.items()]
    values = {
        n: Number(
            reading.value[0], reading.sigma[0], reading.units, reading.sigma_calibration[0], _at(reading.budget, 0)
        )
        for n, reading in found.items()
    }
    return PointReading(name, xy, positions.missing[0], values)


def of_line(variables: Variables, names: Sequence[str], line: LineGauge) -> LineReading:
    """Return variables along a line."""
    xy, distance = positions_along(variables.field, line.vertices_px, line.count)
    positions = sample(variables.field, xy)
    return LineReading(
        name=line.name,
        x_px=xy[:, 0].tolist(),
        y_px=xy[:, 1].tolist(),
        distance_px=distance.tolist(),
        missing=list(positions.missing),
        values=_at_positions(variables, names, positions),
    )


def of_extensometer(
    variables: Variables, kept: list[KeptReading], name: str | None, a: tuple[float, float], b: tuple[float, float]
) -> ExtensometerReading:
    """Return an extensometer between two pixels; `kept` collects the readings that differences need."""
    got = extensometer(variables.field, a, b, shared=variables.shared)
    readings: dict[str, Reading] = {n: getattr(got, n) for n in _EXTENSOMETER_UNITS}
    values = {n: number(r, _EXTENSOMETER_UNITS[n]) for n, r in readings.items()}
    kept += [KeptReading(name, "extensometer", n, _EXTENSOMETER_UNITS[n], r) for n, r in readings.items()]
    return ExtensometerReading(name, a, b, got.missing, values)


def of_area(
    variables: Variables,
    kept: list[KeptReading],
    names: Sequence[str],
    name: str | None,
    corners: list[tuple[float, float]] | None,
) -> AreaReading:
    """Return statistics of variables in an area; `kept` collects the readings that differences need."""
    field = variables.field
    inside = points_within(field, corners)
    values = {}
    for n in names:
        variable, _ = variables.get(n)
        # the correlation of other variables' errors is not known here: no uncertainty of their mean
        own = variables.own_sigma(n)
        of_position = component_of(n) in range(3)
        shared = variables.shared.positions if of_position else variables.shared
        got = area_statistics(
            field,
            variable.values,
            None if own is None else own.own,
            inside,
            shared=shared,
            common=None if own is None else own.common,
            sigma_reference=None if own is None else own.reference,
        )
        of_strain = variables.mean_strain_variance(inside) if n in STRAIN_NAMES and got.count else None
        if of_strain is not None:
            got = got.with_mean_variance(*of_strain.of(STRAIN_NAMES.index(n)))
        kept.append(KeptReading(name, "area", n, variable.units, got.mean_reading))
        values[n] = AreaStatistics(
            units=variable.units,
            count=got.count,
            mean=finite(got.mean),
            mean_sigma=finite(got.mean_sigma),
            sd=finite(got.sd),
            rms=finite(got.rms),
            min=finite(got.minimum),
            max=finite(got.maximum),
            mean_sigma_calibration=finite(got.mean_sigma_calibration),
            mean_budget=plain(got.mean_reading.budget),
        )
    valid = int((inside & field.valid).sum())
    missing = "" if valid else "no valid point in the area"
    return AreaReading(name, int(inside.sum()), valid, missing, values)


def _list(values: Float) -> list[float | None]:
    return [finite(v) for v in values]
