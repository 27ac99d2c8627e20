"""What happened in the test, by its data: slack, slipped grips, unloading, failure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.server.evaluations.cards import Mark
from stereorig.server.evaluations.tensile.curve import AXIAL, STRESS, Curve, Indices

_FAILED = 0.3  # share of the largest stress below which a specimen is broken
_SLACK = 0.01  # share of the largest stress below which a specimen hangs in its grips
_BEYOND = 4.0  # standard deviations that noise does not exceed
_AT_ONCE = 1  # a grip slips between two steps, a machine takes more of them to take the load off


@dataclass(frozen=True, eq=False)
class Course:
    """The course of a test.

    Attributes
    ----------
    loading
        Indices of the steps in which the specimen is stretched for the first time, before failure.
    failure
        Index of the first step after failure; None if it did not fail.
    marks
        What happened.
    """

    loading: Indices
    failure: int | None
    marks: tuple[Mark, ...]


def course_of(curve: Curve) -> Course:
    """Return the course of a test."""
    axial, stress = curve.values[AXIAL], curve.values[STRESS]
    marks: list[Mark] = []
    peak = int(np.argmax(stress))
    low = np.flatnonzero(stress[peak:] < _FAILED * stress[peak])
    failure = None
    # a machine that takes the load off shortens the specimen with it; the last steps stay low after a failure
    if len(low) and (stress[peak + low[0] :] < _FAILED * stress[peak]).all() and not _taken_off(curve, peak, low[0]):
        failure = peak + int(low[0])
        marks.append(Mark("failed", "The specimen broke.", (int(curve.steps[failure]),)))
    whole = np.arange(len(stress) if failure is None else failure)
    known = whole[np.isfinite(axial[whole])]
    loading, behind = _stretched(curve, known)
    marks += _runs(curve, behind)
    slack = [
        i for i in loading if i < peak and (stress[: i + 1] - stress[0] < _SLACK * (stress[peak] - stress[0])).all()
    ]
    if len(slack) > 1:
        text = f"The load stays below {_SLACK:.0%} of its largest for {len(slack)} steps: slack, or not yet started."
        marks.append(Mark("slack", text, tuple(int(curve.steps[i]) for i in slack)))
    return Course(loading, failure, tuple(marks))


def _taken_off(curve: Curve, peak: int, fell: int) -> bool:
    """Return True if the load went over several steps in which the specimen is still measured and gets shorter."""
    axial = curve.values[AXIAL, peak : peak + fell + 1]
    return fell > _AT_ONCE and bool(np.isfinite(axial).all() and (np.diff(axial[1:]) < 0.0).all())


def _stretched(curve: Curve, known: Indices) -> tuple[Indices, list[int]]:
    """Return the indices at which the strain is at its largest so far, and the others."""
    axial, own = curve.values[AXIAL], curve.own[AXIAL]
    stress, own_stress = curve.values[STRESS], curve.own[STRESS]
    loading: list[int] = []
    behind: list[int] = []
    top = -1
    for i in known.tolist():
        fell = top >= 0 and axial[i] < axial[top] - _BEYOND * float(np.hypot(own[i], own[top]))
        lower = top >= 0 and stress[i] < stress[top] - _BEYOND * float(np.hypot(own_stress[i], own_stress[top]))
        if fell and lower:
            behind.append(i)
            continue
        loading.append(i)
        top = i if top < 0 or axial[i] >= axial[top] else top
    return np.asarray(loading, dtype=np.intp), behind


def _runs(curve: Curve, behind: list[int]) -> list[Mark]:
    """Return a mark for each run of steps in which load and strain are below what they were."""
    marks = []
    for run in np.split(np.asarray(behind, dtype=np.intp), np.flatnonzero(np.diff(behind) > 1) + 1):
        if not len(run):
            continue
        steps = tuple(int(curve.steps[i]) for i in run)
        if int(np.argmin(curve.values[STRESS, run])) < _AT_ONCE and run[-1] < curve.values.shape[1] - 1:
            text = "Load and strain fell at once and came back: a grip slipped."
            marks.append(Mark("grip_slipped", text, steps, ("upper_yield", "lower_yield")))
        else:
            marks.append(Mark("unloaded", "The specimen was unloaded; these steps are left out.", steps))
    return marks
