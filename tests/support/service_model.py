"""A small model of what a service must hold, and a service that can be killed between any two changes of its folder."""

from __future__ import annotations

import asyncio
import os
import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
from serial.urlhandler import protocol_socket
from starlette.routing import BaseRoute

import stereorig.server.formats.disk
from stereorig.server.api.app import create_app
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.workflows.service import Service
from tests.support.hooked_disk import HookedDisk
from tests.support.power_loss.recording import ThreadWorker

_OWN = ("catalog.", "service.lock", "audit.log")
#: the application's routes; they are asked for the service each time, and to build them takes longer than a start
_ROUTES: list[BaseRoute] = []


@dataclass
class Modelled:
    """One test: its name, its steps by number with their labels, and the numbers that were given."""

    name: str
    steps: dict[int, str] = field(default_factory=dict)
    given: set[int] = field(default_factory=set)
    analyses: set[str] = field(default_factory=set)


@dataclass
class Trashed:
    """One entry of the trash."""

    kind: str
    ids: dict[str, Any]
    content: Any


@dataclass
class Request:
    """A request that makes something, so that it can be sent again."""

    url: str
    body: dict[str, Any]
    made: dict[str, Any] | None = None  # what it answered; None: no answer came


class KillingDisk(HookedDisk):
    """The real disk; before its n-th call it puts a copy of the folder aside, as a kill then would leave it.

    Parameters
    ----------
    data
        The folder.
    """

    def __init__(self, data: Path) -> None:
        self.data = data
        self._left, self._aside = 0, data

    def arm(self, n: int, aside: Path) -> None:
        """Count from here."""
        self._left, self._aside = n, aside

    def disarm(self) -> bool:
        """Return True if it came to it."""
        came, self._left = self._left == 0, -1
        return came

    def before(self, call: str, path: Path, data: bytes = b"") -> None:
        """Put the copy aside, if it is this call's turn."""
        if self._left > 0:
            self._left -= 1
            if self._left == 0:
                copy_folder(self.data, self._aside)


def copy_folder(data: Path, aside: Path) -> None:
    """Copy a data folder as it is: files are only ever replaced, so links do; the catalogue as it was committed."""
    shutil.copytree(
        data, aside, copy_function=os.link, ignore=lambda _, names: [n for n in names if n.startswith(_OWN)]
    )
    with (
        closing(sqlite3.connect(aside / "catalog.sqlite")) as copy,
        closing(sqlite3.connect(data / "catalog.sqlite")) as own,
    ):
        own.backup(copy)


class AppClient:
    """Asks the application itself, without a socket.

    Parameters
    ----------
    service
        Started.
    """

    def __init__(self, service: Service) -> None:
        app = create_app(service, close_service=False)
        _ROUTES.extend([] if _ROUTES else app.router.routes)
        app.router.routes[:] = _ROUTES
        self._client = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1/api/v1")
        self._runner = asyncio.Runner()
        self._life = app.router.lifespan_context(app)
        self._runner.run(self._life.__aenter__())

    def request(self, method: str, url: str, **body: Any) -> httpx.Response:
        """Send a request; return the answer."""
        return self._runner.run(self._client.request(method, url, **body))

    def get(self, url: str) -> httpx.Response:
        """As `request`."""
        return self.request("GET", url)

    def close(self) -> None:
        """End the loop."""
        self._runner.run(self._client.aclose())
        self._runner.run(self._life.__aexit__(None, None, None))
        self._runner.close()


class Lab:
    """A service in this process, with its client; can be killed and started again.

    Parameters
    ----------
    folder
        Its data folders, one after the other, lie in it.
    config
        The rig.
    """

    def __init__(self, folder: Path, config: RigConfig) -> None:
        self.folder, self.config = folder, config
        self.starts = 0
        self.data = folder / "0"
        self.disk = KillingDisk(self.data)
        self._real = stereorig.server.formats.disk.disk, protocol_socket.time
        stereorig.server.formats.disk.disk = self.disk
        # pyserial waits 0.3 s after a line is closed; the next start opens another one
        protocol_socket.time = SimpleNamespace(sleep=lambda _seconds: None)
        self._open()

    def _open(self) -> None:
        self.disk.data = self.data
        self.service = Service(self.config, self.data, worker=ThreadWorker()).start()  # type: ignore[arg-type]
        self.service.rig.set_scene("plate")  # what is captured goes with what is imported
        self.client = AppClient(self.service)

    def close(self) -> None:
        """End for good."""
        self._end()
        stereorig.server.formats.disk.disk, protocol_socket.time = self._real
        shutil.rmtree(self.folder)

    def restart(self, aside: Path | None = None) -> None:
        """Start again: on the same folder after an orderly end, or on a copy that a kill left."""
        self._end()
        if aside is not None:
            shutil.rmtree(self.data)
            self.data = aside
        self._open()

    def _end(self) -> None:
        self.client.close()
        self.service.close()

    def new_folder(self) -> Path:
        """Return a name for the next copy."""
        self.starts += 1
        return self.folder / str(self.starts)
