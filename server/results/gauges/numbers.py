"""Readings as documents hold them: unknown numbers are None."""

from __future__ import annotations

import numpy as np

from stereorig.core.common.budget import Budget
from stereorig.core.gauge.reading import Reading
from stereorig.server.formats.gauges.readings import Number


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
