"""Ours and the peer on the same files with the same points, cameras and subsets, each in its own process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from core.cameras.lens import OpenCVLens
from tests.bench.speed.pairs import BenchScene, Errors, compare
from tests.support.requirements import ROOT

PEER_PYTHON = ROOT / ".venv-bench" / "bin" / "python"
MAX_S = 1800.0


@dataclass(frozen=True)
class Run:
    """One program, one setting, one number of steps.

    ``options`` go to the program as they are: options of ``stereorig measure``, or arguments of ``calculate_3d``.
    """

    name: str
    subset_px: int
    steps: int
    options: dict[str, Any] = field(default_factory=dict)
    repeats: int = 1


@dataclass(frozen=True)
class Outcome:
    """What a run took and what it is worth.

    Attributes
    ----------
    points
        Points in a field.
    wall_s, cpu_s
        Best of the repeats.
    errors
        None where a field had no result at all.
    """

    run: Run
    threads: int
    points: int
    wall_s: float
    cpu_s: float
    errors: Errors

    @property
    def rate(self) -> float:
        """Points of displacement fields per second; the reference's own work is in the time."""
        return self.points * self.run.steps / self.wall_s


def peer_python() -> Path | None:
    """Return the interpreter that has the peer, or None: ``STEREORIG_BENCH_PEER``, ``.venv-bench``, this one."""
    named = os.environ.get("STEREORIG_BENCH_PEER")
    for candidate in [Path(named)] if named else [PEER_PYTHON, Path(sys.executable)]:
        if candidate.exists():
            with tempfile.TemporaryDirectory() as elsewhere:  # it leaves a log file where it is imported
                command = [str(candidate), "-c", "import pyvale.dic"]
                probe = subprocess.run(command, capture_output=True, check=False, cwd=elsewhere)
            if probe.returncode == 0:
                return candidate
    return None


def run_ours(scene: BenchScene, runs: list[Run], threads: int, folder: Path) -> tuple[str, list[Outcome]]:
    """Measure with ``stereorig measure``, called in one process; returns version and outcomes."""
    command = [sys.executable, "-m", "tests.bench.speed.worker"]
    return _run(command, scene, runs, threads, folder / f"ours_{scene.request.name}_{threads}")


def run_peer(python: Path, scene: BenchScene, runs: list[Run], threads: int, folder: Path) -> tuple[str, list[Outcome]]:
    """Measure with the peer's interpreter; returns the peer's version and outcomes."""
    command = [str(python), str(Path(__file__).with_name("bench_peer_pyvale.py"))]
    return _run(command, scene, runs, threads, folder / f"peer_{scene.request.name}_{threads}")


def _run(
    command: list[str], scene: BenchScene, runs: list[Run], threads: int, folder: Path
) -> tuple[str, list[Outcome]]:
    folder.mkdir(parents=True, exist_ok=True)
    job = folder / "job.json"
    job.write_text(json.dumps(_job(scene, runs, threads, folder)))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(
        [*command, str(job)], capture_output=True, text=True, check=False, env=environment, timeout=MAX_S, cwd=folder
    )
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    # programs may print lines of their own
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    version = str(lines[0]["version"])
    took = {line["name"]: line for line in lines[1:]}
    return version, [_outcome(scene, run, threads, folder, took[run.name]) for run in runs]


def _job(scene: BenchScene, runs: list[Run], threads: int, folder: Path) -> dict[str, Any]:
    cams = {}
    for name, camera in (("cam1", scene.pair.cam1), ("cam2", scene.pair.cam2)):
        lens = camera.lens
        assert isinstance(lens, OpenCVLens)
        cams[name] = {
            "fx": lens.fx_px,
            "fy": lens.fy_px,
            "skew": lens.skew_px,
            "cx": lens.cx_px,
            "cy": lens.cy_px,
            "distortion": [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3],
        }
    pose = scene.pair.cam2_from_cam1
    return {
        **cams,
        "rotation": pose.rotation.tolist(),
        "translation_mm": pose.translation_mm.tolist(),
        "calibration": str(scene.calibration),
        "threads": threads,
        "folder": str(folder),
        "files1": [str(p) for p in scene.cam1],
        "files2": [str(p) for p in scene.cam2],
        "size_px": scene.request.size_px,
        "spacing_px": scene.request.spacing_px,
        "runs": [
            {
                "name": r.name,
                "subset_px": r.subset_px,
                "steps": r.steps,
                "options": r.options,
                "repeats": r.repeats,
                "region_px": scene.request.region(r.subset_px),
            }
            for r in runs
        ],
    }


def _outcome(scene: BenchScene, run: Run, threads: int, folder: Path, took: dict[str, Any]) -> Outcome:
    with np.load(folder / f"{run.name}.npz") as fields:
        wanted = scene.request.points(run.subset_px)
        if not np.array_equal(np.stack([fields["x"], fields["y"]], axis=1), wanted):
            raise RuntimeError(f"{run.name} did not measure the points that it was asked for.")
        errors = compare(scene, run.subset_px, fields["xyz"], fields["uvw"])
    return Outcome(run, threads, len(wanted), min(took["wall_s"]), min(took["cpu_s"]), errors)
