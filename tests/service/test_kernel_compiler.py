"""A kernel that is not on disk is compiled by another process: the first measurement on a machine equals the next."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray

from stereorig.core.compiling import NotCompiledError, compile_elsewhere, refuse_compiling, report_compiling
from stereorig.server.worker import kernel_compiler
from stereorig.server.worker.kernel_compiler import KernelCompiler, compiled_aside
from tests.support.copied_tests import write_test_folder
from tests.support.measure_command import command
from tests.support.requirements import ROOT

KERNEL = """
from stereorig.core.matching.kernels.naming import entry

def twice(x):
    return 2.0 * x

twice = entry(twice)
"""


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Make a module with a kernel of its own, which is on no disk."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)  # beside the module, which numba takes in its own time only
    monkeypatch.setattr("numba.core.config.CACHE_DIR", "")
    (tmp_path / "kernel_of_test.py").write_text(KERNEL)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("kernel_of_test").twice
    del sys.modules["kernel_of_test"]


@pytest.fixture
def started(monkeypatch):
    """Collect the processes that are started."""
    processes = []
    start = kernel_compiler._start
    monkeypatch.setattr(kernel_compiler, "_start", lambda: processes.append(start()) or processes[-1])
    return processes


def test_it_is_compiled_by_another_process_and_loaded_here(kernel):
    told = []
    with compiled_aside(), report_compiling(lambda: told.append(True)):
        assert kernel(1.5) == 3.0
    assert sum(kernel.compiled.stats.cache_hits.values()) == 1
    assert told == [True]


def test_one_process_compiles_all_that_is_asked_for(kernel, started):
    with compiled_aside():
        assert kernel(1.5) == 3.0
        assert kernel(np.float32(1.5)) == 3.0
    assert len(started) == 1
    assert sum(kernel.compiled.stats.cache_hits.values()) == 2
    assert started[0].returncode is not None


@pytest.mark.parametrize("instead", ["pass", "import sys; sys.stdin.buffer.read(1)"])
def test_where_the_process_dies_it_is_compiled_here(kernel, monkeypatch, instead):
    monkeypatch.setattr(
        kernel_compiler,
        "_start",
        lambda: subprocess.Popen([sys.executable, "-c", instead], stdin=subprocess.PIPE, stdout=subprocess.PIPE),
    )
    with compiled_aside():
        assert kernel(1.5) == 3.0
    assert sum(kernel.compiled.stats.cache_hits.values()) == 0


def test_a_compiler_that_ended_is_started_again(kernel, started):
    with compiled_aside():
        assert kernel(1.5) == 3.0
        started[0].kill()
        started[0].wait()
        assert kernel(np.float32(1.5)) == 3.0
    assert len(started) == 2
    assert sum(kernel.compiled.stats.cache_hits.values()) == 2


def test_a_refused_compilation_starts_no_compiler(kernel):
    asked = []
    with compile_elsewhere(lambda *what: asked.append(what)), refuse_compiling(), pytest.raises(NotCompiledError):
        kernel(1.5)
    assert not asked


def test_what_is_on_disk_starts_no_process(kernel, monkeypatch):
    kernel(1.5)
    monkeypatch.setattr(kernel_compiler, "_start", lambda: pytest.fail("started"))
    kernel.compiled._reset_overloads()
    with compiled_aside():
        assert kernel(1.5) == 3.0


def test_a_compiler_that_was_asked_nothing_can_be_closed():
    KernelCompiler().close()


@pytest.mark.deep
def test_the_first_measurement_on_a_machine_equals_the_next_to_the_last_bit(tmp_path):
    write_test_folder(tmp_path / "test", 2, load_a_step=300.0)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PYTHONPATH": str(ROOT)}

    def measured(name: str) -> list[xarray.Dataset]:
        arguments = command(tmp_path, tmp_path / name, cam1=None, cam2=None, calibration=None, roi="25,25,130,115")
        line = [sys.executable, "-m", "stereorig.server.cli", *arguments, str(tmp_path / "test")]
        done = subprocess.run(line, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert ("compiling" in done.stderr) == (name == "first")
        return [xarray.load_dataset(path) for path in sorted(Path(tmp_path / name).glob("step_*.nc"))]

    for first, second in zip(measured("first"), measured("second"), strict=True):
        assert first.equals(second)
