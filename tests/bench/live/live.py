"""Speed of a live measurement: latency from a frame in memory to its value on the socket, and the rate by points.

    python -m tests.bench.live.live --minutes 10 [--page]

Two simulated cameras of 512 x 480 px run free at 50 Hz; what they show was rendered beforehand and is played forth and
back. A client in a process of its own reads the values from the WebSocket; another takes a stored step a second.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np
import psutil

from stereorig.core.names import CAMERAS
from stereorig.server.http.supervisor import ServePlan, Supervisor
from stereorig.server.worker.death import resident_mib
from stereorig.sim.world import SimWorld
from tests.bench.live.page import write_page
from tests.bench.live.socket_client import ValueSocket
from tests.bench.speed.scene import Rig, capture, rig_of_size
from tests.support.requirements import ROOT
from tests.support.service_rig import new_test, wait_for_rig
from tests.support.tiny_rig import tiny_rig

SIZE = (512, 480)
RATE_HZ = 50.0
PICTURES = 12
MAIN_POINTS = 1024
#: points, and the spacing and width of the square that holds them
FIELDS = {100: (31, 279), 324: (18, 306), 1024: (10, 310), 2025: (7, 308), 5041: (5, 350)}
#: subset and interpolation of further runs at the main number of points; what a body leaves out is the default
FASTER: tuple[dict[str, Any], ...] = (
    {"interpolation": "cubic"},
    {"subset_px": 15},
    {"interpolation": "cubic", "subset_px": 15},
)
API = "/api/v1"
#: variable with the file that lets the cameras play
START = "STEREORIG_BENCH_START"
RIG = tiny_rig(
    image_size_px="image_size_px = [512, 480]",
    name='name = "live bench"\ntrigger = "free"\nframe_rate_hz = 50.0',
    # the cameras run free, each by a thread of its own, on a machine that computes besides
    max_skew_ms="max_skew_ms = 15.0",
    exposure_ms="exposure_ms = 5.0",
    kernel_threads="kernel_threads = 2",
)


@dataclass
class Run:
    """One run: arrival of each value and its latency, and what the service says of the frames."""

    points: int
    seconds: float
    latency_ms: list[float] = field(default_factory=list)
    account: dict[str, Any] = field(default_factory=dict)
    captures: int = 0
    memory_mib: list[tuple[float, float]] = field(default_factory=list)
    load: float = 0.0
    busy_ms: float = float("nan")
    """Processor time of the computation a measured pair."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Those that it ran with, the defaults included."""

    @property
    def rate_hz(self) -> float:
        """Values a second."""
        return len(self.latency_ms) / self.seconds

    def percentile(self, q: float) -> float:
        """Percentile of the latency, ms."""
        return float(np.percentile(self.latency_ms, q)) if self.latency_ms else float("nan")


class Playback:
    """Takes the place of what the simulated world shows: the reference at rest, later pictures when it plays.

    It is in the rig process (`tests.bench.live.rig_host`), and plays once a file is there.
    """

    def __init__(self, rig: Rig, start: Path) -> None:
        self.pictures = [capture(rig, 0.3 * k) for k in range(PICTURES + 1)]
        self._start, self._plays = start, False
        self._began = time.monotonic()

    def expose(self, _world: SimWorld, cam: str, **_: object) -> np.ndarray:
        """Return the picture of this moment."""
        k = 0
        self._plays = self._plays or self._start.exists()
        if self._plays:
            turn = int((time.monotonic() - self._began) * RATE_HZ) % (2 * PICTURES - 2)
            k = 1 + (turn if turn < PICTURES else 2 * PICTURES - 2 - turn)
        return np.asarray(self.pictures[k][CAMERAS.index(cam)])  # type: ignore[arg-type]


def gauges() -> dict[str, Any]:
    """Twelve gauges in the middle of the pictures."""
    ends = [{"name": f"e{k + 1}", "a_px": [150 + 25 * k, 160], "b_px": [160 + 25 * k, 320]} for k in range(8)]
    areas = [{"name": f"a{k + 1}", "rectangle": [150 + 50 * k, 190, 210 + 50 * k, 290]} for k in range(4)]
    return {"extensometers": ends, "areas": areas}


def read_values(port: int, path: str, out: Connection, seconds: float) -> None:
    """Read values from the WebSocket, in a process of its own; sends the latency of each, ms."""
    link = ValueSocket(port, path)
    until, found = time.monotonic() + seconds, []
    while (now := time.monotonic()) < until:
        message = link.message(until - now)
        if message is None:
            break
        if message["valid"]:
            found.append(1e3 * (time.monotonic() - message["arrived_s"]))
    out.send(found)


