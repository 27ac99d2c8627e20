"""The process that compiles ahead: what it leaves on disk is what a measurement then takes, and no process."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from server.compute.background_compilation import BackgroundCompilation

WOULD_COMPILE = """
import sys
import numpy as np
from core.compiling import report_compiling
from core.matching.fit import fit_motion
from core.matching.options import MatchOptions
from tests.support.matching_scene import paper_pair

compiled = []
picture = np.random.default_rng(2).integers(0, 255, (80, 90)).astype(np.uint8)
with report_compiling(lambda: compiled.append(True)):
    fit_motion(paper_pair(), *[picture] * 4, [[40.0, 40.0]], [[0.002, 0.0, 0.0]], None, MatchOptions(subset_px=15))
print(len(compiled))
"""


@pytest.fixture(autouse=True)
def two_processors(monkeypatch):
    monkeypatch.setattr("core.threads.available_threads", lambda: 2)


@pytest.mark.deep
def test_what_it_compiled_nobody_compiles_again(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    with BackgroundCompilation("auto") as compilation:
        compilation.start()
        compilation.wait()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run([sys.executable, "-c", WOULD_COMPILE], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["0"]


def test_after_the_wait_nothing_is_started(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(a))
    with BackgroundCompilation("auto") as compilation:
        compilation.wait()
        compilation.start()
    assert not started


def test_leaving_early_ends_the_process(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    before = time.monotonic()
    with BackgroundCompilation("quadratic") as compilation:
        compilation.start()
        process = compilation._process
    assert process is not None
    assert process.poll() is not None
    assert time.monotonic() - before < 10.0
