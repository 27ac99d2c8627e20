"""A service in processes of its own on a controller in this one, and the stage's wire after one of them has died.

The time is taken from just before the kill to the moment when the controller has read the stop, by one clock.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil

from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.support.patience import Deadline
from tests.support.requirements import ROOT
from tests.support.stage_service import rig_text, wait_until

API = "/api/v1"
#: a part of a service -> a word of its process' command line
_MODULES = {"web": "stereorig.server.cli.web", "rig": "stereorig.server.rig.process.host"}
DEATHS = [
    ("web", signal.SIGHUP),
    ("web", signal.SIGQUIT),
    ("web", signal.SIGSEGV),
    ("web", signal.SIGKILL),
    ("rig", signal.SIGKILL),
    ("front", signal.SIGKILL),
    ("front", signal.SIGHUP),
]


@contextlib.contextmanager
def serving(
    folder: Path,
    url: str,
    driver: str = "esp301",
    options: tuple[str, ...] = (),
    *,
    second: str | None = None,
    **environment: str,
) -> Iterator[tuple[subprocess.Popen[str], httpx.Client]]:
    """Serve a rig whose axes take 100 s from one end to the other; ``options`` go to the command.

    With the URL of a ``second`` controller each moves one axis.
    """
    text = rig_text(driver=f'"{driver}"', url=f'"{url}"', velocity_mm_s="0.05")
    if second is not None:
        lines = "".join(
            f'[[stage.controllers]]\nurl = "{one}"\naxes = [{axis}]\n' for axis, one in ((1, url), (2, second))
        )
        text = text.replace(f'url = "{url}"\n', "").replace("[target]\n", f"{lines}[target]\n")
    (folder / "rig.toml").write_text(text)
    command = ["-m", "stereorig.server.cli", "serve", "--config", str(folder / "rig.toml"), "--port", "0"]
    with (folder / "log").open("a") as log:
        process = subprocess.Popen(
            [sys.executable, *command, "--data", str(folder / "data"), "--record", str(folder / "wire.txt"), *options],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        )
    try:
        assert process.stdout is not None
        base = next((word for word in process.stdout.readline().split() if word.startswith("http://")), None)
        assert base is not None, (folder / "log").read_text()
        with httpx.Client(base_url=base, timeout=60.0, trust_env=False) as client:
            wait_until(lambda: client.get(f"{API}/rig").json()["connected"], 60.0)
            yield process, client
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def process_of(service: subprocess.Popen[str], part: str) -> psutil.Process:
    """Return the process of a part of a service: ``front``, ``rig`` or ``web``."""
    if part == "front":
        return psutil.Process(service.pid)
    deadline = Deadline(60.0)
    while deadline.left:
        for child in psutil.Process(service.pid).children():
            with contextlib.suppress(psutil.Error):
                if _MODULES[part] in child.cmdline():
                    return child
        time.sleep(0.05)
    raise RuntimeError(f"there is no {part} process")


def finished(client: httpx.Client, answer: httpx.Response) -> dict[str, Any]:
    """Wait for the end of a job."""
    assert answer.status_code == 202, answer.text
    url = f"{API}/jobs/{answer.json()['job']['id']}"
    deadline = Deadline(60.0)
    while (job := client.get(url).json())["state"] not in ("succeeded", "failed", "cancelled", "interrupted"):
        assert deadline.left
        time.sleep(0.01)
    found: dict[str, Any] = job
    return found


def start_long_move(client: httpx.Client, controller: Any, target_mm: float = 5.0) -> str:
    """Start a move, and return its job's id once the axis moves."""
    answer = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": target_mm}})
    assert answer.status_code == 202, answer.text
    wait_until(lambda: controller.axis(1).moving, 30.0)
    return str(answer.json()["job"]["id"])


def stop_after(controller: Any, action: Callable[[], object], patience_s: float) -> float:
    """Do something, and return the time until the controller has read a stop, s."""
    known, began = len(controller.received), time.monotonic()
    action()

    def stops() -> list[float]:
        return [entry.at_s for entry in controller.received[known:] if "ST" in entry.text]

    wait_until(stops, patience_s)
    return stops()[0] - began


def time_deaths(driver: str, victim: str, number: signal.Signals, deaths: int) -> list[float]:
    """Return the times from so many deaths in a move to the stop on the wire, ms."""
    times: list[float] = []
    while len(times) < deaths:
        controller = make_controller(driver, (1, 2), time_scale=1.0)
        with (
            tempfile.TemporaryDirectory() as folder,
            ControllerServer(controller) as server,
            serving(Path(folder), server.url, driver) as (process, client),
        ):
            # of one service as many deaths as it survives
            while len(times) < deaths and process.poll() is None:
                wait_until(lambda client=client: _is_connected(client), 60.0)
                assert finished(client, client.post(f"{API}/stage:home"))["state"] == "succeeded"
                start_long_move(client, controller)
                pid = process_of(process, victim).pid
                times.append(1e3 * stop_after(controller, lambda pid=pid: os.kill(pid, number), 10.0))
                if victim == "front":
                    process.wait(60.0)
    return times


def _is_connected(client: httpx.Client) -> bool:
    with contextlib.suppress(httpx.HTTPError, KeyError, ValueError):
        return bool(client.get(f"{API}/rig", timeout=5.0).json()["connected"])
    return False
