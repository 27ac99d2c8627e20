"""A step as a CSV table: a header, then one line a point; the last column of the first one has the provenance."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats import csv_cells
from stereorig.server.formats.files import written_temporary
from stereorig.server.results.provenance import provenance
from stereorig.server.results.reader import FileVariable
from stereorig.server.results.steps import ExportSource, StepResult, columns_of, without_internals

_LINES_AT_ONCE = 2000


def write_table(path: Path, step: StepResult, source: ExportSource, *, asked: bool = False) -> None:
    """Write one step as CSV.

    Parameters
    ----------
    path
        The file.
    step, source
        Its numbers, and their provenance.
    asked
        True: its variables were asked for by name, so that internals among them are written too, and covariances
        (upper triangle) and common factors an entry a column.

    Notes
    -----
    The header comes first, so that programs read the table without an option, then one line a grid point: ``row,
    col``, then the variables. A number that is not there is empty; a variable of states is written as its number, with
    the name in the next column. The column ``about`` has JSON in the first line alone: the provenance, and each
    column's unit and meaning. Its number signs are escaped: no reader takes them for comments.
    """
    columns = columns_of(step if asked else without_internals(step), matrices=asked)
    with written_temporary(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as out:
        header = ["row", "col"]
        for name, variable in columns.items():
            header += [name] if variable.flags is None else [name, f"{name}_name"]
        out.write(csv_cells.row([*header, "about"]))
        about = csv_cells.row([_about(step, source, columns)])
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
            for line in zip(*block, strict=True):
                out.write(f"{','.join(line)},{about}")
                about = "\n"


def _text_of(values: NDArray[Any]) -> Callable[[Any], str]:
    if values.dtype.kind != "f":
        return str
    if values.dtype.itemsize <= 4:  # nine digits are all that single precision holds
        return lambda v: "" if v != v else f"{v:.9g}"
    return lambda v: "" if v != v else repr(v)


def _name_of(flags: dict[int, str]) -> Callable[[Any], str]:
    names = {state: csv_cells.row([name]).rstrip("\n") for state, name in flags.items()}
    return lambda v: names.get(v, "")


def _about(step: StepResult, source: ExportSource, columns: Mapping[str, FileVariable]) -> str:
    document = {
        **provenance(step, source),
        "units": {"row": "1", "col": "1", **{name: v.units for name, v in columns.items()}},
        "meaning": {
            "row": "row of the grid of points",
            "col": "column of the grid of points",
            **{name: v.long_name for name, v in columns.items()},
        },
    }
    return json.dumps(document, ensure_ascii=False).replace("#", "\\u0023")
