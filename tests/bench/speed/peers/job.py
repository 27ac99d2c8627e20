"""What every measured program does with a job: its runs one after another, timed, and their fields beside the job.

Standard library and numpy alone: peers import it by its folder, in environments that have nothing of this project.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def read_job() -> dict[str, Any]:
    """Return the job that the command line names, on as many cores as it says: before anything that counts cores is imported."""
    job = json.loads(Path(sys.argv[1]).read_text())
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: job["threads"]])
    return dict(job)


def measure_runs(
    job: dict[str, Any],
    version: str,
    measure: Callable[[dict[str, Any], Path], None],
    read_fields: Callable[[dict[str, Any], Path], dict[str, Any]],
) -> None:
    """Print one JSON line with the version and one of timings a run; only ``measure`` is timed.

    Parameters
    ----------
    measure
        Measures a run's image files and writes its results into a new folder.
    read_fields
        Reads them back: points ``x``, ``y`` (N), positions ``xyz`` (N, 3) and displacements ``uvw`` (steps, N, 3) in camera
        1's frame, millimetres, NaN where there is no result.
    """
    import numpy as np

    print(json.dumps({"version": version}), flush=True)
    for run in job["runs"]:
        out = Path(job["folder"]) / run["name"]
        wall, cpu = [], []
        for _ in range(run["repeats"]):
            shutil.rmtree(out, ignore_errors=True)
            out.mkdir(parents=True)
            start = time.perf_counter(), sum(os.times()[:4])  # processes that it starts count too
            measure(run, out)
            wall.append(time.perf_counter() - start[0])
            cpu.append(sum(os.times()[:4]) - start[1])
        np.savez(out.with_suffix(".npz"), **read_fields(run, out))
        print(json.dumps({"name": run["name"], "wall_s": wall, "cpu_s": cpu}), flush=True)
