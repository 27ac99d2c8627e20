"""Interface of the stage drivers: the stage protocol, its options and its results.

A stage is one controller, or one chain of controllers on one serial line, with numbered axes. Positions are in
millimetres in the controller's own coordinates, whose zero homing defines. Computations use positions that were read
back, never commanded ones.

The description of a stage is declared here, each field with its meaning; replies of the service derive from these
classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal, Protocol, runtime_checkable

from pydantic import Field


class AxisState(StrEnum):
    """State of an axis."""

    NOT_HOMED = "not_homed"  # its position is not defined yet
    MOTOR_OFF = "motor_off"
    HOMING = "homing"
    MOVING = "moving"
    READY = "ready"
    FAULT = "fault"
    CONFIGURATION = "configuration"  # the SMC100's configuration mode, in which it refuses to move


@dataclass(frozen=True, kw_only=True)
class AxisOptions:
    """Options of one axis, from the rig file.

    Attributes
    ----------
    soft_limits_mm
        (low, high); can only tighten the controller's own travel limits.
    velocity_mm_s, acceleration_mm_s2
        Set when the stage is opened and read back; ``None`` leaves the controller's.
    backlash_mm
        Every move ends with at least this much travel in the direction that ``approach_from`` gives; 0 switches it off.
    approach_from
        Side from which every position is arrived at: ``below`` means by moving in the positive direction.
    settle_ms
        Wait between the end of motion and the reading of the position.
    tolerance_mm
        A read-back position further from the target than this is a fault.
    assume_homed
        Trust the controller's position although this driver did not home it. The ESP301 does not report if it was
        homed, so the user must state it.
    home_mode
        ESP301: mode of the home search (parameter of OR); ``None`` for the driver's usual one. The SMC100 family keeps
        its home search type (HT) in its configuration.
    positioner
        XPS: name of the axis, as ``Group1.Pos``; Zaber: device and axis, as ``1.1``.
    mm_per_step
        Standa: travel of a full motor step; Zaber: of a microstep; Kinesis: of a count.
    """

    soft_limits_mm: tuple[float, float] | None = None
    velocity_mm_s: float | None = None
    acceleration_mm_s2: float | None = None
    backlash_mm: float = 0.0
    approach_from: Literal["below", "above"] = "below"
    settle_ms: float = 0.0
    tolerance_mm: float = 0.002
    assume_homed: bool = False
    home_mode: int | None = None
    positioner: str | None = None
    mm_per_step: float | None = None


@dataclass(frozen=True)
class AxisIdentity:
    """Stage connected to one axis, in the controller's words."""

    axis: Annotated[int, Field(description="Axis number.")]
    model: Annotated[str, Field(description="Model of the actuator.")]
    serial: Annotated[str, Field(description="Serial number; empty where it does not report it.")] = ""
    units: Annotated[str, Field(description="Unit of the controller's own numbers.")] = "mm"


@dataclass(frozen=True)
class StageIdentity:
    """Identity of the controller."""

    driver: Annotated[str, Field(description="Protocol.", examples=["esp301"])]
    model: Annotated[str, Field(description="Model.")]
    firmware: Annotated[str, Field(description="Firmware.")]
    url: Annotated[str, Field(description="Port or address that it is reached at.")]
    axes: Annotated[tuple[AxisIdentity, ...], Field(description="What stands on each axis.")]


@dataclass(frozen=True)
class AxisLimits:
    """Travel of an axis: the controller's, and the tighter of that and the rig file's soft limits."""

    low_mm: Annotated[float, Field(description="Lowest position, the tighter of the controller's and the rig file's.")]
    high_mm: Annotated[float, Field(description="Highest position.")]
    controller_low_mm: Annotated[float, Field(description="The controller's own lowest position.")]
    controller_high_mm: Annotated[float, Field(description="The controller's own highest position.")]


@dataclass(frozen=True)
class AxisDynamics:
    """Speeds of an axis, as read back from the controller."""

    axis: Annotated[int, Field(description="Axis number.")]
    velocity_mm_s: Annotated[float, Field(description="Velocity of moves.")]
    acceleration_mm_s2: Annotated[float, Field(description="Acceleration of moves.")]
    max_velocity_mm_s: Annotated[
        float | None, Field(description="The greatest; null where the controller does not report it.")
    ] = None
    max_acceleration_mm_s2: Annotated[
        float | None, Field(description="The greatest; null where it does not report it.")
    ] = None


