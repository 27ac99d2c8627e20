"""The compute worker: an executor whose one process reports its progress, can be stopped and may die."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from pathlib import Path

import pytest
from numba import njit

from stereorig.core.compiling import COMPILING, report_compiling
from stereorig.core.errors import Cancelled, RegionError
from stereorig.server.worker.embedded import ComputeWorker
from stereorig.server.worker.executor import WorkerDiedError
from tests.support import worker_functions as work
from tests.support.patience import busy
from tests.support.requirements import ROOT


@pytest.fixture(scope="module")
def worker() -> Iterator[ComputeWorker]:
    with ComputeWorker(threads=1) as made:
        yield made


def test_it_is_an_executor_with_one_long_lived_process_and_pinned_threads(worker: ComputeWorker) -> None:
    assert isinstance(worker, Executor)
    assert worker.submit(work.add, 2, b=3).result(timeout=30) == 5
    one, two = (worker.submit(work.process_of).result(timeout=30) for _ in range(2))
    assert one == two
    assert one["pid"] == worker.pid
    assert one["cv2_threads"] in (0, 1)  # OpenCV calls sequential work both
    assert one["numba"] == "1"


def test_the_functions_of_tasks_load_no_numerical_library_before_the_threads_are_set() -> None:
    code = "import sys, stereorig.server.compute.functions; print({'numpy', 'cv2', 'numba'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_what_a_task_leaves_in_circles_is_gone_before_the_next(worker: ComputeWorker) -> None:
    assert [worker.submit(work.leave_a_circle).result(timeout=30) for _ in range(5)] == [0, 0, 0, 0, 0]


def test_an_error_comes_back_whole(worker: ComputeWorker) -> None:
    with pytest.raises(RegionError, match="value 7") as caught:
        worker.submit(work.refuse, 7).result(timeout=30)
    assert caught.value.code == "region_empty"
    assert caught.value.context == {"value": 7}


def test_progress_comes_while_it_works(worker: ComputeWorker) -> None:
    seen: list[tuple[str, int, int]] = []
    future = worker.submit(work.count, 5, 0.01)
    future.on_progress = lambda *report: seen.append(report)
    assert future.result(timeout=30) == 5
    assert seen[-1] == ("counting", 5, 5)
    assert [done for _, done, _ in seen] == sorted(done for _, done, _ in seen)


def test_a_task_that_compiles_kernels_says_so(worker: ComputeWorker) -> None:
    seen: list[tuple[str, int, int]] = []
    future = worker.submit(work.compile_something)
    future.on_progress = lambda *report: seen.append(report)
    assert future.result(timeout=60) == 42
    assert seen == [(COMPILING, 0, 1)]


def test_a_task_that_waits_for_kernels_to_be_compiled_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))  # nothing is on disk there
    seen: list[tuple[str, int, int]] = []
    with ComputeWorker(threads=1, warm_up=work.warm_up) as made:
        future = made.submit(work.add, 1, 2)
        future.on_progress = lambda *report: seen.append(report)
        assert future.result(timeout=60) == 3
    assert seen == [(COMPILING, 0, 1)]


@pytest.mark.fault(43)
def test_a_running_task_stops_within_a_second_and_the_process_lives_on(worker: ComputeWorker) -> None:
    pid = worker.submit(work.process_of).result(timeout=30)["pid"]
    future = worker.submit(work.count, 1000, 0.05)
    time.sleep(0.3)
    asked = time.monotonic()
    future.request_stop()
    with pytest.raises(Cancelled):
        future.result(timeout=10)
    assert time.monotonic() - asked < 1.0 * busy()
    assert worker.submit(work.process_of).result(timeout=30)["pid"] == pid


def test_a_deaf_task_is_ended_with_its_process_and_the_next_one_runs(worker: ComputeWorker) -> None:
    future = worker.submit(work.deaf, 60.0)
    time.sleep(0.3)
    asked = time.monotonic()
    future.request_stop()
    with pytest.raises(Cancelled):
        future.result(timeout=10)
    assert time.monotonic() - asked < 1.5 * busy()  # 0.7 s of patience, and the process to end
    assert worker.submit(work.add, 1, 1).result(timeout=30) == 2


def test_a_waiting_task_is_cancelled_before_it_begins(worker: ComputeWorker) -> None:
    running = worker.submit(work.count, 20, 0.02)
    waiting = worker.submit(work.add, 1, 1)
    waiting.request_stop()
    with pytest.raises(CancelledError):
        waiting.result(timeout=10)
    assert running.result(timeout=30) == 20


def test_death_is_told_and_mended(worker: ComputeWorker) -> None:
    starts = worker.starts
    with pytest.raises(WorkerDiedError, match="signal 9") as caught:
        worker.submit(work.die).result(timeout=30)
    assert caught.value.code == "worker_died"
    assert worker.starts == starts + 1
    assert worker.submit(work.add, 4, 4).result(timeout=30) == 8


def test_after_shutdown_nothing_is_taken() -> None:
    worker = ComputeWorker(threads=1)
    worker.shutdown()
    with pytest.raises(RuntimeError, match="shut down"):
        worker.submit(work.add, 1, 1)


def test_compiling_is_told_once_and_loading_never() -> None:
    @njit
    def once(x: int) -> int:
        return x + 1

    compiled: list[int] = []
    with report_compiling(lambda: compiled.append(1)):
        assert once(1) == 2
        assert once(1.5) == 2.5  # another signature, compiled too
    assert compiled == [1]
    with report_compiling(lambda: compiled.append(2)):
        assert once(2) == 3
    assert compiled == [1]
