"""How long a stop takes from the request to the wire while everything else is busy.

The service runs in a process of its own, on the simulated cameras and a simulated ESP301 that stands in this process. Its
worker analyses load steps on every processor; two live views are open, three clients poll, and a job moves the axis. A stop is
timed from just before the HTTP request is written to the moment when the controller has read the command, by one clock.

    python -m tests.bench.reliability.stage_stop [--stops 200] [--idle]
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from stereorig.server.config.rig_file import parse_config
from stereorig.server.demo.process import running_service
from stereorig.server.formats.images import encode_tiff
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.support.requirements import ROOT

API = "/api/v1"
TEST_ID = "t000007-abcdef"
TIME = "2026-01-01T00:00:00Z"
STEPS = 40
REGION = {"rectangle": [25, 25, 130, 115]}
CAMERA = """
[cam{n}]
image_size_px = [160, 144]
phd_px = 3600.0
standoff_mm = 404.0
angle_deg = {angle}
aspect = 0.9617
stage_axis = {n}
exposure_ms = 10.0
gain_db = 0.0
[sim.cam{n}]
phd_px = 3560.0
cx_px = 80.4
cy_px = 71.8
kappa_per_px2 = 1.0e-8
aspect = 0.9617
alpha_rad = 0.78
beta_rad = 0.01
gamma_rad = {gamma}
x0_mm = 0.2
y0_mm = 0.1
z0_mm = 400.0
"""
RIG = """
[rig]
name = "stop bench"
kind = "simulated"
[stage]
driver = "esp301"
url = "{url}"
soft_limits_mm = [-6.0, 6.0]
velocity_mm_s = 0.4
acceleration_mm_s2 = 40.0
home_at_start = true
[target]
pitch_mm = 1.0
lines = [11, 11]
line_width_mm = 0.1
[calibration]
positions_mm = [0.0, 5.0]
[service]
compute_queue = 4
kernel_threads = {threads}
[sim]
seed = 7
speckle_mm = 0.4
[sim.noise]
read_noise_e = 280.0
full_well_e = 40000.0
"""


@dataclass(frozen=True)
class StopTimes:
    """Latencies in milliseconds, sorted, and what the machine did meanwhile."""

    latencies_ms: tuple[float, ...]
    busy_share: float
    analysed_steps: int

    def percentile(self, share: float) -> float:
        """Return the smallest latency that this share of the stops does not exceed."""
        return self.latencies_ms[max(int(np.ceil(share * len(self.latencies_ms))) - 1, 0)]

    def row(self) -> str:
        """Return a row of the table in docs/explanation/reliability.md."""
        p50, p99, longest = self.percentile(0.5), self.percentile(0.99), self.latencies_ms[-1]
        return f"| {len(self.latencies_ms)} | {self.busy_share:.0%} | {p50:.1f} | {p99:.1f} | {longest:.1f} |"


def rig_text(url: str) -> str:
    """Return the rig file."""
    cameras = "".join(
        CAMERA.format(n=n, angle=angle, gamma=gamma) for n, angle, gamma in ((1, -30.0, -0.52), (2, 30.0, 0.53))
    )
    return RIG.format(url=url, threads=os.cpu_count() or 1) + cameras


def write_test_folder(folder: Path, text: str) -> None:
    """Write load steps as another service would have left them, for the worker to chew on."""
    rig = SimRig.from_dict(parse_config(text).model_dump(exclude_none=True))
    world = SimWorld(rig, lambda _: 0.0)
    world.set_scene("plate", load=0.0)
    rng = np.random.default_rng(5)
    (folder / "analyses").mkdir(parents=True)
    pair = world.true_pair()
    calibration = {"cam1": pair.cam1.paper_parameters(), "cam2": pair.cam2.paper_parameters()}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    for n in range(STEPS):
        step = folder / "steps" / f"{n:04d}"
        step.mkdir(parents=True)
        sha256 = {}
        for cam in ("cam1", "cam2"):
            content = encode_tiff(world.expose(cam, exposure_ms=10.0, gain_db=0.0, rng=rng))
            (step / f"{cam}.tif").write_bytes(content)
            sha256[cam] = hashlib.sha256(content).hexdigest()
        document = {
            "n": n,
            "test_id": folder.name,
            "label": "",
            "load_n": None,
            "source": "import",
            "captured_utc": TIME,
            "skew_ms": None,
            "quality": {},
            "sha256": sha256,
        }
        (step / "step.json").write_text(json.dumps(document))
    document = {"id": folder.name, "name": "load", "specimen": "", "notes": "", "calibration_id": None}
    (folder / "test.json").write_text(json.dumps({**document, "created_utc": TIME}))


def set_priority(nice: int) -> None:
    """Set the niceness of this process, and of its session where it leads one; a right that not every user has."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
        if os.getsid(0) == os.getpid():
            Path("/proc/self/autogroup").write_text(str(nice), encoding="ascii")


