"""Differences of gauges' readings from one step's: the uncertainty that both steps share cancels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from stereorig.core.errors import InputError
from stereorig.core.gauge.reading import Reading, difference
from stereorig.server.formats.gauges.readings import DifferenceReading, Number, StepReadings
from stereorig.server.results.gauges.numbers import number

#: of the reference itself: no step differs in them
_OF_REFERENCE = frozenset({"x_mm", "y_mm", "z_mm", "length0_mm"})


class KeptReading(NamedTuple):
    """A gauge's reading with the data that its difference from another step needs."""

    gauge: str | None
    kind: str
    quantity: str
    units: str
    reading: Reading


def with_differences(
    steps: Sequence[StepReadings], kept: Sequence[Sequence[KeptReading]], base: int
) -> list[StepReadings]:
    """Return the readings of steps with their differences from one of them.

    Parameters
    ----------
    steps
        Readings of each step.
    kept
        For each step, the readings of its gauges.
    base
        Number of the step that is taken from the others.

    Raises
    ------
    InputError
        ``gauge_unusable`` if that step is the reference, or has no readings.
    """
    at = [step.n for step in steps].index(base)
    if steps[at].kind != "displacement" or steps[at].problem is not None:
        raise InputError(
            f"Differences are asked for from step {base}, which is the reference or has no readings.",
            code="gauge_unusable",
            remedy="Ask for another step; displacements and strains are differences from the reference as they are.",
        )
    before = {entry[:3]: entry.reading for entry in kept[at]}
    return [
        step if k == at or step.kind != "displacement" else replace(step, differences=_of(kept[k], before))
        for k, step in enumerate(steps)
    ]


def _of(now: Sequence[KeptReading], before: dict[tuple[str | None, str, str], Reading]) -> list[DifferenceReading]:
    found: dict[tuple[str | None, str], dict[str, Number]] = {}
    for entry in now:
        if entry.quantity not in _OF_REFERENCE and entry[:3] in before:
            change = difference(before[entry[:3]], entry.reading)
            found.setdefault(entry[:2], {})[entry.quantity] = number(change, entry.units)
    return [DifferenceReading(gauge, kind, values) for (gauge, kind), values in found.items()]
