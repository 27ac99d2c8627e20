"""All steps in one HDF5 file: each variable stacked over the steps, for MATLAB's h5read, h5py and xarray alike."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.common.factor import Causes, joined
from stereorig.server.formats.channel_units import plain_names
from stereorig.server.formats.results.netcdf import opened, written_dataset
from stereorig.server.results.channels import Recorded
from stereorig.server.results.provenance import provenance
from stereorig.server.results.steps import ExportSource, StepResult, causes_in, chosen, each, require_same_grid
from stereorig.server.results.uncertainty import COMMON_FACTOR

LOAD_MEANS = "load, where it is known"
_NO_STATE = -1  # of an integer variable in a step that does not have it
_COMMON = ("x_px", "y_px")
_OF_A_STEP = ("step", "label", "load_n", "kind", "time_s", "channels")


def write_stacked(path: Path, source: ExportSource, steps: Sequence[int] | None, names: Sequence[str] | None) -> None:
    """Write one file of all steps, one step in memory at a time.

    Datasets have the axes step, row, col (MATLAB, which counts from the other end, has col, row, step); ``x_px`` and
    ``y_px`` are the same in every step and have row, col. ``step``, ``load_n``, ``time_s`` (since the reference),
    ``channel_...`` as recorded, ``label`` and ``provenance`` (JSON text) have one entry a step. A variable that a step
    lacks is NaN there, or -1 if it counts. Units and meanings are attributes. A column of a common factor is the same
    cause in all steps (attribute ``parts``), zero where a step does without it. The file is netCDF-4, which is HDF5.

    Raises
    ------
    InputError
        ``steps_mixed`` if the steps have different points.
    """
    files = chosen(source, steps)
    count, causes = len(files), _all_causes(files)
    first: StepResult | None = None
    with written_dataset(path, classic=False) as data:
        for k, step in enumerate(each(source, steps, names)):
            if first is None:
                _begin(data, step, count)
                first = step
            require_same_grid(step, first)
            _put(data, k, _aligned(step, causes), source)


def _all_causes(files: Sequence[Path]) -> Causes | None:
    """Return the causes of the columns of all steps together: a step has as few as hold its own variance."""
    found = []
    for path in files:
        with opened(path) as data:
            found.append(causes_in(data))
    known = [causes for causes in found if causes is not None]
    return functools.reduce(joined, known) if known else None


def _aligned(step: StepResult, causes: Causes | None) -> StepResult:
    """Return a step whose common factors have the columns of all steps: those that it lacks are zero."""
    if causes is None or step.causes is None:
        return step
    variables = {
        name: replace(v, values=step.causes.aligned(v.values, causes).astype(v.values.dtype), parts=causes.columns)
        if name.startswith(COMMON_FACTOR)
        else v
        for name, v in step.variables.items()
    }
    # a point without numbers stays without them
    for name in variables:
        if name.startswith(COMMON_FACTOR):
            variables[name].values[~step.valid] = np.nan
    return replace(step, variables=variables)


def scalars_of(recorded: Recorded) -> Iterator[tuple[str, float, str, str]]:
    """Yield the scalars recorded with a step as name, value, unit and meaning; unknown ones are left out."""
    if recorded.load_n is not None:
        yield "load_n", recorded.load_n, "N", LOAD_MEANS
    if recorded.time_s is not None:
        yield "time_s", recorded.time_s, "s", "time since the reference"
    plain = plain_names(recorded.channels)
    for name, value in recorded.channels.items():
        yield f"channel_{plain[name]}", value, recorded.units[name], f"channel {name}, as recorded with the step"
        if name in recorded.u:
            means = f"standard uncertainty of the channel {name} at the exposure"
            yield f"channel_{plain[name]}_u", recorded.u[name], recorded.units[name], means


def _begin(data: Any, step: StepResult, count: int) -> None:
    rows, cols = step.shape
    for name, size in (("step", count), ("row", rows), ("col", cols)):
        data.createDimension(name, size)
    _describe(data.createVariable("step", "i4", ("step",)), "1", "number of the step")
    _describe(data.createVariable("load_n", "f8", ("step",), fill_value=np.nan), "N", LOAD_MEANS)
    for name, meaning in (
        ("label", "the step's label, given by the user"),
        ("provenance", "where it comes from, JSON"),
    ):
        _describe(data.createVariable(name, str, ("step",)), "1", meaning)


def _put(data: Any, k: int, step: StepResult, source: ExportSource) -> None:
    document = provenance(step, source)
    if k == 0:
        of_all = {n: v for n, v in document.items() if n not in _OF_A_STEP}
        data.setncatts({n: v if isinstance(v, str) else json.dumps(v, sort_keys=True) for n, v in of_all.items()})
    data.variables["step"][k] = step.n
    for name, value, units, meaning in scalars_of(replace(step.recorded, load_n=step.load_n)):
        if name not in data.variables:
            _describe(data.createVariable(name, "f8", ("step",), fill_value=np.nan), units, meaning)
        data.variables[name][k] = value
    data.variables["label"][k] = step.label
    data.variables["provenance"][k] = json.dumps(document, ensure_ascii=False, sort_keys=True)
    for name, variable in step.variables.items():
        values = variable.values
        if name not in data.variables:
            _declare(data, name, variable, stacked=name not in _COMMON)
        if name not in _COMMON:
            held = data.variables[name]
            part = (slice(None),) * 2 + tuple(slice(0, n) for n in values.shape[2:])
            held[(k, *part)] = values  # a shape has fewer comparisons than a displacement
        elif k == 0:
            data.variables[name][...] = values


def _declare(data: Any, name: str, variable: Any, *, stacked: bool) -> None:
    shape = variable.values.shape
    dims: list[str] = ["step", "row", "col"] if stacked else ["row", "col"]
    for _ in shape[2:]:
        # unlimited, as a shape has three components and one comparison where a displacement has more
        dims.append(f"{name}_part_{len(dims) - 2}")
        data.createDimension(dims[-1], None)
    fill = np.nan if variable.values.dtype.kind == "f" else _NO_STATE
    chunks = [*([1] if stacked else []), *shape[:2], *shape[2:]]
    made = data.createVariable(
        name,
        variable.values.dtype.str[1:],
        tuple(dims),
        fill_value=fill,
        chunksizes=chunks,
        compression="zlib",
        complevel=1,
        shuffle=True,
    )
    made.set_auto_mask(False)
    _describe(made, variable.units, variable.long_name)
    if variable.flags is not None:
        made.flag_values = np.array(list(variable.flags), dtype=variable.values.dtype)
        made.flag_meanings = " ".join(variable.flags.values())
    if variable.parts:
        made.parts = " ".join(variable.parts)


def _describe(variable: Any, units: str, meaning: str) -> None:
    variable.setncatts({"units": units, "long_name": meaning})
