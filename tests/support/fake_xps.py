# ruff: noqa: N802 - the names are the controller's
"""A Newport XPS after the published language: states, blocking functions, an answer on the connection that asked.

Axes are those of our simulated controllers, so that faults of a motion are the same.
"""

from __future__ import annotations

import contextlib
import socket
import socketserver
import threading
import time
from typing import Any

from stereorig.sim.controllers.axis import SimAxis, SimClock

READY, DISABLED, NOT_REFERENCED, HOMING, MOVING = 12, 20, 42, 43, 44
TEXTS = {
    0: "Not initialized state",
    7: "Not initialized state due to a KillAll command",
    20: "Disable state",
    22: "Disabled state due to a following error during motion",
    42: "Not referenced state",
}
ERRORS = {-17: "Parameter out of range", -22: "Not allowed action", -25: "Following error", -27: "Move aborted"}


class FakeXPS:
    """Groups ``Group1`` and ``Group2`` with a positioner ``Pos`` each, on a free port of this machine."""

    def __init__(self, *, time_scale: float = 50.0, start_mm: float = 3.0, unit: str = "mm") -> None:
        clock = SimClock(time_scale)
        self.axes = {f"Group{n}": SimAxis(clock, start_mm=start_mm) for n in (1, 2)}
        self.states = dict.fromkeys(self.axes, 0)
        self.unit = unit
        self.limits = (-50.0, 50.0)
        self.received: list[tuple[float, str]] = []
        self.silent = False
        self._lock = threading.RLock()
        self._connections: list[socket.socket] = []
        fake = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                fake._connections.append(self.request)
                while data := self.request.recv(4096):
                    answer = fake.answer(data.decode("ascii"))
                    if answer is not None:
                        self.request.sendall(f"{answer},EndOfAPI".encode())

            def finish(self) -> None:
                self.request.close()

        class Server(socketserver.ThreadingTCPServer):
            daemon_threads = True
            block_on_close = False
            allow_reuse_address = True
            request_queue_size = 100

            def handle_error(self, request: Any, client_address: Any) -> None:
                """A client that has gone is no news."""

        self._server = Server(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        self.url = f"socket://127.0.0.1:{self.port}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    def axis(self, number: int) -> SimAxis:
        return self.axes[f"Group{number}"]

    def hang_up(self) -> None:
        """End every connection, as a controller that boots."""
        for connection in self._connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._connections.clear()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self.hang_up()

    def words(self, name: str) -> list[str]:
        return [text for _, text in self.received if text.startswith(name)]

    def answer(self, text: str) -> str | None:
        with self._lock:
            self.received.append((time.monotonic(), text))
        if self.silent:
            return None
        name, _, inside = text.rstrip(")").partition("(")
        given = inside.split(",")
        function = getattr(self, f"_{name}", None)
        if function is None:
            return f"-4,{text}"
        of_group = name.startswith(("Group", "Positioner")) and name != "GroupStatusStringGet"
        if of_group and given[0].split(".")[0] not in self.axes:
            return f"-19,{text}"
        result = function(*given)
        return f"{result},{text}" if isinstance(result, int) and result else f"0,{'' if result == 0 else result}"

    def _FirmwareVersionGet(self, _: str) -> str:
        return "XPS-D Firmware V1.4.1"

    def _ErrorListGet(self, _: str) -> str:
        return ";".join(f"Error {code} : {text}" for code, text in ERRORS.items())

    def _ErrorStringGet(self, code: str, _: str) -> str:
        return ERRORS.get(int(code), "Unknown error")

    def _GroupStatusStringGet(self, code: str, _: str) -> str:
        return TEXTS.get(int(code), "a state")

    def _PositionerStageParameterGet(self, _: str, parameter: str, __: str) -> Any:
        return {"SmartStageName": "ILS100CC", "Unit": self.unit}.get(parameter, -17)

    def _PositionerUserTravelLimitsGet(self, *_: str) -> str:
        return f"{self.limits[0]},{self.limits[1]}"

    def _PositionerMaximumVelocityAndAccelerationGet(self, *_: str) -> str:
        return "40,400"

    def _PositionerSGammaParametersGet(self, name: str, *_: str) -> str:
        axis = self.axes[name.split(".")[0]]
        return f"{axis.velocity_mm_s},{axis.acceleration_mm_s2},0.005,0.05"

    def _PositionerSGammaParametersSet(self, name: str, velocity: str, acceleration: str, *_: str) -> int:
        axis = self.axes[name.split(".")[0]]
        if not 0 < float(velocity) <= 40 or not 0 < float(acceleration) <= 400:
            return -17
        axis.velocity_mm_s, axis.acceleration_mm_s2 = float(velocity), float(acceleration)
        return 0

    def _GroupStatusGet(self, group: str, _: str) -> str:
        return str(self.states[group])

    def _GroupPositionCurrentGet(self, name: str, *_: str) -> str:
        return f"{self.axes[name.split('.')[0]].encoder_mm:.6f}"

    def _GroupInitialize(self, group: str) -> int:
        if self.states[group] >= 10:
            return -22
        self.states[group] = NOT_REFERENCED
        return 0

    def _GroupKill(self, group: str) -> int:
        self.axes[group].cut()
        self.states[group] = 7
        return 0

    def _GroupMotionEnable(self, group: str) -> int:
        if self.states[group] not in range(20, 40):
            return -22
        self.states[group] = 13
        return 0

    def _GroupMotionDisable(self, group: str) -> int:
        if self.states[group] not in range(10, 20):
            return -22
        self.states[group] = DISABLED
        return 0

    def _GroupMoveAbort(self, group: str) -> int:
        with self._lock:
            if self.states[group] != MOVING:
                return -22
            self.axes[group].stop()
        self._until(group, lambda: self.states[group] == MOVING and self.axes[group].moving)
        return 0

    def _GroupHomeSearch(self, group: str) -> int:
        axis = self.axes[group]
        with self._lock:
            if self.states[group] != NOT_REFERENCED:
                return -22
            self.states[group] = HOMING
            axis.move_home()
        self._until(group, lambda: self.states[group] == HOMING and axis.moving)
        if self.states[group] != HOMING:
            return -27
        axis.set_home()
        self.states[group] = 11
        return 0

    def _GroupMoveAbsolute(self, name: str, target: str) -> int:
        group, goal = name.split(".")[0], float(target)
        axis = self.axes[group]
        with self._lock:
            if self.states[group] not in range(10, 20):
                return -22
            if not self.limits[0] <= goal <= self.limits[1]:
                return -17
            self.states[group] = MOVING
            axis.take_trouble()
            axis.move_to(goal)
        self._until(group, lambda: self.states[group] == MOVING and axis.moving)
        trouble = axis.take_trouble()
        if self.states[group] != MOVING:
            return -27
        self.states[group] = 22 if trouble else READY if abs(axis.goal_mm - goal) < 1e-9 else 10
        return -25 if trouble else 0 if self.states[group] == READY else -27

    @staticmethod
    def _until(group: str, goes_on: Any) -> None:
        while goes_on():
            time.sleep(0.001)
