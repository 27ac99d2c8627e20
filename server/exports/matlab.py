"""All steps in one MATLAB file (version 5): each variable stacked over the steps, doubles, names that MATLAB takes."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

from stereorig.core.errors import InputError
from stereorig.server.exports.stacked import write_stacked
from stereorig.server.formats.channel_units import plain_names
from stereorig.server.formats.files import written_temporary
from stereorig.server.formats.gauges.matlab import matlab_name
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.results.steps import ExportSource

_MAX_BYTES = (1 << 31) - (1 << 20)  # of one variable in this version of the format


def write_mat(path: Path, source: ExportSource, steps: Sequence[int] | None, names: Sequence[str] | None) -> None:
    """Write one file of all steps, one variable in memory at a time.

    Variables over the points have rows, columns, steps, in this order; ``x_px`` and ``y_px`` are the same in every step
    and have rows and columns. ``step``, ``load_n``, ``time_s`` (since the reference) and ``channel_...`` are columns of
    one number a step, ``label`` and ``provenance`` (JSON text, for ``jsondecode``) cells of one text a step. A number
    that a step lacks is NaN; a state that it lacks is -1. The struct ``about`` has the provenance of all steps, and
    ``units``, ``meaning``, ``states`` and ``parts`` by variable.

    Raises
    ------
    InputError
        ``steps_mixed`` if the steps have different points; ``export_too_large`` for a variable beyond the 2 GB that
        this version of the format holds.
    """
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        stack = Path(folder) / "stack.h5"
        write_stacked(stack, source, steps, names)
        with opened(stack) as data, written_temporary(path) as temporary, temporary.open("wb") as out:
            plain = plain_names(data.variables, matlab_name)
            # on an open file, each call appends
            for name, variable in data.variables.items():
                if 8 * int(np.prod(variable.shape)) > _MAX_BYTES:
                    raise InputError(
                        f"{name} comes to {8 * int(np.prod(variable.shape)) >> 20} MiB over all steps; a MATLAB file "
                        "of version 5 holds 2 GB.",
                        code="export_too_large",
                        remedy="Choose fewer steps, or the format h5.",
                    )
                _save(out, {plain[name]: _values(variable)})
            _save(out, {"about": _about(data, plain)})


def _values(variable: Any) -> NDArray[Any]:
    """Return a variable as MATLAB holds it: texts as cells, numbers as doubles, the steps after rows and columns."""
    values = variable[...]
    if variable.dtype is str:
        return np.array([[text] for text in np.atleast_1d(values)], dtype=object)
    numbers = np.asarray(values, dtype=np.float64)
    if variable.dimensions[:3] == ("step", "row", "col"):
        return np.moveaxis(numbers, 0, 2)
    return numbers[:, None] if numbers.ndim == 1 else numbers


def _about(data: Any, plain: dict[str, str]) -> dict[str, Any]:
    held = {
        name: {key: variable.getncattr(key) for key in variable.ncattrs()} for name, variable in data.variables.items()
    }
    states = {
        plain[name]: "; ".join(
            f"{k} = {text}"
            for k, text in zip(np.atleast_1d(one["flag_values"]), one["flag_meanings"].split(), strict=True)
        )
        for name, one in held.items()
        if "flag_meanings" in one
    }
    return {
        **{matlab_name(key): data.getncattr(key) for key in data.ncattrs()},
        "units": {plain[name]: one["units"] for name, one in held.items()},
        "meaning": {plain[name]: one["long_name"] for name, one in held.items()},
        "states": states,
        "parts": {plain[name]: one["parts"] for name, one in held.items() if "parts" in one},
    }


def _save(out: Any, content: dict[str, Any]) -> None:
    save: Any = scipy.io.savemat  # its stubs have names of files alone
    save(out, content, long_field_names=True, do_compression=True)
