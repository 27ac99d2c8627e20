"""Scheduling of a long test on many workers: the program's own plan, driven by the clock of a simulation or by Dask's."""

from __future__ import annotations

import heapq
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereorig.core.errors import SeedError
from stereorig.server.workflows.analysis.block import BlockStep
from stereorig.server.workflows.analysis.blocks import LONGEST, Blocks

_TASKS_A_WORKER = 6


@dataclass(frozen=True)
class Overhead:
    """What a task costs besides its work, measured on a Dask scheduler with workers whose tasks sleep.

    Attributes
    ----------
    latency_s
        From the end of a task's work to its result at the client, and from the client to its begin, together.
    serial_s
        Time of the scheduler and the client per task: the most tasks a second are its inverse.
    """

    workers: int
    tasks: int
    task_s: float
    bytes: int
    wall_s: float
    latency_s: float
    serial_s: float


@dataclass(frozen=True)
class Simulated:
    """A simulated run.

    Attributes
    ----------
    speedup
        Work of a chain over the wall time.
    besides
        Share of the workers' time that went to heads, joints and repeated steps; ``idle``: to nothing.
    coordinator
        Share of the wall time for which service and scheduler were busy.
    """

    workers: int
    steps: int
    changes: int
    speedup: float
    besides: float
    idle: float
    coordinator: float


def _sleep(seconds: float, content: bytes) -> bytes:
    time.sleep(seconds)
    return content[: len(content) // 2]


def dask_overhead(workers: int, task_s: float, size: int) -> Overhead:
    """Run tasks that sleep as long as a step takes and carry as many bytes, one after another on each of the workers."""
    import dask
    import distributed

    count = workers * _TASKS_A_WORKER
    # what each worker does for itself, many times a second, would be the work of as many machines
    dask.config.set(
        {
            "distributed.worker.profile.enabled": False,
            "distributed.admin.tick.interval": "10s",
            "distributed.admin.system-monitor.interval": "10s",
        }
    )
    cluster = distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=50
    )
    with cluster, distributed.Client(cluster) as client:  # type: ignore[no-untyped-call]
        content = bytes(size)
        client.gather(client.map(_sleep, [0.0] * workers, [content[:10]] * workers, pure=False))
        alone = []
        for _ in range(20):  # one at a time: latency
            began = time.perf_counter()
            client.submit(_sleep, 0.02, content, pure=False).result()
            alone.append(time.perf_counter() - began - 0.02)
        running, began, left = {}, time.perf_counter(), count
        serial = time.process_time()  # client and scheduler are in this process; tasks sleep
        done = distributed.as_completed()
        while left or running:
            while left and len(running) < workers:
                future = client.submit(_sleep, task_s, content, pure=False)
                running[future.key] = future
                done.add(future)
                left -= 1
            ended = next(done)
            ended.result()
            del running[ended.key]
        wall, serial = time.perf_counter() - began, time.process_time() - serial
    return Overhead(workers, count, task_s, size, wall, float(np.median(alone)), serial / count)


def simulate(
    steps: int, workers: int, times: dict[str, float], service_s: float, overhead: Overhead, *, changes: int = 0
) -> Simulated:
    """Let the plan of :class:`Blocks` run on simulated workers: one queue for service and scheduler, tasks beside.

    Parameters
    ----------
    times
        Of a ``step``, a ``head`` and a ``joint``, s.
    service_s
        Processor time of the service per step, s.
    changes
        Changes of the reference, evenly spread.
    """
    reach = steps // (changes + 1)
    chain = steps * (times["step"] + service_s)
    if workers == 1:
        return Simulated(1, steps, changes, 1.0, 0.0, 0.0, service_s / (times["step"] + service_s))
    order = list(range(1, steps + 1))
    plan = Blocks(order, previous=0, reference=0, first=0, width=workers)
    serial = service_s + overhead.serial_s
    now, free_at, busy, besides, coordinator = 0.0, 0.0, 0.0, 0.0, 0.0
    running: list[tuple[float, int, BlockStep]] = []
    files: dict[int, int] = {0: 0}
    count = 0
    while not plan.through:
        while len(running) < workers and (ask := plan.ask()) is not None:
            free_at = max(free_at, now) + serial
            coordinator += serial
            seconds = times["joint" if ask.kind in ("joint", "again") else ask.kind]
            busy += seconds
            besides += 0.0 if ask.kind == "step" else seconds
            count += 1
            heapq.heappush(running, (free_at + overhead.latency_s + seconds, count, ask))
        now, _, ask = heapq.heappop(running)
        plan.ended(ask, _outcome(ask, reach, files))
    return Simulated(
        workers, steps, changes, chain / now, besides / (workers * now), 1.0 - busy / (workers * now), coordinator / now
    )


def _outcome(ask: BlockStep, reach: int, files: dict[int, int]) -> Any:
    """A reference serves for ``reach`` steps."""
    if ask.kind == "head":
        assert ask.against is not None
        if ask.n - ask.against > reach:
            return SeedError("another reference")
        files.setdefault(ask.n, ask.against)
        return {"n": ask.n}
    assert ask.previous is not None
    reference = files[ask.previous]
    if ask.n - reference > reach:
        reference = ask.previous
    agrees = files.get(ask.n) == reference
    files[ask.n] = reference
    return {"n": ask.n, "reference_step": reference or None, "agrees": agrees}


def longest_block() -> int:
    """Steps of a block at most."""
    return LONGEST
