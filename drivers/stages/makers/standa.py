"""Standa 8SMC4 and 8SMC5 through the maker's library libximc (MIT): one controller, one axis.

The library runs in a process of its own (`stereorig.drivers.stages.makers.standa_process`), which stops the axis when
this one ends. The controller counts motor steps and parts of them: their length is in the rig file. It knows if it was
homed, and moves after power-off by itself: so the driver keeps whether the motor was switched off.

References
----------
Standa, *libximc* documentation (``ximc.h``), and *8SMC5-USB user's manual*.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stereorig.core.errors import StageError
from stereorig.drivers.stages.protocol import (
    AxisIdentity,
    AxisOptions,
    AxisState,
    AxisStatus,
    ControllerMessage,
    StageIdentity,
)
from stereorig.drivers.stages.refusals import motion_fault, no_travel, unit_not_length
from stereorig.drivers.stages.serial_stage import SerialStage

_START_S = 20.0  # the library looks for a controller in the network so long
_CALL_S = 5.0  # and tries again for so long
_TRY_AGAIN_S = 1.0  # each look for a controller starts a program
_RUNNING, _FAILED, _COMMAND, _HOMING = 0x80, 0x40, 0x3F, 0x06  # bits of MvCmdSts
_HOMED = 0x20  # bits of Flags
_FAULTS = {0x40: "alarm", 0x80: "position lost (CTP)", 0x100: "driver too hot", 0x20000: "fault of the H bridge"}
_BORDERS_BY_POSITION, _ENCODER_UNITS, _LIMITED = 0x1, (1, 6), 0x80


class XimcLine:
    """The library's process for one controller.

    Parameters
    ----------
    url
        ``xi-com:///dev/ttyACM0``, ``xi-net://host/serial``, or ``xi-emu:///file`` for the maker's emulator.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._process: subprocess.Popen[bytes] | None = None
        self._calls = self._stops = socket.socket()
        self._calls.close()
        self._lock, self._stopping = threading.RLock(), threading.Lock()
        self._broken, self._next_try = False, 0.0

    @property
    def is_open(self) -> bool:
        """True while its process was not ended; independent of the controller."""
        return self._process is not None

    def open(self) -> None:
        """Start the process and connect; raises `StageError` ``driver_missing`` or ``stage_lost``."""
        with self._lock:
            self._calls, calls = socket.socketpair()
            self._stops, stops = socket.socketpair()
            numbers = [calls.fileno(), stops.fileno()]
            command = [
                sys.executable,
                "-m",
                "stereorig.drivers.stages.makers.standa_process",
                *map(str, numbers),
                self.url,
            ]
            self._process = subprocess.Popen(command, pass_fds=numbers, stdin=subprocess.DEVNULL)
            calls.close()
            stops.close()
            self._broken = False
            try:
                self._reply(_START_S)
            except StageError:
                self.close()
                self._next_try = time.monotonic() + _TRY_AGAIN_S
                raise

    def renew(self) -> None:
        """Start the process again if the controller was gone or it has ended."""
        with self._lock:
            if self._broken or self._process is None or self._process.poll() is not None:
                self.close()
                time.sleep(max(self._next_try - time.monotonic(), 0.0))
                self.open()

    def close(self) -> None:
        """End the process, which stops the axis; safe to call twice."""
        with self._stopping:
            process, self._process = self._process, None
            self._calls.close()
            self._stops.close()
        if process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(2.0)
            process.kill()
            process.wait()

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of the library once; errors `StageError` ``stage_lost`` and ``stage_refused``."""
        with self._lock:
            if self._broken:  # a late answer must not be taken for the next command's
                raise self._lost("it did not answer before")
            try:
                self._calls.sendall(json.dumps([name, arguments]).encode("ascii") + b"\n")
            except OSError as error:
                raise self._lost(str(error)) from error
            return self._reply(_CALL_S)

    def _reply(self, timeout_s: float) -> Any:
        held = b""
        try:
            self._calls.settimeout(timeout_s)
            while not held.endswith(b"\n"):
                data = self._calls.recv(65536)
                if not data:
                    raise ConnectionResetError("the library's process has ended")
                held += data
        except OSError as error:
            raise self._lost(str(error)) from error
        reply = json.loads(held)
        if "missing" in reply:
            raise StageError(
                f"Standa's library cannot be used: {reply['missing']}.",
                code="driver_missing",
                remedy="Install it: pip install 'stereorig[standa]'.",
            )
        if "gone" in reply:
            raise self._lost(reply["gone"])
        if "refused" in reply:
            raise StageError(
                f"The controller {self.url} refused a call: {reply['refused']}.",
                code="stage_refused",
                remedy="Correct the cause that it names, then try again.",
            )
        return reply["value"]

    def urgent(self, text: str) -> None:
        """Write a stop on the socket that is for nothing else."""
        try:
            self._stops.sendall(text.encode("ascii") + b"\n")
        except OSError as error:
            raise self._lost(str(error)) from error

    def last_words(self, text: str) -> list[tuple[int, bytes]]:
        """Return a copy of that socket's descriptor and the bytes of a stop."""
        with self._stopping:
            if self._process is None:
                return []
            return [(os.dup(self._stops.fileno()), text.encode("ascii") + b"\n")]

    def _lost(self, failure: str) -> StageError:
        self._broken = True
        return StageError(
            f"The controller {self.url} cannot be reached ({failure}).",
            code="stage_lost",
            remedy="Check power, cable and the url in the rig file; no other program may hold it. Then reconnect.",
            url=self.url,
        )


