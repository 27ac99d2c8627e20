"""A tiny fast rig, and the service on it, for the service's tests."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import uvicorn

from stereorig.core.cameras.camera import ELEVEN_PARAMETER_NAMES
from stereorig.server.api.app import create_app
from stereorig.server.config.rig_file import RigConfig, parse_config
from stereorig.server.front.front import ConnectionLimits
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline
from tests.support.tiny_rig import TINY, tiny_rig

# half of the paper rig's pixels: lines of the grid one pixel wide, speckles of four
SMALL = (
    TINY.replace("[160, 144]", "[256, 240]")
    .replace("3600.0", "6100.0")
    .replace("phd_px = 3560.0", "phd_px = 6031.0")
    .replace("phd_px = 3530.0", "phd_px = 5969.0")
    .replace("cx_px = 80.4", "cx_px = 130.4")
    .replace("cx_px = 79.7", "cx_px = 124.7")
    .replace("cy_px = 71.8", "cy_px = 117.8")
    .replace("cy_px = 72.1", "cy_px = 122.1")
    .replace("line_width_mm = 0.1", "line_width_mm = 0.06")
    .replace("pitch_mm = 1.4", "pitch_mm = 1.0")
    .replace("lines = [8, 8]", "lines = [11, 11]")
    .replace("speckle_mm = 0.45", "speckle_mm = 0.26")
)


def tiny_config(**replacements: str) -> RigConfig:
    """Return the tiny rig's configuration, with lines replaced (``velocity_mm_s="velocity_mm_s = 1.0"``)."""
    return parse_config(tiny_rig(**replacements))


def true_cameras(text: str) -> dict[str, dict[str, float]]:
    """A simulated rig's own cameras as a calibration file, so that nothing need be calibrated."""
    world = tomllib.loads(text)["sim"]
    return {cam: {name: world[cam][name] for name in ELEVEN_PARAMETER_NAMES} for cam in ("cam1", "cam2")}


@contextlib.contextmanager
def served(service: Service, **app: Any) -> Iterator[httpx.Client]:
    """Serve on a free loopback port in a thread of this process; yields a client. ``app`` goes to `create_app`."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.bind(("127.0.0.1", 0))
    listener.listen()  # who comes before the server is up waits in the queue
    settings = uvicorn.Config(
        create_app(service, close_service=False, **app),
        log_level="error",
        timeout_keep_alive=ConnectionLimits().idle_s,
        timeout_graceful_shutdown=2,
    )
    server = uvicorn.Server(settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    try:
        with httpx.Client(base_url=url, timeout=60.0, trust_env=False) as client:
            yield client
    finally:
        service.stop_streams()
        server.should_exit = True
        thread.join(timeout=10.0)
        listener.close()


def wait_for_rig(client: httpx.Client, seconds: float = 60.0) -> None:
    """Wait until the stage is homed."""
    deadline = Deadline(seconds)
    while deadline.left:
        rig = client.get("/api/v1/rig").json()
        if rig["connected"] and all(axis["state"] == "ready" for axis in rig["stage"]["axes"]):
            return
        assert rig["fault"] is None or rig["fault"]["code"] == "not_connected", rig["fault"]
        time.sleep(0.02)
    raise AssertionError("the rig did not come up")


def wait_for_job(client: httpx.Client, job: dict[str, Any], seconds: float = 240.0) -> dict[str, Any]:
    """Poll a job until it has ended."""
    deadline = Deadline(seconds)
    while deadline.left:
        document: dict[str, Any] = client.get(f"/api/v1/jobs/{job['id']}").json()
        if document["state"] in ("succeeded", "failed", "cancelled", "interrupted"):
            return document
        time.sleep(0.02)
    raise AssertionError(f"job {job['id']} did not end: {document}")


def a_second(client: httpx.Client) -> float:
    """A second; more on a machine so busy that a plain answer takes long."""
    began = time.monotonic()
    for _ in range(3):
        client.get("/api/v1/healthz")
    return 1.0 + 10.0 * (time.monotonic() - began)


def new_test(client: httpx.Client, **body: Any) -> str:
    """Make a test without a calibration."""
    answer = client.post("/api/v1/tests", json={"name": "a test", **body})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def plate_test(client: httpx.Client) -> str:
    """Make a test with one step of the plate, unloaded, and the true calibration of the small rig."""
    sent = client.post("/api/v1/calibrations:import", files={"file": ("c.json", json.dumps(true_cameras(SMALL)))})
    test_id = new_test(client, name="plate", calibration_id=str(sent.json()["id"]))
    client.put("/api/v1/sim/scene", json={"scene": "plate", "load": 0.0}).raise_for_status()
    client.post(f"/api/v1/tests/{test_id}/steps", json={"label": "reference"}).raise_for_status()
    return test_id


def data_of(path: Path) -> Path:
    """Where a test's service keeps its data."""
    return path / "data"
