"""Runs the command line's ``measure`` on the files that a job names, in one warm process on a given number of cores.

``python -m tests.bench.speed.worker JOB.json``, the twin of ``bench_peer_pyvale.py``: images on disk to results on disk.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np


def measure(job: dict[str, Any], run: dict[str, Any], out: Path) -> None:
    """One call of ``stereorig measure`` for a run of the job."""
    from server.cli.main import main

    last = run["steps"] + 1
    arguments = [
        "measure",
        "--cam1",
        *job["files1"][:last],
        "--cam2",
        *job["files2"][:last],
        "--calibration",
        job["calibration"],
        "--roi",
        ",".join(map(str, run["region_px"])),
        "--subset",
        str(run["subset_px"]),
        "--step",
        str(job["spacing_px"]),
        "--out",
        str(out),
        "--strain",
        "off",
        *(text for name, value in run["options"].items() for text in (f"--{name}", str(value))),
    ]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main(arguments)
    if status != 0:
        raise RuntimeError(printed.getvalue())


def read_fields(out: Path, steps: int) -> dict[str, Any]:
    """Results (N, 3) and (steps, N, 3) as files hold them, in the calibration's system frame, which is camera 1's here."""
    from server.formats.results.reading import read_field

    fields = [read_field(out / f"step_{n:04d}.nc") for n in range(steps + 1)]
    first = fields[0]
    moved = []
    for field in fields[1:]:
        assert field.uvw_mm is not None
        moved.append(np.where(field.valid[..., None], field.uvw_mm, np.nan).reshape(-1, 3))
    return {
        "x": first.x_px.ravel(),
        "y": first.y_px.ravel(),
        "uvw": np.array(moved),
        "xyz": np.where(first.valid[..., None], first.xyz_mm, np.nan).reshape(-1, 3),
    }


def main() -> int:
    """Run the job."""
    job = json.loads(Path(sys.argv[1]).read_text())
    if hasattr(os, "sched_setaffinity"):  # before anything that counts cores is imported
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: job["threads"]])
    from server.formats.version import software_version

    print(json.dumps({"version": software_version()}), flush=True)
    for run in job["runs"]:
        out = Path(job["folder"]) / run["name"]
        wall, cpu = [], []
        for _ in range(run["repeats"]):
            shutil.rmtree(out, ignore_errors=True)
            start = time.perf_counter(), time.process_time()
            measure(job, run, out)
            wall.append(time.perf_counter() - start[0])
            cpu.append(time.process_time() - start[1])
        np.savez(out.with_suffix(".npz"), **read_fields(out, run["steps"]))
        print(json.dumps({"name": run["name"], "wall_s": wall, "cpu_s": cpu}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
