"""Readings of gauges as a MATLAB file: the table's columns as one struct, one number a row; MATLAB's names."""

from __future__ import annotations

import io
import json
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats.channel_units import plain_names
from stereorig.server.formats.gauges.readings import GaugeReadings
from stereorig.server.formats.gauges.table import columns, table_rows

_MAX_NAME = 63  # namelengthmax
_KEYWORDS = frozenset(
    {
        "break",
        "case",
        "catch",
        "classdef",
        "continue",
        "else",
        "elseif",
        "end",
        "for",
        "function",
        "global",
        "if",
        "otherwise",
        "parfor",
        "persistent",
        "return",
        "spmd",
        "switch",
        "try",
        "while",
    }
)
_TEXTS = frozenset({"label", "gauge", "kind", "quantity", "units", "missing", "not_included"})


def gauges_mat(readings: GaugeReadings) -> bytes:
    """Return the readings as a MATLAB file of version 5.

    ``gauges`` is a struct of the columns of :func:`stereorig.server.formats.gauges.table.gauges_csv`: numbers as column
    vectors, NaN for missing values, texts as cells; ``struct2table(gauges)`` makes a table of it. ``about`` holds
    settings, inputs and version as text.
    """
    from scipy.io import savemat  # imported late: few calls need it

    rows = list(table_rows(readings))
    wanted = columns(readings)
    plain = plain_names(wanted, matlab_name)
    held = {plain[name]: _column(name, [value(row) for row in rows]) for name, value in wanted.items()}
    about = {k: v if isinstance(v, str) else json.dumps(v, sort_keys=True) for k, v in readings.about().items()}
    out = io.BytesIO()
    save: Any = savemat
    save(out, {"gauges": held, "about": about}, long_field_names=True, do_compression=True)
    return out.getvalue()


def _column(name: str, values: list[str | float | None]) -> NDArray[np.object_] | NDArray[np.float64]:
    if name in _TEXTS:
        cells = np.empty((len(values), 1), dtype=object)
        cells[:, 0] = ["" if v is None else str(v) for v in values]
        return cells
    return np.array([np.nan if v is None else float(v) for v in values]).reshape(-1, 1)


def matlab_name(name: str) -> str:
    """Return a name as MATLAB takes it for a variable or field: letters, digits, underscores, a letter first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", name)
    if not name or not name[0].isalpha() or name in _KEYWORDS:
        name = f"v_{name}"
    return name[:_MAX_NAME]
