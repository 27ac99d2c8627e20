"""Runs OpenCorr on the files that a job names, by ``opencorr_bench.cpp``, which was built from OpenCorr's sources.

``python run_opencorr.py JOB.json``; imports nothing of this project but ``job.py``. Each call is a process of its own, from image
files to files of positions.
"""

from __future__ import annotations

import os
import subprocess

import numpy as np
from job import measure_runs, read_job

JOB = read_job()
PROGRAM = os.environ["STEREORIG_BENCH_OPENCORR"]


def rotation_vector(R):
    """Axis times angle, as OpenCorr has rotations (of less than half a turn)."""
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2.0
    sine = np.linalg.norm(axis)
    return axis * (np.arctan2(sine, (np.trace(R) - 1.0) / 2.0) / sine) if sine > 0.0 else axis


def grid(run):
    """Columns and rows of the points."""
    x0, y0, x1, y1 = run["region_px"]
    step = JOB["spacing_px"]
    return np.arange(x0, x1 + 1, step), np.arange(y0, y1 + 1, step)


def camera_text(camera, translation_mm, R):
    K = [camera[name] for name in ("fx", "fy", "skew", "cx", "cy")]
    pose = [*translation_mm, *rotation_vector(np.array(R))]
    return " ".join(repr(float(v)) for v in (*K, *camera["distortion"], *pose))


def measure(run, out):
    columns, rows = grid(run)
    steps = run["steps"]
    job = out / "job.txt"
    head = (
        JOB["threads"],
        run["subset_px"] // 2,
        columns[0],
        rows[0],
        JOB["spacing_px"],
        len(columns),
        len(rows),
        steps,
    )
    pairs = zip(JOB["files1"][: steps + 1], JOB["files2"][: steps + 1], strict=True)
    lines = [os.curdir, " ".join(map(str, head)), *(f"{one} {two}" for one, two in pairs)]
    lines.append(camera_text(JOB["cam1"], (0.0, 0.0, 0.0), np.eye(3)))
    lines.append(camera_text(JOB["cam2"], JOB["translation_mm"], JOB["rotation"]))
    job.write_text("\n".join(lines) + "\n")
    done = subprocess.run([PROGRAM, str(job)], cwd=out, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{PROGRAM} ended with {done.returncode}: {done.stderr[-2000:]}")


def read_fields(run, out):
    """Positions of each step; its world is camera 1."""
    x, y = (v.ravel() for v in np.meshgrid(*grid(run)))
    found = [np.fromfile(out / f"step_{n}.bin", np.float32).reshape(-1, 3) for n in range(run["steps"] + 1)]
    xyz = np.array(found, dtype=np.float64)
    return {"x": x, "y": y, "xyz": xyz[0], "uvw": xyz[1:] - xyz[0]}


if __name__ == "__main__":
    measure_runs(JOB, "from its sources, which name no version", measure, read_fields)
