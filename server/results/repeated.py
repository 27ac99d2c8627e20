"""Comparison of a result with a repetition of it: equal to the last bit, or their difference over the uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats.environment import Change, Environment, changes_between
from stereorig.server.formats.results.netcdf import opened

Verdict = Literal["equal", "within", "differs"]

#: largest difference that counts as within, in standard uncertainties: a repetition shares the images and so their
#: noise; only rounding remains, thousands of times smaller
WITHIN_U = 0.1
#: attributes about the origin of a result, not its content
_ORIGIN = frozenset({"created", "source", "software_version", "environment"})
#: attributes without which two results are not of the same thing
_SAME = ("kind", "step", "frame", "settings", "inputs_sha256", "patch")


@dataclass(frozen=True)
class VariableDifference:
    """Difference of one variable.

    Attributes
    ----------
    values
        Number of values that are not equal to the last bit.
    largest
        Largest absolute difference, in ``units``; None if no value is known in both.
    over_u
        Largest difference over the reported standard uncertainty; for an uncertainty itself its relative
        change; None for variables without an uncertainty.
    unmatched
        Number of values known in one of both results only.
    """

    name: str
    units: str
    values: int
    largest: float | None
    over_u: float | None
    unmatched: int


@dataclass(frozen=True)
class StepRepetition:
    """Comparison of one step with its repetition.

    Attributes
    ----------
    verdict
        ``equal``: every variable to the last bit. ``within``: the same points, and every difference at most
        ``WITHIN_U`` of its uncertainty. ``differs``: anything else.
    reasons
        Reasons why it differs, in words.
    differences
        Variables that are not equal.
    status_changed
        Points with another status.
    """

    n: int
    verdict: Verdict
    reasons: tuple[str, ...] = ()
    differences: tuple[VariableDifference, ...] = ()
    status_changed: int = 0


def compare_results(before: Path, again: Path, n: int) -> StepRepetition:
    """Compare the result of a step with its repetition.

    Raises
    ------
    FileFormatError
        A file that cannot be read.
    """
    with opened(before) as a, opened(again) as b:
        reasons = [f"its {name} is another one" for name in _SAME if _text(a, name) != _text(b, name)]
        names = sorted({*a.variables, *b.variables})
        lone = [name for name in names if name not in a.variables or name not in b.variables]
        common = [name for name in names if name not in lone]
        reshaped = [name for name in common if a.variables[name].shape != b.variables[name].shape]
        reasons += [f"{name} is in one of both results only" for name in lone]
        reasons += [f"{name} has another shape" for name in reshaped]
        differences = []
        for name in common:
            if name not in reshaped:
                found = _difference(a, b, name)
                differences += [] if found is None else [found]
        status_changed = 0
        if "status" not in (*lone, *reshaped):
            status_changed = int(np.sum(a.variables["status"][...] != b.variables["status"][...]))
        attributes = sorted(
            name for name in {*a.ncattrs(), *b.ncattrs()} - _ORIGIN - {*_SAME} if _text(a, name) != _text(b, name)
        )
    if status_changed:
        reasons.append(f"{status_changed} points have another status")
    for one in differences:
        if one.over_u is not None and not one.over_u <= WITHIN_U:
            reasons.append(f"{one.name} differs by {one.over_u:.2g} of its uncertainty")
        if one.over_u is not None and one.unmatched:
            reasons.append(f"{one.unmatched} values of {one.name} are known in one of both results only")
    verdict: Verdict = "differs" if reasons else "within" if differences or attributes else "equal"
    return StepRepetition(n, verdict, tuple(reasons), tuple(differences), status_changed)


def changes_of(before: Path, again: Path) -> list[Change]:
    """Return the differences in program, libraries and processor between the writing of two results."""
    with opened(before) as a, opened(again) as b:
        one, two = (Environment.of(_text(data, "environment")) for data in (a, b))
        versions = _text(a, "software_version"), _text(b, "software_version")
    if two is None:
        return []
    lone = one is None and versions[0] not in ("", versions[1])
    return [*([Change("version", *versions)] if lone else []), *changes_between(one, two)]


def _difference(a: Any, b: Any, name: str) -> VariableDifference | None:
    one, two = (np.ascontiguousarray(data.variables[name][...]) for data in (a, b))
    if one.dtype == two.dtype and one.tobytes() == two.tobytes():
        return None
    units = str(getattr(a.variables[name], "units", "1"))
    if one.dtype.kind not in "fiu" or two.dtype.kind not in "fiu":
        return VariableDifference(name, units, int(np.sum(one != two)), None, None, 0)
    first, second = one.astype(np.float64), two.astype(np.float64)
    known = np.isfinite(first) & np.isfinite(second)
    unmatched = int(np.sum(np.isfinite(first) != np.isfinite(second)))
    unequal = int(np.sum(known & (first != second))) + unmatched
    if unequal == 0 and one.dtype == two.dtype:
        unequal = int(np.sum(_bits(one) != _bits(two)))  # zeros of another sign
    apart = np.abs(first - second)[known]
    largest = float(apart.max()) if apart.size else None
    return VariableDifference(name, units, unequal, largest, _over_u(a, name, first, second, known), unmatched)


def _over_u(
    a: Any, name: str, first: NDArray[np.float64], second: NDArray[np.float64], known: NDArray[np.bool_]
) -> float | None:
    """Largest difference over the reported uncertainty; None for a variable without one."""
    if name.startswith("sigma_"):
        scale = first
    elif f"sigma_{name}" in a.variables:
        scale = np.asarray(a.variables[f"sigma_{name}"][...], dtype=np.float64)
    else:
        return None
    there = known & np.isfinite(scale) & (scale > 0.0)
    return float(np.max(np.abs(first - second)[there] / scale[there])) if there.any() else 0.0


def _bits(values: NDArray[Any]) -> NDArray[np.uint8]:
    return values.view(np.uint8).reshape(values.size, values.itemsize)


def _text(data: Any, name: str) -> str:
    return str(data.getncattr(name)) if name in data.ncattrs() else ""
