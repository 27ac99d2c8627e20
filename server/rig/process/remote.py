"""The rig's devices as the web process sees them: each call goes to the rig process and back."""

from __future__ import annotations

import contextlib
import functools
import logging
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from stereorig.core.errors import DeviceError, StageError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.pairing import Pair
from stereorig.drivers.cameras.protocol import CameraSettings, FoundDevice
from stereorig.drivers.stages.controllers import Controllers
from stereorig.drivers.stages.protocol import MoveResult
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.rig.build import OnLost, OnStage
from stereorig.server.rig.cameras import CameraPair, CapturedPair, GatheredPairs, PairMark
from stereorig.server.rig.process.wire import GIVEN_UP, Channel, OpenedDevices

if TYPE_CHECKING:
    from stereorig.sim.world import SimWorld

_log = logging.getLogger("stereorig.rig")
Check = Callable[[], None]
OnStopped = Callable[[int, bool], None]
# how soon a caller that gives up is heard
_CHECK_S = 0.05
# longest time from a stop to its announcement
_KNOWN_S = 2.0
_UNIT_PROPERTIES = frozenset(
    {"description", "settings", "wanted", "fault", "reconnections", "trigger", "rate_hz", "was_found", "since_s"}
)


class RigLink:
    """Connections to the rig process: one a caller at the same time, and one for events.

    Parameters
    ----------
    path
        The rig process' socket.
    on_stopped
        Called for a stop that did not come through this process, with its number and whether the service ends with it.
        Motions that were asked for before it returns are refused.
    on_gone
        Called when the rig process has ended.
    """

    def __init__(self, path: Path, on_stopped: OnStopped, on_gone: Callable[[], None]) -> None:
        self._path = path
        self._on_stopped, self._on_gone = on_stopped, on_gone
        self._lock = threading.Lock()
        self._known = threading.Condition(self._lock)
        self._idle: list[Channel] = []
        self._events: Channel | None = None
        self.on_lost: OnLost | None = None
        self.on_stage: OnStage | None = None
        #: number of the last stop that this process knows of
        self.known_stop = 0

    def _connected(self) -> Channel:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(str(self._path))
        except OSError as error:
            connection.close()
            raise rig_process_lost() from error
        return Channel(connection)

    def listen(self) -> None:
        """Hear the events of the rig process that runs now."""
        with self._lock:
            if self._events is not None:
                return
            events = self._events = self._connected()
            self.known_stop = 0  # another process counts its own
        events.send("events")
        threading.Thread(target=self._hear, args=(events,), name="rig events", daemon=True).start()

    def _hear(self, events: Channel) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                name, *data = events.receive()
                if name == "stopped":
                    try:
                        self._on_stopped(*data)
                    finally:
                        self.stopped(data[0])
                elif name == "lost" and self.on_lost is not None:
                    self.on_lost(*data)
                elif name == "stage" and self.on_stage is not None:
                    self.on_stage(*data)
        with self._lock:
            self._events = None
            idle, self._idle = self._idle, []
        for channel in (events, *idle):
            channel.close()
        self._on_gone()

    def stopped(self, number: int) -> None:
        """Note that a stop is known here."""
        with self._known:
            self.known_stop = max(self.known_stop, number)
            self._known.notify_all()

    def move(self, name: str, *args: Any, since: int) -> Any:
        """Call a motion of the stage, which is refused after any stop later than number ``since``; raises as `call`.

        The error of a motion that was stopped is raised once the stop is known here, and its job cancelled.
        """
        try:
            return self.call("stage", name, *args, since=since)
        except StageError as error:
            if error.code == "stage_stopped":
                with self._known:
                    self._known.wait_for(lambda: self.known_stop > since, _KNOWN_S)
            raise

    def call(self, target: str, name: str, *args: Any, check: Check | None = None, **kwargs: Any) -> Any:
        """Call a function in the rig process, and return its result.

        Parameters
        ----------
        target, name
            ``host``, ``stage``, ``pair``, ``world`` or a camera, and the name of its function or property.
        check
            May raise while the call waits; the call is given up then.

        Raises
        ------
        DeviceError
            ``rig_process_lost``, or an error of the function's.
        """
        with self._lock:
            channel = self._idle.pop() if self._idle else None
        try:
            if channel is None:
                channel = self._connected()
            channel.send((target, name, args, kwargs, check is not None))
            given_up: BaseException | None = None
            while check is not None and given_up is None and not channel.waiting(_CHECK_S):
                try:
                    check()
                except BaseException as error:  # noqa: BLE001 - raised again below
                    given_up = error
                    channel.send(GIVEN_UP)
            whole, answer = channel.receive()
            if given_up is not None:
                channel.close()  # the rig process may have read the message, or not
                raise given_up
        except (EOFError, OSError) as error:
            if channel is not None:
                channel.close()
            raise rig_process_lost() from error
        with self._lock:
            self._idle.append(channel)
        if not whole:
            raise answer
        return answer


def rig_process_lost() -> DeviceError:
    """Return the error of every call while there is no rig process."""
    return DeviceError(
        "The process that holds cameras and stage has ended; the stage was stopped.",
        code="rig_process_lost",
        remedy="It is started again by itself; POST /rig:reconnect if it does not come back, and home the stage.",
    )


