"""The one door for evaluations: what an evaluation declares, what it is given, and how it is found.

A package offers an evaluation by an entry point of the group ``stereorig.evaluations``::

    [project.entry-points."stereorig.evaluations"]
    flatness = "my_package.flatness:Flatness"

API, command line, library and page then have it, without a further line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic.json_schema import JsonSchemaValue

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import InputError, MeasurementError, StereorigError
from stereorig.core.field.points.result import Field
from stereorig.core.progress import Progress, no_progress
from stereorig.core.strain import StrainField
from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.json_values import without_nan
from stereorig.server.evaluations.histories import Deflection, Ends, History, Mean, history
from stereorig.server.formats.results.folder import file_of_step, home_of, number_of
from stereorig.server.formats.results.reading import ResultHead, read_field, read_head
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.variables import SIGMA, values_of
from stereorig.server.results.channels import Recorded, recorded_with
from stereorig.server.wording import problems_in

GROUP = "stereorig.evaluations"
#: names of evaluations, part of addresses and file names
NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")


@dataclass(frozen=True, eq=False)
class GridValues:
    """A variable that an evaluation adds to a step's points.

    Attributes
    ----------
    values
        (rows, cols) as the step's points; NaN where there is none.
    units
        Unit of the values, ``1`` for a ratio.
    long_name
        Meaning in one sentence.
    """

    values: Float
    units: str
    long_name: str


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Return value of an evaluation.

    Attributes
    ----------
    document
        Instance of the evaluation's ``document``.
    step
        Step whose points ``variables`` belong to.
    variables
        Variables over the points, by name; they are written to the VTU file beside the document.
    files
        Further files that are written beside it: text by the end of the name, as ``.csv``.
    """

    document: BaseModel
    step: int = 0
    variables: Mapping[str, GridValues] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)


