"""Ours and peers on the same files with the same cameras and subsets, each in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.lens import OpenCVLens
from tests.bench.speed.pairs import BenchScene, Errors, compare
from tests.bench.speed.peers.programs import Peer
from tests.support.requirements import ROOT

MAX_S = 1800.0


@dataclass(frozen=True)
class Run:
    """One program, one setting, one number of steps.

    ``options`` go to the program as they are: options of ``stereorig measure``, arguments of pyvale's ``calculate_3d``, keys of
    al-dic-3d's table ``matching``.
    """

    name: str
    subset_px: int
    steps: int
    options: dict[str, Any] = field(default_factory=dict)
    repeats: int = 1

    @property
    def kind(self) -> str:
        """The reference and one step, or several."""
        return "single" if self.steps == 1 else "sequence"

    @property
    def setting(self) -> str:
        """Name of the setting alone."""
        return self.name.split(" ", 1)[0]


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


@dataclass
class Beside:
    """What a peer took and what it is worth: outcomes by scene, and where it failed."""

    peer: Peer
    version: str = ""
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)


def run_ours(scene: BenchScene, runs: list[Run], threads: int, folder: Path) -> tuple[str, list[Outcome]]:
    """Measure with ``stereorig measure``, called in one process; returns version and outcomes."""
    command = [sys.executable, "-m", "tests.bench.speed.worker"]
    return _run(command, scene, runs, threads, folder / f"ours_{scene.request.name}_{threads}")


def run_peer(
    peer: Peer, python: Path, scene: BenchScene, runs: list[Run], threads: int, folder: Path
) -> tuple[str, list[Outcome]]:
    """Measure with the peer's interpreter; returns the peer's version and outcomes."""
    command = [str(python), str(Path(__file__).parent / peer.script)]
    place = folder / f"{peer.name}_{scene.request.name}_{threads}"
    return _run(command, scene, runs, threads, place, peer.spacing_px)


def _run(
    command: list[str], scene: BenchScene, runs: list[Run], threads: int, folder: Path, spacing_px: int | None = None
) -> tuple[str, list[Outcome]]:
    folder.mkdir(parents=True, exist_ok=True)
    job = folder / "job.json"
    job.write_text(json.dumps(_job(scene, runs, threads, folder) | ({"spacing_px": spacing_px} if spacing_px else {})))
    # small matrices: the threads of a linear algebra library would only wait for one another
    limits = {"OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **limits}
    done = subprocess.run(
        [*command, str(job)], capture_output=True, text=True, check=False, env=environment, timeout=MAX_S, cwd=folder
    )
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    # programs may print lines of their own
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    version = str(lines[0]["version"])
    took = {line["name"]: line for line in lines[1:]}
    return version, [_outcome(scene, run, threads, folder, took[run.name], spacing_px) for run in runs]


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


def _outcome(
    scene: BenchScene, run: Run, threads: int, folder: Path, took: dict[str, Any], spacing_px: int | None
) -> Outcome:
    with np.load(folder / f"{run.name}.npz") as fields:
        points = np.stack([fields["x"], fields["y"]], axis=1).astype(np.float64)
        if not _as_asked(scene, run, points, spacing_px):
            raise RuntimeError(f"{run.name} did not measure the points that it was asked for.")
        errors = compare(scene, points, fields["xyz"], fields["uvw"])
    return Outcome(run, threads, len(points), min(took["wall_s"]), min(took["cpu_s"]), errors)


def _as_asked(scene: BenchScene, run: Run, points: Float, spacing_px: int | None) -> bool:
    """Whether these are the scene's points, or nodes of a program's own that fill the same region at its own distance."""
    if spacing_px is None:
        return np.array_equal(points, scene.request.points(run.subset_px))
    x0, y0, x1, y1 = scene.request.region(run.subset_px)
    nodes = (1 + (x1 - x0) // spacing_px) * (1 + (y1 - y0) // spacing_px)
    inside = (points >= (x0, y0)).all() and (points <= (x1, y1)).all()
    return bool(inside) and len(np.unique(points, axis=0)) == len(points) == nodes
