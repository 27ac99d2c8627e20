"""Measures docs/explanation/cluster.md: a long test in its default settings on one and two workers, and on 64 simulated ones.

Run from the repository's root::

    python -m tests.bench.cluster.bench [--steps N] [--spacing PX] [--simulated-only]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import tempfile
import time
from collections import defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from stereorig.server.compute.tasks import StepTask
from stereorig.server.worker.executor import TaskExecutor, TaskFuture
from stereorig.server.workflows.analysis.block import BlockStep
from stereorig.server.workflows.analysis.blocks import Blocks
from tests.bench.cluster.page import write_page
from tests.bench.cluster.scheduler import Overhead, Simulated, dask_overhead, simulate
from tests.support import sequence_bench as scenes
from tests.support.copied_tests import write_test_of
from tests.support.dask_bench import Cluster, Host, cluster_of
from tests.support.running_analyses import API, begin, contents, folder_of
from tests.support.service_rig import wait_for_job

URL = f"{API}/tests/t000001-abcdef"
REGION = [110, 100, 410, 380]
SIMULATED_WORKERS = (1, 2, 4, 8, 16, 32, 64, 128)
SIMULATED_STEPS = 2048
ASKED_WORKERS = 64
INSTANT_STEPS = 512
#: in one process; what Dask does per task hardly depends on their number, what it does per worker fills two cores at 64
SLEEPING_WORKERS = 16
#: a step's task and its summary as they travel; images and results go by the disk
TASK_BYTES = 20_000


@dataclass
class Run:
    """One analysis.

    Attributes
    ----------
    wall_s, service_s
        Wall time, and processor time of the service.
    busy_s
        Processor time of each worker.
    tasks
        Wall time of the measurements by kind, as the service saw them; a chain's are all ``step``.
    """

    workers: int
    wall_s: float
    service_s: float
    busy_s: list[float]
    tasks: dict[str, list[float]]
    steps: int
    points: int = 0

    @property
    def within(self) -> float:
        """How many times faster the run was than its own work without heads on one worker, by processor time."""
        all_s = sum(sum(found) for found in self.tasks.values())
        heads = sum(self.tasks.get("head", [])) / all_s if all_s > 0.0 else 0.0
        return sum(self.busy_s) * (1.0 - heads) / max(self.busy_s)


@dataclass
class Figures:
    """What the page shows."""

    steps: int
    load: tuple[float, float]
    runs: list[Run]
    worst_sigma: float | None
    status_changed: int | None
    bytes_a_task: int | None
    service_s: float
    overhead: Overhead
    simulated: list[Simulated]
    changed: list[Simulated] = field(default_factory=list)


class Watched:
    """Times between a plan's asks and their ends."""

    def __init__(self) -> None:
        self.tasks: dict[str, list[float]] = defaultdict(list)
        self._begun: dict[int, float] = {}
        self._ask, self._ended = Blocks.ask, Blocks.ended

    def __enter__(self) -> Watched:
        def ask(plan: Blocks) -> BlockStep | None:
            found = self._ask(plan)
            if found is not None:
                self._begun[id(found)] = time.monotonic()
            return found

        def ended(plan: Blocks, found: BlockStep, outcome: Any) -> None:
            self.tasks[found.kind].append(time.monotonic() - self._begun.pop(id(found)))
            self._ended(plan, found, outcome)

        Blocks.ask, Blocks.ended = ask, ended  # type: ignore[method-assign]
        return self

    def __exit__(self, *_: object) -> None:
        Blocks.ask, Blocks.ended = self._ask, self._ended  # type: ignore[method-assign]


def write_data(folder: Path, steps: int) -> None:
    """A plate that turns, moves and stretches; no reference is left."""
    images = (
        scenes.capture(
            scenes.plate(0.1 * n, np.array([0.01, -0.006, 0.004]) * n, np.diag([1 + 4e-4 * n, 1 - 2e-4 * n])), seed=n
        )
        for n in range(steps)
    )
    write_test_of(folder / "tests" / "t000001-abcdef", scenes.rig().pair, images)


def measured(data: Path, cluster: Cluster, spacing_px: int, steps: int) -> tuple[Run, list[dict[str, Any]]]:
    """Measure the test on the cluster; return what it took, and the results."""
    body = {"region": {"rectangle": REGION}, "subset_px": 33, "spacing_px": spacing_px}
    host = Host(data, f'[compute]\nscheduler = "{cluster.address}"')
    try:
        processes = [psutil.Process(worker.pid) for worker in cluster.workers]
        alone = {"start_from": "reference", "steps": [1, 2, 3, 4]}
        wait_for_job(host.client, begin(host.client, URL, **body, **alone)[1])  # all have loaded their kernels now
        with Watched() as watched:
            busy, own, began = [_busy_s(p) for p in processes], _own_s(), time.monotonic()
            url, job = begin(host.client, URL, **body)
            done = wait_for_end(host, job)
            wall_s, service_s = time.monotonic() - began, _own_s() - own
        if done["state"] != "succeeded":
            raise RuntimeError(str(done["problem"]))
        found = [contents(folder_of(host, url) / f"step_{n:04d}.nc") for n in range(steps)]
        used = [_busy_s(p) - b for p, b in zip(processes, busy, strict=True)]
        points = int((found[0]["status"] == 0).sum())
        return Run(len(processes), wall_s, service_s, used, dict(watched.tasks), steps - 1, points), found
    finally:
        host.close()


