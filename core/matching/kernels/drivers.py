"""The two parallel kernels: points in chunks of fixed size, one work space a chunk.

A point's result depends on nothing but its own input, so neither the chunks nor the threads change a digit.
"""

from __future__ import annotations

from numba import njit, prange

from core.matching.kernels.motion import motion_point
from core.matching.kernels.point import work_space
from core.matching.kernels.shape import shape_point

CHUNK = 64


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def shape_points(reference, gradients, image2, lens1, lens2, R, t, xy, start, setting, out, status, iterations):
    """Run ``shape_point`` for every row of ``xy``."""
    n = xy.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        space = work_space(setting[0], 1)
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            status[i], iterations[i] = shape_point(
                reference, gradients, image2, lens1, lens2, R, t, xy[i], start[i], setting, space, out[i]
            )


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def motion_points(reference, gradients, image2, image1t, image2t, lens1, lens2, R, t, xy, start_w, start_g, setting,
                  out, status, iterations):  # fmt: skip
    """Run ``motion_point`` for every row of ``xy``."""
    n = xy.shape[0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        space = work_space(setting[0], 3)
        for i in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            status[i], iterations[i] = motion_point(
                reference, gradients, image2, image1t, image2t, lens1, lens2, R, t, xy[i], start_w[i], start_g[i],
                setting, space, out[i],
            )  # fmt: skip
