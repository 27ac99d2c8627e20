"""Commands of a controller, as a stage driver defines them; `SerialStage` is built on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from stereorig.drivers.stages.protocol import AxisStatus, ControllerMessage, StageIdentity


class ControllerLine(Protocol):
    """Connection to a controller for `SerialStage`; `stereorig.drivers.stages.serial_line.SerialLine` is one."""

    url: str

    @property
    def is_open(self) -> bool:
        """True if it is open; independent of the device at the other end."""

    def open(self) -> None:
        """Connect."""

    def renew(self) -> None:
        """Connect again if it is closed, broken or a network's."""

    def close(self) -> None:
        """End the connection; safe to call twice."""

    def urgent(self, text: str) -> None:
        """Write a stop at once, around every lock that a waiting query holds."""

    def last_words(self, text: str) -> list[tuple[int, bytes]]:
        """Return copies of descriptors, to be closed, and the bytes by which another process stops this line.

        Empty for a line without a descriptor.
        """


class ControllerCommands(ABC):
    """Commands and replies of one family of controllers."""

    def _check_unit(self, axis: int) -> None:  # noqa: B027 - few controllers need it
        """Check that units are still those at opening, for a controller that can change them."""

    def _check_settable(self, axis: int) -> None:  # noqa: B027
        """Raise an error for new velocities in a state in which the controller takes none."""

    def _distrust(self, axis: int) -> None:  # noqa: B027
        """Mark an axis as not homed."""

    def _greatest(self, axis: int) -> tuple[float | None, float | None]:  # noqa: ARG002
        """Return the greatest velocity and acceleration that the controller allows, if it reports them."""
        return None, None

    @abstractmethod
    def _connect(self) -> StageIdentity:
        """Read the controller's identity; called with the line open."""

    @abstractmethod
    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        """Read the controller's own software limits."""

    @abstractmethod
    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        """Set velocity and acceleration if the options give them; return both as read back."""

    @abstractmethod
    def _read_position_mm(self, axis: int) -> float:
        """Read the position of the axis."""

    @abstractmethod
    def _read_status(self, axis: int) -> AxisStatus:
        """Read the state of the axis."""

    @abstractmethod
    def _switch_motor(self, axis: int, *, on: bool) -> None:
        """Switch the motor, and check that it is."""

    @abstractmethod
    def _start_homing(self, axis: int) -> None:
        """Write the homing command, once, and raise the controller's error if it refuses."""

    @abstractmethod
    def _finish_homing(self, axis: int) -> None:
        """Check that homing ended well; called when the axis rests."""

    @abstractmethod
    def _send_move(self, axis: int, position_mm: float) -> None:
        """Write the motion command, once."""

    @abstractmethod
    def _stop_text(self, axis: int | None) -> str:
        """Return the stop command for one axis or all."""

    def _last_text(self) -> str:
        """Return the stop of all axes for a process that outlives this one."""
        return self._stop_text(None)

    @abstractmethod
    def _abort_text(self) -> str:
        """Return the command for an emergency stop of all axes."""

    @abstractmethod
    def _drain_errors(self, axis: int | None = None) -> list[ControllerMessage]:
        """Read and clear the controller's errors (of one axis if it keeps them separately)."""

    @abstractmethod
    def _code_of(self, message: ControllerMessage) -> str | None:
        """Map a controller's error to one of the codes of `Stage`, if one fits."""
