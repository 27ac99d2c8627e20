"""Action commands: one packet that makes both cameras expose, at once or at a time of their common clock."""

from __future__ import annotations

import time
from collections.abc import Mapping

from stereorig.core.errors import CameraError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.genicam.gvcp import ActionAnswer, send_action


class ActionTrigger:
    """Fires both cameras by an action command, and counts their answers in each unit's statistics.

    Parameters
    ----------
    units
        Both cameras, in trigger mode ``action``.
    keys
        Device key, group key and group mask that they were set to.
    lead_ms
        From the command to the exposures, by the clock that both cameras follow; None: at once.
    broadcast
        One packet for both if they are on one interface; else one for each.
    """

    def __init__(
        self,
        units: Mapping[CameraName, CameraUnit],
        keys: tuple[int, int, int],
        *,
        lead_ms: float | None = None,
        broadcast: bool = True,
    ) -> None:
        self._units = units
        self._keys = keys
        self._lead_ms = lead_ms
        self._broadcast = broadcast

    def fire(self) -> None:
        """Send one command.

        Raises
        ------
        CameraError
            ``no_common_clock`` if the action has a time and the cameras follow no master, or not the same one;
            ``camera_lost``.
        """
        addresses: dict[str, CameraUnit] = {}
        for cam in CAMERAS:
            unit = self._units[cam]
            _ = unit.reader
            addresses[unit.description.extra.get("address", "")] = unit
        at_ns = None if self._lead_ms is None else self._time_ns(self._lead_ms)
        answers = send_action(list(addresses), self._keys, at_ns=at_ns, broadcast=self._broadcast)
        for address, answer in answers.items():
            addresses[address].commands[f"actions_{answer}"] += 1
        if ActionAnswer.NO_TIME in answers.values():
            raise self._apart("a camera follows no master yet")

    def _time_ns(self, lead_ms: float) -> int:
        one, two = (self._units[cam] for cam in CAMERAS)
        clocks = [unit.description.clock for unit in (one, two)]
        if clocks[0] == "" or clocks[0] != clocks[1]:
            raise self._apart(f"cam1 follows {clocks[0] or 'none'}, cam2 {clocks[1] or 'none'}")
        now_ns = one.reader.device_ns(time.monotonic_ns())
        if now_ns is None:
            raise self._apart("cam1 cannot be asked for its time")
        return now_ns + round(lead_ms * 1e6)

    @staticmethod
    def _apart(why: str) -> CameraError:
        return CameraError(
            f"An action at a set time needs one master clock for both cameras: {why}.",
            code="no_common_clock",
            remedy="Set ptp = true for both cameras and wait some seconds, or leave action_lead_ms out.",
        )
