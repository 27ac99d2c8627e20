"""GenICam features of one camera through pylon: kinds, values, ranges and increments."""

from __future__ import annotations

import math
from typing import Any

from stereorig.drivers.cameras.genicam.features import Bounds, CameraFeatures, Kind
from stereorig.drivers.cameras.protocol import FeatureValue
from stereorig.drivers.cameras.pylon.device import PylonDevice
from stereorig.drivers.cameras.pylon.library import genapi

_KINDS: dict[str, Kind] = {
    "intfICommand": "command",
    "intfIEnumeration": "enumeration",
    "intfIBoolean": "boolean",
    "intfIFloat": "float",
    "intfIInteger": "integer",
    "intfIString": "string",
}


class PylonFeatures(CameraFeatures):
    """The features of an opened device.

    Parameters
    ----------
    device
        The camera, connected.
    """

    def __init__(self, device: PylonDevice) -> None:
        super().__init__(device)
        self._device = device
        self._nodes: dict[str, Any] = {}
        self._kinds: dict[str, Kind | None] = {}
        with device.asked() as camera:
            self._map = camera.GetNodeMap()
            self.names = tuple(self._names_in("Root", set()))

    def _names_in(self, category: str, seen: set[str]) -> list[str]:
        names: list[str] = []
        for node in self._map.GetNode(category).GetFeatures():
            name = str(node.GetNode().GetName())
            if name in seen:
                continue
            seen.add(name)
            if node.GetNode().GetPrincipalInterfaceType() == genapi().intfICategory:
                names += self._names_in(name, seen)
            elif self.kind(name) is not None:
                names.append(name)
        return names

    def _node(self, name: str) -> Any:
        if name not in self._nodes:
            self._nodes[name] = self._map.GetNode(name)
        return self._nodes[name]

    def release(self) -> None:
        """Let go of the camera's description, which must not outlive the camera."""
        self._nodes.clear()
        self._map = None

    def kind(self, name: str) -> Kind | None:
        """Return the kind of a feature; None when the camera has none of that name."""
        if name not in self._kinds:
            with self._device.asked(name):
                node = self._node(name)
                there = node is not None and genapi().IsImplemented(node)
                face = node.GetNode().GetPrincipalInterfaceType() if there else None
                kinds = (kind for word, kind in _KINDS.items() if face == getattr(genapi(), word))
                self._kinds[name] = next(kinds, None)
        return self._kinds[name]

    def has(self, name: str) -> bool:
        """Return True if the camera has it and it can be used now."""
        if self.kind(name) is None:
            return False
        with self._device.asked(name):
            return bool(genapi().IsAvailable(self._node(name)))

    def writable(self, name: str) -> bool:
        """Return True if the camera has it and it can be written now."""
        if self.kind(name) is None:
            return False
        with self._device.asked(name):
            return bool(genapi().IsWritable(self._node(name)))

    def locked(self, name: str) -> bool:
        """Return True if it cannot be written while the camera sends."""
        lock = "TLParamsLocked"
        return self.has(name) and not self.writable(name) and self.has(lock) and self.read(lock) == 1

    def unit(self, name: str) -> str:
        """Return the unit in the camera's description, or an empty string."""
        if self.kind(name) not in ("float", "integer"):
            return ""
        with self._device.asked(name):
            return str(self._node(name).GetUnit() or "")

    def read(self, name: str) -> FeatureValue:
        """Return its value as the camera has it; errors as `Features.read` names them."""
        kind = self._known(name)
        if kind == "command":
            raise self._device.unknown(name, "is a command and has no value")
        with self._device.asked(name):
            value = self._node(name).GetValue()
        if kind == "boolean":
            return bool(value)
        return int(value) if kind == "integer" else float(value) if kind == "float" else str(value)

    def _numbers(self, name: str) -> dict[str, int]:
        """Return the entries of an enumeration that can be had now, with their numbers."""
        with self._device.asked(name):
            entries = [entry for entry in self._node(name).GetEntries() if genapi().IsAvailable(entry)]
            return {str(entry.GetSymbolic()): int(entry.GetValue()) for entry in entries}

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the values that an enumeration can have now."""
        return tuple(self._numbers(name)) if self.kind(name) == "enumeration" else ()

    def is_at(self, name: str, value: FeatureValue) -> bool:
        """Return True if a feature has a value; two names of an enumeration's one value are the same."""
        present = self.read(name)
        if present == value or self.kind(name) != "enumeration":
            return present == value
        numbers = self._numbers(name)
        return value in numbers and numbers.get(str(present)) == numbers[str(value)]

    def bounds(self, name: str) -> Bounds:
        """Return the range of an integer or float feature, as the camera has it now."""
        kind = self._known(name)
        if kind not in ("integer", "float"):
            return Bounds(-math.inf, math.inf, None)
        with self._device.asked(name):
            node = self._node(name)
            low, high = node.GetMin(), node.GetMax()
            if kind == "integer":
                return Bounds(low, high, max(1, int(node.GetInc())))
            return Bounds(low, high, float(node.GetInc()) or None if node.HasInc() else None)

    def write(self, name: str, value: FeatureValue) -> None:
        """Set it; errors as `Features.write` names them."""
        kind = self._known(name)
        if not self.writable(name):
            raise self._device.unknown(name, "can only be read")
        with self._device.asked(name, value):
            if kind != "command":
                self._node(name).SetValue(value)
            elif value is True:
                self._node(name).Execute()
