"""The compiled entry points: a band of rows of vectors, and the positions of the ordinary field's points.

As in :mod:`stereorig.core.matching.kernels.drivers`, they release the GIL, run on ranges of their own, and are kept on
disk under a stamp of all sources.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereorig.core.dense.kernels.cameras import positions
from stereorig.core.dense.kernels.finish import finish
from stereorig.core.dense.kernels.windows import make_windows
from stereorig.core.matching.kernels.drivers import kernel_sources
from stereorig.core.matching.kernels.naming import entry, entry_with_arrays, stamp_of
from stereorig.core.matching.kernels.point import epipolar_shift

_STAMP = stamp_of([*kernel_sources(), *sorted(Path(__file__).parent.glob("*.py"))])
_SHAPE, _MOTION = make_windows(1), make_windows(3)
_shape_band, _motion_band = _SHAPE.band, _MOTION.band
shape_space, motion_space = _SHAPE.space, _MOTION.space


def _entries(stamp: int):  # type: ignore[no-untyped-def]
    @entry
    def shape_rows(first, last, given, space, out):
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        _shape_band(first, last, given, space, out)

    @entry
    def motion_rows(first, last, given, space, out):
        if stamp < 0:
            return
        _motion_band(first, last, given, space, out)

    @entry_with_arrays
    def project(lens1, lens2, R, t, rays, state, images, out):
        if stamp < 0:
            return
        shift, slopes = np.zeros(2), np.zeros((6, 6))
        for i in range(rays.shape[0]):
            shift[0], shift[1], along = epipolar_shift(lens2, R, t, rays[i, 0], rays[i, 1], state[i, 0])
            out[i, 6], out[i, 7], out[i, 8] = shift[0], shift[1], along
            positions(lens1, lens2, R, t, rays[i], state[i], shift, images, out[i], slopes)

    @entry
    def finish_rows(first, last, found, points, limits, shape, covariance, noise):
        if stamp < 0:
            return
        finish(first, last, found, points, limits, shape, covariance, noise)

    return shape_rows, motion_rows, project, finish_rows


shape_rows, motion_rows, project, finish_rows = _entries(_STAMP)
"""See :mod:`.kernels.windows`, :func:`.kernels.cameras.positions`, :func:`.kernels.finish.finish`."""
