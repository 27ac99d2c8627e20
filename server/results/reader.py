"""Reading single variables and points out of result files."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
from numpy.typing import NDArray

from core.errors import FileFormatError
from core.status import PointStatus
from server.base.errors import NotFoundError

# the netCDF and HDF5 libraries are not built for several threads at once
library = threading.Lock()


@dataclass(frozen=True)
class Variable:
    """One variable of a result file: values with NaN where there are none."""

    values: NDArray[Any]
    units: str
    long_name: str
    dimensions: tuple[str, ...] = ()


def _open(path: Path) -> netCDF4.Dataset:
    try:
        return netCDF4.Dataset(path, "r")
    except OSError as error:
        raise FileFormatError(f"{path.name} cannot be read: {error}.", file=path.name) from error


def _values(variable: Any) -> NDArray[Any]:
    values = variable[:]
    if np.ma.isMaskedArray(values):
        filled = values.filled(np.nan) if np.issubdtype(values.dtype, np.floating) else values.filled()
        return np.asarray(filled)
    return np.asarray(values)


def read_variable(path: Path, name: str) -> Variable:
    """Read one variable.

    Raises
    ------
    NotFoundError
        ``field_missing``, with the names that there are.
    """
    with library, _open(path) as data:
        if name not in data.variables:
            raise NotFoundError(
                f"{path.name} has no variable {name!r}.",
                code="field_missing",
                remedy="Use one of `available`.",
                available=sorted(data.variables),
            )
        variable = data.variables[name]
        return Variable(
            _values(variable),
            str(getattr(variable, "units", "1")),
            str(getattr(variable, "long_name", "")),
            tuple(variable.dimensions),
        )


def list_variables(path: Path) -> list[dict[str, Any]]:
    """Return name, unit, meaning and dimensions of every variable of a result file.

    ``flags`` names the values of a status, ``comparisons`` those of the correlation's last axis.
    """
    with library, _open(path) as data:
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
    with library, _open(path) as data:
        if "cut_line" not in data.variables:
            return []
        x, y, line = (_values(data.variables[name]) for name in ("cut_x_px", "cut_y_px", "cut_line"))
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
    with library, _open(path) as data:
        held = data.variables
        position = np.stack([_values(held[f"{axis}_mm"]) for axis in "xyz"], axis=-1)
        if "u_mm" in held:
            position = position + np.stack([_values(held[f"{axis}_mm"]) for axis in "uvw"], axis=-1)
        measured = np.isin(_values(held["status"]), (PointStatus.OK, PointStatus.EXTRAPOLATED))
    return np.asarray(np.where(measured[..., None], position, np.nan), dtype=np.float64)


def read_residuals(path: Path) -> dict[str, Any]:
    """Return a calibration's residuals: for each view its facts, and lists of found places and residuals."""
    with library, _open(path) as data:
        found, residual = _values(data.variables["found_px"]), _values(data.variables["residual_px"])
        facts = json.loads(data.getncattr("views"))
    views = [
        {**fact, "found_px": _number(xy), "residual_px": _number(r)}
        for fact, xy, r in zip(facts, found, residual, strict=True)
    ]
    return {"views": views}


def probe_result(path: Path, x_px: float, y_px: float) -> dict[str, Any]:
    """Return the point nearest to a pixel: place, status, and every number of two-dimensional variables."""
    with library, _open(path) as data:
        arrays = {name: _values(v) for name, v in data.variables.items() if len(v.dimensions) >= 2}
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
