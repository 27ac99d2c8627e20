"""Common parts of the serial stage drivers: checks before a byte is sent, one-sided arrival, waiting, stopping.

A driver adds only its controller's commands, see `stereorig.drivers.stages.commands`.

A stop takes no lock. It sets a number of its own on the axes it concerns, and then writes. A motion notes these numbers
when it is asked for, and checks them again after each command that starts movement: in either order on the wire, the
axis is at rest afterwards, and a motion that was still waiting for its turn never starts.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from stereorig.core.errors import StageError
from stereorig.drivers.stages.commands import ControllerCommands, ControllerLine
from stereorig.drivers.stages.protocol import (
    AxisDynamics,
    AxisLimits,
    AxisOptions,
    AxisState,
    AxisStatus,
    ControllerMessage,
    MoveResult,
    StageIdentity,
)
from stereorig.drivers.stages.refusals import (
    check_dynamic,
    check_number,
    check_target,
    configuration_state,
    detour,
    motion_fault,
    motor_off,
    not_homed,
    not_in_configuration,
    tighten,
)

_POLL_S = 0.02
# An axis that reports motion without moving for this long has jammed
_JAM_S = 1.0
# Added to the computed travel time before a motion counts as overdue
_MARGIN_S = 5.0
# Messages kept for `errors`, which may never be called
_MESSAGES = 100
# Counter for all stages of a process, so that a stage that is opened again does not repeat its numbers
_STOP_NUMBERS = itertools.count(1)
# Longest time of an axis to come to rest after a stop
_REST_S = 3.0


# the longest search for home: so many times the whole travel, since the search is slower near its end
_HOME_S, _HOME_MARGIN = 120.0, 2.0


def next_stop() -> int:
    """Return the number of a new stop, higher than every earlier one in this process."""
    return next(_STOP_NUMBERS)


def longest_search_s(travel_mm: tuple[float, float], velocity_mm_s: float) -> float:
    """Return how long a search for home may take over a travel (lowest, highest) at a velocity."""
    return max(_HOME_S, _HOME_MARGIN * (travel_mm[1] - travel_mm[0]) / velocity_mm_s if velocity_mm_s > 0.0 else 0.0)


class SerialStage(ControllerCommands):
    """Base of the stage drivers; see `stereorig.drivers.stages.protocol.Stage` for its interface."""

    def __init__(
        self, line: ControllerLine, options: Mapping[int, AxisOptions], numbers: Mapping[int, int] | None = None
    ) -> None:
        self._line = line
        self._options = dict(options)
        self._own = {axis: axis if numbers is None else numbers[axis] for axis in self._options}
        self._travel_mm: dict[int, tuple[float, float]] = {}
        self._limits: dict[int, AxisLimits] = {}
        self._velocity_mm_s: dict[int, float] = {}
        self._acceleration_mm_s2: dict[int, float] = {}
        self._messages: list[ControllerMessage] = []
        self._motion_lock = threading.RLock()
        self._stops = dict.fromkeys(self._options, 0)  # axis -> number of the last stop that concerned it
        self._moving: set[int] = set()
        self._identity: StageIdentity | None = None

    @property
    def axes(self) -> tuple[int, ...]:
        """Axis numbers that the rig uses."""
        return tuple(sorted(self._options))

    def open(self) -> None:
        """Connect, identify, read limits, set and read back velocities; stop axes that move already."""
        with self._motion_lock:
            self._line.open()
            try:
                self._prepare()
            except BaseException:
                self._line.close()
                raise

    def reconnect(self) -> None:
        """Connect as `open` does; a line that is open and not broken stays open in any case."""
        with self._motion_lock:
            self._line.renew()
            self._prepare()

    def _prepare(self) -> None:
        identity = self._connect()
        for axis in self.axes:
            self._travel_mm[axis] = self._read_travel_mm(axis)
            self._limits[axis] = tighten(axis, self._options[axis].soft_limits_mm, *self._travel_mm[axis])
            self._velocity_mm_s[axis], self._acceleration_mm_s2[axis] = self._set_dynamics(axis)
        self._stop_left_over()
        self._identity = identity

    def close(self) -> None:
        """Release the line; axes that this driver is moving are stopped first."""
        if self._line.is_open:
            try:
                if self._moving:
                    self.stop()
            finally:
                self._line.close()

    def identify(self) -> StageIdentity:
        """Return the controller's identity, as read when the stage was opened."""
        if self._identity is None:
            raise StageError(
                f"The stage on {self._line.url} was not opened.", code="stage_lost", remedy="Connect the stage first."
            )
        return self._identity

    def limits(self, axis: int) -> AxisLimits:
        """Limits of the axis."""
        self._check_axis(axis)
        if axis not in self._limits:
            self.identify()
        return self._limits[axis]

    def position(self, axis: int) -> float:
        """Read the position in mm."""
        self._check_axis(axis)
        return self._read_position_mm(axis)

    def state(self, axis: int) -> AxisStatus:
        """Read the state."""
        self._check_axis(axis)
        return self._read_status(axis)

    def errors(self, *, ask: bool = True) -> tuple[ControllerMessage, ...]:
        """Empty the controller's error queue."""
        if ask and not self._moving:  # a motion reads the queue itself, and must find its own errors there
            self._keep(self._drain_errors())
        found, self._messages = self._messages, []
        return tuple(found)

    @property
    def is_open(self) -> bool:
        """True while its line is open, whether the controller answers or not."""
        return self._line.is_open

    @property
    def is_moving(self) -> bool:
        """True while a motion of this driver is under way."""
        return bool(self._moving)

    def stop(self, axis: int | None = None, *, number: int | None = None) -> int:
        """Stop one axis or all, at once, and return the number of this stop; takes no lock.

        ``number`` is a stop's that concerns other controllers too, of `next_stop`.
        """
        if axis is not None:
            self._check_axis(axis)
        number = self._mark_stopped(self.axes if axis is None else (axis,), number)
        self._line.urgent(self._stop_text(axis))
        return number

    def abort(self, *, number: int | None = None) -> int:
        """Stop all axes as in an emergency, make sure that their motors are off, return the number of this stop."""
        number = self._mark_stopped(self.axes, number)
        self._line.urgent(self._abort_text())
        rest = time.monotonic() + _REST_S
        for axis in self.axes:
            while (status := self._read_status(axis)).moving and time.monotonic() < rest:
                time.sleep(_POLL_S)
            if status.motor_on:
                self._switch_motor(axis, on=False)
        return number

    def last_words(self) -> list[tuple[int, bytes]]:
        """Return copies of the line's descriptors, to be closed, each with the bytes that stop axes.

        They are for a process that outlives this one. None are returned if the line has no descriptor of its own.
        """
        return self._line.last_words(self._last_text())

    def _axis_of(self, own: int) -> int:
        """Return the axis that the controller counts as ``own``; its number for one that is not used here."""
        return next((axis for axis, number in self._own.items() if number == own), own)

    def _mark_stopped(self, axes: tuple[int, ...], number: int | None) -> int:
        number = next_stop() if number is None else number
        for axis in axes:
            self._stops[axis] = number
        return number

    def _stop_left_over(self) -> None:
        """Stop motions that an earlier program left when it died; no caller waits for them any more."""
        moving = [axis for axis in self.axes if self._read_status(axis).moving]
        for axis in moving:
            self._line.urgent(self._stop_text(axis))
            self._distrust(axis)
            self._keep([ControllerMessage("opened_moving", "was moving when the stage was opened: stopped", axis)])
        rest = time.monotonic() + _REST_S
        while any(self._read_status(axis).moving for axis in moving) and time.monotonic() < rest:
            time.sleep(_POLL_S)

    def dynamics(self, axis: int) -> AxisDynamics:
        """Velocity and acceleration as last read back."""
        self._check_axis(axis)
        if axis not in self._velocity_mm_s:
            self.identify()
        return AxisDynamics(axis, self._velocity_mm_s[axis], self._acceleration_mm_s2[axis], *self._greatest(axis))

    def set_dynamics(
        self, axis: int, *, velocity_mm_s: float | None = None, acceleration_mm_s2: float | None = None
    ) -> AxisDynamics:
        """Set velocity, acceleration or both, and return the values that the controller took; homing keeps them."""
        known = self.dynamics(axis)
        for quantity, value, maximum in (
            ("velocity", velocity_mm_s, known.max_velocity_mm_s),
            ("acceleration", acceleration_mm_s2, known.max_acceleration_mm_s2),
        ):
            if value is not None:
                check_dynamic(axis, quantity, value, maximum)
        with self._motion_lock:
            self._check_settable(axis)
            before = self._options[axis]
            self._options[axis] = replace(
                before,
                velocity_mm_s=before.velocity_mm_s if velocity_mm_s is None else velocity_mm_s,
                acceleration_mm_s2=before.acceleration_mm_s2 if acceleration_mm_s2 is None else acceleration_mm_s2,
            )
            try:
                self._velocity_mm_s[axis], self._acceleration_mm_s2[axis] = self._set_dynamics(axis)
            except BaseException:
                self._options[axis] = before
                raise
        return self.dynamics(axis)

    def leave_configuration(self, axis: int) -> None:
        """Leave the configuration state; only the SMC100 family has one."""
        self._check_axis(axis)
        raise not_in_configuration(axis)

    def enable(self, axis: int, *, since: int | None = None) -> None:
        """Switch the motor on."""
        self._check_axis(axis)
        noted = self._note_stops((axis,), since)
        with self._motion_lock:
            self._check_not_stopped(noted, write=False)
            self._switch_motor(axis, on=True)

    def disable(self, axis: int) -> None:
        """Switch the motor off."""
        self._check_axis(axis)
        with self._motion_lock:
            self._switch_motor(axis, on=False)

    def home(self, axis: int, *, timeout_s: float | None = None, since: int | None = None) -> float:
        """Search home and return the position read back in mm."""
        self._check_axis(axis)
        if timeout_s is None:
            timeout_s = longest_search_s(self._travel_mm[axis], self._velocity_mm_s[axis])
        noted = self._note_stops((axis,), since)
        with self._motion_lock:
            self._check_not_stopped(noted, write=False)
            with self._stopped_on_error((axis,)):
                self._start_homing(axis)
                self._check_not_stopped(noted)
                self._wait((axis,), noted, time.monotonic() + timeout_s, watch_jam=False)
                self._finish_homing(axis)
            return self._read_position_mm(axis)

    def move_to(self, axis: int, position_mm: float) -> MoveResult:
        """Move, arrive from the configured side, settle, read back."""
        return self.move_many({axis: position_mm})[axis]

    def move_by(self, axis: int, distance_mm: float) -> MoveResult:
        """As `move_to`, from the position read back at the start."""
        self._check_axis(axis)
        check_number(axis, distance_mm)
        noted = self._note_stops((axis,))
        with self._motion_lock:
            return self._move({axis: self._read_position_mm(axis) + distance_mm}, noted)[axis]

    def move_many(self, targets_mm: Mapping[int, float], *, since: int | None = None) -> dict[int, MoveResult]:
        """Move several axes at the same time."""
        noted = self._note_stops(tuple(targets_mm), since)
        for axis, target in targets_mm.items():
            self._check_axis(axis)
            self._check_target(axis, target)
        with self._motion_lock:
            return self._move(targets_mm, noted)

    def _move(self, targets_mm: Mapping[int, float], noted: Mapping[int, int]) -> dict[int, MoveResult]:
        axes = tuple(targets_mm)
        start = time.monotonic()
        goals = {axis: self._check_target(axis, target) for axis, target in targets_mm.items()}
        self._check_not_stopped(noted, write=False)
        here = {axis: self._check_ready(axis).position_mm for axis in axes}
        detours = {
            axis: mm
            for axis in axes
            if (mm := detour(axis, self._options[axis], self.limits(axis), here[axis], goals[axis])) is not None
        }
        self._keep(self._drain_errors())  # errors found afterwards were caused by this motion
        with self._stopped_on_error(axes):
            if detours:
                self._move_together(here, detours, noted)
            self._move_together({**here, **detours}, goals, noted)
            time.sleep(max(self._options[axis].settle_ms for axis in axes) / 1000)
            self._check_not_stopped(noted)
            results = {}
            for axis, goal in goals.items():
                there = self._read_position_mm(axis)
                if abs(there - goal) > self._options[axis].tolerance_mm:
                    raise motion_fault(axis, f"stands at {there:.5f} mm instead of {goal:.5f} mm")
                results[axis] = MoveResult(axis, goal, there, time.monotonic() - start)
        return results

    def _move_together(self, here: Mapping[int, float], goals: Mapping[int, float], noted: Mapping[int, int]) -> None:
        longest = 0.0
        for axis, goal in goals.items():
            self._check_not_stopped(noted)
            self._send_move(axis, goal)
            self._check_not_stopped(noted)
            self._raise_refusal(tuple(goals), f"move to {goal:.5f} mm")
            speed, ramp = self._velocity_mm_s[axis], self._acceleration_mm_s2[axis]
            longest = max(longest, abs(goal - here[axis]) / speed + speed / ramp)
        self._wait(tuple(goals), noted, time.monotonic() + 1.5 * longest + _MARGIN_S)

    def _wait(
        self, axes: tuple[int, ...], noted: Mapping[int, int], deadline: float, *, watch_jam: bool = True
    ) -> None:
        waiting = set(axes)
        last: dict[int, tuple[float, float]] = {}
        while waiting:
            for axis in sorted(waiting):
                self._check_not_stopped(noted)
                status = self._read_status(axis)
                if status.state is AxisState.FAULT or (watch_jam and status.state is AxisState.MOTOR_OFF):
                    self._check_not_stopped(noted)  # an abort since the last look switched it off
                    raise motion_fault(axis, status.detail or "switched its motor off")
                if not status.moving:
                    if watch_jam and status.state is not AxisState.READY:
                        self._check_not_stopped(noted)
                        raise motion_fault(axis, f"ended in the state {status.state} {status.detail}".rstrip())
                    waiting.discard(axis)
                    continue
                now = time.monotonic()
                mm, since = last.get(axis, (math.inf, now))
                # a slow axis must not count as jammed
                step = min(self._options[axis].tolerance_mm / 2, 0.2 * self._velocity_mm_s[axis] * _JAM_S)
                if abs(status.position_mm - mm) > step:
                    last[axis] = (status.position_mm, now)
                elif watch_jam and now - since > _JAM_S:
                    raise motion_fault(axis, f"has stood at {status.position_mm:.5f} mm for {now - since:.1f} s")
                if now > deadline:
                    raise motion_fault(axis, f"did not come to rest in time, it is at {status.position_mm:.5f} mm")
            if waiting:
                time.sleep(_POLL_S)
        # A stop that came between the last question and its answer brought the axes to rest, not their goal
        self._check_not_stopped(noted)
        # Once every axis rests, the errors of the motion are in the error queue
        bad = self._new_errors(axes)
        if bad:
            raise motion_fault(bad[0].axis or axes[0], "; ".join(f"{message.text} ({message.code})" for message in bad))

    def _check_axis(self, axis: int) -> None:
        if axis not in self._options:
            raise StageError(
                f"There is no axis {axis!r} on {self._line.url}, only {', '.join(map(str, self.axes))}.",
                code="invalid_axis",
                remedy="Name one of the axes above.",
                axis=axis,
            )

    def _check_target(self, axis: int, target: object) -> float:
        return check_target(axis, target, self.limits(axis))

    def _check_ready(self, axis: int) -> AxisStatus:
        status = self._read_status(axis)
        if status.state is AxisState.CONFIGURATION:
            raise configuration_state(axis)
        if not status.homed:
            raise not_homed(axis)
        if status.state is AxisState.MOTOR_OFF:
            raise motor_off(axis)
        if status.state is not AxisState.READY:
            raise motion_fault(axis, f"is not ready to move: {status.state} {status.detail}".rstrip())
        self._check_unit(axis)
        return status

    def _note_stops(self, axes: tuple[int, ...], since: int | None = None) -> dict[int, int]:
        """Return the last stop of each axis; of those that the caller knows of, ``since`` is the last one."""
        return {axis: self._stops.get(axis, 0) if since is None else since for axis in axes}

    def _check_not_stopped(self, noted: Mapping[int, int], *, write: bool = True) -> None:
        axes = tuple(noted)
        if all(self._stops.get(axis, 0) <= noted[axis] for axis in axes):
            return
        if write:
            # The stop may have been on the wire before the command that started this motion
            for axis in axes:
                self._line.urgent(self._stop_text(axis))
            rest = time.monotonic() + _REST_S
            while any(self._read_status(axis).moving for axis in axes) and time.monotonic() < rest:
                time.sleep(_POLL_S)
        raise StageError(
            f"A stop ended the motion of axis {', '.join(map(str, axes))}.",
            code="stage_stopped",
            remedy="Read the position back, then move again when it is safe.",
            axes=list(axes),
        )

    @contextmanager
    def _stopped_on_error(self, axes: tuple[int, ...]) -> Iterator[None]:
        self._moving.update(axes)
        try:
            yield
        except BaseException as error:
            if not (isinstance(error, StageError) and error.code == "stage_stopped") and self._line.is_open:
                for axis in axes:
                    try:
                        self._line.urgent(self._stop_text(axis))
                    except StageError as lost:
                        error.add_note(f"The stop of axis {axis} could not be written either: {lost.cause}")
            raise
        finally:
            self._moving.difference_update(axes)

    def _new_errors(self, axes: tuple[int, ...]) -> list[ControllerMessage]:
        """Empty the error queue into `errors`, and return the messages of these axes or of no axis in particular."""
        found = [message for axis in axes for message in self._drain_errors(axis)]
        self._keep(found)
        return [message for message in found if message.axis is None or message.axis in axes]

    def _keep(self, messages: list[ControllerMessage]) -> None:
        self._messages = [*self._messages, *messages][-_MESSAGES:]

    def _raise_refusal(self, axes: tuple[int, ...], request: str) -> None:
        bad = self._new_errors(axes)
        if bad:
            raise self._refusal(bad[0].axis or axes[0], request, bad)

    def _refusal(self, axis: int, request: str, messages: list[ControllerMessage]) -> StageError:
        text = "; ".join(f"{message.text} ({message.code})" for message in messages)
        return StageError(
            f"The controller refused for axis {axis} the {request}: {text}.",
            code=next((code for message in messages if (code := self._code_of(message)) is not None), "stage_refused"),
            remedy="Correct the cause that the controller names, then try again.",
            axis=axis,
        )
