"""GenICam features of one camera through Aravis: kinds, values, ranges and increments."""

from __future__ import annotations

import math
from typing import Any

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.aravis.device import AravisDevice
from stereorig.drivers.cameras.aravis.library import aravis
from stereorig.drivers.cameras.genicam.features import Bounds, CameraFeatures, Kind
from stereorig.drivers.cameras.protocol import FeatureValue

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


class AravisFeatures(CameraFeatures):
    """The features of an opened device.

    Every call may wait for the camera: about a millisecond for one that answers, 2.5 s for one that does not.

    Parameters
    ----------
    device
        The camera, connected.
    """

    def __init__(self, device: AravisDevice) -> None:
        super().__init__(device)
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
        if method == "string":
            return self._device.text(f"get_{method}_feature_value", name)
        value = self._device.ask(f"get_{method}_feature_value", name)
        if method == "boolean":
            return bool(value)
        return int(value) if method == "integer" else float(value)

    def entries(self, name: str) -> tuple[str, ...]:
        """Return the values that an enumeration can have now."""
        entries = self._if_given("dup_available_enumeration_feature_values_as_strings", name)
        return tuple(str(entry) for entry in entries or ())

    def is_at(self, name: str, value: FeatureValue) -> bool:
        """Return True if a feature has a value; two names of an enumeration's one value are the same."""
        present = self.read(name)
        if present == value or self.kind(name) != "enumeration":
            return present == value
        numbers = {str(entry.get_name()): entry.get_value() for entry in self._device.node(name).get_entries()}
        return value in numbers and numbers.get(str(present)) == numbers[str(value)]

    def bounds(self, name: str) -> Bounds:
        """Return the range of an integer or float feature, as the camera has it now.

        Aravis takes both ends of a register through the description's formula; behind a formula that neither grows nor
        falls both come out as the same number, which is no range unless it is the present value.
        """
        method = "integer" if self.kind(name) == "integer" else "float"
        number = int if method == "integer" else float
        ends = self._if_given(f"get_{method}_feature_bounds", name)
        step = self._if_given(f"get_{method}_feature_increment", name)
        present = self._if_given(f"get_{method}_feature_value", name)
        low, high = (-math.inf, math.inf) if ends is None else (number(end) for end in ends)
        if low > high or (low == high and present is not None and present != low):
            low, high = -math.inf, math.inf
        if method == "integer":
            return Bounds(low, high, max(1, int(step or 1)))
        # without an increment Aravis gives the smallest number there is
        return Bounds(low, high, None if step is None or not 1e-300 < step < math.inf else float(step))

    def _if_given(self, method: str, name: str) -> Any:
        """Return the answer to a question; None if the camera's description does not hold it."""
        try:
            return self._device.ask(method, name)
        except CameraError as error:
            if error.code != "unknown_feature":
                raise
            return None

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