def serve(folder: Path) -> int:
    """Serve as ``stereorig serve`` does, on cameras that play."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    data, config = str(folder / "data"), str(folder / "rig.toml")
    log: dict[str, Any] = {"log_level": "warning", "log_format": "text"}
    web = {"config": config, "data": data, "record": None, "host": "127.0.0.1", **log}
    plan = ServePlan(Path(data), web, scheme="http", rig_module="tests.bench.live.rig_host", **log)
    return asyncio.run(Supervisor(plan, listener, announce=lambda *_: print(url, flush=True)).run())


@contextmanager
def serving() -> Iterator[tuple[httpx.Client, str]]:
    """A service whose cameras play, and a test with its reference."""
    rig = rig_of_size(SIZE)
    known = dict(zip(CAMERAS, (rig.pair.cam1, rig.pair.cam2), strict=True))
    cameras = {cam: camera.paper_parameters() for cam, camera in known.items()}
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "rig.toml").write_text(RIG)
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.bench.live.live", "--serve", name],
            cwd=ROOT,
            env={**os.environ, START: str(folder / "start")},
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert process.stdout is not None
            with httpx.Client(base_url=process.stdout.readline().strip(), timeout=60.0, trust_env=False) as client:
                wait_for_rig(client, 300.0)
                sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(cameras))})
                test_id = new_test(client, calibration_id=str(sent.raise_for_status().json()["id"]))
                client.post(f"{API}/tests/{test_id}/steps", json={"label": "reference"}).raise_for_status()
                (folder / "start").touch()
                yield client, test_id
        finally:
            process.terminate()
            process.wait(60.0)


def measure(
    client: httpx.Client, test_id: str, points: int, seconds: float, *, captures: bool = False, **settings: Any
) -> Run:
    """Measure live for some seconds; ``settings`` are entries of the request's body."""
    spacing, width = FIELDS[points]
    x, y = 256 - width // 2, 240 - width // 2
    body = {
        **gauges(),
        "region": {"rectangle": [x, y, x + width, y + width]},
        "spacing_px": spacing,
        "field": True,
        "silence_ms": 5000,
        **settings,
    }
    client.post(f"{API}/tests/{test_id}/live", json=body).raise_for_status()
    until = time.monotonic() + 180.0
    while (live := client.get(f"{API}/tests/{test_id}/live").json())["account"]["measured"] < 20:
        if live["state"] == "failed" or time.monotonic() > until:
            raise RuntimeError(f"it does not measure: {live['problem']}, {live['values']['reason']}")
        time.sleep(0.1)
    port = int(client.base_url.port or 0)
    web, worker = _web_process(), _live_worker()
    ours, theirs = multiprocessing.Pipe()
    context = multiprocessing.get_context("spawn")
    reader = context.Process(target=read_values, args=(port, f"{API}/tests/{test_id}/live/ws", theirs, seconds))
    reader.start()
    run = Run(points, seconds, settings=live["settings"])
    before, began = client.get(f"{API}/tests/{test_id}/live").json()["account"], time.monotonic()
    loads, busy_before = [], _busy_s(worker)
    while time.monotonic() < began + seconds + 0.5:
        if captures:
            run.captures += client.post(f"{API}/tests/{test_id}/steps", json={"label": "beside"}).status_code == 201
        held = [resident_mib(web) or 0.0, resident_mib(worker) or 0.0 if worker else 0.0]
        run.memory_mib.append((held[0], held[1]))
        loads.append(os.getloadavg()[0])
        time.sleep(max(0.0, 1.0 - (time.monotonic() - began) % 1.0))
    busy_s, after = _busy_s(worker) - busy_before, client.get(f"{API}/tests/{test_id}/live").json()["account"]
    run.load = float(np.mean(loads))
    run.latency_ms = ours.recv()
    reader.join()
    client.post(f"{API}/tests/{test_id}/live:stop").raise_for_status()
    names = ("frames", "measured", "followed", "step", "skipped", "refused")
    run.account = {name: after[name] - before[name] for name in names}
    run.busy_ms = 1e3 * busy_s / max(run.account["measured"], 1)
    return run


def _busy_s(worker: int | None) -> float:
    times = None if worker is None else psutil.Process(worker).cpu_times()
    return float("nan") if times is None else times.user + times.system


def _web_process() -> int:
    """Return the web process' id."""
    for one in psutil.Process().children(recursive=True):
        if "stereorig.server.cli.web" in one.cmdline():
            return int(one.pid)
    raise RuntimeError("there is no web process")


def _live_worker() -> int | None:
    """Process of the live measurement: of the web process', the busiest over its life."""

    def share(one: psutil.Process) -> float:
        times = one.cpu_times()
        return float((times.user + times.system) / max(time.time() - one.create_time(), 0.1))

    children = psutil.Process(_web_process()).children(recursive=True)
    return int(max(children, key=share).pid) if children else None


def main() -> int:
    """Run, print, and write the page where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="of the run at 1,024 points (default: 10)")
    parser.add_argument("--seconds", type=float, default=15.0, help="of each other number of points (default: 15)")
    parser.add_argument("--page", action="store_true", help="write docs/explanation/live_speed.md")
    parser.add_argument("--serve", type=Path, metavar="FOLDER", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve is not None:
        return serve(args.serve)
    runs, faster = [], []
    with serving() as (client, test_id):
        main_run = measure(client, test_id, MAIN_POINTS, 60.0 * args.minutes, captures=True)
        print("with a stored step a second:", _line(main_run), flush=True)
        for points in FIELDS:
            runs.append(measure(client, test_id, points, args.seconds))
            print(_line(runs[-1]), flush=True)
        for settings in FASTER:
            faster.append(measure(client, test_id, MAIN_POINTS, args.seconds, **settings))
            print(settings, _line(faster[-1]), flush=True)
    print(json.dumps({k: v for k, v in asdict(main_run).items() if k not in ("latency_ms", "memory_mib")}))
    if args.page:
        write_page(main_run, runs, faster)
    return 0


def _line(run: Run) -> str:
    figures = ", ".join(f"p{q:g} {run.percentile(q):.1f}" for q in (50.0, 99.0, 99.9))
    figures += f"; {run.busy_ms:.1f} ms of processor time a pair"
    return f"{run.points} points: {run.rate_hz:.1f} values/s; ms: {figures}; {run.account}; load {run.load:.1f}"


if __name__ == "__main__":
    raise SystemExit(main())
