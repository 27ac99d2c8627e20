"""Steps as exports need them: one at a time, read from its result file as it is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.common.factor import Causes
from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.field.region.cuts import Cuts, from_arrays
from stereorig.core.settings import Coverage, CoverageFields
from stereorig.core.status import PointStatus
from stereorig.server.base.errors import NotFoundError, no_variable
from stereorig.server.base.json_values import nothing
from stereorig.server.formats.results.derived import derived_names
from stereorig.server.formats.results.folder import home_of, number_of
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.formats.results.reading import causes_of
from stereorig.server.formats.results.uncertainty import Included, Statement
from stereorig.server.formats.results.variables import described
from stereorig.server.results.channels import Recorded, recorded_with
from stereorig.server.results.naming import numbered
from stereorig.server.results.reader import FileVariable, derived_variable
from stereorig.server.results.uncertainty import COMMON_FACTOR, as_matrix, in_file, matrix_columns, with_intervals
from stereorig.server.store.durable import known_json

ALWAYS = ("x_px", "y_px", "x_mm", "y_mm", "z_mm", "status")
_GRID = ("row", "col")


@dataclass(frozen=True)
class StepResult:
    """One step's result, or the variables of it that were asked for.

    Attributes
    ----------
    n
        Number of the step.
    variables
        By name, in the file's order.
    attributes
        The file's own, as text and numbers.
    cuts
        Cracks and borders of holes.
    included
        The terms that its uncertainties include.
    causes
        Cause of each column of its common factors; None without any.
    recorded
        Channels and time, if the step is one of a test.
    """

    n: int
    variables: dict[str, FileVariable]
    attributes: dict[str, object]
    cuts: Cuts | None
    included: Included
    causes: Causes | None = None
    recorded: Recorded = field(default_factory=Recorded)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        rows, cols = self.variables["x_px"].values.shape
        return rows, cols

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(r, c) True where a point has numbers."""
        return np.isin(self.variables["status"].values, (PointStatus.OK, PointStatus.EXTRAPOLATED))

    @property
    def load_n(self) -> float | None:
        """Load in newtons; None if it is not known."""
        if self.recorded.load_n is not None:
            return self.recorded.load_n
        text = self.attributes.get("load_n")
        return None if text is None else float(str(text))

    @property
    def label(self) -> str:
        """The step's label, given by the user."""
        return str(self.attributes.get("label", ""))


@dataclass(frozen=True)
class ExportSource:
    """Results to export, and their provenance.

    Attributes
    ----------
    files
        Result files of one measurement, by step.
    name
        Prefix of the files' names.
    title
        The test's name.
    image
        Camera 1's reference image, if it is known.
    about
        Further entries for every export: ids of test, analysis and calibration.
    mask
        Mask of the points, if there was one.
    stale_reasons
        Inputs that are gone or were replaced since they were measured.
    coverage
        Coverage of the expanded uncertainties, which are added to the standard ones unless it is one standard
        uncertainty.
    home
        Folder of the results as they were measured, in the folder of the test with its records; None: each file's own.
    """

    files: Sequence[Path]
    name: str
    title: str = ""
    image: Path | None = None
    about: dict[str, object] = field(default_factory=dict)
    mask: Path | None = None
    stale_reasons: Sequence[str] = ()
    coverage: CoverageFields = field(default_factory=lambda: Coverage.model_validate({}))
    home: Path | None = None


def step_name(source: ExportSource, step: StepResult) -> str:
    """Return the name of a step's file without its ending: the source's, the number, the label."""
    return numbered(source.name, step.n, step.label)


