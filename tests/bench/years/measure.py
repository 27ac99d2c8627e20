"""Cost of a data folder over its size: the start, and what lists and documents take.

A service is a process of its own on a folder of so many steps; it is started after a kill, stopped, and started again.
Wall times are shown beside the processor time that the service used, which other work on the machine does not change.

    python -m tests.bench.years.measure [--sizes 10/1000 75/15000 1000/200000] [--page]

``--page`` writes figures and plot into docs/explanation/years.md.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import httpx
import psutil

from stereorig.server.workflows.service import Service
from tests.bench.years.folder import multiply
from tests.support.requirements import ROOT
from tests.support.service_rig import served, tiny_config, true_cameras, wait_for_rig
from tests.support.tiny_rig import TINY, tiny_rig

API = "/api/v1"
SIZES = ["10/1000", "75/15000", "1000/200000"]
ASKED = 100
REGION = {"rectangle": [60, 60, 100, 90]}


@dataclass
class Cost:
    """Cost of one size: seconds, milliseconds, bytes; by name of the request where there are several."""

    tests: int
    steps: int
    made_s: float = 0.0
    disk_mib: float = 0.0
    #: to the first answer, by kind of stop before: wall, processor time
    start_s: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: until everything was read behind the service after a kill: wall, processor time
    rebuilt_s: tuple[float, float] = (0.0, 0.0)
    stop_s: float = 0.0
    memory_mib: float = 0.0
    p50_ms: dict[str, float] = field(default_factory=dict)
    p99_ms: dict[str, float] = field(default_factory=dict)
    first_ms: dict[str, float] = field(default_factory=dict)
    cpu_ms: dict[str, float] = field(default_factory=dict)
    reply_bytes: dict[str, int] = field(default_factory=dict)
    load: float = 0.0


def make_first(data: Path) -> None:
    """Make a data folder with one real test of two steps and an analysis."""
    with Service(tiny_config(), data) as service, served(service) as client:
        wait_for_rig(client)
        file = json.dumps(true_cameras(TINY)).encode()
        sent = client.post(f"{API}/calibrations:import", files={"file": ("truth.json", file)})
        made = sent.raise_for_status().json()
        name = {"name": "one", "calibration_id": made["id"]}
        test = client.post(f"{API}/tests", json=name).raise_for_status().json()["id"]
        for n in range(2):
            client.put(f"{API}/sim/scene", json={"scene": "plate", "load": float(n)}).raise_for_status()
            client.post(f"{API}/tests/{test}/steps", json={"label": f"{n}"}).raise_for_status()
        body = {"region": REGION, "subset_px": 21, "spacing_px": 16}
        job = client.post(f"{API}/tests/{test}/analyses", json=body).raise_for_status().json()["job"]
        while job["state"] in ("queued", "running"):
            job = client.get(f"{API}/jobs/{job['id']}", params={"wait": 30}).json()
        if job["state"] != "succeeded":
            raise RuntimeError(job)


@contextlib.contextmanager
def running(folder: Path) -> Iterator[tuple[psutil.Process, httpx.Client, float]]:
    """Start a service on ``folder/data``; yields its process, a client, and the seconds to its first answer."""
    rig = folder / "rig.toml"
    rig.write_text(tiny_rig())
    began = time.monotonic()
    command = [
        sys.executable,
        "-m",
        "stereorig.server.cli",
        "serve",
        "--config",
        rig,
        "--data",
        folder / "data",
        "--port",
        "0",
    ]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if " on http" not in line:
            raise RuntimeError(f"the service did not start: {line!r}")
        url = line.split(" on ")[1].split(" ")[0]
        with httpx.Client(base_url=url, timeout=120.0, trust_env=False) as client:
            client.get("/healthz").raise_for_status()
            yield psutil.Process(process.pid), client, time.monotonic() - began
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def cpu_s(process: psutil.Process) -> float:
    """Return the processor time of the service alone, without its worker."""
    times = process.cpu_times()
    return float(times.user + times.system)


def ask_all(client: httpx.Client, process: psutil.Process, cost: Cost, longest: str) -> None:
    """Ask for every list and document a hundred times."""
    analysis = client.get(f"{API}/tests/{longest}").json()["analyses"][0]["id"]
    test = f"{API}/tests/{longest}"
    requests: dict[str, tuple[str, dict[str, Any]]] = {
        "list of tests, 100": (f"{API}/tests", {"limit": 100}),
        "a test": (test, {}),
        "its steps, 100": (f"{test}/steps", {"limit": 100}),
        "a step": (f"{test}/steps/1", {}),
        "its analyses": (f"{test}/analyses", {}),
        "an analysis": (f"{test}/analyses/{analysis}", {}),
        "its steps' figures, 20": (f"{test}/analyses/{analysis}/steps", {"limit": 20}),
        "list of jobs": (f"{API}/jobs", {}),
        "metrics": ("/metrics", {}),
        "health": ("/healthz", {}),
    }
    for name, (path, params) in requests.items():
        taken, before = [], 0.0
        for k in range(ASKED + 1):
            began = time.monotonic()
            answer = client.get(path, params=params)
            taken.append((time.monotonic() - began) * 1e3)
            answer.raise_for_status()
            if k == 0:
                before = cpu_s(process)
        cost.first_ms[name] = taken[0]
        ordered = sorted(taken[1:])
        cost.p50_ms[name], cost.p99_ms[name] = ordered[len(ordered) // 2], ordered[int(0.99 * len(ordered)) - 1]
        cost.cpu_ms[name] = (cpu_s(process) - before) / ASKED * 1e3
        cost.reply_bytes[name] = len(answer.content)


def measure(folder: Path, tests: int, steps: int) -> Cost:
    """Make a folder of that size and measure what it costs."""
    cost = Cost(tests, steps)
    make_first(folder / "data")
    began = time.monotonic()
    ids = multiply(folder / "data", tests, steps, longest=min(5000, steps // 2))
    cost.made_s = time.monotonic() - began
    for name in ("catalog.sqlite.clean",):
        (folder / "data" / name).unlink(missing_ok=True)
    with running(folder) as (process, client, wall):
        cost.start_s["after a kill"] = wall, cpu_s(process)
        began = time.monotonic()
        while client.get("/healthz").json().get("tests_to_read"):
            time.sleep(0.2)
        cost.rebuilt_s = time.monotonic() - began + wall, cpu_s(process)
        cost.stop_s = stop(process)
    with running(folder) as (process, client, wall):
        cost.start_s["after a clean stop"] = wall, cpu_s(process)
        cost.disk_mib = (folder / "data" / "catalog.sqlite").stat().st_size / 2**20
        ask_all(client, process, cost, ids[0])
        cost.memory_mib = process.memory_info().rss / 2**20
        cost.load = os.getloadavg()[0]
        stop(process)
    return cost


def stop(process: psutil.Process) -> float:
    """Stop a service; return how long that took."""
    began = time.monotonic()
    process.send_signal(signal.SIGTERM)
    process.wait(timeout=120.0)
    return time.monotonic() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=SIZES, metavar="TESTS/STEPS")
    parser.add_argument("--json", type=Path, help="write everything that was measured to this file")
    parser.add_argument("--page", action="store_true", help="write figures and plot into docs/explanation/years.md")
    args = parser.parse_args()
    costs = []
    for size in args.sizes:
        tests, steps = map(int, size.split("/"))
        with tempfile.TemporaryDirectory() as folder:
            costs.append(measure(Path(folder), tests, steps))
            print(json.dumps(asdict(costs[-1]), indent=1), flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(one) for one in costs], indent=1))
    if args.page:
        from tests.bench.years.page import write_page

        write_page(costs)


if __name__ == "__main__":
    main()
