"""Reading single variables and points out of result files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.settings import CoverageFields
from stereorig.core.status import PointStatus
from stereorig.server.base.errors import no_variable
from stereorig.server.documents.results import FieldVariable, Probe, ProbeValue, Uncertainty, ViewResiduals
from stereorig.server.formats.results.budgets import PointBudget, field_budgets, strain_budgets
from stereorig.server.formats.results.derived import DERIVED, derive, derived_names
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.uncertainty import Included, Statement
from stereorig.server.formats.results.variables import described

_GRID = ("row", "col")


@dataclass(frozen=True)
class FileVariable:
    """One variable of a result file.

    Attributes
    ----------
    values
        As stored; NaN for missing numbers.
    units, long_name, dimensions
        As stored.
    flags
        Name of each value of a variable of states.
    parts
        Names along the third axis, if the file has them.
    """

    values: NDArray[Any]
    units: str
    long_name: str
    dimensions: tuple[str, ...] = ()
    flags: dict[int, str] | None = None
    parts: tuple[str, ...] = ()

    @staticmethod
    def of(variable: Any) -> FileVariable:
        """Read a variable of an open file."""
        parts = next((str(getattr(variable, a)) for a in ("comparisons", "components") if a in variable.ncattrs()), "")
        return FileVariable(
            np.asarray(variable[...]),
            str(getattr(variable, "units", "1")),
            str(getattr(variable, "long_name", "")),
            tuple(variable.dimensions),
            _flags(variable),
            tuple(parts.split()),
        )


def derived_variable(held: Any, name: str) -> FileVariable:
    """Return a derived variable, computed from an open file's."""
    return FileVariable(derive(held, name), *DERIVED[name], dimensions=_GRID)


def read_variable(path: Path, name: str) -> FileVariable:
    """Read one variable, or compute it if it is derived from the file's.

    Raises
    ------
    NotFoundError
        ``field_missing``, with the names that there are.
    """
    with opened(path) as data:
        if name in derived_names(data.variables):
            return derived_variable(data.variables, name)
        if name not in data.variables:
            raise no_variable(path.name, name, data.variables)
        return FileVariable.of(data.variables[name])


def _described(
    name: str, units: str, long_name: str, dimensions: Sequence[str], shape: Sequence[int], variable: Any = None
) -> FieldVariable:
    row, flags = described(name), None if variable is None else _flags(variable)
    return FieldVariable(
        name=name,
        units=units,
        long_name=long_name,
        dimensions=list(dimensions),
        shape=list(shape),
        flags=None if flags is None else {str(value): word for value, word in flags.items()},
        comparisons=str(variable.comparisons).split() if hasattr(variable, "comparisons") else None,
        label=row.shown,
        group=row.group,
        kind=row.kind,
        relative=row.relative,
    )


def list_variables(path: Path) -> list[FieldVariable]:
    """Return every variable of a result file, then those that follow from them."""
    with opened(path) as data:
        shape = list(data.variables["status"].shape)
        derived = [_described(name, *DERIVED[name], _GRID, shape) for name in derived_names(data.variables)]
        held = []
        for name, variable in data.variables.items():
            units, long_name = (str(getattr(variable, of, none)) for of, none in (("units", "1"), ("long_name", "")))
            held.append(_described(name, units, long_name, variable.dimensions, variable.shape, variable))
        return held + derived


def _flags(variable: Any) -> dict[int, str] | None:
    if "flag_meanings" not in variable.ncattrs():
        return None
    words = str(variable.flag_meanings).split()
    return {int(v): word for v, word in zip(np.atleast_1d(variable.flag_values), words, strict=True)}


def read_cut_pieces(path: Path) -> list[list[float]]:
    """Return the straight pieces [x0, y0, x1, y1] of a result's cuts, px of camera 1's reference image."""
    with opened(path) as data:
        if "cut_line" not in data.variables:
            return []
        x, y, line = (data.variables[name][...] for name in ("cut_x_px", "cut_y_px", "cut_line"))
    same = line[1:] == line[:-1]
    return [[float(v) for v in piece] for piece in np.stack([x[:-1], y[:-1], x[1:], y[1:]], axis=1)[same]]


