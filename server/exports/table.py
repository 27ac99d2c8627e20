"""A step as a CSV table: one line a point, its provenance in comment lines above the header."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats import csv_cells
from stereorig.server.formats.files import written_temporary
from stereorig.server.results.provenance import provenance
from stereorig.server.results.steps import ExportSource, StepResult, columns_of

_LINES_AT_ONCE = 2000


def write_table(path: Path, step: StepResult, source: ExportSource, *, matrices: bool = False) -> None:
    """Write one step as CSV.

    Parameters
    ----------
    path
        The file.
    step, source
        Its numbers, and their provenance.
    matrices
        Write covariances (upper triangle) and common factors among its variables too, an entry a column.

    Notes
    -----
    Lines that begin with ``#`` state the provenance name by name, and each column's unit and meaning. The header
    follows, then one line a grid point: ``row, col``, then the variables. A number that is not there is empty; a
    variable of states is written as its number, with the name in the next column.
    """
    columns = columns_of(step, matrices=matrices)
    with written_temporary(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as out:
        for name, value in provenance(step, source).items():
            out.write(csv_cells.comment(f"{name}: {_text(value)}"))
        out.write("# column row, unit 1: row of the grid of points\n# column col, unit 1: column of the grid\n")
        header = ["row", "col"]
        for name, variable in columns.items():
            out.write(csv_cells.comment(f"column {name}, unit {variable.units}: {variable.long_name}"))
            header.append(name)
            if variable.flags is not None:
                header.append(f"{name}_name")
        out.write(csv_cells.row(header))
        rows, cols = step.shape
        texts: list[tuple[Callable[[Any], str], NDArray[Any]]] = [
            (str, np.repeat(np.arange(rows), cols)),
            (str, np.tile(np.arange(cols), rows)),
        ]
        for variable in columns.values():
            flat = variable.values.ravel()
            texts.append((_text_of(flat), flat))
            if variable.flags is not None:
                texts.append((_name_of(variable.flags), flat))
        for first in range(0, rows * cols, _LINES_AT_ONCE):
            block = [[text(v) for v in flat[first : first + _LINES_AT_ONCE].tolist()] for text, flat in texts]
            out.writelines(",".join(line) + "\n" for line in zip(*block, strict=True))


def _text_of(values: NDArray[Any]) -> Callable[[Any], str]:
    if values.dtype.kind != "f":
        return str
    if values.dtype.itemsize <= 4:  # nine digits are all that single precision holds
        return lambda v: "" if v != v else f"{v:.9g}"
    return lambda v: "" if v != v else repr(v)


def _name_of(flags: dict[int, str]) -> Callable[[Any], str]:
    names = {state: csv_cells.row([name]).rstrip("\n") for state, name in flags.items()}
    return lambda v: names.get(v, "")


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, sort_keys=True)
