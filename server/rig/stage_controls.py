"""Operations of a stage other than motion: motors, velocities, messages, abort, the configuration state."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import asdict

from stereorig.core.errors import DeviceError
from stereorig.drivers.stages.controllers import Controllers
from stereorig.drivers.stages.protocol import AxisState
from stereorig.server.rig.description import DynamicsReply, StageMessage
from stereorig.server.store.folder import now_utc

_log = logging.getLogger("stereorig.rig")
_KEPT = 200


class StageControls:
    """Controls of the stage that is connected at the moment.

    Parameters
    ----------
    stage
        Gives the connected stage, or raises ``not_connected``.
    """

    def __init__(self, stage: Callable[[], Controllers]) -> None:
        self._stage = stage
        self._messages: deque[StageMessage] = deque(maxlen=_KEPT)
        self._next_message = 1
        self._collecting = threading.Lock()
        #: axis -> velocity and acceleration that were asked for, so that a reconnected stage gets them again
        self.dynamics: dict[int, tuple[float | None, float | None]] = {}

    def abort(self) -> None:
        """Stop every axis as in an emergency and switch the motors off, now, from any thread."""
        self._stage().abort()

    def switch(self, axes: tuple[int, ...], *, on: bool) -> None:
        """Switch motors; call on the owner thread, with the hold."""
        stage = self._stage()
        since = stage.last_stop  # an abort between two axes leaves the second one off
        for axis in axes:
            if on:
                stage.enable(axis, since=since)
            else:
                stage.disable(axis)

    def read_dynamics(self, axis: int) -> DynamicsReply:
        """Return velocity and acceleration as the controller has them."""
        return DynamicsReply.model_validate(asdict(self._stage().dynamics(axis)))

    def set_dynamics(self, axis: int, velocity_mm_s: float | None, acceleration_mm_s2: float | None) -> DynamicsReply:
        """Set velocity, acceleration or both and return the values read back; on the owner thread, with the hold."""
        taken = self._stage().set_dynamics(axis, velocity_mm_s=velocity_mm_s, acceleration_mm_s2=acceleration_mm_s2)
        velocity, acceleration = self.dynamics.get(axis, (None, None))
        self.dynamics[axis] = (
            velocity if velocity_mm_s is None else velocity_mm_s,
            acceleration if acceleration_mm_s2 is None else acceleration_mm_s2,
        )
        return DynamicsReply.model_validate(asdict(taken))

    def leave_configuration(self, axis: int) -> None:
        """Leave the configuration state, which writes the flash memory; on the owner thread, with the hold."""
        self._stage().leave_configuration(axis)

    def in_configuration(self, axes: tuple[int, ...]) -> tuple[int, ...]:
        """Name the axes that a program left in configuration state: these cannot be homed."""
        stage = self._stage()
        return tuple(axis for axis in axes if stage.state(axis).state is AxisState.CONFIGURATION)

    def collect(self, stage: Controllers, *, ask: bool = True) -> None:
        """Read the controller's messages, log and keep them."""
        with self._collecting:
            for message in stage.errors(ask=ask):
                _log.warning("stage, axis %s: %s (%s)", message.axis or "-", message.text, message.code)
                entries = {"id": self._next_message, "utc": now_utc(), **asdict(message)}
                self._messages.append(StageMessage.model_validate(entries))
                self._next_message += 1

    def messages(self) -> list[StageMessage]:
        """Return the controller's messages, oldest first, with the time at which they were read; none is lost by it.

        A controller that is silent or not connected adds none.
        """
        try:
            self.collect(self._stage())
        except DeviceError as error:
            _log.info("no messages from the stage: %s", error)
        return list(self._messages)