@dataclass(frozen=True)
class AxisStatus:
    """State of one axis, all read from the controller in one query except ``homed`` if it does not report it."""

    axis: Annotated[int, Field(description="Axis number.")]
    state: Annotated[AxisState, Field(description="What it is doing or lacks.", examples=["ready"])]
    position_mm: Annotated[float, Field(description="Where it stands.")]
    motor_on: Annotated[bool, Field(description="Whether its motor has power.")]
    homed: Annotated[bool, Field(description="Whether its position is known.")]
    moving: Annotated[bool, Field(description="Whether it moves.")]
    detail: Annotated[str, Field(description="What the controller says beside the state.")] = ""


@dataclass(frozen=True)
class ControllerMessage:
    """One entry of a controller's error queue."""

    code: Annotated[str, Field(description="The controller's own code.", examples=["103"])]
    text: Annotated[
        str, Field(description="The controller's own words.", examples=["FOLLOWING ERROR THRESHOLD EXCEEDED"])
    ]
    axis: Annotated[int | None, Field(description="Axis that it concerns; null for none in particular.")] = None


@dataclass(frozen=True)
class MoveResult:
    """Target of an axis and its position, read back after settling."""

    axis: int
    target_mm: float
    position_mm: float
    duration_s: float


@runtime_checkable
class Stage(Protocol):
    """A stage with numbered axes. Every call may come from any thread; motion calls are serialised, `stop` never waits.

    Errors are `stereorig.core.errors.StageError` with one of these codes: ``out_of_limits`` (also NaN and infinite
    targets: no byte went out), ``not_homed``, ``motor_off``, ``motion_fault`` (limit switch, stall, following error,
    position not reached: the axis was stopped), ``stage_stopped`` (`stop` was called during or before the motion),
    ``stage_lost`` (silence or garbage: the position is unknown), ``stage_refused`` (the controller's own error),
    ``out_of_range`` (a velocity or acceleration that the controller cannot do), ``configuration_state`` (an SMC100 that
    a program left in its configuration state), ``unit_not_length``, ``units_changed`` (an ESP301's axis that counts in
    another unit than when it was opened), ``invalid_axis``.
    """

    @property
    def axes(self) -> tuple[int, ...]:
        """Axis numbers, as the controller counts them."""

    def open(self) -> None:
        """Connect, identify, read units and limits, set and read back velocities.

        Moves nothing; an axis that moves already, since an earlier program died, is stopped.
        """

    def close(self) -> None:
        """Release the line; an axis that this driver is moving is stopped first. Safe to call twice."""

    def identify(self) -> StageIdentity:
        """Return the controller's identity, for example ``ESP301 Version 3.09``."""

    def enable(self, axis: int, *, since: int | None = None) -> None:
        """Switch the motor on; ``since`` as in `move_many`."""

    def disable(self, axis: int) -> None:
        """Switch the motor off."""

    def home(self, axis: int, *, timeout_s: float | None = None, since: int | None = None) -> float:
        """Search home, wait until it is found, and return the position read back in mm; ``since`` as in `move_many`.

        ``timeout_s`` is by default twice the time of the whole travel at the axis' velocity, and at least 120 s.
        """

    def move_to(self, axis: int, position_mm: float) -> MoveResult:
        """Move, arrive from the configured side, settle, and return the position read back."""

    def move_by(self, axis: int, distance_mm: float) -> MoveResult:
        """As `move_to`, from the position that is read back at the start."""

    def move_many(self, targets_mm: Mapping[int, float], *, since: int | None = None) -> dict[int, MoveResult]:
        """Move several axes at the same time; all targets are checked before any axis starts.

        ``since`` is the number of the last stop that the caller knows of: after a later one nothing moves.
        """

    def stop(self, axis: int | None = None) -> int:
        """Stop one axis or all, at once, and return this stop's number, which grows from stop to stop.

        It never waits for a lock and is never queued; motions that wait for their turn are void.
        """

    def abort(self) -> int:
        """Stop all axes as in an emergency and switch their motors off; the stop goes out at once, as with `stop`."""

    def dynamics(self, axis: int) -> AxisDynamics:
        """Velocity and acceleration as last read back."""

    def set_dynamics(
        self, axis: int, *, velocity_mm_s: float | None = None, acceleration_mm_s2: float | None = None
    ) -> AxisDynamics:
        """Set the values given, and return those that the controller took."""

    def leave_configuration(self, axis: int) -> None:
        """Leave an SMC100's configuration state, which writes its flash memory; never done unasked."""

    def position(self, axis: int) -> float:
        """Read the position in mm; works while another thread waits in a move."""

    def state(self, axis: int) -> AxisStatus:
        """Read the state; works while another thread waits in a move."""

    def limits(self, axis: int) -> AxisLimits:
        """Limits of the axis."""

    def errors(self, *, ask: bool = True) -> tuple[ControllerMessage, ...]:
        """Empty the controller's error queue and return it, with messages that earlier calls took from it unread.

        With ``ask=False`` only the latter: nothing is sent over the line.
        """
