"""Readings of gauges as a MATLAB file: the table's columns as one struct, one number a row."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np

from server.formats.results.gauge_csv import COLUMNS, NO_VALUE, rows

_TEXTS = frozenset({"label", "gauge", "kind", "quantity", "units", "missing"})
_ABOUT = (
    "software_version",
    "stale_reasons",
    "frame",
    "subset_px",
    "smoothing_window",
    "settings",
    "inputs_sha256",
    "alignment",
)


def gauges_mat(document: dict[str, Any]) -> bytes:
    """Return the readings as a MATLAB file of version 5.

    ``gauges`` is a struct of the columns of :func:`gauges_csv`: numbers as column vectors, NaN
    where there is none, texts as cells; ``struct2table(gauges)`` makes a table of it. ``about`` holds settings, inputs
    and version as text.

    Parameters
    ----------
    document
        Of :func:`server.results.gauges.readings.read_gauges`.
    """
    from scipy.io import savemat  # loaded where it is used

    columns: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    for step in document["steps"]:
        head = {"step": step["n"], "label": step["label"], "load_n": step["load_n"]}
        for row in rows(step):
            if row.get("value") is None:
                row["missing"] = row.get("missing") or NO_VALUE
            for name, column in columns.items():
                column.append({**head, **row}.get(name))
    held: dict[str, Any] = {}
    for name, column in columns.items():
        if name in _TEXTS:
            cells = np.empty((len(column), 1), dtype=object)
            cells[:, 0] = ["" if v is None else str(v) for v in column]
            held[name] = cells
        else:
            held[name] = np.array([np.nan if v is None else float(v) for v in column]).reshape(-1, 1)
    about = {name: v if isinstance(v := document[name], str) else json.dumps(v, sort_keys=True) for name in _ABOUT}
    out = io.BytesIO()
    save: Any = savemat
    save(out, {"gauges": held, "about": about}, long_field_names=True, do_compression=True)
    return out.getvalue()
