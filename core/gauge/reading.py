"""A number with its standard uncertainty."""

from __future__ import annotations

from typing import NamedTuple


class Reading(NamedTuple):
    """One number read off a field.

    Attributes
    ----------
    value
        NaN where it is missing.
    sigma
        Standard uncertainty in the value's unit; NaN where it is not known.
    sigma_calibration
        The calibration's part of it; NaN where that is not known, and then not included.
    """

    value: float
    sigma: float
    sigma_calibration: float = float("nan")


MISSING = Reading(float("nan"), float("nan"))
