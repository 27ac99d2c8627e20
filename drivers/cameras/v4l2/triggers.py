"""Trigger modes of devices that have no standard way: the rig file names the controls that bring them there."""

from __future__ import annotations

from collections.abc import Mapping

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import CameraOptions, FeatureValue, TriggerMode
from stereorig.drivers.cameras.v4l2.controls import Control, Controls, Raw


class Triggers:
    """Trigger modes of one device.

    The one button among the features of ``software`` is pressed by `press`; the others are set.
    """

    def __init__(self, controls: Controls, options: CameraOptions) -> None:
        self._controls = controls
        self._path = options.device
        self._features = options.trigger_features
        self._asked: TriggerMode = "free"

    @property
    def modes(self) -> tuple[TriggerMode, ...]:
        """Free run, and the modes of the options."""
        modes: tuple[TriggerMode, ...] = ("software", "hardware")
        return ("free", *(mode for mode in modes if mode in self._features))

    def checked(self, mode: TriggerMode | None) -> list[tuple[Control, Raw]]:
        """Return the controls to set for a mode, without setting them; none for ``None``."""
        if mode is None:
            return []
        if mode not in self.modes:
            raise self._controls.out_of_range(
                "trigger", mode, f"{', '.join(self.modes)}; others need trigger_features in the rig file"
            )
        wanted = self._features_of(mode)
        found = [self._controls.check(name, value) for name, value in wanted.items()]
        if mode == "software":
            self._button()
        return [(control, raw) for control, raw in found if not control.is_button]

    def _features_of(self, mode: TriggerMode) -> Mapping[str, FeatureValue]:
        return self._features.get(mode, {})

    def _button(self) -> Control:
        buttons = [self._controls.find(name) for name in self._features_of("software")]
        buttons = [control for control in buttons if control.is_button]
        if len(buttons) != 1:
            raise CameraError(
                f"The software trigger of {self._path} names {len(buttons)} controls to press, not one.",
                code="unknown_feature",
                remedy="Name the one button that fires it in trigger_features for 'software', with the value true.",
                device=self._path,
            )
        return buttons[0]

    def mode(self) -> TriggerMode | None:
        """Return the mode whose controls have the values of its features; of several, the one that names most."""
        candidates: list[tuple[int, bool, TriggerMode]] = []
        for mode in self.modes:
            wanted = [self._controls.check(name, value) for name, value in self._features_of(mode).items()]
            wanted = [(control, raw) for control, raw in wanted if not control.is_button]
            if all(self._controls.get(control) == raw for control, raw in wanted):
                candidates.append((len(wanted), mode == self._asked, mode))
        return max(candidates, key=lambda one: one[:2])[2] if candidates else None

    def settle(self, mode: TriggerMode) -> None:
        """Check the controls of a mode after they were set; code ``setting_not_taken`` when they have other values."""
        self._asked = mode
        now = self.mode()
        if now != mode:
            raise CameraError(
                f"{self._path} was asked for trigger mode {mode!r}, and its controls still say {now!r}.",
                code="setting_not_taken",
                remedy=f"Name in trigger_features for {mode!r} the controls that bring it there.",
                device=self._path,
                setting="trigger",
            )

    def press(self, *, armed: bool) -> None:
        """Press the button of the software trigger; codes ``wrong_trigger``, ``not_armed``."""
        if self.mode() != "software":
            raise CameraError(
                f"{self._path} is in trigger mode {self.mode()!r}, not 'software'.",
                code="wrong_trigger",
                remedy="Set trigger to 'software' first.",
                device=self._path,
            )
        if not armed:
            raise CameraError(
                f"{self._path} is not armed.",
                code="not_armed",
                remedy="Arm it before it is triggered.",
                device=self._path,
            )
        self._controls.put(self._button(), 0)
