"""Reading single variables and points out of result files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.status import PointStatus
from server.base.errors import NotFoundError
from server.formats.results.netcdf import opened


@dataclass(frozen=True)
class Variable:
    """One variable of a result file.

    Attributes
    ----------
    values
        As stored; NaN where there is no number.
    units, long_name, dimensions
        As stored.
    flags
        Name of each value of a variable of states.
    parts
        Names along the third axis, where the file has them.
    """

    values: NDArray[Any]
    units: str
    long_name: str
    dimensions: tuple[str, ...] = ()
    flags: dict[int, str] | None = None
    parts: tuple[str, ...] = ()

    @staticmethod
    def of(variable: Any) -> Variable:
        """Read a variable of an open file."""
        flags = None
        if "flag_meanings" in variable.ncattrs():
            numbers = np.atleast_1d(variable.flag_values)
            flags = {int(v): name for v, name in zip(numbers, variable.flag_meanings.split(), strict=True)}
        parts = next((str(getattr(variable, a)) for a in ("comparisons", "components") if a in variable.ncattrs()), "")
        return Variable(
            np.asarray(variable[...]),
            str(getattr(variable, "units", "1")),
            str(getattr(variable, "long_name", "")),
            tuple(variable.dimensions),
            flags,
            tuple(parts.split()),
        )


def read_variable(path: Path, name: str) -> Variable:
    """Read one variable.

    Raises
    ------
    NotFoundError
        ``field_missing``, with the names that there are.
    """
    with opened(path) as data:
        if name not in data.variables:
            raise NotFoundError(
                f"{path.name} has no variable {name!r}.",
                code="field_missing",
                remedy="Use one of `available`.",
                available=sorted(data.variables),
            )
        return Variable.of(data.variables[name])


def list_variables(path: Path) -> list[dict[str, Any]]:
    """Return name, unit, meaning and dimensions of every variable of a result file.

    ``flags`` names the values of a status, ``comparisons`` those of the correlation's last axis.
    """
    with opened(path) as data:
        return [
            {
                "name": name,
                "units": str(getattr(variable, "units", "1")),
                "long_name": str(getattr(variable, "long_name", "")),
                "dimensions": list(variable.dimensions),
                "shape": list(variable.shape),
                **_meanings(variable),
            }
            for name, variable in data.variables.items()
        ]


def read_cut_pieces(path: Path) -> list[list[float]]:
    """Return the straight pieces [x0, y0, x1, y1] of a result's cuts, px of camera 1's reference image."""
    with opened(path) as data:
        if "cut_line" not in data.variables:
            return []
        x, y, line = (data.variables[name][...] for name in ("cut_x_px", "cut_y_px", "cut_line"))
    same = line[1:] == line[:-1]
    return [[float(v) for v in piece] for piece in np.stack([x[:-1], y[:-1], x[1:], y[1:]], axis=1)[same]]


def _meanings(variable: Any) -> dict[str, Any]:
    told = variable.ncattrs()
    meanings: dict[str, Any] = {}
    if "flag_values" in told:
        words = str(variable.flag_meanings).split()
        meanings["flags"] = {str(int(v)): w for v, w in zip(np.atleast_1d(variable.flag_values), words, strict=True)}
    if "comparisons" in told:
        meanings["comparisons"] = str(variable.comparisons).split()
    return meanings


def read_point_positions(path: Path) -> NDArray[np.float64]:
    """Return (rows, cols, 3) where each point is at the step, mm; NaN where it was not measured."""
    with opened(path) as data:
        held = data.variables
        position = np.stack([held[f"{axis}_mm"][...] for axis in "xyz"], axis=-1)
        if "u_mm" in held:
            position = position + np.stack([held[f"{axis}_mm"][...] for axis in "uvw"], axis=-1)
        measured = np.isin(held["status"][...], (PointStatus.OK, PointStatus.EXTRAPOLATED))
    return np.asarray(np.where(measured[..., None], position, np.nan), dtype=np.float64)


def read_residuals(path: Path) -> dict[str, Any]:
    """Return a calibration's residuals: for each view its facts, and lists of found places and residuals."""
    with opened(path) as data:
        found, residual = data.variables["found_px"][...], data.variables["residual_px"][...]
        facts = json.loads(data.getncattr("views"))
    views = [
        {**fact, "found_px": _number(xy), "residual_px": _number(r)}
        for fact, xy, r in zip(facts, found, residual, strict=True)
    ]
    return {"views": views}


def probe_result(path: Path, x_px: float, y_px: float) -> dict[str, Any]:
    """Return the point nearest to a pixel: place, status, and every number of two-dimensional variables."""
    with opened(path) as data:
        arrays = {name: v[...] for name, v in data.variables.items() if len(v.dimensions) >= 2}
        units = {name: str(getattr(data.variables[name], "units", "1")) for name in arrays}
    distance = np.hypot(arrays["x_px"] - x_px, arrays["y_px"] - y_px)
    row, col = (int(i) for i in np.unravel_index(int(np.nanargmin(distance)), distance.shape))
    values: dict[str, Any] = {}
    for name, array in arrays.items():
        if array.ndim > 3:
            continue  # the covariance is read as a field
        here = array[row, col]
        values[name] = {"value": _number(here), "units": units[name]}
    return {
        "row": row,
        "col": col,
        "distance_px": float(distance[row, col]),
        "status": PointStatus(int(arrays["status"][row, col])).name.lower(),
        "values": values,
    }


def _number(value: Any) -> Any:
    if np.ndim(value):
        return [_number(v) for v in value]
    number = value.item()
    return number if np.isfinite(number) else None
