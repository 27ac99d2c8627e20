"""The first use on a machine: from `pip install` of the wheel to the demo's first measured field, with no kernel compiled.

Called by ``tests.bench.documents.install_size``; minutes. The packages come from the index and cache that pip is set to.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from tests.support.requirements import ROOT

_SOURCES = ("core", "drivers", "server", "sim", "stereorig", "config", "pyproject.toml", "README.md", "LICENSE")
_RUNS = 3


@dataclass(frozen=True)
class FirstUse:
    """Seconds since the demo's start, and processor time of all its processes."""

    calibrated_s: float
    shape_s: float
    field_s: float
    whole_s: float
    cpu_s: float


def section() -> list[str]:
    """Measure, and return the page's lines: medians of some runs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.monotonic()
        python = _install(folder)
        install_s = time.monotonic() - began
        cold, warm = [], []
        for run in range(_RUNS):
            kernels = folder / f"kernels{run}"
            cold.append(_demo(python, folder / f"cold{run}", kernels))
            warm.append(_demo(python, folder / f"warm{run}", kernels))
    rows = [
        f"| {text} | {_median(cold, which):.1f} | {_median(warm, which):.1f} |"
        for text, which in (
            ("calibrated (18 views, fitted and held out)", "calibrated_s"),
            ("shape of the plate, 1,225 points", "shape_s"),
            ("first displacement field", "field_s"),
            ("the whole demo, eleven steps, pictures", "whole_s"),
            ("processor time of all processes", "cpu_s"),
        )
    ]
    processors = len(os.sched_getaffinity(0))
    return [
        "## First use",
        "",
        f"On {processors} processors, a fresh environment and the wheel from pip's own index and cache: installed in {install_s:.0f} s. Then",
        f"`stereorig demo`, medians of {_RUNS} runs, seconds from its start, with no kernel compiled and with all of them on disk:",
        "",
        "| until | nothing compiled | on disk |",
        "| --- | --- | --- |",
        *rows,
        "",
        "A service has kernels compiled in processes beside its worker: those that find a grid first, while the stages move, a shape's before a",
        "displacement's. A calibration waits for the first, each step for those that it needs, and says so. Compiled kernels hold for one Python, one numba and one",
        "kind of processor, so the wheel brings none ([why](decisions/0035-kernels-compiled-locally.md)); the container image has them.",
        "",
    ]


def _median(runs: list[FirstUse], which: str) -> float:
    return sorted(getattr(run, which) for run in runs)[len(runs) // 2]


def _install(folder: Path) -> Path:
    """Build the wheel of a copy of the sources, and install it; pip compiles every module, as it does for a user."""
    copy = folder / "sources"
    copy.mkdir()
    files = subprocess.run(["git", "ls-files", "-z", *_SOURCES], cwd=ROOT, capture_output=True, check=True).stdout
    subprocess.run(
        ["xargs", "-0", "cp", "--parents", "--no-dereference", "-t", str(copy)], cwd=ROOT, input=files, check=True
    )
    pip = ["-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([sys.executable, *pip, "wheel", "--no-deps", "-w", str(folder), str(copy)], check=True)
    subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
    python = folder / "venv" / "bin" / "python"
    subprocess.run([str(python), *pip, "install", str(next(folder.glob("*.whl")))], check=True)
    return python


def _demo(python: Path, out: Path, kernels: Path) -> FirstUse:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(kernels)}
    environment.pop("PYTHONPATH", None)
    before, started, began = os.times(), time.time(), time.monotonic()
    calibrated = None
    command = [str(python.with_name("stereorig")), "demo", "--out", str(out)]
    with subprocess.Popen(
        command, cwd=out.parent, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if calibrated is None and re.match(r"\s*fitted ", line):
                calibrated = time.monotonic() - began
    if process.returncode or calibrated is None:
        raise RuntimeError(f"the demo ended with {process.returncode}")
    whole, after = time.monotonic() - began, os.times()
    shape, field = (next(out.rglob(f"analyses/*/step_000{n}.nc")).stat().st_mtime - started for n in (0, 1))
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return FirstUse(calibrated, shape, field, whole, cpu)
