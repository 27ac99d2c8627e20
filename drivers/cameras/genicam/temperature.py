"""The temperature that a camera reports, by any name that its description gives it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.genicam.features import CameraFeatures
from stereorig.drivers.cameras.genicam.synonyms import TEMPERATURE, TEMPERATURE_PLACES, TEMPERATURE_SELECTOR

_T = TypeVar("_T")
#: zero of kelvin, degrees Celsius
_KELVIN = -273.15
#: a number beyond these is no temperature of a camera at work, but a register that is not filled
_LOW_C, _HIGH_C = -60.0, 150.0


def choose_place(features: CameraFeatures) -> None:
    """Let a camera of several thermometers report the sensor's, or the one nearest to it."""
    selector = features.first(*TEMPERATURE_SELECTOR)
    if selector is None or not features.writable(selector):
        return
    known = features.entries(selector)
    place = next((place for place in TEMPERATURE_PLACES if place in known), None)
    if place is not None and not features.is_at(selector, place):
        _asked(lambda: features.write(selector, place))


def temperature_c(features: CameraFeatures) -> float | None:
    """Return the temperature in degrees Celsius; None if the camera has none, or none that can be one.

    Raises
    ------
    CameraError
        ``camera_lost``.
    """
    name = features.first(*TEMPERATURE)
    if name is None:
        return None
    value = _asked(lambda: features.read_number(name))
    if value is None:
        return None
    value += _KELVIN if features.unit(name).strip().lower() in ("k", "kelvin") else 0.0
    return round(value, 3) if math.isfinite(value) and _LOW_C < value < _HIGH_C else None


def _asked(question: Callable[[], _T]) -> _T | None:
    """Return the answer; None if the camera has none now."""
    try:
        return question()
    except CameraError as error:
        if error.code == "camera_lost":
            raise
        return None
