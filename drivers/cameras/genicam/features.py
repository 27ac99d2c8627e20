"""GenICam features of one camera by name: checks of values, and errors in the project's words."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

from stereorig.drivers.cameras.genicam.errors import NamedCamera
from stereorig.drivers.cameras.protocol import FeatureValue

Kind = Literal["command", "enumeration", "boolean", "float", "integer", "string"]


@dataclass(frozen=True)
class Bounds:
    """Lowest and highest value of a feature and its step.

    ``step`` is None if any value between will do; the ends are infinite if the camera's description gives none that
    hold.
    """

    low: float
    high: float
    step: float | None

    @property
    def first(self) -> int:
        """Return the number from which steps are counted."""
        return int(self.low) if math.isfinite(self.low) else 0

    @property
    def known(self) -> bool:
        """Return True if both ends are known."""
        return math.isfinite(self.low) and math.isfinite(self.high)


class CameraFeatures(ABC):
    """The features of an opened device.

    Parameters
    ----------
    device
        The camera, connected.

    Attributes
    ----------
    names
        Names of all features, in the order of the camera's description.
    """

    names: tuple[str, ...]

    def __init__(self, device: NamedCamera) -> None:
        self._camera = device

    @abstractmethod
    def kind(self, name: str) -> Kind | None:
        """Return the kind of a feature; None when the camera has none of that name."""

    @abstractmethod
    def has(self, name: str) -> bool:
        """Return True if the camera has it and it can be used now."""

    @abstractmethod
    def writable(self, name: str) -> bool:
        """Return True if the camera has it and it can be written, now or at another time."""

    @abstractmethod
    def locked(self, name: str) -> bool:
        """Return True if it must not be written now."""

    @abstractmethod
    def unit(self, name: str) -> str:
        """Return the unit in the camera's description, or an empty string."""

    @abstractmethod
    def read(self, name: str) -> FeatureValue:
        """Return its value as the camera has it.

        Raises
        ------
        CameraError
            ``unknown_feature`` for a name that the camera does not have or a command; ``camera_lost``.
        """

    @abstractmethod
    def entries(self, name: str) -> tuple[str, ...]:
        """Return the values that an enumeration can have now."""

    @abstractmethod
    def is_at(self, name: str, value: FeatureValue) -> bool:
        """Return True if a feature has a value; two names of an enumeration's one value are the same."""

    @abstractmethod
    def bounds(self, name: str) -> Bounds:
        """Return the range of an integer or float feature, as the camera has it now."""

    @abstractmethod
    def write(self, name: str, value: FeatureValue) -> None:
        """Set it; `check_value` first gives the better error texts.

        Raises
        ------
        CameraError
            ``out_of_range``, ``unknown_feature``, ``camera_lost``.
        """

    def first(self, *names: str) -> str | None:
        """Return the first of several names that the camera has."""
        return next((name for name in names if self.has(name)), None)

    def read_number(self, name: str) -> float:
        """Return the value of an integer or float feature."""
        value = self.read(name)
        if isinstance(value, str):
            raise self._camera.unknown(name, "is no number")
        return float(value)

    def check_value(self, name: str, value: FeatureValue, shown: str | None = None, scale: float = 1.0) -> FeatureValue:
        """Return the value as the feature takes it, or raise ``out_of_range`` with the allowed values.

        Parameters
        ----------
        name, value
            Feature, and value in the camera's unit.
        shown, scale
            For the error text: the setting's name, and the number of the camera's units in one of its units.
        """
        kind = self._known(name)
        shown = shown or name
        if kind in ("command", "boolean"):
            if not isinstance(value, bool):
                raise self._camera.out_of_range(shown, value, "true" if kind == "command" else "true or false")
            return value
        if kind == "enumeration":
            known = self.entries(name)
            if value not in known:
                raise self._camera.out_of_range(shown, value, "one of " + ", ".join(known))
            return value
        if kind == "string":
            if not isinstance(value, str):
                raise self._camera.out_of_range(shown, value, "text")
            return value
        return self._check_number(name, value, shown, scale)

    def _check_number(self, name: str, value: FeatureValue, shown: str, scale: float) -> FeatureValue:
        bounds = self.bounds(name)
        allowed = f"{bounds.low / scale:g} to {bounds.high / scale:g}" if bounds.known else "numbers"
        if bounds.step is not None and bounds.step != 1:
            allowed += f" in steps of {bounds.step / scale:g}"
        given = value if scale == 1.0 or isinstance(value, bool | str) else value / scale
        if isinstance(value, bool | str) or not bounds.low <= value <= bounds.high:  # NaN is in no range
            raise self._camera.out_of_range(shown, given, allowed)
        if self.kind(name) == "integer":
            whole = math.isfinite(value) and value == int(value)
            if not whole or (bounds.step is not None and (int(value) - bounds.first) % int(bounds.step)):
                raise self._camera.out_of_range(shown, given, "whole numbers, " + allowed)
            return int(value)
        return float(value)

    def check_taken(self, name: str, value: FeatureValue) -> None:
        """Raise ``out_of_range`` if the camera has not taken a value that no range could refuse beforehand."""
        kind = self.kind(name)
        unlimited = kind == "enumeration" or (kind == "integer" and not self.bounds(name).known)
        if unlimited and not self.is_at(name, value):
            raise self._camera.out_of_range(name, value, f"what the camera takes: it made {self.read(name)} of it")

    def _known(self, name: str) -> Kind:
        kind = self.kind(name)
        if kind is None:
            raise self._camera.unknown(name, "is not there")
        if not self.has(name):
            raise self._camera.unknown(name, "cannot be used now")
        return kind
