"""All controllers of a rig as one stage. Each is looked for until it answers, and again after each loss.

A stop is sent to every controller at once, each by its own thread, so that a line that hangs holds up no other one. A
motion is only begun on a controller whose line was announced (`Controllers`): another process may have to stop it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from stereorig.core.errors import StageError
from stereorig.drivers.stages.protocol import (
    AxisDynamics,
    AxisLimits,
    AxisStatus,
    ControllerMessage,
    MoveResult,
    StageIdentity,
)
from stereorig.drivers.stages.refusals import check_target
from stereorig.drivers.stages.serial_stage import SerialStage, next_stop

_log = logging.getLogger("stereorig.rig")
# a controller that is back must work within three seconds, of which opening its line and identifying it takes one
_EVERY_S = 0.25
# a controller that was not asked anything for so long is asked for a position, so that its loss and return are noticed
_PROBE_S = 1.0
_JOIN_S = 1.0

Line = tuple[int, bytes]
DeviceState = Literal["looked_for", "connected", "lost"]


@dataclass(frozen=True)
class ControllerStatus:
    """Connection of one controller.

    Attributes
    ----------
    driver, url
        As the rig file names them.
    axes
        Axes that it moves.
    state
        ``looked_for``: it was not found yet; ``lost``: it was, and is looked for again.
    since_s
        Beginning of this state, seconds of Unix time.
    fault
        Reason why it cannot be used; None for a connected one.
    """

    driver: str
    url: str
    axes: tuple[int, ...]
    state: DeviceState
    since_s: float
    fault: StageError | None = None


class KeptController:
    """One controller, connected as long as it answers.

    Parameters
    ----------
    stage
        Its driver, not opened.
    driver, url
        As the rig file names them.
    watched
        Ask it from time to time; needless for a simulated one in the same process.
    """

    def __init__(self, stage: SerialStage, driver: str, url: str, *, watched: bool = True) -> None:
        self.stage = stage
        self.axes = stage.axes
        self._driver, self._url, self._watched = driver, url, watched
        self._guard = threading.Lock()
        self._fault: StageError | None = StageError(
            f"The controller on {url} was not looked for yet.", code="stage_lost", remedy="Wait until it is."
        )
        self._found = False
        self._connections = 0
        self._since_s = time.time()
        self._heard = time.monotonic()
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        #: is given its state when it was connected or lost
        self.on_change: Callable[[ControllerStatus], None] = lambda _status: None

    def status(self) -> ControllerStatus:
        """Return the state of its connection."""
        with self._guard:
            state: DeviceState = "connected" if self._fault is None else "lost" if self._found else "looked_for"
            return ControllerStatus(self._driver, self._url, self.axes, state, self._since_s, self._fault)

    @property
    def was_found(self) -> bool:
        """True if it was connected at any time."""
        return self._found

    @contextlib.contextmanager
    def used(self, *, motion: bool = False) -> Iterator[SerialStage]:
        """Give its driver for one call, and note a loss; a lost one is still asked while its line is open.

        Raises
        ------
        StageError
            The reason why it cannot be used. Motions and changes of its state need a connected controller.
        """
        fault = self._fault
        if fault is not None and (motion or not self._found or not self.stage.is_open):
            raise StageError(fault.cause, code=fault.code, remedy=fault.remedy, **fault.context)
        connection = self._connections
        try:
            yield self.stage
        except StageError as error:
            if error.code == "stage_lost":
                self._lose(error, connection)
            raise
        self._heard = time.monotonic()

    def _lose(self, error: StageError, connection: int) -> None:
        with self._guard:
            if self._connections != connection:
                return  # it was connected again since
            known, self._fault = self._fault, error
            if known is not None:
                return
            _log.warning("the controller on %s was lost: %s", self._url, error)
            self._since_s = time.time()
        self.on_change(self.status())

    def connect(self, announce: Callable[[], None]) -> None:
        """Look for it once; ``announce`` is called after its line may have changed, and before motions are allowed."""
        try:
            self.stage.reconnect()
        except Exception as error:  # noqa: BLE001 - a driver may bring up anything, which must be shown
            fault = error if isinstance(error, StageError) else None
            with self._guard:
                self._fault = fault or StageError(
                    f"The driver of the controller on {self._url} has failed: {type(error).__name__}: {error}",
                    code="driver_failed",
                    remedy="Install what the message names; report it with the message if the stage works elsewhere.",
                )
            announce()
            return
        if self._ending.is_set():
            self.stage.close()
            return
        announce()
        with self._guard:
            self._fault, self._found, self._since_s = None, True, time.time()
            self._connections += 1
        self._heard = time.monotonic()
        _log.info("the controller on %s is connected", self._url)
        self.on_change(self.status())

    def keep(self, connect: Callable[[KeptController], None]) -> None:
        """Look for it from now on, in a thread of its own."""
        self._thread = threading.Thread(target=self._run, args=(connect,), name=f"keep {self._url}", daemon=True)
        self._thread.start()

    def _run(self, connect: Callable[[KeptController], None]) -> None:
        while not self._ending.wait(_EVERY_S):
            try:
                if self._fault is None:
                    if self._watched and time.monotonic() - self._heard > _PROBE_S:
                        with contextlib.suppress(StageError), self.used() as stage:
                            stage.position(self.axes[0])
                elif not self.stage.is_moving:  # a motion finds the loss itself, and stops its axes as far as it can
                    connect(self)
            except Exception:  # noqa: BLE001 - it must be looked for whatever happened
                _log.exception("connecting the controller on %s failed", self._url)

    def end(self) -> None:
        """Look for it no more; an attempt that takes long closes its line itself."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)


