"""One variable of one measurement point over the steps, a column a quantity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.status import PointStatus
from stereorig.server.base.errors import NotFoundError
from stereorig.server.formats.results.derived import derived_names
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.results.reader import Place, derived_variable, nearest_place


@dataclass
class PointHistory:
    """Columns over the steps; a missing number is None, and `status` holds the point's status."""

    units: str = "1"
    value: list[float | None] = field(default_factory=list)
    sigma: list[float | None] = field(default_factory=list)
    status: list[str] = field(default_factory=list)


def nearest_point(path: Path, x_px: float, y_px: float) -> Place:
    """Return the point of a result file nearest to a pixel; the grid is the same in all steps of an analysis."""
    with opened(path) as data:
        x, y = (data.variables[name][...] for name in ("x_px", "y_px"))
    return nearest_place(x, y, (x_px, y_px))


def point_history(files: Sequence[Path], name: str, place: Place) -> PointHistory:
    """Read a variable with one number a point, and its standard uncertainty, in each of some result files.

    A step that lacks it, as the reference lacks displacements, has neither.

    Raises
    ------
    NotFoundError
        ``field_missing`` if none of the files has it, or it has several numbers a point.
    """
    history, found = PointHistory(), not files
    for path in files:
        with opened(path) as data:
            held = data.variables
            status = PointStatus(int(held["status"][place.row, place.col]))
            value, units = _at(held, name, place)
            sigma, _ = _at(held, f"sigma_{name}", place)
        history.status.append(status.name.lower())
        history.value.append(value)
        history.sigma.append(sigma)
        if units is not None:
            found, history.units = True, units
    if not found:
        raise NotFoundError(
            f"No step that was asked for has a variable {name!r} with one number a point.",
            code="field_missing",
            remedy="GET .../steps/{n}/fields lists the variables.",
        )
    return history


def _at(held: Mapping[str, Any], name: str, place: Place) -> tuple[float | None, str | None]:
    """Return a variable's value at a point and its unit; no unit if there is no such variable."""
    if name in held:
        variable = held[name]
        if len(variable.dimensions) != 2:
            return None, None
        return _finite(variable[place.row, place.col]), str(getattr(variable, "units", "1"))
    if name in derived_names(held):
        whole = derived_variable(held, name)
        return _finite(whole.values[place.row, place.col]), whole.units
    return None, None


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