class _Remote:
    """A thing in the rig process: its functions are called there, with the same arguments and results.

    Parameters
    ----------
    link
        Connections to the rig process.
    target
        The thing, as `RigLink.call` takes it.
    constants
        Attributes that do not change while the devices are open.
    properties
        Names of its properties, which are read there at each use.
    """

    def __init__(
        self, link: RigLink, target: str, *, properties: frozenset[str] = frozenset(), **constants: object
    ) -> None:
        self._link, self._target, self._properties = link, target, properties
        vars(self).update(constants)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._properties:
            return self._link.call(self._target, name)
        return functools.partial(self._link.call, self._target, name)


class _RemotePair(_Remote):
    def capture(self, frames: int = 1, check: Check | None = None) -> CapturedPair:
        """Capture there, and judge the image's motion here, see `CameraPair.capture`."""
        gathered: GatheredPairs = self._link.call("pair", "gather", frames, check=check)
        return gathered.judged()

    def newest(self, after: PairMark | None, check: Check) -> tuple[PairMark, int, Pair]:
        """Return the newest pair, see `CameraPair.newest`."""
        found: tuple[PairMark, int, Pair] = self._link.call("pair", "newest", after, check=check)
        return found


class _RemoteStage(_Remote):
    """A stage whose motions are refused after a stop that is not known here yet."""

    @property
    def last_stop(self) -> int:
        """Return the number of the last stop that is known here."""
        return self._link.known_stop

    def enable(self, axis: int, *, since: int) -> None:
        """Switch the motor on, see `Stage.enable`."""
        self._link.move("enable", axis, since=since)

    def home(self, axis: int, *, since: int) -> float:
        """Search home, see `Stage.home`."""
        return float(self._link.move("home", axis, since=since))

    def move_many(self, targets_mm: Mapping[int, float], *, since: int) -> dict[int, MoveResult]:
        """Move several axes, see `Stage.move_many`."""
        moved: dict[int, MoveResult] = self._link.move("move_many", dict(targets_mm), since=since)
        return moved

    def stop(self) -> None:
        """Stop every axis at once."""
        self._link.stopped(self._link.call("stage", "stop"))

    def abort(self) -> None:
        """Stop every axis as in an emergency and switch the motors off."""
        self._link.stopped(self._link.call("stage", "abort"))


class RemoteDevices:
    """Everything that the rig process has open; each call of `pair`, `stage` and `world` goes there and back."""

    def __init__(self, link: RigLink, opened: OpenedDevices) -> None:
        self._link = link
        units = {cam: _Remote(link, cam, name=cam, properties=_UNIT_PROPERTIES) for cam in CAMERAS}
        self.pair = cast(CameraPair, _RemotePair(link, "pair", units=units, properties=frozenset({"fires"})))
        self.stage = cast(Controllers, _RemoteStage(link, "stage", axes=opened.axes))
        self.world = cast("SimWorld", _Remote(link, "world")) if opened.has_world else None

    def close(self) -> None:
        """Release every device; a rig process that is gone has released them."""
        with contextlib.suppress(DeviceError):
            self._link.call("host", "close")


class RemoteRig:
    """Opens and finds devices in the rig process, as `stereorig.server.rig.build` does in this one.

    Parameters
    ----------
    path
        The rig process' socket.
    """

    def __init__(self, path: Path) -> None:
        self._link = RigLink(path, self._stopped, self._gone)
        #: called for a stop that came through the front process, see `RigLink`
        self.on_stopped: OnStopped = lambda _number, _ending: None
        #: called when the rig process has ended
        self.on_gone: Callable[[], None] = lambda: None

    def _stopped(self, number: int, ending: bool) -> None:
        try:
            self.on_stopped(number, ending)
        except Exception:  # noqa: BLE001 - later stops must be heard
            _log.exception("a stop of the stage could not be followed")

    def _gone(self) -> None:
        try:
            self.on_gone()
        except Exception:  # noqa: BLE001 - the rig can still be opened by a request
            _log.exception("the end of the rig process could not be followed")

    def __call__(
        self,
        config: RigConfig,
        settings: Mapping[CameraName, CameraSettings],
        *,
        record: Path | None = None,
        dynamics: Mapping[int, tuple[float | None, float | None]] | None = None,
        on_lost: OnLost | None = None,
        on_stage: OnStage | None = None,
        keep_looking: bool = True,  # noqa: ARG002 - the rig process always does
    ) -> RemoteDevices:
        """Open the devices, see `stereorig.server.rig.build.open_devices`."""
        self._link.on_lost, self._link.on_stage = on_lost, on_stage
        self._link.listen()
        opened: OpenedDevices = self._link.call("host", "open", config, dict(settings), record, dict(dynamics or {}))
        return RemoteDevices(self._link, opened)

    def discover(self, driver: str) -> list[FoundDevice]:
        """List the cameras that a driver finds."""
        found: list[FoundDevice] = self._link.call("host", "discover", driver)
        return found

    def ports(self) -> list[FoundDevice]:
        """List the serial ports."""
        found: list[FoundDevice] = self._link.call("host", "ports")
        return found
