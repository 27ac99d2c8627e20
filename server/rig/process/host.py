"""The rig process itself: holds cameras and stage for the web process, and stops the stage when another one dies.

``python -m stereorig.server.rig.process.host CONTROL LISTENER`` takes two descriptors of the front process: a control
socket, over which a stop comes (`stereorig.server.http.supervisor`), and a listening socket, at which the web process
connects (`stereorig.server.rig.process.remote`). Each of its connections has a thread; a stop has one of its own,
behind which nothing else waits.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import shutil
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereorig.core.errors import Cancelled, DeviceError, StereorigError
from stereorig.core.names import CameraName
from stereorig.drivers.cameras.protocol import CameraSettings
from stereorig.drivers.registry import discover_cameras
from stereorig.drivers.stages.controllers import Line
from stereorig.drivers.stages.serial_ports import discover_ports
from stereorig.server.base import logs
from stereorig.server.base.priority import raise_file_limit, raise_service, settle
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.rig.build import Devices, open_devices
from stereorig.server.rig.process.wire import GIVEN_UP, Channel, OpenedDevices
from stereorig.server.worker.kernel_compiler import compiled_aside

_log = logging.getLogger("stereorig.rig")
_MESSAGE_BYTES = 65536
_OPENING_S = 10.0


class RigHost:
    """Devices of the rig process, and the calls that both other processes may make.

    Parameters
    ----------
    control
        Datagram socket (SOCK_SEQPACKET) to the front process, with JSON in each message.
    """

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._devices: Devices | None = None
        self._opening = threading.Lock()
        self._events: Channel | None = None
        self._happened: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self._calls: dict[str, Callable[..., Any]] = {
            "open": self.open,
            "close": self.close,
            "discover": discover_cameras,
            "ports": discover_ports,
        }

    # the front process ------------------------------------------------------------------------------------------------

    def obey(self) -> bool:
        """Carry out the front process' requests, a stop before all others; return False if that process has died."""
        while True:
            try:
                data = self._control.recv(_MESSAGE_BYTES)
            except OSError:
                return False
            if not data:
                return False
            asked = json.loads(data)
            action = asked["do"]
            if action == "end":
                return True
            if action == "abort":
                # it waits until the motors are off, behind which no stop must wait
                threading.Thread(target=self._halt, args=(asked,), name="abort", daemon=True).start()
            elif action == "stop":
                self._halt(asked)
            elif action == "ping":
                self._tell({"of": asked["id"]})

    def _tell(self, answer: dict[str, Any], *descriptors: int) -> None:
        with contextlib.suppress(OSError):  # the front process is gone, which `obey` notices
            socket.send_fds(self._control, [json.dumps(answer).encode()], descriptors)

    def _halt(self, asked: dict[str, Any]) -> None:
        began = time.perf_counter()
        answer: dict[str, Any] = {"of": asked["id"]}
        try:
            number = self.halt(asked["do"], ending=asked.get("ending", False))
        except StereorigError as error:
            answer |= {"code": error.code, "cause": error.cause, "remedy": error.remedy}
        except Exception as error:  # noqa: BLE001 - the client must learn that nothing was stopped
            _log.exception("the stage could not be stopped")
            answer |= {"code": "stage_lost", "cause": f"The stop failed: {type(error).__name__}.", "remedy": ""}
        else:
            answer |= {"number": number, "elapsed_ms": 1e3 * (time.perf_counter() - began)}
        self._tell(answer)

    def halt(self, action: str, *, ending: bool = False) -> int:
        """Stop or abort every axis now, announce it to the web process, and return the number of the stop.

        ``ending`` is announced too: the service ends, and its job was not cancelled by a user.

        Raises
        ------
        DeviceError
            ``not_connected`` while no stage is open, or an error of the stage's.
        """
        devices = self._devices
        if devices is None:
            raise DeviceError(
                "The rig is not connected.", code="not_connected", remedy="Mend the fault, then POST /rig:reconnect."
            )
        stage = devices.stage
        try:
            return stage.abort() if action == "abort" else stage.stop()
        finally:  # also if one of several controllers was not reached
            self._happened.put(("stopped", stage.last_stop, ending))

    def stop_quietly(self) -> None:
        """Stop every axis when another process died; a stage that is not there is no fault then."""
        try:
            self.halt("stop")
        except StereorigError as error:
            _log.info("no stop: %s", error)

    # the web process --------------------------------------------------------------------------------------------------

    def accept(self, listener: socket.socket) -> None:
        """Serve the web process' connections for ever, each in a thread of its own."""
        while True:
            connection, _ = listener.accept()
            threading.Thread(target=self._serve, args=(Channel(connection),), name="calls", daemon=True).start()

    def announce(self) -> None:
        """Send events to the web process, for ever; a web process that does not read holds this thread alone."""
        while True:
            event, events = self._happened.get(), self._events
            if events is not None:
                with contextlib.suppress(OSError):
                    events.send(event)

    def _serve(self, channel: Channel) -> None:
        with contextlib.suppress(EOFError, OSError):
            first = channel.receive()
            if first == "events":
                self._events = channel
                self._watch(channel)
                return
            while True:
                if first != GIVEN_UP:  # the caller gave up a call that was answered already
                    self._answer(channel, first)
                first = channel.receive()
        channel.close()

    def _watch(self, channel: Channel) -> None:
        """Wait for the end of the web process, and stop the axes then; no other process would."""
        with contextlib.suppress(EOFError, OSError):
            channel.receive()
        if self._events is channel:
            self._events = None
            self.stop_quietly()
        channel.close()

    def _answer(self, channel: Channel, asked: tuple[str, str, tuple[Any, ...], dict[str, Any], bool]) -> None:
        target, name, args, kwargs, checked = asked
        if checked:
            kwargs["check"] = lambda: _check(channel)
        try:
            answer = True, self._function(target, name)(*args, **kwargs)
        except BaseException as error:  # noqa: BLE001 - it is the caller's
            answer = False, error
        try:
            channel.send(answer)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - an error that cannot be pickled still has its text
            channel.send((False, RuntimeError(f"{type(error).__name__}: {error}; {answer[1]!r}")))

    def _function(self, target: str, name: str) -> Callable[..., Any]:
        if target == "host":
            return self._calls[name]
        devices = self._devices
        if devices is None:
            raise DeviceError(
                "The rig is not connected.", code="not_connected", remedy="Mend the fault, then POST /rig:reconnect."
            )
        owner = {"stage": devices.stage, "pair": devices.pair, "world": devices.world}.get(target)
        found = getattr(devices.pair.units[target] if owner is None else owner, name)  # type: ignore[index]
        return found if callable(found) else lambda: found

    def open(
        self,
        config: RigConfig,
        settings: dict[CameraName, CameraSettings],
        record: Path | None,
        dynamics: dict[int, tuple[float | None, float | None]],
    ) -> OpenedDevices:
        """Open the devices, in place of those that were open; errors as `stereorig.server.rig.build.open_devices`."""
        with self._opening:
            self._close()
            devices = self._devices = open_devices(
                config,
                settings,
                record=record,
                dynamics=dynamics,
                on_lost=lambda cam, error: self._happened.put(("lost", cam, error)),
                on_stage=lambda status: self._happened.put(("stage", status)),
                on_lines=self._pass_lines,
                keep_looking=True,
            )
            return OpenedDevices(devices.stage.axes, devices.world is not None)

    def _pass_lines(self, lines: list[Line]) -> None:
        self._tell({"lines": [stop.decode("ascii") for _, stop in lines]}, *(descriptor for descriptor, _ in lines))

    def close(self) -> None:
        """Stop the stage and release every device; those that are being opened by then are waited for some seconds."""
        held = self._opening.acquire(timeout=_OPENING_S)
        try:
            self._close()
        finally:
            if held:
                self._opening.release()

    def _close(self) -> None:
        devices, self._devices = self._devices, None
        if devices is not None:
            self._pass_lines([])
            devices.close()


def _check(channel: Channel) -> None:
    """Raise an error if the caller has given up, or is gone."""
    if channel.waiting():
        raise Cancelled("The caller has given up.")


def main() -> int:
    """Hold the rig's devices until the front process ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)  # the front process handles them; this one ends when that does
    control, listener = (socket.socket(fileno=int(number)) for number in sys.argv[1:3])
    folder, level, form = sys.argv[3:6]
    logs.configure(level, "json" if form == "json" else "text", lines_per_s=30)
    raise_file_limit()
    raise_service()
    host = RigHost(control)
    threading.Thread(target=host.accept, args=(listener,), name="accept", daemon=True).start()
    threading.Thread(target=host.announce, name="events", daemon=True).start()
    settle()
    with compiled_aside():
        asked = host.obey()
    host.stop_quietly()
    host.close()
    if not asked:  # the front process cannot remove it any more
        shutil.rmtree(folder, ignore_errors=True)
    logging.shutdown()
    os._exit(0)  # threads of drivers' libraries may hang


if __name__ == "__main__":
    raise SystemExit(main())
