"""A step as a CSV table: one line a point, its provenance in comment lines above the header."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from server.formats.files import written_temporary
from server.results.provenance import provenance
from server.results.steps import Source, StepResult, columns_of

_LINES_AT_ONCE = 2000


def write_table(path: Path, step: StepResult, source: Source, *, matrices: bool = False) -> None:
    """Write one step as CSV.

    Parameters
    ----------
    path
        Of the file.
    step, source
        Its numbers, and where they come from.
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
            out.write(f"# {name}: {_one_line(value)}\n")
        out.write("# column row, unit 1: row of the grid of points\n# column col, unit 1: column of the grid\n")
        header = ["row", "col"]
        for name, variable in columns.items():
            out.write(f"# column {name}, unit {variable.units}: {_one_line(variable.long_name)}\n")
            header.append(name)
            if variable.flags is not None:
                header.append(f"{name}_name")
        out.write(",".join(header) + "\n")
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
    return lambda v: flags.get(v, "")


def _one_line(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, sort_keys=True)
    return " ".join(text.split())
