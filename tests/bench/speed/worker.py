"""Runs the command line's ``measure`` on the files that a job names, in one warm process on a given number of cores.

``python -m tests.bench.speed.worker JOB.json``, the twin of the scripts in ``peers``: images on disk to results on disk.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.speed.peers.job import measure_runs, read_job


def measure(job: dict[str, Any], run: dict[str, Any], out: Path) -> None:
    """One call of ``stereorig measure`` for a run of the job."""
    from stereorig.server.cli.main import main

    last = run["steps"] + 1
    options = {"strain": "off", **run["options"]}  # peers make none
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
        *(text for name, value in options.items() for text in (f"--{name}", str(value))),
    ]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = main(arguments)
    if status != 0:
        raise RuntimeError(printed.getvalue())


def read_fields(out: Path, steps: int) -> dict[str, Any]:
    """Results (N, 3) and (steps, N, 3) as files hold them, in the calibration's system frame, which is camera 1's here."""
    from stereorig.server.formats.results.reading import read_field

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
    job = read_job()
    from stereorig.server.formats.version import software_version

    measure_runs(
        job,
        software_version(),
        lambda run, out: measure(job, run, out),
        lambda run, out: read_fields(out, run["steps"]),
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
