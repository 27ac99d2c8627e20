"""A stage driver, a simulated controller and the line between them, as the stage tests use them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from drivers.registry import STAGE_DRIVERS
from drivers.stages.protocol import AxisOptions
from drivers.stages.serial_stage import SerialStage
from sim.controllers.axis import SimAxis
from sim.controllers.registry import make_controller
from sim.controllers.server import ControllerServer

Transport = Literal["socket", "pty"]
CONTROLLERS = ("esp301", "smc100", "conex-cc")
# the words that start a motion, by which the tests count what was sent
MOVE_WORD = "PA"


@dataclass
class Bench:
    """Controller, server and an opened stage."""

    driver: str
    controller: Any
    server: ControllerServer
    stage: SerialStage

    def axis(self, number: int) -> SimAxis:
        found = self.controller.axis(number)
        assert isinstance(found, SimAxis)
        return found

    def ready(self, *axes: int) -> None:
        """Enable and home."""
        for axis in axes:
            self.stage.enable(axis)
            self.stage.home(axis)

    def another(self, options: dict[int, AxisOptions]) -> SerialStage:
        """Open a second driver on the same controller, in place of the first."""
        self.stage.close()
        self.stage = STAGE_DRIVERS[self.driver](self.server.url, options)
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
    controller = make_controller(driver, (1, 2), **{"time_scale": 50.0, "start_mm": 3.0, **controller_options})
    with ControllerServer(controller, transport) as server:
        stage = STAGE_DRIVERS[driver](
            server.url,
            {1: AxisOptions(), 2: AxisOptions()} if options is None else options,
            record=record,
            timeout_s=0.25,
        )
        stage.open()
        result = Bench(driver, controller, server, stage)
        try:
            yield result
        finally:
            result.stage.close()
