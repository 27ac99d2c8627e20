"""Compile kernels in processes of their own, while other work does not need them yet.

numba compiles one kernel at a time in a process, and keeps it on disk for every other. A displacement's kernels are
compiled while another process compiles a shape's, which a measurement needs first. When a service starts, it has all
kernels compiled in such processes, in the order line grid, shape, displacement: its worker can calibrate before all
are done, and waits only for the kernels that a task needs.
"""

from __future__ import annotations

import subprocess
import sys
import time
from types import TracebackType
from typing import Any, Protocol

import numpy as np

from stereorig.core.compiling import COMPILING, NotCompiledError, no_collection, refuse_compiling
from stereorig.server.base.priority import BELOW_WORKER, LAST, end_with_parent, lower_worker
from stereorig.server.worker.kernel_compiler import start_module

_MAX_WAIT_S = 300.0
_POLL_S = 0.05
_LOOK_AGAIN_S = 0.5


class BackgroundCompilation:
    """A process that compiles the kernels of a displacement.

    Parameters
    ----------
    patch
        The patches that will be measured with.
    """

    def __init__(self, patch: str) -> None:
        self._degree = "quadratic" if patch == "quadratic" else "plane"
        self._process: subprocess.Popen[bytes] | None = None
        from stereorig.core.threads import available_threads  # loads numba

        self._wanted = available_threads() > 1  # a single processor has no time to spare

    def start(self) -> None:
        """Start, unless it was started or it is too late to be of use."""
        if not self._wanted:
            return
        self._wanted = False
        self._process = _start(self._degree)

    def wait(self) -> None:
        """Return once the kernels are there, or will have to be compiled here; :meth:`start` does nothing any more."""
        self._wanted = False
        if self._process is not None:
            try:
                self._process.wait(_MAX_WAIT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()

    def __enter__(self) -> BackgroundCompilation:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()


class Task(Protocol):
    """The waiting task of the worker: it gets progress, and can be stopped."""

    def check(self) -> None:
        """Raise an error if the task is to stop."""

    def progress(self, phase: str, done: int, total: int) -> None:
        """Report progress."""


class KernelsAside:
    """Kernels compiled at a low priority while this process does other work.

    Parameters
    ----------
    what
        Kernels to compile: ``grid``, of finding a line grid; ``shape``, ``motion``, of a first shape and displacement.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start; the processes end with this one."""
        self._process = _start(self._what)

    @property
    def ended(self) -> bool:
        """True once a wait would return at once."""
        return self._process is None or self._process.poll() is not None

    def wait(self, task: Task) -> None:
        """Return once the kernels are there, or will have to be compiled here.

        Raises
        ------
        Cancelled
            The task was asked to stop.
        """
        if self._process is None:
            return
        told = False
        while self._process.poll() is None:
            if not told:
                task.progress(COMPILING, 0, 1)
                told = True
            task.check()
            try:
                self._process.wait(_POLL_S)
            except subprocess.TimeoutExpired:
                continue
        self._process = None


def _start(what: str) -> subprocess.Popen[bytes]:
    return start_module(__name__, what)


def _compile_shape() -> None:
    lower_worker(BELOW_WORKER)
    from stereorig.core.threads import set_threads
    from stereorig.server.compute.measurement import measure_small_steps

    set_threads(1)
    measure_small_steps(motion=False)


def _compile_after_shape() -> None:
    """Compile a displacement's fit while a shape's kernels are compiled; then the other kernels of a displacement."""
    lower_worker(LAST)
    from stereorig.core.threads import set_threads
    from stereorig.server.compute.measurement import measure_small_steps

    set_threads(1)
    _compile_motion("affine")
    ends = time.monotonic() + _MAX_WAIT_S
    while time.monotonic() < ends:
        try:
            with refuse_compiling():
                measure_small_steps(motion=False)
            break
        except NotCompiledError:
            time.sleep(_LOOK_AGAIN_S)
    measure_small_steps()


def _compile_grid() -> None:
    lower_worker()
    from stereorig.server.compute.grid_kernels import find_drawn_grid

    find_drawn_grid()


def _compile_motion(patch: Any) -> None:
    """Fit one point that has no start, and compute its covariance: this compiles all kernels of a displacement."""
    from stereorig.core.cameras.camera import Camera
    from stereorig.core.cameras.stereo import StereoPair
    from stereorig.core.matching.cluster_robust import cluster_robust_covariance
    from stereorig.core.matching.fit import fit_motion
    from stereorig.core.matching.options import MatchOptions

    camera = Camera.from_paper(
        phd_px=1000.0,
        cx_px=32.0,
        cy_px=32.0,
        kappa_per_px2=0.0,
        aspect=1.0,
        alpha_rad=0.0,
        beta_rad=0.0,
        gamma_rad=0.0,
        x0_mm=0.0,
        y0_mm=0.0,
        z0_mm=100.0,
    )
    picture = np.random.default_rng(1).normal(128.0, 20.0, (64, 64))
    options = MatchOptions(subset_px=21, patch=patch)
    pair, xy, start = StereoPair(camera, camera), [[32.0, 32.0]], [[np.nan] * 3]
    fit_motion(pair, picture, picture, picture, picture, xy, start, None, options)
    terms = 6 if patch == "quadratic" else 3
    w, G = np.full((1, terms), np.nan), np.full((1, 3, terms), np.nan)
    cluster_robust_covariance(pair, [picture] * 4, xy, w, G, 0.0, options)


def main() -> int:
    """Compile a displacement's kernels for plane or quadratic patches, or a grid's, a first shape's or motion's."""
    end_with_parent()
    what = sys.argv[1]
    with no_collection():
        if what == "shape":
            _compile_shape()
        elif what == "motion":
            _compile_after_shape()
        elif what == "grid":
            _compile_grid()
        else:
            _compile_motion("quadratic" if what == "quadratic" else "affine")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