def failed_steps(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the problem of each step that could not be measured, by its number, as ``summary.json`` has it."""
    failed = known_json(folder / "summary.json", {"steps": nothing}).get("steps_failed")
    return {n: one for n, one in failed.items() if isinstance(one, dict)} if isinstance(failed, dict) else {}


def chosen(source: ExportSource, steps: Sequence[int] | None) -> list[Path]:
    """Return the result files of the steps asked for; all if none are named.

    Raises
    ------
    NotFoundError
        ``no_results`` without any, ``step_missing`` for one that is not there.
    """
    files = {number_of(path): path for path in source.files}
    if not files:
        raise NotFoundError(
            "There are no finished steps to export.",
            code="no_results",
            remedy="Wait for the first step, or measure again.",
        )
    missing = [] if steps is None else [n for n in steps if n not in files]
    if missing:
        failed = source.about.get("steps_failed")
        problem = failed.get(str(missing[0])) if isinstance(failed, dict) else None
        because = f": it failed ({problem['code']})" if isinstance(problem, dict) and "code" in problem else ""
        raise NotFoundError(
            f"There is no result for step {missing[0]}{because}.",
            code="step_missing",
            remedy="Ask for steps that are finished.",
            available=sorted(files),
        )
    return [files[n] for n in sorted(files if steps is None else set(steps))]


def read_step(
    path: Path, names: Sequence[str] | None = None, *, always: Sequence[str] = ALWAYS, home: Path | None = None
) -> StepResult:
    """Read a result file, or some of its variables.

    Parameters
    ----------
    path
        The result file.
    names
        Variables to read, and ``always`` in any case. None: all over the grid of points.
    always
        Variables that the form needs: positions and status.
    home
        Folder of the results as they were measured, where the file is another than was; None: the file's own.

    Raises
    ------
    FileFormatError
        ``file_missing``, ``file_unreadable``.
    NotFoundError
        ``field_missing``, with the names that there are.
    """
    with opened(path) as data:
        return _read(path, data, names, always, home_of(path) if home is None else home)


def _read(path: Path, data: Any, names: Sequence[str] | None, always: Sequence[str], home: Path) -> StepResult:
    over_grid = [name for name, v in data.variables.items() if tuple(v.dimensions[:2]) == _GRID]
    lacking = [name for name in ALWAYS if name not in over_grid]
    if lacking:
        raise FileFormatError(f"{path.name} is no result: it lacks {', '.join(lacking)}.", file=path.name)
    derived = [name for name in derived_names(data.variables) if names is not None and name in names]  # where asked for
    missing = [name for name in names or () if name not in over_grid and name not in derived]
    if missing:
        raise no_variable(path.name, missing[0], over_grid)
    wanted = set(over_grid) if names is None else {*always, *names}
    variables = {name: as_matrix(name, FileVariable.of(data.variables[name])) for name in over_grid if name in wanted}
    variables |= {name: derived_variable(data.variables, name) for name in derived}
    cuts = None
    if "cut_line" in data.variables:
        points = np.stack([np.asarray(data.variables[n][...], dtype=np.float64) for n in ("cut_x_px", "cut_y_px")], 1)
        cuts = from_arrays(points, np.asarray(data.variables["cut_line"][...], dtype=np.int32))
    attributes = {name: _plain(data.getncattr(name)) for name in data.ncattrs()}
    n = int(str(attributes.get("step", number_of(path))))
    causes = causes_in(data)
    if causes is not None:
        variables |= {
            name: replace(v, parts=causes.columns) for name, v in variables.items() if name.startswith(COMMON_FACTOR)
        }
    reference = attributes.get("reference_step")
    recorded = recorded_with(home, n, None if reference is None else int(str(reference)))
    return StepResult(n, variables, attributes, cuts, Included.of(data), causes, recorded)


def causes_in(data: Any) -> Causes | None:
    """Return the causes of the columns of an open file's common factors; None if it has none."""
    held = data.variables
    return causes_of(held, held[COMMON_FACTOR].shape[-1]) if COMMON_FACTOR in held else None


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else value


def each(source: ExportSource, steps: Sequence[int] | None, names: Sequence[str] | None = None) -> Iterator[StepResult]:
    """Read the chosen steps one after the other; a variable that only some steps have is no error.

    Raises
    ------
    NotFoundError
        ``field_missing`` for a variable that no step has.
    """
    files = chosen(source, steps)
    if names is not None:
        names = [in_file(name, source.coverage) for name in names]
    require_known(files, names)
    for path in files:
        there = [] if names is None else variables_of(path, derived=True)
        wanted = None if names is None else [name for name in names if name in there]
        yield with_coverage(read_step(path, wanted, home=source.home), source)


def with_coverage(step: StepResult, source: ExportSource) -> StepResult:
    """Return a step with the expanded uncertainties that its source is asked for."""
    return replace(step, variables=with_intervals(step.variables, step.included, source.coverage))


def statement_of(step: StepResult, source: ExportSource) -> Statement:
    """Return the statement about a step's uncertainties."""
    return Statement(step.included, source.coverage)


def require_known(files: Sequence[Path], names: Sequence[str] | None) -> None:
    """Raise an error for a variable that no file has.

    Raises
    ------
    NotFoundError
        ``field_missing``, with the names that there are.
    """
    there = [set(variables_of(path, derived=True)) for path in files] if names else []
    for name in names or ():
        if not any(name in found for found in there):
            read_step(files[-1], [name])  # the error names those that there are


def variables_of(path: Path, *, derived: bool = False) -> list[str]:
    """Return the names of a result file's variables over its points, and of those that follow from them."""
    with opened(path) as data:
        held = [name for name, v in data.variables.items() if tuple(v.dimensions[:2]) == _GRID]
        return held + (derived_names(data.variables) if derived else [])


def require_same_grid(step: StepResult, first: StepResult) -> None:
    """Raise an error for steps that have different grids of points.

    Raises
    ------
    InputError
        ``steps_mixed``.
    """
    same = step.shape == first.shape and all(
        np.array_equal(step.variables[n].values, first.variables[n].values) for n in ("x_px", "y_px")
    )
    if not same:
        raise InputError(
            f"Steps {first.n} and {step.n} have different points; they cannot be stacked in one file.",
            code="steps_mixed",
            remedy="Export the steps of one analysis, or choose another format.",
        )


def without_internals(step: StepResult) -> StepResult:
    """Return a step without the variables that no reader of a table needs: angles of patches, iterations, causes."""
    kept = {name: v for name, v in step.variables.items() if name in ALWAYS or described(name).group != "Internals"}
    return replace(step, variables=kept)


def columns_of(step: StepResult, *, matrices: bool = False) -> dict[str, FileVariable]:
    """Return a step's variables with one number a point each: comparisons separate.

    Parameters
    ----------
    matrices
        Covariances (their upper triangle) and common factors too.
    """
    flat: dict[str, FileVariable] = {}
    for name, variable in step.variables.items():
        values = variable.values
        entries = matrix_columns(name, variable)
        if entries is not None:
            flat |= entries if matrices else {}
        elif values.ndim == 2:
            flat[name] = variable
        elif values.ndim == 3:
            for k in range(values.shape[2]):
                part = variable.parts[k] if k < len(variable.parts) else str(k)
                long_name = f"{variable.long_name}, {part}"
                flat[f"{name}_{part}"] = replace(variable, values=values[..., k], long_name=long_name, parts=())
    return flat
