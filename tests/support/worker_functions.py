"""Tasks for the compute worker's tests; the worker's process imports this module."""

from __future__ import annotations

import os
import signal
import time
import weakref

import cv2
import numpy as np

from stereorig.core.errors import RegionError
from stereorig.server.worker.process import current_task


def add(a: int, b: int) -> int:
    return a + b


def refuse(value: int) -> None:
    raise RegionError(f"value {value} is no region.", code="region_empty", value=value)


def process_of() -> dict[str, object]:
    return {"pid": os.getpid(), "cv2_threads": cv2.getNumThreads(), "numba": os.environ["NUMBA_NUM_THREADS"]}


def count(n: int, pause_s: float) -> int:
    task = current_task()
    for index in range(n):
        task.check()
        task.progress("counting", index + 1, n)
        time.sleep(pause_s)
    return n


def deaf(seconds: float) -> None:
    """Work on without looking at the token."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.01)


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


class Image:
    """A large object with a reference cycle, as between a context and what it measures with."""

    def __init__(self) -> None:
        self.pixels = np.zeros((2048, 2048))
        self.itself = self


_left: list[weakref.ref[Image]] = []


def leave_a_circle() -> int:
    """Return how many of the circles that earlier tasks left are still there."""
    there = sum(left() is not None for left in _left)
    _left.append(weakref.ref(Image()))
    return there


def compile_something() -> int:
    from numba import njit

    @njit
    def twice(x: int) -> int:
        return 2 * x

    return int(twice(21))


def warm_up(threads: int) -> None:
    time.sleep(0.5)  # so that a task is waiting
    compile_something()
    time.sleep(0.5)


def compiled_while_waiting() -> list[int]:
    """Wait for the kernels that are compiled aside, measure, and return what was compiled here all the same."""
    import stereorig.server.compute.measurement
    from stereorig.core.compiling import report_compiling
    from stereorig.core.target import GridTarget
    from stereorig.server.compute.grid_kernels import await_grid_kernels, find_drawn_grid

    await_grid_kernels(GridTarget(pitch_mm=1.0, lines=(9, 9), line_width_mm=0.05))
    stereorig.server.compute.measurement.await_kernels()
    compiled: list[int] = []
    with report_compiling(lambda: compiled.append(1)):
        find_drawn_grid()
        stereorig.server.compute.measurement.measure_small_steps()
    return compiled
