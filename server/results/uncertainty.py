"""Uncertainties of a step as exports hold them: standard and expanded ones, matrices as columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereorig.core.settings import CoverageFields
from stereorig.server.formats.results.layout import COVARIANCE_NAMES, unpacked
from stereorig.server.formats.results.uncertainty import Included, Statement
from stereorig.server.formats.results.variables import EXPANDED, SIGMA, STRAIN_NAMES
from stereorig.server.results.reader import FileVariable, read_variable

COMMON_FACTOR, COVARIANCES = "common_factor", ("covariance", "measured_covariance")


def in_file(name: str, asked: CoverageFields) -> str:
    """Return the name of a result file's variable that an export's variable is made of."""
    if name.startswith("zncc_"):  # comparisons are parts of one variable
        return "zncc"
    if asked.factor != 1.0 and name.startswith(EXPANDED):
        return SIGMA + name.removeprefix(EXPANDED)
    return name


def read_interval(path: Path, name: str, statement: Statement) -> FileVariable:
    """Read one variable; ``expanded_NAME`` as the statement's interval.

    Raises
    ------
    NotFoundError
        ``field_missing``, with the names that there are.
    """
    of_file = in_file(name, statement.asked)
    read = read_variable(path, of_file)
    if of_file.startswith(SIGMA):
        return with_intervals({of_file: read}, statement.included, statement.asked)[name]
    return read if of_file == name else read_variable(path, name)


def with_intervals(
    variables: dict[str, FileVariable], included: Included, asked: CoverageFields
) -> dict[str, FileVariable]:
    """Return variables with the expanded uncertainty after each standard one, if one is asked for.

    ``expanded_NAME`` is k times ``sigma_NAME``. The meaning of both states the terms that they include.
    """
    statement = Statement(included, asked)
    out: dict[str, FileVariable] = {}
    for name, variable in variables.items():
        if not name.startswith(SIGMA):
            out[name] = variable
            continue
        out[name] = replace(variable, long_name=f"{variable.long_name}, includes {included.text}")
        if statement.expanded:
            of = name.removeprefix(SIGMA)
            text = f"expanded uncertainty of {of}, {statement.text}"
            values = (statement.k * variable.values).astype(variable.values.dtype)
            out[EXPANDED + of] = replace(variable, values=values, long_name=text)
    return out


def as_matrix(name: str, variable: FileVariable) -> FileVariable:
    """Return a covariance that its file holds as packed triangles as (r, c, n, n) matrices; other variables as is."""
    values = variable.values
    n = len(COVARIANCE_NAMES)
    if name not in COVARIANCES or values.ndim != 3 or values.shape[-1] != n * (n + 1) // 2:
        return variable
    return replace(variable, values=unpacked(values, n).astype(values.dtype), dimensions=("row", "col", "i", "j"))


def matrix_columns(name: str, variable: FileVariable) -> dict[str, FileVariable] | None:
    """Return the entries of a covariance's upper triangle, or of a common factor, by name; None for other variables.

    Parameters
    ----------
    name
        Name of the variable in the result file.
    variable
        (r, c, n, n) covariance, or packed with the names of its parts; (r, c, n, k) factor.
    """
    values = variable.values
    if name.endswith("covariance") and values.ndim == 4:
        n = values.shape[-1]
        rows, cols = np.triu_indices(n)
        return _columns(name, variable, values[..., rows, cols], _pairs(n))
    if name.endswith("covariance") and values.ndim == 3:
        return _columns(name, variable, values, variable.parts)
    if name.startswith(COMMON_FACTOR) and values.ndim == 4:
        n, k = values.shape[2:]
        names = STRAIN_NAMES if "strain" in name else COVARIANCE_NAMES
        causes = _numbered(variable.parts, k)
        each = [f"{names[i]}_{causes[j]}" for i in range(n) for j in range(k)]
        return _columns(name, variable, values.reshape(*values.shape[:2], n * k), each)
    return None


def _pairs(n: int) -> list[str]:
    return [f"{COVARIANCE_NAMES[i]}_{COVARIANCE_NAMES[j]}" for i in range(n) for j in range(i, n)]


def _numbered(causes: Sequence[str], count: int) -> list[str]:
    """Name each column by its cause and its number among all."""
    named = causes if len(causes) == count else ["cause"] * count
    return [f"{cause}_{k + 1}" for k, cause in enumerate(named)]


def _columns(
    name: str, variable: FileVariable, values: NDArray[np.floating], each: Sequence[str]
) -> dict[str, FileVariable]:
    return {
        f"{name}_{one}": replace(variable, values=values[..., k], long_name=f"{variable.long_name}: {one}", parts=())
        for k, one in enumerate(each)
    }
