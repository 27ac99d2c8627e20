"""The compiled entry points: a range of points, one work space a call.

They release the GIL and are called from several threads on ranges of their own. A point's result depends on nothing
but its own input, so neither ranges nor threads change a digit.

Only these are cached on disk. numba looks at the date of the cached function's own file alone, and all kernels are
inlined here; so the cache's key gets a stamp of all their sources, through a closure variable, and a change in any of
them compiles anew.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit

from core.matching.kernels.motion import make_motion
from core.matching.kernels.shape import make_shape


@cache
def _stamp() -> int:
    here = Path(__file__).parent
    sources = [*sorted(here.glob("*.py")), here.parent / "image.py", here.parents[1] / "status.py"]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).digest()
    return int.from_bytes(digest[:7], "big")


@cache
def shape_points(degree: int) -> Any:
    """Return the compiled fit of shape for plane (1) or curved (2) patches, for rows ``first`` to ``last``."""
    stamp = _stamp() + degree
    shape_point, work_space, _ = make_shape(degree)

    @njit(cache=True, nogil=True, error_model="numpy")
    def run_shape(first, last, reference, image2, lens1, lens2, R, t, xy, start, setting, out, status, iterations):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        space = work_space(setting[0])
        for i in range(first, last):
            status[i], iterations[i] = shape_point(
                reference, image2, lens1, lens2, R, t, xy[i], start[i], setting, space, out[i]
            )

    return run_shape


@cache
def motion_points(degree: int) -> Any:
    """Return the compiled fit of shape and motion for plane (1) or curved (2) patches."""
    stamp = _stamp() + degree
    motion_point, work_space, _ = make_motion(degree)

    @njit(cache=True, nogil=True, error_model="numpy")
    def run_motion(first, last, reference, image2, image1t, image2t, lens1, lens2, R, t, xy, start_w, start_g, setting,
                   out, status, iterations):  # fmt: skip
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        space = work_space(setting[0])
        for i in range(first, last):
            status[i], iterations[i] = motion_point(
                reference, image2, image1t, image2t, lens1, lens2, R, t, xy[i], start_w[i], start_g[i], setting, space,
                out[i],
            )  # fmt: skip

    return run_motion
