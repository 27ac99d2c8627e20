"""The processes that compile ahead: what they leave on disk is what a measurement then takes, and no process."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time

import pytest
from numba import njit

from stereorig.core.compiling import COMPILING, NotCompiledError, no_collection, refuse_compiling
from stereorig.core.errors import Cancelled
from stereorig.server.compute import background_compilation
from stereorig.server.compute.background_compilation import BackgroundCompilation, KernelsAside
from stereorig.server.compute.functions import warm_up
from stereorig.server.worker.embedded import ComputeWorker
from tests.support import worker_functions

WOULD_COMPILE = """
import sys
import numpy as np
from stereorig.core.compiling import report_compiling
from stereorig.core.matching.fit import fit_motion
from stereorig.core.matching.options import MatchOptions
from tests.support.matching_scene import paper_pair

compiled = []
picture = np.random.default_rng(2).integers(0, 255, (80, 90)).astype(np.uint8)
with report_compiling(lambda: compiled.append(True)):
    fit_motion(paper_pair(), *[picture] * 4, [[40.0, 40.0]], [[0.002, 0.0, 0.0]], None, MatchOptions(subset_px=15))
print(len(compiled))
"""


@pytest.fixture(autouse=True)
def two_processors(monkeypatch):
    monkeypatch.setattr("stereorig.core.threads.available_threads", lambda: 2)


@pytest.mark.deep
def test_a_compiled_kernel_is_not_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    with BackgroundCompilation("auto") as compilation:
        compilation.start()
        compilation.wait()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run([sys.executable, "-c", WOULD_COMPILE], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["0"]


class Waiting:
    """A task that is told to stop after some questions."""

    def __init__(self, patience: int) -> None:
        self.patience, self.told = patience, []

    def progress(self, phase, done, total):
        self.told.append((phase, done, total))

    def check(self):
        self.patience -= 1
        if self.patience < 0:
            raise Cancelled("Stop.")


def slow(monkeypatch, seconds):
    """Have a process that sleeps in the place of one that compiles."""

    def start(what):
        assert what == "shape"
        return subprocess.Popen([sys.executable, "-c", f"import time; time.sleep({seconds})"])

    monkeypatch.setattr(background_compilation, "_start", start)


def test_a_task_waits_for_what_is_compiled_aside_and_says_so_once(monkeypatch):
    slow(monkeypatch, 0.4)
    aside, task = KernelsAside("shape"), Waiting(10**6)
    aside.start()
    process = aside._process
    aside.wait(task)
    assert process is not None
    assert process.returncode == 0
    assert task.told == [(COMPILING, 0, 1)]
    aside.wait(task)  # there by now
    assert len(task.told) == 1


def test_a_task_that_waits_for_kernels_can_be_stopped_and_the_next_waits_again(monkeypatch):
    slow(monkeypatch, 60)
    aside = KernelsAside("shape")
    aside.start()
    process = aside._process
    assert process is not None
    try:
        with pytest.raises(Cancelled):
            aside.wait(Waiting(2))
        assert process.poll() is None
        with pytest.raises(Cancelled):
            aside.wait(Waiting(0))
    finally:
        process.kill()
        process.wait()


def test_nothing_started_is_nothing_to_wait_for():
    task = Waiting(0)
    KernelsAside("shape").wait(task)
    assert task.told == []


def test_a_kernel_that_is_not_there_is_refused_and_can_be_compiled_after():
    @njit
    def twice(x: int) -> int:
        return 2 * x

    with pytest.raises(NotCompiledError), refuse_compiling():
        twice(1)
    assert twice(1) == 2
    with refuse_compiling():
        assert twice(2) == 4


def test_the_collector_goes_on_after_compiling():
    assert gc.isenabled()
    with no_collection():
        assert not gc.isenabled()
    assert gc.isenabled()


@pytest.mark.deep
def test_a_worker_with_no_kernels_is_ready_at_once_and_its_first_measurement_compiles_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    with ComputeWorker(threads=2, warm_up=warm_up) as worker:
        seen = []
        first = worker.submit(worker_functions.compiled_while_waiting)
        first.on_progress = lambda *report: seen.append(report)
        assert worker.ready.wait(60.0)
        assert worker.compiling.is_set()
        assert first.result(timeout=280) == []
    # told by the wait itself
    assert (COMPILING, 0, 1) in seen


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
