"""Analyses that are begun, watched, and read back."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import httpx
import netCDF4
import numpy as np

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.copied_tests import CONFIG
from tests.support.patience import Deadline
from tests.support.service_rig import served

API = "/api/v1"


BODY: dict[str, Any] = {"region": {"rectangle": [30, 30, 120, 110]}, "subset_px": 21, "spacing_px": 8}


def begin(client: httpx.Client, url: str, **changes: Any) -> tuple[str, dict[str, Any]]:
    accepted = client.post(f"{url}/analyses", json={**BODY, **changes})
    assert accepted.status_code == 202, accepted.text
    return f"{url}/analyses/{accepted.json()['analysis_id']}", accepted.json()["job"]


def wait_for_steps(client: httpx.Client, url: str, count: int, seconds: float = 240.0) -> None:
    deadline = Deadline(seconds)
    while deadline.left:
        if len(client.get(url).json()["steps_finished"]) >= count:
            return
        time.sleep(0.005)
    raise AssertionError(client.get(url).text)


def folder_of(host: Host, url: str) -> Path:
    parts = url.split("/")
    return host.data / "tests" / parts[-3] / "analyses" / parts[-1]


def contents(path: Path) -> dict[str, Any]:
    with netCDF4.Dataset(path) as data:
        data.set_auto_mask(False)
        return {name: np.asarray(variable[...]) for name, variable in data.variables.items()}


class Host:
    """A service on a data folder, begun anew when wanted."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self.service: Any = None
        self.client: Any = None
        self._context: Any = None

    def start(self) -> httpx.Client:
        self.stop()
        self.service = Service(parse_config(CONFIG), self.data).start()
        self._context = served(self.service)
        self.client = self._context.__enter__()
        return self.client

    def stop(self) -> None:
        if self.service is not None:
            self._context.__exit__(None, None, None)
            self.service.close()
            self.service = None