class Controllers:
    """Every controller of a rig behind the interface of one stage, see `stereorig.drivers.stages.protocol.Stage`.

    Parameters
    ----------
    kept
        The controllers, not opened; none for a rig on which nothing moves.
    on_lines
        Called with the descriptor of each open line and the bytes that stop its axes, whenever one opens or closes.
    on_change
        Called with the state of a controller that was connected or lost.
    """

    def __init__(
        self,
        kept: Sequence[KeptController],
        on_lines: Callable[[list[Line]], None] | None = None,
        on_change: Callable[[ControllerStatus], None] | None = None,
    ) -> None:
        self._kept = list(kept)
        if on_change is not None:
            for one in self._kept:
                one.on_change = on_change
        self._on_lines = on_lines
        self._lines = threading.Lock()  # announcements in the order of their lines
        self.axes: tuple[int, ...] = tuple(sorted(axis for one in kept for axis in one.axes))
        #: number of the last stop
        self.last_stop = 0

    # connections ------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Look for every controller once; one that is not there is no error, see `controllers`."""
        for kept in self._kept:
            self._connect(kept)

    def keep(self) -> None:
        """Continue to search for controllers that are not connected."""
        for kept in self._kept:
            kept.keep(self._connect)

    def _connect(self, kept: KeptController) -> None:
        kept.connect(self._announce)

    def _announce(self) -> None:
        if self._on_lines is None:
            return
        with self._lines, contextlib.ExitStack() as copies:
            lines = []
            for kept in self._kept:
                with contextlib.suppress(StageError):  # it is closed
                    for descriptor, stop in kept.stage.last_words():
                        copies.callback(os.close, descriptor)
                        lines.append((descriptor, stop))
            self._on_lines(lines)

    def controllers(self) -> list[ControllerStatus]:
        """Return the state of each controller's connection, without asking any."""
        return [kept.status() for kept in self._kept]

    def close(self) -> None:
        """Stop moving axes, and release every line; safe to call twice."""
        for kept in self._kept:
            kept.end()
        with contextlib.ExitStack() as stages:
            for kept in self._kept:
                stages.callback(kept.stage.close)

    def _of(self, axis: int) -> KeptController:
        for kept in self._kept:
            if axis in kept.axes:
                return kept
        raise StageError(
            f"The rig has no axis {axis!r}, only {list(self.axes)}.",
            code="invalid_axis",
            remedy="Use an axis that the rig file names.",
            axis=axis,
        )

    # stops ------------------------------------------------------------------------------------------------------------

    def stop(self, axis: int | None = None) -> int:
        """Stop one axis or all, see `Stage.stop`; raises if a controller that was ever connected was not reached."""
        return self._halt(
            self._kept if axis is None else [self._of(axis)], lambda stage, number: stage.stop(axis, number=number)
        )

    def abort(self) -> int:
        """Stop all axes as in an emergency, see `Stage.abort`; errors as `stop`."""
        return self._halt(self._kept, lambda stage, number: stage.abort(number=number))

    def _halt(self, kept: Sequence[KeptController], halt: Callable[[SerialStage, int], int]) -> int:
        number = self.last_stop = next_stop()
        failed: dict[int, StageError] = {}

        def one(index: int) -> None:
            try:
                halt(kept[index].stage, number)
            except StageError as error:
                failed[index] = error

        others = [threading.Thread(target=one, args=(index,), daemon=True) for index in range(1, len(kept))]
        for thread in others:
            thread.start()
        if kept:
            one(0)
        for thread in others:
            thread.join()
        unreached = [index for index in failed if kept[index].was_found or len(failed) == len(kept)]
        if unreached:
            raise failed[unreached[0]]
        return number

    # one axis ---------------------------------------------------------------------------------------------------------

    def enable(self, axis: int, *, since: int | None = None) -> None:
        """Switch the motor on, see `Stage.enable`."""
        with self._of(axis).used(motion=True) as stage:
            stage.enable(axis, since=since)

    def disable(self, axis: int) -> None:
        """Switch the motor off."""
        with self._of(axis).used(motion=True) as stage:
            stage.disable(axis)

    def home(self, axis: int, *, timeout_s: float | None = None, since: int | None = None) -> float:
        """Search home, see `Stage.home`."""
        with self._of(axis).used(motion=True) as stage:
            return stage.home(axis, timeout_s=timeout_s, since=since)

    def dynamics(self, axis: int) -> AxisDynamics:
        """Velocity and acceleration as last read back."""
        with self._of(axis).used() as stage:
            return stage.dynamics(axis)

    def set_dynamics(
        self, axis: int, *, velocity_mm_s: float | None = None, acceleration_mm_s2: float | None = None
    ) -> AxisDynamics:
        """Set the values given, see `Stage.set_dynamics`."""
        with self._of(axis).used(motion=True) as stage:
            return stage.set_dynamics(axis, velocity_mm_s=velocity_mm_s, acceleration_mm_s2=acceleration_mm_s2)

    def leave_configuration(self, axis: int) -> None:
        """Leave an SMC100's configuration state, which writes its flash memory."""
        with self._of(axis).used(motion=True) as stage:
            stage.leave_configuration(axis)

    def position(self, axis: int) -> float:
        """Read the position in mm."""
        with self._of(axis).used() as stage:
            return stage.position(axis)

    def state(self, axis: int) -> AxisStatus:
        """Read the state."""
        with self._of(axis).used() as stage:
            return stage.state(axis)

    def limits(self, axis: int) -> AxisLimits:
        """Limits of the axis."""
        with self._of(axis).used() as stage:
            return stage.limits(axis)

    # several axes -----------------------------------------------------------------------------------------------------

    def move_to(self, axis: int, position_mm: float) -> MoveResult:
        """Move, see `Stage.move_to`."""
        return self.move_many({axis: position_mm})[axis]

    def move_by(self, axis: int, distance_mm: float) -> MoveResult:
        """Move by a distance, see `Stage.move_by`."""
        with self._of(axis).used(motion=True) as stage:
            return stage.move_by(axis, distance_mm)

    def move_many(self, targets_mm: Mapping[int, float], *, since: int | None = None) -> dict[int, MoveResult]:
        """Move several axes, see `Stage.move_many`: one controller's axes together, controllers one after another."""
        since = self.last_stop if since is None else since
        for axis, target in targets_mm.items():
            check_target(axis, target, self.limits(axis))
        moved: dict[int, MoveResult] = {}
        for kept in self._kept:
            own = {axis: target for axis, target in targets_mm.items() if axis in kept.axes}
            if own:
                with kept.used(motion=True) as stage:
                    moved |= stage.move_many(own, since=since)
        return moved

    def known_positions(self) -> dict[int, float | StageError]:
        """Return the position of each axis in mm, or the reason why it is not known; a lost controller is not asked."""
        known: dict[int, float | StageError] = {}
        for kept in self._kept:
            fault = kept.status().fault
            for axis in kept.axes:
                try:
                    known[axis] = self.position(axis) if fault is None else fault
                except StageError as error:
                    fault = known[axis] = error
        return known

    def identify(self) -> StageIdentity:
        """Return the identity of the connected controllers, each thing that differs named for each of them.

        Raises
        ------
        StageError
            None is connected.
        """
        found: list[StageIdentity] = []
        fault: StageError | None = None
        for kept in self._kept:
            try:
                with kept.used() as stage:
                    found.append(stage.identify())
            except StageError as error:
                fault = error
        if fault is not None and not found:
            raise fault
        driver, model, firmware = (
            ", ".join(dict.fromkeys(str(getattr(one, name)) for one in found))
            for name in ("driver", "model", "firmware")
        )
        axes = sorted((axis for one in found for axis in one.axes), key=lambda axis: axis.axis)
        return StageIdentity(driver, model, firmware, ", ".join(one.url for one in found), tuple(axes))

    def errors(self, *, ask: bool = True) -> tuple[ControllerMessage, ...]:
        """Empty the error queue of every controller that answers, see `Stage.errors`."""
        found: list[ControllerMessage] = []
        for kept in self._kept:
            with contextlib.suppress(StageError):
                found += kept.stage.errors(ask=ask and kept.status().state == "connected")
        return tuple(found)
