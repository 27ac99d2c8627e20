"""Differences of gauges' readings from one step's: the uncertainty that both steps share cancels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from stereorig.core.common.budget import Budget
from stereorig.core.errors import InputError
from stereorig.core.gauge.align import Alignment
from stereorig.core.gauge.reading import Reading, difference
from stereorig.core.gauge.rigid import RigidMotion
from stereorig.server.formats.gauges.readings import (
    DifferenceReading,
    FrameReading,
    Number,
    RigidMotionReading,
    StepReadings,
)

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


# Frames and rigid motions, as readings state them.

_MOTION = (("rotation", "rad"), ("translation", "mm"))


def frame_reading(alignment: Alignment) -> FrameReading:
    """Return a frame as readings state it."""
    sigma = np.sqrt(np.diag(alignment.covariance))
    return FrameReading(
        rotation=alignment.rotation.tolist(),
        origin_mm=alignment.origin_mm.tolist(),
        sigma_rad=sigma[:3].tolist(),
        sigma_origin_mm=sigma[3:].tolist(),
        residual_rms_mm=alignment.residual_rms_mm,
        points=alignment.points,
        budget_rad=[one.document() for one in alignment.budgets[:3]],
        budget_origin_mm=[one.document() for one in alignment.budgets[3:]],
    )


def motion_reading(motion: RigidMotion) -> RigidMotionReading:
    """Return a rigid motion as readings state it."""
    sigma = np.sqrt(np.diag(motion.covariance))
    found = np.concatenate([motion.rotation_vector_rad, motion.translation_mm])
    names = [f"{quantity}_{axis}_{unit}" for quantity, unit in _MOTION for axis in "xyz"]
    units = [unit for _, unit in _MOTION for _ in range(3)]
    numbers = zip(names, found, sigma, units, motion.sigma_common, motion.budgets, strict=True)
    return RigidMotionReading(
        values={
            name: number(Reading(float(value), float(s), float(part), budget), unit)
            for name, value, s, unit, part, budget in numbers
        },
        centre_mm=motion.centre_mm.tolist(),
        covariance=motion.covariance.tolist(),
        points=motion.points,
        residual_rms_mm=motion.residual_rms_mm,
        noise_ratio=motion.noise_ratio,
    )


# Readings as documents hold them: unknown numbers are None.


def finite(value: float) -> float | None:
    """Return a number; None if it is not finite."""
    return float(value) if np.isfinite(value) else None


def plain(budget: Budget) -> dict[str, float] | None:
    """Return a budget's parts by name; None if no part is known."""
    return dict(budget.document()) or None


def number(reading: Reading, units: str) -> Number:
    """Return a reading as documents hold it."""
    return Number(
        finite(reading.value), finite(reading.sigma), units, finite(reading.sigma_calibration), plain(reading.budget)
    )