class StandaStage(SerialStage):
    """Driver for Standa's controllers.

    Parameters
    ----------
    url
        As `XimcLine`.
    options
        The one axis -> how it is used, with ``mm_per_step``.
    record, timeout_s, numbers
        Not used: the library has no wire to show, limits of its own, and one axis.
    **serial
        Not used: the library sets the line.
    """

    _line: XimcLine

    def __init__(
        self,
        url: str,
        options: Mapping[int, AxisOptions],
        *,
        record: Path | None = None,  # noqa: ARG002
        timeout_s: float = 0.5,  # noqa: ARG002
        numbers: Mapping[int, int] | None = None,
        **serial: Any,  # noqa: ARG002
    ) -> None:
        super().__init__(XimcLine(url), options, numbers)
        self._parts = 256  # parts of a step
        self._off = False

    def _mm(self, axis: int, steps: int, parts: int) -> float:
        return (steps + parts / self._parts) * (self._options[axis].mm_per_step or 0.0)

    def _split(self, axis: int, mm: float) -> tuple[int, int]:
        total = round(mm / (self._options[axis].mm_per_step or 1.0) * self._parts)
        steps = int(total / self._parts)
        return steps, total - steps * self._parts

    def _connect(self) -> StageIdentity:
        axis = self.axes[0]
        found, engine = self._line.call("get_device_information"), self._line.call("get_engine_settings")
        self._parts = 1 << max(engine["MicrostepMode"] - 1, 0)
        encoder = self._line.call("get_feedback_settings")["FeedbackType"] in _ENCODER_UNITS
        if encoder or not self._options[axis].mm_per_step:
            unit = "encoder counts" if encoder else "steps of unknown length"
            remedy = "Set mm_per_step in the rig file, and the controller's feedback to none or EMF."
            raise unit_not_length(axis, self._line.url, unit, remedy)
        version = ".".join(map(str, self._line.call("get_firmware_version")))
        stage = self._line.call("get_stage_name")["PositionerName"]
        identity = AxisIdentity(axis, stage or "a stage", str(self._line.call("get_serial_number")), "steps")
        model = f"{found['Manufacturer']} {found['ProductDescription']}".strip()
        return StageIdentity("standa", model, version, self._line.url, (identity,))

    def _read_travel_mm(self, axis: int) -> tuple[float, float]:
        edges, soft = self._line.call("get_edges_settings"), self._options[axis].soft_limits_mm
        if edges["BorderFlags"] & _BORDERS_BY_POSITION:
            ends = [self._mm(axis, edges[side], edges[f"u{side}"]) for side in ("LeftBorder", "RightBorder")]
            return min(ends), max(ends)
        if soft is None:  # limit switches alone, whose places the controller does not know
            raise no_travel(axis, self._line.url)
        return soft

    def _set_dynamics(self, axis: int) -> tuple[float, float]:
        option, wanted = self._options[axis], {}
        if option.velocity_mm_s is not None:
            wanted["Speed"], wanted["uSpeed"] = self._split(axis, option.velocity_mm_s)
        if option.acceleration_mm_s2 is not None:
            wanted["Accel"] = wanted["Decel"] = max(1, self._split(axis, option.acceleration_mm_s2)[0])
        if wanted:
            self._line.call("set_move_settings", wanted)
        taken = self._line.call("get_move_settings")
        return self._mm(axis, taken["Speed"], taken["uSpeed"]), self._mm(axis, taken["Accel"], 0)

    def _greatest(self, axis: int) -> tuple[float | None, float | None]:
        engine = self._line.call("get_engine_settings")
        limited = engine["EngineFlags"] & _LIMITED
        return (self._mm(axis, engine["NomSpeed"], engine["uNomSpeed"]) if limited else None), None

    def _read_position_mm(self, axis: int) -> float:
        found = self._line.call("get_position")
        return self._mm(axis, found["Position"], found["uPosition"])

    def _read_status(self, axis: int) -> AxisStatus:
        found = self._line.call("get_status")
        position = self._mm(axis, found["CurPosition"], found["uCurPosition"])
        moving = bool(found["MvCmdSts"] & _RUNNING)
        homed = bool(found["Flags"] & _HOMED) or self._options[axis].assume_homed
        faults = [text for bit, text in _FAULTS.items() if found["Flags"] & bit]
        if moving:
            state = AxisState.HOMING if found["MvCmdSts"] & _COMMAND == _HOMING else AxisState.MOVING
        elif faults:
            state = AxisState.FAULT
        elif self._off:
            state = AxisState.MOTOR_OFF
        else:
            state = AxisState.READY if homed else AxisState.NOT_HOMED
        detail = f"reports: {', '.join(faults)}" if faults else ""
        return AxisStatus(axis, state, position, not self._off, homed, moving, detail)

    def _switch_motor(self, axis: int, *, on: bool) -> None:
        if self._read_status(axis).moving:
            raise motion_fault(axis, "moves: stop it first")
        self._line.call("command_stop" if on else "command_power_off")  # which clears an alarm
        self._off = not on

    def _start_homing(self, axis: int) -> None:
        if self._off:
            self._switch_motor(axis, on=True)
        self._line.call("command_home")

    def _finish_homing(self, axis: int) -> None:
        found = self._line.call("get_status")
        if found["MvCmdSts"] & _FAILED or not found["Flags"] & _HOMED:
            raise motion_fault(axis, "did not find home")
        self._line.call("command_zero")

    def _send_move(self, axis: int, position_mm: float) -> None:
        self._line.call("command_move", *self._split(axis, position_mm))

    def _stop_text(self, axis: int | None) -> str:  # noqa: ARG002 - there is one
        return "sstp"

    def _abort_text(self) -> str:
        return "stop"

    def _drain_errors(self, axis: int | None = None) -> list[ControllerMessage]:  # noqa: ARG002
        return []  # it keeps no errors: a refused call is one, and its state shows faults

    def _code_of(self, message: ControllerMessage) -> str | None:  # noqa: ARG002
        return None
