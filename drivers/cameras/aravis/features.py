"""GenICam features of one camera by name: kinds, ranges and increments, and errors in the project's words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from drivers.cameras.aravis.device import Device
from drivers.cameras.aravis.library import aravis
from drivers.cameras.protocol import FeatureValue

Kind = Literal["command", "enumeration", "boolean", "float", "integer", "string"]

# the first class of a node is its kind: an enumeration can be read as an integer as well
_KINDS: tuple[tuple[str, Kind], ...] = (
    ("GcCommand", "command"),
    ("GcEnumeration", "enumeration"),
    ("GcBoolean", "boolean"),
    ("GcFloat", "float"),
    ("GcInteger", "integer"),
    ("GcString", "string"),
)
# features of standard cameras that some descriptions do not put into a category
_OUTSIDE_CATEGORIES = ("Gain", "GainRaw", "GainAuto", "ExposureAuto", "BlackLevel", "BlackLevelRaw")


@dataclass(frozen=True)
class Bounds:
    """Lowest and highest value of a feature and its step; ``step`` is None where any value between will do."""

    low: float
    high: float
    step: float | None


class Features:
    """The features of an opened device.

    Every call may wait for the camera: about a millisecond for one that answers, 2.5 s for one that does not.

    Parameters
    ----------
    device
        The camera, connected.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._kinds: dict[str, Kind | None] = {}
        self.names = self._list_names()

    def _list_names(self) -> tuple[str, ...]:
        names: list[str] = []
        seen: set[str] = set()
        waiting = ["Root"]
        while waiting:
            name = waiting.pop(0)
            if name in seen:
                continue
            seen.add(name)
            node = self._device.node(name)
            if node is None:
                continue
            if isinstance(node, aravis().GcCategory):
                waiting += [str(inner) for inner in node.get_features()]
            else:
                names.append(name)
        names += [name for name in _OUTSIDE_CATEGORIES if name not in seen and self._device.node(name)]
        return tuple(names)

    def kind(self, name: str) -> Kind | None:
        """Return the kind of a feature; None when the camera has none of that name."""
        if name not in self._kinds:
            node = self._device.node(name)
            classes = [] if node is None else [k for c, k in _KINDS if isinstance(node, getattr(aravis(), c))]
            self._kinds[name] = classes[0] if classes else None
        return self._kinds[name]

    def has(self, name: str) -> bool:
        """Return True if the camera has it and it can be used now."""
        if self.kind(name) is None:
            return False
        return bool(self._device.ask("is_feature_available", name))

    def first(self, *names: str) -> str | None:
        """Return the first of several names that the camera has."""
        return next((name for name in names if self.has(name)), None)

    def writable(self, name: str) -> bool:
        """Return True if the camera has it and it can be written at all."""
        if not self.has(name):
            return False
        mode = self._device.ask("get_feature_access_mode", name)
        return bool(mode != aravis().GcAccessMode.RO)

    def locked(self, name: str) -> bool:
        """Return True if it must not be written now."""
        return self.kind(name) is not None and bool(self._device.ask_node(name, "is_locked"))

    def unit(self, name: str) -> str:
        """Return the unit in the camera's description, or an empty string."""
        return str(self._device.ask_node(name, "get_unit") or "") if self.kind(name) in ("float", "integer") else ""

    def read(self, name: str) -> FeatureValue:
        """Return its value as the camera has it.

        Raises
        ------
        CameraError
            ``unknown_feature`` for a name that the camera does not have or a command; ``camera_lost``.
        """
        kind = self._known(name)
        if kind == "command":
            raise self._device.unknown(name, "is a command and has no value")
        method = "string" if kind == "enumeration" else kind
        value = self._device.ask(f"get_{method}_feature_value", name)
        if method == "string":
            return str(value or "")
        if method == "boolean":
            return bool(value)
        return int(value) if method == "integer" else float(value)

    def read_number(self, name: str) -> float:
        """Return the value of an integer or float feature."""
        value = self.read(name)
        if isinstance(value, str):
            raise self._device.unknown(name, "is no number")
        return float(value)

    def entries(self, name: str) -> tuple[str, ...]:
        """Values that an enumeration can have now."""
        entries = self._device.ask("dup_available_enumeration_feature_values_as_strings", name)
        return tuple(str(entry) for entry in entries or ())

    def bounds(self, name: str) -> Bounds:
        """Range of an integer or float feature, as the camera has it now."""
        ask = self._device.ask
        if self.kind(name) == "integer":
            low, high = ask("get_integer_feature_bounds", name)
            return Bounds(int(low), int(high), max(1, int(ask("get_integer_feature_increment", name))))
        low, high = ask("get_float_feature_bounds", name)
        step = float(ask("get_float_feature_increment", name))
        # without an increment Aravis gives the smallest number there is
        return Bounds(float(low), float(high), step if 1e-300 < step < math.inf else None)

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
                raise self._device.out_of_range(shown, value, "true" if kind == "command" else "true or false")
            return value
        if kind == "enumeration":
            known = self.entries(name)
            if value not in known:
                raise self._device.out_of_range(shown, value, "one of " + ", ".join(known))
            return value
        if kind == "string":
            if not isinstance(value, str):
                raise self._device.out_of_range(shown, value, "text")
            return value
        return self._check_number(name, value, shown, scale)

    def _check_number(self, name: str, value: FeatureValue, shown: str, scale: float) -> FeatureValue:
        bounds = self.bounds(name)
        allowed = f"{bounds.low / scale:g} to {bounds.high / scale:g}"
        if bounds.step is not None and bounds.step != 1:
            allowed += f" in steps of {bounds.step / scale:g}"
        given = value if scale == 1.0 or isinstance(value, bool | str) else value / scale
        if isinstance(value, bool | str) or not bounds.low <= value <= bounds.high:  # NaN is in no range
            raise self._device.out_of_range(shown, given, allowed)
        if self.kind(name) == "integer":
            if value != int(value) or (bounds.step is not None and (int(value) - int(bounds.low)) % int(bounds.step)):
                raise self._device.out_of_range(shown, given, "whole numbers, " + allowed)
            return int(value)
        return float(value)

    def write(self, name: str, value: FeatureValue) -> None:
        """Set it; `check_value` first gives the better error texts.

        Raises
        ------
        CameraError
            ``out_of_range``, ``unknown_feature``, ``camera_lost``.
        """
        kind = self._known(name)
        if not self.writable(name):
            raise self._device.unknown(name, "can only be read")
        if kind == "command":
            if value is True:
                self._device.ask("execute_command", name)
            return
        method = "string" if kind == "enumeration" else kind
        self._device.ask(f"set_{method}_feature_value", name, value)

    def _known(self, name: str) -> Kind:
        kind = self.kind(name)
        if kind is None:
            raise self._device.unknown(name, "is not there")
        if not self.has(name):
            raise self._device.unknown(name, "cannot be used now")
        return kind
