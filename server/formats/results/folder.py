"""A folder of result files: ``step_<nnnn>.nc``, one a step."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from stereorig.core.errors import InputError

_RESULT = re.compile(r"step_[0-9]{4,9}\.nc")


DENSE = "dense"
"""Folder of the dense fields, inside that of the ordinary results: files of the same names and contract."""


def dense_result(path: Path) -> Path:
    """Return the path of the dense field that belongs to a step's result file."""
    return path.parent / DENSE / path.name


def home_of(path: Path) -> Path:
    """Return the folder of the ordinary results that a result file, dense or not, belongs to."""
    return path.parent.parent if path.parent.name == DENSE else path.parent


def results_in(folder: Path) -> list[Path]:
    """Return a folder's result files, by step."""
    return sorted(p for p in folder.glob("step_*.nc") if _RESULT.fullmatch(p.name))


def number_of(path: Path) -> int:
    """Return the step's number in the name of a result file."""
    return int(path.stem.removeprefix("step_"))


def file_of_step(files: Mapping[int, Path], step: int) -> Path:
    """Return the result file of a step, of files by step.

    Raises
    ------
    InputError
        ``step_missing``, with the first steps that there are.
    """
    if step not in files:
        raise InputError(
            f"There is no result of step {step}; there are {', '.join(map(str, sorted(files)[:8]))}"
            f"{' ...' if len(files) > 8 else ''}.",
            code="step_missing",
            remedy="Name a step that was measured.",
        )
    return files[step]


def first_results(folder: Path, folders: Iterable[Path]) -> list[Path]:
    """Return the result files of the first folder that has any.

    Parameters
    ----------
    folder
        The folder that the user named.
    folders
        Folders that may have its results, in the order of search.

    Raises
    ------
    InputError
        ``results_missing``.
    """
    files = next((found for path in folders if (found := results_in(path))), None)
    if files is None:
        raise InputError(
            f"There is no step_0000.nc or another step's result in {folder}.",
            code="results_missing",
            remedy="Give the folder that stereorig measure --out wrote, or an analysis' folder.",
        )
    return files
