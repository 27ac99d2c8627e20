"""From a curve to the numbers of a standard: found, doubtful, or missing with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.evaluations.cards import Lack, Mark
from stereorig.server.evaluations.tensile.checks import doubts, doubts_of_load
from stereorig.server.evaluations.tensile.curve import Curve
from stereorig.server.evaluations.tensile.events import course_of
from stereorig.server.evaluations.tensile.planning import Asked, planned
from stereorig.server.evaluations.tensile.profiles import Profile
from stereorig.server.evaluations.tensile.propagate import Uncertain, uncertain_numbers


@dataclass(frozen=True)
class Found:
    """A number of the card.

    Attributes
    ----------
    number
        With its uncertainty; None if there is none.
    lack
        Why there is none.
    doubts
        Codes of the marks that make it doubtful.
    """

    number: Uncertain | None = None
    lack: Lack | None = None
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Assessed:
    """The numbers of a test.

    Attributes
    ----------
    numbers
        By the profile's keys.
    marks
        What happened, and what is doubtful.
    toe
        Strain at which the modulus' line has no stress; None without a modulus.
    used
        Steps of the modulus' window.
    """

    numbers: Mapping[str, Found]
    marks: tuple[Mark, ...]
    toe: Uncertain | None = None
    used: tuple[int, ...] = field(default=())


def assessed(curve: Curve, profile: Profile, asked: Asked, expected: Float | None = None) -> Assessed:
    """Return the numbers of a test; parameters as of the functions that find them."""
    if curve.values.shape[1] < 3:
        lack = Lack("too_few_steps", f"{curve.values.shape[1]} steps have a load and a strain.")
        return Assessed({key: Found(lack=lack) for key in profile.numbers}, ())
    course = course_of(curve)
    chosen = planned(curve, course, profile, asked)
    marks = (*course.marks, *doubts_of_load(curve, course), *chosen.marks)
    if chosen.plan is None:
        return Assessed({key: Found(lack=chosen.lacks[key]) for key in profile.numbers}, marks)
    found = uncertain_numbers(curve, chosen.plan)
    marks += tuple(doubts(curve, chosen.plan, profile, found, expected))
    numbers = {}
    for key in profile.numbers:
        if key in chosen.lacks or key not in found or not np.isfinite(found[key].value):
            numbers[key] = Found(lack=chosen.lacks.get(key, Lack("not_found", "The steps do not determine it.")))
            continue
        one = found[key]
        if key in chosen.sampling:
            one = Uncertain(one.value, {**one.parts, "sampling": chosen.sampling[key]})
        numbers[key] = Found(one, doubts=tuple(mark.code for mark in marks if key in mark.spoils))
    return Assessed(numbers, marks, found["toe"], tuple(int(curve.steps[i]) for i in chosen.plan.window))
