"""Measures docs/how_to/scale_on_dask.md: one analysis by the service's own worker, and by Dask clusters of 1, 2 and 4 workers here.

Run from the repository's root, on a machine that does nothing else::

    python -m tests.bench.speed.scaling
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import netCDF4
import numpy as np
import psutil

from stereorig.server.config.rig_file import load_config
from stereorig.server.demo.process import running_service
from stereorig.server.formats.images import encode_tiff
from stereorig.sim.rig import SimRig
from stereorig.sim.world import SimWorld
from tests.bench.documents.prose import wrapped
from tests.support.requirements import ROOT

PAGE = ROOT / "docs" / "how_to" / "scale_on_dask.md"
RIG = ROOT / "config" / "sim_paper.toml"
STEPS = 17  # the reference and sixteen more
TEST = "t000001-abcdef"
BODY = {
    "region": {"rectangle": [60, 60, 450, 420]},
    "subset_px": 33,
    "spacing_px": 5,
    "patch": "affine",
    "start_from": "reference",
}
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def write_test(folder: Path, steps: int = STEPS) -> None:
    """Write a plate under growing pressure as a folder of a test: images, checksums, calibration."""
    rig = SimRig.from_dict(load_config(RIG).model_dump(exclude_none=True))
    world, rng = SimWorld(rig, lambda _: 0.0), np.random.default_rng(5)
    (folder / "analyses").mkdir(parents=True)
    pair = world.true_pair()
    calibration = {"cam1": pair.cam1.paper_parameters(), "cam2": pair.cam2.paper_parameters()}
    (folder / "calibration.json").write_text(json.dumps(calibration))
    now = datetime.now(UTC).isoformat()
    for n in range(steps):
        world.set_scene("plate", load=40.0 * n)
        step = folder / "steps" / f"{n:04d}"
        step.mkdir(parents=True)
        sha256 = {}
        for cam in ("cam1", "cam2"):
            content = encode_tiff(world.expose(cam, exposure_ms=10.0, gain_db=0.0, rng=rng))
            (step / f"{cam}.tif").write_bytes(content)
            sha256[cam] = hashlib.sha256(content).hexdigest()
        metadata = {
            "label": "",
            "load_n": None,
            "source": "import",
            "captured_utc": now,
            "skew_ms": None,
            "quality": {},
        }
        (step / "step.json").write_text(json.dumps({"n": n, "test_id": TEST, **metadata, "sha256": sha256}))
    document = {"id": TEST, "name": "scaling", "specimen": "", "notes": "", "calibration_id": None, "created_utc": now}
    (folder / "test.json").write_text(json.dumps(document))


@dataclass
class Cluster:
    """A scheduler and workers of one thread each."""

    address: str
    workers: list[subprocess.Popen[bytes]]

    def kill_one(self) -> None:
        """End a worker as the kernel would."""
        victim = self.workers.pop()
        victim.send_signal(signal.SIGKILL)
        victim.wait()

    def cpu_s(self) -> float:
        """Processor time of the workers so far."""
        return sum(sum(psutil.Process(w.pid).cpu_times()[:2]) for w in self.workers)


@contextlib.contextmanager
def cluster(folder: Path, count: int) -> Iterator[Cluster]:
    """Run one until the block ends."""
    file, log = folder / "scheduler.json", (folder / "cluster.log").open("ab")
    file.unlink(missing_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def start(module: str, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{module}", "--no-dashboard", "--host", "127.0.0.1"]
        return subprocess.Popen([*command, *arguments], cwd=folder, stdout=log, stderr=log, env=environment)

    scheduler = start("dask_scheduler", "--port", "0", "--scheduler-file", str(file))
    workers: list[subprocess.Popen[bytes]] = []
    try:
        while not file.exists():
            time.sleep(0.05)
        workers += [
            start("dask_worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny") for _ in range(count)
        ]
        yield Cluster(json.loads(file.read_text())["address"], workers)
    finally:
        for process in [*workers, scheduler]:
            process.kill()
            process.wait()
        log.close()


def analyse(client: httpx.Client, steps: list[int], at: int | None = None, then: Any = None) -> tuple[str, float]:
    """Run an analysis; return its id and the seconds of its job. ``then`` is called once ``at`` steps are finished."""
    accepted = client.post(f"/tests/{TEST}/analyses", json={**BODY, "steps": steps}).raise_for_status().json()
    job_url, url = f"/jobs/{accepted['job']['id']}", f"/tests/{TEST}/analyses/{accepted['analysis_id']}"
    while (job := client.get(job_url).json())["state"] in ("queued", "running"):
        if then is not None and len(client.get(url).json()["steps_finished"]) >= (at or 0):
            then()
            then = None
        time.sleep(0.1)
    if job["state"] != "succeeded":
        raise SystemExit(f"the analysis {job['state']}: {job['problem']}")
    began, ended = (datetime.fromisoformat(job[name]) for name in ("started_utc", "finished_utc"))
    return accepted["analysis_id"], (ended - began).total_seconds()


@dataclass
class Run:
    """One row."""

    name: str
    wall_s: float
    cpu_s: float | None
    difference: float


def max_difference(data: Path, one: str, two: str) -> float:
    """Largest difference of two analyses' double-precision numbers over the largest of each variable."""
    worst = 0.0
    for n in range(STEPS):
        files = [data / "tests" / TEST / "analyses" / a / f"step_{n:04d}.nc" for a in (one, two)]
        with netCDF4.Dataset(files[0]) as a, netCDF4.Dataset(files[1]) as b:
            for name, variable in a.variables.items():
                if variable.dtype == np.float64:
                    x, y = (np.ma.filled(d.variables[name][...], np.nan) for d in (a, b))
                    if not np.array_equal(np.isnan(x), np.isnan(y)):
                        return float("inf")
                    scale = np.nanmax(np.abs(x), initial=1e-300)
                    worst = max(worst, float(np.nanmax(np.abs(x - y), initial=0.0) / scale))
    return worst