def make_load(base: str) -> None:
    """Keep the service busy until this process is ended."""
    set_priority(0)
    client = httpx.Client(base_url=base, timeout=60.0, trust_env=False, limits=httpx.Limits(max_connections=20))

    def again(work: Any) -> None:
        while True:
            with contextlib.suppress(httpx.HTTPError):
                work()

    def watch(cam: str) -> None:
        with client.stream("GET", f"{API}/cameras/{cam}/stream.mjpg", params={"rate_hz": 10}) as view:
            for _ in view.iter_raw():
                pass

    def poll(path: str) -> None:
        client.get(f"{API}{path}")
        time.sleep(0.02)

    def analyse() -> None:
        body = {"region": REGION, "subset_px": 21, "spacing_px": 2}
        client.post(f"{API}/tests/{TEST_ID}/analyses", json=body)  # beyond the queue's length: 503
        time.sleep(0.5)

    works = [
        lambda: watch("cam1"),
        lambda: watch("cam2"),
        lambda: poll("/stage"),
        lambda: poll("/stage"),
        lambda: poll("/rig"),
        analyse,
    ]
    threads = [threading.Thread(target=again, args=(work,), daemon=True) for work in works]
    for thread in threads:
        thread.start()
    print("busy", flush=True)
    sys.stdin.read()  # until the parent goes


@contextlib.contextmanager
def loaded(base: str, data: Path) -> Iterator[None]:
    """Load the service until the block ends; begins when the worker correlates."""
    child = subprocess.Popen(
        [sys.executable, "-m", "tests.bench.reliability.stage_stop", "--load", base],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 240.0
        while analysed(data) < 2:
            if time.monotonic() > deadline:
                raise RuntimeError("the worker analysed nothing in four minutes")
            time.sleep(0.1)
        yield
    finally:
        child.kill()
        child.communicate()


def analysed(data: Path) -> int:
    """Count the steps that the worker has finished."""
    return len(list((data / "tests" / TEST_ID / "analyses").glob("*/step_*.nc")))


def busy_s() -> tuple[float, float]:
    """Return seconds that the processors worked, and all their seconds, since the machine was started."""
    fields = [float(value) for value in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return sum(fields) - fields[3] - fields[4], sum(fields)


def time_stops(client: httpx.Client, controller: SimESP301, stops: int) -> list[float]:
    """Stop so many moves, and return how many milliseconds each stop took to the wire."""
    dice = random.Random(26)
    latencies = []
    target = 5.0
    while len(latencies) < stops:
        target = -target
        answer = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": target}})
        if answer.status_code == 409:  # the load's own requests hold the hardware for moments
            time.sleep(0.005)
            continue
        job = answer.raise_for_status().json()["job"]
        deadline = time.monotonic() + 10.0
        while not controller.axis(1).moving:
            if time.monotonic() > deadline:
                raise RuntimeError(f"the move did not start: {client.get(API + '/jobs/' + job['id']).json()}")
            time.sleep(0.001)
        time.sleep(dice.uniform(0.0, 0.03))
        known = len(controller.received)
        asked = time.monotonic()
        client.post(f"{API}/stage:stop").raise_for_status()
        while not (arrived := [entry.at_s for entry in controller.received[known:] if entry.text == "ST"]):
            if time.monotonic() > asked + 5.0:
                raise RuntimeError("a stop never reached the wire")
            time.sleep(0.001)
        latencies.append((arrived[0] - asked) * 1e3)
        while client.get(f"{API}/jobs/{job['id']}").json()["state"] not in ("cancelled", "succeeded", "failed"):
            time.sleep(0.002)
    return latencies


@contextlib.contextmanager
def homed_bench(folder: Path, rig: Callable[[str], str]) -> Iterator[tuple[str, httpx.Client, SimESP301]]:
    """A service on ``rig`` (stage's address -> rig file) with load steps to chew on; its controller is simulated here."""
    controller = SimESP301(axes=2, travel_mm=(-11.0, 11.0))
    with ControllerServer(controller) as server:
        text = rig(server.url)
        (folder / "rig.toml").write_text(text)
        write_test_folder(folder / "data" / "tests" / TEST_ID, text)
        with (
            running_service(folder / "rig.toml", folder / "data", folder / "log.txt") as base,
            httpx.Client(base_url=base, timeout=60.0, trust_env=False) as client,
        ):
            deadline = time.monotonic() + 120.0
            while not all(axis["state"] == "ready" for axis in client.get(f"{API}/stage").json()["axes"]):
                if time.monotonic() > deadline:
                    raise RuntimeError("the stage was not homed in two minutes")
                time.sleep(0.05)
            yield base, client, controller


def measure(folder: Path, *, stops: int = 200, idle: bool = False) -> StopTimes:
    """Start a service under full load (or idle) and time stops."""
    with (
        homed_bench(folder, rig_text) as (base, client, controller),
        contextlib.nullcontext() if idle else loaded(base, folder / "data"),
    ):
        first = analysed(folder / "data")
        work, whole = busy_s()
        latencies = time_stops(client, controller, stops)
        work, whole = busy_s()[0] - work, busy_s()[1] - whole
        done = analysed(folder / "data") - first
    return StopTimes(tuple(sorted(latencies)), work / whole, done)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stops", type=int, default=200)
    parser.add_argument("--idle", action="store_true", help="without load, to compare")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--load", metavar="URL", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.load:
        make_load(args.load)
        return
    set_priority(-15)  # the controller in here is the instrument: its clock must not wait
    with tempfile.TemporaryDirectory() as folder:
        times = measure(Path(folder), stops=args.stops, idle=args.idle)
    if args.json is not None:
        args.json.write_text(json.dumps(asdict(times)))
    print("| stops | processors busy | p50 ms | p99 ms | max ms |\n| ---: | ---: | ---: | ---: | ---: |")
    print(times.row())
    print(f"{times.analysed_steps} load steps were analysed meanwhile")


if __name__ == "__main__":
    main()
