"""The service with simulated cameras and a stage whose controller is outside, where the wire can be watched."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from stereorig.server.config.rig_file import RigConfig, parse_config
from stereorig.server.workflows.service import Service
from stereorig.sim.controllers.axis import SimAxis
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.support.patience import Deadline
from tests.support.service_rig import TINY, served
from tests.support.stage_bench import Transport

API = "/api/v1"
# words that set something in motion or under power; all others only ask
ACTIONS = ("PA", "PR", "OR", "MO", "MF", "MM", "PW", "ST", "AB", "VA", "AC", "AG")


def rig_text(more: str = "", **stage: str) -> str:
    """Return the tiny rig with keys of [stage] set or replaced, and with more tables behind it."""
    head, rest = TINY.split("[stage]\n")
    own, tail = rest.split("[target]\n")
    kept = [line for line in own.splitlines() if line.split(" =")[0] not in stage]
    lines = [*kept, *(f"{key} = {value}" for key, value in stage.items()), more, "[target]", tail]
    return head + "[stage]\n" + "\n".join(lines)


def rig(more: str = "", **stage: str) -> RigConfig:
    """Return the configuration of `rig_text`."""
    return parse_config(rig_text(more, **stage))


@dataclass
class StageService:
    """A served rig and the controller at the other end of its stage's line."""

    client: httpx.Client
    service: Service
    controller: Any
    server: ControllerServer

    def axis(self, number: int) -> SimAxis:
        found = self.controller.axis(number)
        assert isinstance(found, SimAxis)
        return found

    def actions(self) -> list[str]:
        """Commands that came in and are no questions."""
        return [
            entry.text
            for entry in self.controller.received
            if "?" not in entry.text and any(word in entry.text for word in ACTIONS)
        ]

    def post(self, path: str, **body: Any) -> httpx.Response:
        return self.client.post(f"{API}{path}", json=body)

    def job(self, path: str, **body: Any) -> dict[str, Any]:
        """Post something that makes a job."""
        answer = self.post(path, **body)
        assert answer.status_code == 202, answer.text
        job: dict[str, Any] = answer.json()["job"]
        return job

    def done(self, job: dict[str, Any], seconds: float = 30.0) -> dict[str, Any]:
        """Wait until a job has ended."""
        deadline = Deadline(seconds)
        while deadline.left:
            document: dict[str, Any] = self.client.get(f"{API}/jobs/{job['id']}").json()
            if document["state"] in ("succeeded", "failed", "cancelled", "interrupted"):
                return document
            time.sleep(0.01)
        raise AssertionError(f"the job did not end: {document}")

    def home(self) -> None:
        assert self.done(self.job("/stage:home"))["state"] == "succeeded"

    def stage(self) -> dict[str, Any]:
        answer = self.client.get(f"{API}/stage")
        assert answer.status_code == 200, answer.text
        shown: dict[str, Any] = answer.json()
        return shown


def wait_until(condition: Callable[[], object], seconds: float = 10.0) -> None:
    """Wait until a condition holds."""
    deadline = Deadline(seconds)
    while not condition():
        assert deadline.left, "waited in vain"
        time.sleep(0.002)


@contextmanager
def stage_service(
    data: Path,
    driver: str = "esp301",
    transport: Transport = "socket",
    *,
    record: Path | None = None,
    stage: dict[str, str] | None = None,
    **controller_options: Any,
) -> Iterator[StageService]:
    """Serve the tiny rig on a controller of our own."""
    controller = make_controller(driver, (1, 2), **{"time_scale": 10.0, "start_mm": 3.0, **controller_options})
    with ControllerServer(controller, transport) as server:
        config = rig(driver=f'"{driver}"', url=f'"{server.url}"', reply_timeout_ms="250", **(stage or {}))
        service = Service(config, data, record=record).start()
        try:
            with served(service) as client:
                wait_until(lambda: client.get(f"{API}/rig").json()["connected"])
                yield StageService(client, service, controller, server)
        finally:
            service.close()
