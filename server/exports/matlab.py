"""Steps as a MATLAB file (version 5): a struct a step, double arrays, names that MATLAB takes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from stereorig.core.errors import InputError
from stereorig.server.formats.channel_units import plain_names
from stereorig.server.formats.files import written_temporary
from stereorig.server.formats.gauges.matlab import matlab_name
from stereorig.server.results.provenance import provenance
from stereorig.server.results.steps import ExportSource, StepResult

_MAX_BYTES = (1 << 31) - (1 << 20)  # of one variable in this version of the format


def write_mat(path: Path, steps: Iterable[StepResult], source: ExportSource) -> None:
    """Write ``step_<nnnn>``, a struct for each step, and one ``about_<nnnn>`` that describes it.

    A step's struct has ``n``, ``load_n``, ``time_s`` (since the reference; NaN where not known), ``label``, the struct
    ``channels`` if any were recorded (``channel_u``: standard uncertainties of those that the rig file names), and each
    variable as a double array: rows and columns of the grid, NaN where a point has no number. ``about_<nnnn>`` has
    ``units`` and ``meaning`` by variable, and the provenance; settings are JSON text, for ``jsondecode``. Steps are
    written one after the other.

    Raises
    ------
    InputError
        ``export_too_large`` for a step beyond the 2 GB that this version of the format holds in one variable.
    """
    with written_temporary(path) as temporary, temporary.open("wb") as out:
        for step in steps:
            size = sum(8 * v.values.size for v in step.variables.values())
            if size > _MAX_BYTES:
                raise InputError(
                    f"Step {step.n} comes to {size >> 20} MiB; a MATLAB file of version 5 holds 2 GB.",
                    code="export_too_large",
                    remedy="Choose variables, or the format h5.",
                )
            names = {name: matlab_name(name) for name in step.variables}
            held: dict[str, object] = {
                "n": float(step.n),
                "load_n": np.nan if step.load_n is None else step.load_n,
                "label": step.label,
                "time_s": np.nan if step.recorded.time_s is None else step.recorded.time_s,
            }
            if step.recorded.channels:
                plain = plain_names(step.recorded.channels, matlab_name)
                held["channels"] = {plain[name]: value for name, value in step.recorded.channels.items()}
                if step.recorded.u:
                    held["channel_u"] = {plain[name]: u for name, u in step.recorded.u.items()}
            held |= {names[name]: v.values.astype(np.float64) for name, v in step.variables.items()}
            about = {matlab_name(k): _plain(v) for k, v in provenance(step, source).items()}
            about["units"] = {names[name]: v.units for name, v in step.variables.items()}
            about["meaning"] = {names[name]: v.long_name for name, v in step.variables.items()}
            about["states"] = {
                names[name]: "; ".join(f"{k} = {text}" for k, text in v.flags.items())
                for name, v in step.variables.items()
                if v.flags is not None
            }
            about["parts"] = {names[name]: " ".join(v.parts) for name, v in step.variables.items() if v.parts}
            content = {f"step_{step.n:04d}": held, f"about_{step.n:04d}": about}
            # on an open file, each call appends
            save: Any = scipy.io.savemat  # its stubs have names of files alone
            save(out, content, long_field_names=True, do_compression=True)


def _plain(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, bool | int | float):
        return float(value)
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, sort_keys=True)
