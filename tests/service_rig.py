"""A tiny fast rig, and the service on it, for the service's tests."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import uvicorn

from server.api.app import create_app
from server.config import RigConfig, parse_config
from server.service import Service

TINY = """
[rig]
name = "tiny rig"
kind = "simulated"
max_skew_ms = 1.0
[cam1]
image_size_px = [160, 144]
phd_px = 3600.0
standoff_mm = 404.0
angle_deg = -30.0
aspect = 0.9617
stage_axis = 1
exposure_ms = 10.0
gain_db = 0.0
[cam2]
image_size_px = [160, 144]
phd_px = 3600.0
standoff_mm = 404.0
angle_deg = 30.0
aspect = 0.9617
stage_axis = 2
exposure_ms = 10.0
gain_db = 0.0
[stage]
driver = "esp301"
url = "sim"
soft_limits_mm = [-6.0, 6.0]
velocity_mm_s = 5.0
backlash_mm = 0.05
settle_ms = 0
[target]
pitch_mm = 1.0
lines = [11, 11]
line_width_mm = 0.1
[calibration]
positions_mm = [0.0, 5.0]
held_out_mm = [2.0]
frames = 2
[service]
compute_queue = 2
kernel_threads = 1
[sim]
seed = 7
speckle_mm = 0.45
time_scale = 2.5
[sim.noise]
read_noise_e = 280.0
full_well_e = 40000.0
[sim.cam1]
phd_px = 3560.0
cx_px = 80.4
cy_px = 71.8
kappa_per_px2 = 1.0e-8
aspect = 0.9617
alpha_rad = 0.7741
beta_rad = 0.0131
gamma_rad = -0.5149
x0_mm = 0.22
y0_mm = 0.17
z0_mm = 399.3
[sim.cam2]
phd_px = 3530.0
cx_px = 79.7
cy_px = 72.1
kappa_per_px2 = 0.9e-8
aspect = 0.9617
alpha_rad = 0.7852
beta_rad = -0.0087
gamma_rad = 0.5306
x0_mm = -0.15
y0_mm = -0.24
z0_mm = 401.6
"""


def tiny_config(**replacements: str) -> RigConfig:
    """Return the tiny rig's configuration, with lines replaced (``velocity_mm_s="velocity_mm_s = 1.0"``)."""
    lines = TINY.splitlines()
    for name, line in replacements.items():
        lines = [line if old.split(" =")[0] == name else old for old in lines]
    return parse_config("\n".join(lines))


@contextlib.contextmanager
def served(service: Service) -> Iterator[httpx.Client]:
    """Serve on a free loopback port in a thread of this process; yields a client."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.bind(("127.0.0.1", 0))
    settings = uvicorn.Config(create_app(service, close_service=False), log_level="error", timeout_graceful_shutdown=2)
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
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        rig = client.get("/api/v1/rig").json()
        if rig["connected"] and all(axis["state"] == "ready" for axis in rig["stage"]["axes"]):
            return
        assert rig["fault"] is None or rig["fault"]["code"] == "not_connected", rig["fault"]
        time.sleep(0.02)
    raise AssertionError("the rig did not come up")


def wait_for_job(client: httpx.Client, job: dict[str, Any], seconds: float = 120.0) -> dict[str, Any]:
    """Poll a job until it has ended."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        document: dict[str, Any] = client.get(f"/api/v1/jobs/{job['id']}").json()
        if document["state"] in ("succeeded", "failed", "cancelled", "interrupted"):
            return document
        time.sleep(0.02)
    raise AssertionError(f"job {job['id']} did not end: {document}")


def new_test(client: httpx.Client, **body: Any) -> str:
    """Make a test without a calibration."""
    answer = client.post("/api/v1/tests", json={"name": "a test", **body})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def data_of(path: Path) -> Path:
    """Where a test's service keeps its data."""
    return path / "data"
