"""The compiled entry points: a range of points, one work space a call.

They release the GIL and are called from several threads on ranges of their own. A point's result depends on nothing
but its own input, so neither ranges nor threads change a digit.

Only these are cached on disk. numba looks at the date of the cached function's own file alone, and all kernels are
inlined here; so the cache's key gets a stamp of all their sources, through a closure variable, and a change in any of
them compiles again. The kernels themselves are globals: as closure variables they would enter the key too, and their
own key differs from process to process.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

from stereorig.core.matching.kernels.given import FitKernels
from stereorig.core.matching.kernels.motion import make_motion
from stereorig.core.matching.kernels.naming import entry, stamp_of
from stereorig.core.matching.kernels.shape import make_shape


def kernel_sources() -> list[Path]:
    """Return the files that the kernels are made of."""
    here = Path(__file__).parent
    # in addition to the kernels' own files: the sources of their constants and of the layout of a lens
    return [*sorted(here.glob("*.py")), here.parents[1] / "status.py", here.parents[1] / "cameras" / "lens.py"]


def _entry(name: str, kernel: Any, stamp: int) -> Any:
    """Compile the loop over a range of points for a kernel, under a name of its own."""

    def run(first, last, given, space, out, status, iterations):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        reference, patches, which, images, lens1, lens2, R, t, xy, w, G, e, warped, setting = given
        before = warped.values[0].shape[0] > 0
        for i in range(first, last):
            status[i], iterations[i] = _point(
                reference,
                patches,
                which[i],
                images,
                lens1,
                lens2,
                R,
                t,
                xy[i],
                w[i],
                G[i],
                e[i],
                warped.values,
                warped.bends[i if before else 0],
                warped.memory[warped.number[i] if before else 0],
                setting,
                space,
                out[i],
            )

    looped = FunctionType(run.__code__, {**globals(), "_point": kernel}, name, None, run.__closure__)
    looped.__qualname__ = name
    return entry(looped)


def _point(*given: Any) -> tuple[int, int]:
    """Placeholder of an entry point's kernel, which is found under this name in globals of the entry point's own."""
    raise NotImplementedError


_STAMP = stamp_of(kernel_sources())
_FITS = {"shape": {1: make_shape(1), 2: make_shape(2)}, "motion": {1: make_motion(1), 2: make_motion(2)}}


def _by_fit(of: Callable[[str, FitKernels], Any]) -> dict[str, dict[int, Any]]:
    return {kind: {d: of(f"{kind}_{d}", kernels) for d, kernels in fits.items()} for kind, fits in _FITS.items()}


run_points = _by_fit(lambda name, kernels: _entry(f"run_{name}", kernels.point, _STAMP))
cluster_robust_points = _by_fit(lambda name, kernels: _entry(f"observe_{name}", kernels.observed, _STAMP))
"""The compiled fits and cluster-robust covariances: of a shape or a motion, by the patch's degree (1 plane, 2
curved)."""
work_space = _by_fit(lambda _, kernels: kernels.space)
cluster_robust_space = _by_fit(lambda _, kernels: kernels.cluster_robust_space)
"""Makers of their work space for a subset's width; one call at a time may use it."""