def measure(folder: Path) -> tuple[list[Run], int]:
    """Measure every row; also return the points of a step."""
    data, runs = folder / "data", []
    write_test(data / "tests" / TEST)
    every = list(range(1, STEPS))
    base = RIG.read_text(encoding="utf-8") + "\n[service]\nkernel_threads = 1\nfree_reserve_mib = 0\n"
    plain, points = "", 0

    def one(name: str, running: Cluster | None = None, images: str = "path", **more: Any) -> None:
        nonlocal plain, points
        compute = "" if running is None else f'[compute]\nscheduler = "{running.address}"\nimages = "{images}"\n'
        rig = folder / "rig.toml"
        rig.write_text(base + compute, encoding="utf-8")
        with running_service(rig, data, folder / "service.log") as url:
            client = httpx.Client(base_url=f"{url}/api/v1", timeout=60.0, trust_env=False)
            # every process has its kernels loaded and warm before it is timed
            analyse(client, every[: 1 if running is None else len(running.workers)])
            before = None if running is None else running.cpu_s()
            analysis, wall_s = analyse(client, every, **more)
            cpu_s = None if before is None or running is None or more else running.cpu_s() - before
            if not plain:
                plain = analysis
                points = client.get(f"/tests/{TEST}/analyses/{plain}").json()["summary"]["steps"][0]["points"]
        runs.append(Run(name, wall_s, cpu_s, max_difference(data, plain, analysis)))
        print(runs[-1], flush=True)

    one("the service's own worker, 1 thread")
    for count in (1, 2, 4):
        with cluster(folder, count) as running:
            one(f"cluster, {count} worker{'s' * (count > 1)}", running)
    with cluster(folder, 2) as running:
        one("cluster, 2 workers, images sent", running, "scatter")
    with cluster(folder, 2) as running:
        one("cluster, 2 workers, one killed on the way", running, at=4, then=running.kill_one)
    return runs, points


def table(runs: list[Run], points: int, load: float) -> str:
    """Return the measured part of the page."""
    own = runs[0].wall_s
    cores = len(os.sched_getaffinity(0))
    lines = [
        f"Measured on {datetime.now(UTC):%Y-%m-%d}: {cores} cores, Linux {platform.machine()}, Python "
        f"{platform.python_version()}. {STEPS - 1} load steps and their reference, {points:,} points each, 33 px, quintic. "
        f"Other processes kept {load:.1f} of the {cores} cores' queue busy before it began (load average).",
        "",
        "| who computes | wall, s | steps/s | over the own worker | processor time of the workers, s | largest difference |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for run in runs:
        cpu = "" if run.cpu_s is None else f"{run.cpu_s:.1f}"
        lines.append(
            f"| {run.name} | {run.wall_s:.1f} | {STEPS / run.wall_s:.2f} | {own / run.wall_s:.2f} | {cpu} | "
            f"{run.difference:.1e} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure, and put the table into the page."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        runs, points = measure(Path(folder))
    text = PAGE.read_text(encoding="utf-8")
    head, _, rest = text.partition(BEGIN)
    tail = rest.partition(END)[2]
    PAGE.write_text(f"{head}{BEGIN}\n{wrapped(table(runs, points, load))}\n{END}{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