class Instant(TaskExecutor):
    """Workers that have done at once what they are asked, so that what is left is the service's own work."""

    width = ASKED_WORKERS

    def __init__(self, summary: dict[str, Any]) -> None:
        self._summary = summary
        self.tasks = 0

    def submit(self, _fn: Any, /, *args: Any, **_kwargs: Any) -> TaskFuture:
        """Answer with a summary of the step that was asked for."""
        task: StepTask = args[0]
        self.tasks += 1
        future = TaskFuture()
        future.set_result({**self._summary, "n": task.step.n, "step": task.step.n, "agrees": True})
        return future


def service_cost(data: Path, folder: Path, steps: int) -> float:
    """Return the service's processor time per task, s, with as many steps and workers that answer at once."""
    test = folder / "tests" / "t000001-abcdef"
    shutil.copytree(data / "tests" / "t000001-abcdef", test, ignore=shutil.ignore_patterns("analyses"))
    (test / "analyses").mkdir()
    there = len(list((test / "steps").iterdir()))
    for n in range(there, steps + 1):
        shutil.copytree(test / "steps" / f"{n % (there - 1) + 1:04d}", test / "steps" / f"{n:04d}")
        mark = test / "steps" / f"{n:04d}" / "step.json"
        mark.write_text(json.dumps({**json.loads(mark.read_text()), "n": n}))
    summaries = sorted((data / "tests").rglob("step_0001.json"))
    host = Host(folder, "")
    try:
        executor = Instant(json.loads(summaries[-1].read_text()))
        host.service.executor = executor
        own = _own_s()
        _, job = begin(host.client, URL, region={"rectangle": REGION}, subset_px=33, spacing_px=8)
        if wait_for_end(host, job)["state"] != "succeeded":
            raise RuntimeError("the service's own work could not be measured")
        return (_own_s() - own) / executor.tasks
    finally:
        host.close()


def wait_for_end(host: Host, job: dict[str, Any]) -> dict[str, Any]:
    """Wait for a job, asking seldom: who waits asks the service, whose time is measured."""
    while True:
        found: dict[str, Any] = host.client.get(f"{API}/jobs/{job['id']}").json()
        if found["state"] not in ("queued", "running"):
            return found
        time.sleep(2.0)


def _busy_s(process: psutil.Process) -> float:
    return float(sum(process.cpu_times()[:2]))


def _own_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def difference(one: list[dict[str, Any]], two: list[dict[str, Any]]) -> tuple[float, int]:
    """Return the largest difference of a displacement over its standard deviation, and the points with another status."""
    worst, changed = 0.0, 0
    for a, b in zip(one[1:], two[1:], strict=True):
        changed += int((a["status"] != b["status"]).sum())
        for name in "uvw":
            off = np.abs(a[f"{name}_mm"] - b[f"{name}_mm"]) / a[f"sigma_{name}_mm"]
            worst = max(worst, float(np.nanmax(off)))
    return worst, changed


def main() -> int:
    """Measure, simulate, write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=65, help="steps of the measured test, the reference among them")
    parser.add_argument("--spacing", type=int, default=4, help="distance of points, px")
    parser.add_argument("--dry", action="store_true", help="print the figures, write no page")
    args = parser.parse_args()
    before = os.getloadavg()[0]
    runs, results = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data(folder / "data", args.steps)
        size = sum(p.stat().st_size for p in (folder / "data").rglob("0001/*.tif"))
        for workers in (1, 2):
            own = folder / f"cluster{workers}"
            own.mkdir()
            with cluster_of(workers, own) as cluster:
                cluster.await_workers(workers)
                run, found = measured(folder / "data", cluster, args.spacing, args.steps)
            runs.append(run)
            results.append(found)
            print(json.dumps(asdict(run)), flush=True)
        service_s = service_cost(folder / "data", folder / "instant", INSTANT_STEPS)
        result = folder / "data" / "tests" / "t000001-abcdef" / "analyses"
        size += max(p.stat().st_size for p in result.rglob("step_0001.nc"))
    worst, changed = difference(*results)
    times = costs(runs)
    overhead = dask_overhead(SLEEPING_WORKERS, times["step"], TASK_BYTES)
    simulated = [simulate(SIMULATED_STEPS, w, times, service_s, overhead) for w in SIMULATED_WORKERS]
    changes = [simulate(SIMULATED_STEPS, ASKED_WORKERS, times, service_s, overhead, changes=count) for count in (1, 3)]
    load = (before, os.getloadavg()[0])
    figures = Figures(args.steps, load, runs, worst, changed, size, service_s, overhead, simulated, changes)
    print(json.dumps({**asdict(figures), "runs": len(runs)}), flush=True)
    if not args.dry:
        write_page(figures, times)
    return 0


def costs(runs: list[Run]) -> dict[str, float]:
    """Processor time of each kind of task on its worker, s: of a step from the chain, of a head in proportion to its wall time."""
    chain, blocks = runs
    step = sum(chain.busy_s) / chain.steps
    wall = {kind: float(np.median(found)) for kind, found in blocks.tasks.items()}
    # a joint is a step, from the step before it; few of them are measured, and load differs
    return {"step": step, "head": step * wall["head"] / wall["step"], "joint": step}


if __name__ == "__main__":
    raise SystemExit(main())