def read_point_positions(path: Path) -> NDArray[np.float64]:
    """Return (rows, cols, 3) positions of the points at the step, mm; NaN at points that were not measured."""
    with opened(path) as data:
        held = data.variables
        position = np.stack([held[f"{axis}_mm"][...] for axis in "xyz"], axis=-1)
        if "u_mm" in held:
            position = position + np.stack([held[f"{axis}_mm"][...] for axis in "uvw"], axis=-1)
        measured = np.isin(held["status"][...], (PointStatus.OK, PointStatus.EXTRAPOLATED))
    return np.asarray(np.where(measured[..., None], position, np.nan), dtype=np.float64)


def read_residuals(path: Path) -> list[ViewResiduals]:
    """Return a calibration's residuals, view by view."""
    with opened(path) as data:
        found, residual = data.variables["found_px"][...], data.variables["residual_px"][...]
        view_records = json.loads(data.getncattr("views"))
    return [
        ViewResiduals(**record, found_px=_number(xy), residual_px=_number(r))
        for record, xy, r in zip(view_records, found, residual, strict=True)
    ]


@dataclass(frozen=True)
class Place:
    """A point of the grid.

    Attributes
    ----------
    row, col
        Indices of the point in the grid.
    distance_px
        From the pixel that was asked for, in camera 1's reference image.
    """

    row: int
    col: int
    distance_px: float


def nearest_place(x_px: NDArray[Any], y_px: NDArray[Any], at_px: tuple[float, float]) -> Place:
    """Return the point nearest to a pixel of the points (r, c) of a grid."""
    distance = np.hypot(x_px - at_px[0], y_px - at_px[1])
    row, col = (int(i) for i in np.unravel_index(int(np.nanargmin(distance)), distance.shape))
    return Place(row, col, float(distance[row, col]))


def probe_result(path: Path, x_px: float, y_px: float, asked: CoverageFields) -> Probe:
    """Return the point nearest to a pixel; the covariance is left out, it is read as a field."""
    with opened(path) as data:
        statement = Statement(Included.of(data), asked)
        variables = {name: FileVariable.of(v) for name, v in data.variables.items() if v.dimensions[:2] == _GRID}
        variables |= {name: derived_variable(data.variables, name) for name in derived_names(data.variables)}
    place = nearest_place(variables["x_px"].values, variables["y_px"].values, (x_px, y_px))
    row, col = place.row, place.col
    budgets = _budgets_at(path, row, col)

    def number(name: str, variable: FileVariable) -> ProbeValue:
        value = ProbeValue(value=_number(variable.values[row, col]), units=variable.units)
        known = variables.get(f"sigma_{name}")
        sigma = None if known is None else _number(known.values[row, col])
        if sigma is None:
            return value
        expanded = statement.k * sigma if statement.expanded else None
        budget = budgets[name].at(0) if name in budgets else None
        lacking = statement.included.lacking
        more = {"sigma": sigma, "expanded": expanded, "budget": budget, "not_included": lacking}
        return value.model_copy(update=more)

    return Probe(
        row=row,
        col=col,
        distance_px=place.distance_px,
        status=PointStatus(int(variables["status"].values[row, col])).name.lower(),
        values={n: number(n, v) for n, v in variables.items() if v.values.ndim <= 3 and not n.endswith("covariance")},
        uncertainty=Uncertainty.model_validate(statement.document()),
    )


def _budgets_at(path: Path, row: int, col: int) -> dict[str, PointBudget]:
    field, strain = read_field(path), read_strain(path)
    here = np.zeros(field.shape, dtype=bool)
    here[row, col] = True
    return field_budgets(field, here) | ({} if strain is None else strain_budgets(field, strain, here))


def _number(value: Any) -> Any:
    if np.ndim(value):
        return [_number(v) for v in value]
    number = value.item()
    return number if np.isfinite(number) else None
