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
    """

    value: float
    sigma: float


MISSING = Reading(float("nan"), float("nan"))