class Results:
    """The finished steps of an analysis, each read from its file when it is first asked for.

    Parameters
    ----------
    files
        Result files of one measurement.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = {number_of(path): path for path in sorted(files)}
        # a long test's fields do not fit into memory at once
        self._field = lru_cache(maxsize=2)(read_field)
        self._strain = lru_cache(maxsize=2)(read_strain)

    @property
    def steps(self) -> tuple[int, ...]:
        """Numbers of the steps, ascending."""
        return tuple(self._files)

    def file(self, step: int) -> Path:
        """Return the result file of a step.

        Raises
        ------
        InputError
            ``step_missing``.
        """
        return file_of_step(self._files, step)

    def head(self, step: int) -> ResultHead:
        """Return settings, frame and provenance of a step."""
        return read_head(self.file(step))

    def field(self, step: int) -> Field:
        """Return positions, displacements and their covariances."""
        return self._field(self.file(step))

    def strain(self, step: int) -> StrainField | None:
        """Return the strain; None for a shape, or if it was switched off."""
        return self._strain(self.file(step))

    def valid(self, step: int) -> Bool:
        """Return (rows, cols) True where a point has values."""
        return self.field(step).valid

    def values(self, step: int, name: str) -> Float:
        """Return a variable (rows, cols) by its name in result files: ``w_mm``, ``exx``, ``sigma_exx``.

        Raises
        ------
        InputError
            ``evaluation_needs`` if the step has no such variable.
        """
        found = values_of(self.field(step), self.strain(step), name)
        if found is None:
            raise InputError(
                f"Step {step} has no variable {name!r}.",
                code="evaluation_needs",
                remedy="Name a variable that the step has; strain must be switched on when it is measured.",
                variable=name,
                step=step,
            )
        return np.asarray(found, dtype=np.float64)

    def sigma(self, step: int, name: str) -> Float:
        """Return the standard uncertainty (k = 1) of a variable; raises as :meth:`values`."""
        return self.values(step, SIGMA + name)

    def recorded(self, step: int) -> Recorded:
        """Return load, channels and time of a step, as far as they are known."""
        head = self.head(step)
        found = recorded_with(home_of(self.file(step)), head.step, head.reference_step)
        return found if found.load_n is not None else replace(found, load_n=head.load_n)

    def history(self, gauge: Ends | Mean | Deflection) -> History:
        """Return a strain or a deflection over :attr:`steps`, with the errors that they share; see :func:`history`."""
        return history([*self._files.values()], gauge)


class Evaluation(Protocol):
    """What an evaluation declares; an instance is made without arguments.

    Attributes
    ----------
    name
        Name in addresses and on the command line: lower case, digits, ``-`` and ``_``.
    title
        Name for people.
    settings
        Model of the settings; every field needs a description, and the schema an example if fields are required.
    document
        Model of the answer. A field ``verdict`` is shown first; a field ``accepted`` that is false ends the command
        with 1.
    needs
        Variables that the chosen steps must have, such as ``w_mm`` or ``exx``.

    Notes
    -----
    An evaluation may have a method ``over``, from documents by the name of each measurement to an `Evaluated` over all
    of them.
    """

    name: str
    title: str
    settings: type[BaseModel]
    document: type[BaseModel]
    needs: frozenset[str]

    def run(self, results: Results, asked: Any, progress: Progress) -> Evaluated:
        """Work out the document from the results; ``asked`` is an instance of ``settings``."""
        ...


@dataclass(frozen=True)
class Described:
    """An evaluation as lists show it.

    Attributes
    ----------
    settings, document
        JSON schema of both models.
    problem
        Reason why it cannot be used; empty if it can.
    """

    name: str
    title: str = ""
    needs: Sequence[str] = ()
    settings: JsonSchemaValue = field(default_factory=dict)
    document: JsonSchemaValue = field(default_factory=dict)
    package: str = ""
    problem: str = ""


def described() -> list[Described]:
    """Return every evaluation that is installed, by name; one that does not load states its problem."""
    found = []
    for entry in _entries():
        package = "" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
        try:
            made = _loaded(entry)
        except StereorigError as error:
            found.append(Described(entry.name, package=package, problem=error.cause))
            continue
        schemas = made.settings.model_json_schema(), made.document.model_json_schema(mode="serialization")
        found.append(Described(made.name, made.title, sorted(made.needs), *schemas, package=package))
    return found


def evaluation(name: str) -> Evaluation:
    """Return an evaluation by its name.

    Raises
    ------
    NotFoundError
        ``evaluation_missing``, with the names that there are.
    MeasurementError
        ``evaluation_broken`` if its package does not load or lacks a declaration.
    """
    entries = {entry.name: entry for entry in _entries()}
    if name not in entries:
        raise NotFoundError(
            f"No evaluation {name[:40]!r} is installed; there are {', '.join(entries)}.",
            code="evaluation_missing",
            remedy="Use one of these names, or install the package that has it.",
            available=list(entries),
        )
    return _loaded(entries[name])


def evaluate(made: Evaluation, files: Sequence[Path], settings: Mapping[str, object], progress: Progress) -> Evaluated:
    """Run an evaluation over the result files of one measurement.

    Raises
    ------
    InputError
        ``results_missing`` without files; ``evaluation_settings`` for settings that do not fit its model;
        ``evaluation_needs`` if no step has one of the variables that it needs.
    MeasurementError
        ``evaluation_failed`` for an exception that is none of the program's own, or an answer of another kind.
    """
    results = Results(files)
    if not results.steps:
        raise InputError("There is no result file.", code="results_missing", remedy="Measure first.")
    try:
        asked = made.settings.model_validate(dict(settings))
    except ValidationError as error:
        raise InputError(
            f"{made.name}: {problems_in(error)[0]}",
            code="evaluation_settings",
            remedy="Correct the setting; `stereorig evaluate` without a name lists each evaluation's settings.",
        ) from error
    last = results.steps[-1]
    for name in sorted(made.needs):
        results.values(last, name)
    try:
        outcome = made.run(results, asked, progress)
    except StereorigError:
        raise
    except Exception as error:  # an evaluation may be anybody's
        raise MeasurementError(
            f"{made.name} ended with {type(error).__name__}: {error}.",
            code="evaluation_failed",
            remedy="Report this to the author of the evaluation.",
        ) from error
    if not isinstance(outcome, Evaluated) or not isinstance(outcome.document, made.document):
        raise MeasurementError(
            f"{made.name} returned {type(outcome).__name__} in place of its document {made.document.__name__}.",
            code="evaluation_failed",
            remedy="Report this to the author of the evaluation.",
        )
    return outcome


def evaluate_named(files: Sequence[str], name: str, settings: Mapping[str, object]) -> dict[str, object]:
    """Run an evaluation by its name and return its document as JSON data; runs in the export process."""
    outcome = evaluate(evaluation(name), [Path(file) for file in files], settings, no_progress)
    return document_of(outcome)


def document_of(outcome: Evaluated) -> dict[str, object]:
    """Return the document as JSON data; a number that is not finite is missing."""
    found: dict[str, object] = without_nan(outcome.document.model_dump(mode="json"))
    return found


def _entries() -> list[EntryPoint]:
    return sorted(entry_points(group=GROUP), key=lambda entry: entry.name)


def _loaded(entry: EntryPoint) -> Evaluation:
    def broken(why: str) -> MeasurementError:
        return MeasurementError(
            f"The evaluation {entry.name} ({entry.value}) cannot be used: {why}.",
            code="evaluation_broken",
            remedy="Correct its package, or remove it.",
        )

    try:
        made = entry.load()()
    except Exception as error:
        raise broken(f"{type(error).__name__}: {error}") from error
    lacking = [name for name in ("name", "title", "settings", "document", "needs", "run") if not hasattr(made, name)]
    if lacking:
        raise broken(f"it declares no {', '.join(lacking)}")
    if made.name != entry.name or not NAME.fullmatch(made.name):
        raise broken(f"its name is {made.name!r}")
    loaded: Evaluation = made
    return loaded
