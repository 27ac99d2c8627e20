"""A stage driver, a simulated controller and the line between them, as the stage tests use them."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from stereorig.core.errors import StageError
from stereorig.drivers.registry import STAGE_DRIVERS
from stereorig.drivers.stages import serial_stage
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.serial_stage import SerialStage
from stereorig.sim.controllers.axis import SimAxis
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.controllers.wire import Received
from tests.support.fake_kinesis import FakeKinesis
from tests.support.fake_pi import FakePI
from tests.support.fake_zaber import FakeZaber
from tests.support.patience import Deadline

Transport = Literal["socket", "pty"]
# simulated by the product, and by the tests alone
CONTROLLERS = ("esp301", "smc100", "conex-cc")
FAKES: dict[str, Any] = {"pi": FakePI, "zaber": FakeZaber}
# has one axis, and is not for the whole suite
ONE_AXIS: dict[str, Any] = {"kinesis": FakeKinesis}
# the words that start a motion of the former
MOVE_WORD = "PA"
# the commands by which the tests count what was sent to axis N; `[0-9]*` in place of N for any
_NEWPORT = {"left moving": "1PA40", "move": "^{n}PA", "position": "^{n}TP", "stop": "^{n}ST$", "abort": "^ST$"}
_COMMANDS = {
    "esp301": {**_NEWPORT, "abort": "^AB$"},
    "smc100": _NEWPORT,
    "conex-cc": _NEWPORT,
    "kinesis": {
        "left moving": "53040600d001" + "0100801a0600",
        "move": "^5304",
        "position": "^9004",
        "stop": "^6504",
        "abort": "^65040101",
    },
    "pi": {
        "left moving": "MOV 1 40",
        "move": "^MOV {n} ",
        "position": "^POS. {n}$",
        "stop": "^HLT ?{n}$",
        "abort": "\x18",
    },
    "zaber": {
        "left moving": f"/1 1 move abs {round(40 / FakeZaber.mm)}",
        "move": "^/0?{n} 1 .*move abs",
        "position": "^/0?{n} 1 .*get pos",
        "stop": "^/(?:0{n} 1 )?stop$",
        "abort": "^/estop$",
    },
}


def with_lengths(driver: str, options: dict[int, AxisOptions]) -> dict[int, AxisOptions]:
    """Return the options with the length of a step, where the driver needs it."""
    length = getattr({**FAKES, **ONE_AXIS}.get(driver), "mm", None)
    return {axis: replace(one, mm_per_step=length) for axis, one in options.items()}


class Server(ControllerServer):
    """Cuts what comes in as the controller does, where lines are not all that it takes."""

    def _lines(self, buffer: bytearray) -> Iterator[bytes]:
        frames = getattr(self.controller, "frames", super()._lines)
        yield from frames(buffer)


@dataclass
class Bench:
    """Controller, server and an opened stage."""

    driver: str
    controller: Any
    server: ControllerServer
    stage: SerialStage

    @property
    def step_mm(self) -> float:
        """Accuracy of a commanded position: the controller's own step, else the last digit on the wire."""
        return float(getattr(self.controller, "mm", 1e-6))

    def axis(self, number: int) -> SimAxis:
        found = self.controller.axis(number)
        assert isinstance(found, SimAxis)
        return found

    @property
    def left_moving(self) -> bytes:
        """Command line by which another program moves axis 1 to 40 mm."""
        return _COMMANDS[self.driver]["left moving"].encode() + bytes(self.controller.terminator)

    def sent(self, command: str, axis: int | None = None) -> list[Received]:
        """Return the commands of a kind that came in, for one axis or any."""
        pattern = _COMMANDS[self.driver][command].format(n="[0-9]*" if axis is None else axis)
        return [entry for entry in self.controller.received if re.search(pattern, entry.text)]

    def ready(self, *axes: int) -> None:
        """Enable and home."""
        for axis in axes:
            self.stage.enable(axis)
            self.stage.home(axis)

    def another(self, options: dict[int, AxisOptions]) -> SerialStage:
        """Open a second driver on the same controller, in place of the first."""
        self.stage.close()
        self.stage = STAGE_DRIVERS[self.driver](self.server.url, with_lengths(self.driver, options))
        self.stage.open()
        return self.stage


@contextmanager
def bench(
    driver: str,
    transport: Transport,
    *,
    options: dict[int, AxisOptions] | None = None,
    record: Path | None = None,
    **controller_options: Any,
) -> Iterator[Bench]:
    motion = {"time_scale": 50.0, "start_mm": 3.0, **controller_options}
    fakes = {**FAKES, **ONE_AXIS}
    controller = fakes[driver](**motion) if driver in fakes else make_controller(driver, (1, 2), **motion)
    given = {1: AxisOptions(), 2: AxisOptions()} if options is None else options
    with Server(controller, transport) as server:
        stage = STAGE_DRIVERS[driver](server.url, with_lengths(driver, given), record=record, timeout_s=0.4)
        stage.open()
        result = Bench(driver, controller, server, stage)
        try:
            yield result
        finally:
            result.stage.close()


def in_thread(call: Callable[[], object]) -> tuple[threading.Thread, list[StageError]]:
    """Start a call in a thread of its own; the list gets the error that ends it."""
    errors: list[StageError] = []

    def run() -> None:
        try:
            call()
        except StageError as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, errors


def wait_for_its_turn(thread: threading.Thread) -> None:
    """Wait until a motion in a thread of its own waits for another's end."""

    def waits() -> bool:
        frame = sys._current_frames().get(thread.ident or 0)
        return frame is not None and frame.f_code.co_filename == serial_stage.__file__

    wait_until(waits)
    time.sleep(0.02)  # it may be a line before


def wait_until(condition: Callable[[], object], seconds: float = 5.0) -> None:
    """Wait until a condition holds."""
    deadline = Deadline(seconds)
    while not condition():
        assert deadline.left, "waited in vain"
        time.sleep(0.002)
