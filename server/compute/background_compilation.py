"""Compile the kernels of a motion in a process of their own while this one compiles those of a shape.

numba compiles one kernel at a time in a process, and keeps it on disk for every other. A first measurement needs the
shape's kernels first; by the time it needs the motion's, they are there.
"""

from __future__ import annotations

import os
import subprocess
import sys
from types import TracebackType

import numpy as np

from server.base.priority import end_with_parent

_MAX_WAIT_S = 300.0


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
        from core.threads import available_threads  # loads numba

        self._wanted = available_threads() > 1  # a single processor has no time to spare

    def start(self) -> None:
        """Start, unless it was started or it is too late to be of use."""
        if not self._wanted:
            return
        self._wanted = False
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, self._degree],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

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


def main() -> int:
    """Fit one point that has no start, and compute its covariance: this compiles all kernels."""
    end_with_parent()
    from core.cameras.camera import Camera
    from core.cameras.stereo import StereoPair
    from core.matching.cluster_robust import cluster_robust_covariance
    from core.matching.fit import fit_motion
    from core.matching.options import MatchOptions

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
    options = MatchOptions(subset_px=21, patch="quadratic" if sys.argv[1] == "quadratic" else "affine")
    pair, xy, start = StereoPair(camera, camera), [[32.0, 32.0]], [[np.nan] * 3]
    fit_motion(pair, picture, picture, picture, picture, xy, start, None, options)
    terms = 6 if options.patch == "quadratic" else 3
    w, G = np.full((1, terms), np.nan), np.full((1, 3, terms), np.nan)
    cluster_robust_covariance(pair, [picture] * 4, xy, w, G, 0.0, options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
