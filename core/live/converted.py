"""Followed points from the matcher's numbers: the checks of single points, displacement and covariance, in one pass.

The general code of :class:`stereorig.core.field.points.fitter.Fitter` and :mod:`stereorig.core.field.points.assemble`
takes longer than the fit of a frame's thousand points; this does the same for points that were measured in the frame
before.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.fitter import MAX_EPIPOLAR_PX
from stereorig.core.field.points.scales import SOURCES, depth_per_px, is_plausible, px_per_ray
from stereorig.core.matching.kernels.naming import stamp_of
from stereorig.core.status import PointStatus

_OK = int(PointStatus.OK)
_LOW_CORRELATION = int(PointStatus.LOW_CORRELATION)
_EPIPOLAR_MISMATCH = int(PointStatus.EPIPOLAR_MISMATCH)
_NOT_CONVERGED = int(PointStatus.NOT_CONVERGED)


class Constant(NamedTuple):
    """Values that do not change from frame to frame, for n points and the cameras.

    ``rays`` (n, 3) normalised, ``per_px`` (n,) inverse depth that moves camera 2's image by 1 px, ``scale`` (n,) px of
    camera 1's image per unit of a ray, ``R`` (3, 3) camera 1's rotation from the system, ``centre2`` (3,) mm camera 2
    in camera 1's frame, ``position`` (n, 3, 3) mm^2 the shape's covariance, and two limits.
    """

    rays: Float
    per_px: Float
    scale: Float
    R: Float
    centre2: Float
    position: Float
    min_zncc: float
    far_px: float

    @staticmethod
    def of(pair: StereoPair, rays: Float, w0: Float, position: Float, *, min_zncc: float, far_px: float) -> Constant:
        """Return it for points with inverse depths ``w0`` (n,)."""
        return Constant(
            np.array(rays),
            depth_per_px(pair, rays, w0),
            px_per_ray(pair, rays)[:, 0].copy(),
            np.array(pair.cam1.cam_from_sys.rotation),
            np.array(pair.cam2_from_cam1.inverse().translation_mm),
            np.array(position),
            float(min_zncc),
            float(far_px),
        )


def _converter(stamp):
    @njit(cache=True, nogil=True, error_model="numpy")
    def convert(first, last, constant, terms, out, start_w, start_g, ratio, status, uvw, covariance):
        """Check points ``first`` to ``last``, and give displacement and covariance of those that pass.

        Parameters
        ----------
        constant
            A :class:`Constant`.
        terms
            3 for plane patches, 6 for curved ones.
        out
            (n, ...) as :func:`stereorig.core.matching.kernels.motion.n_motion_out` has it.
        start_w, start_g
            (n, terms), (n, 3, terms) start of the fit.
        ratio
            (n, 6) standard deviations with all checks over a fit's own.
        status
            (n,) int8, changed in place: a status other than OK stays.
        uvw
            (n, 3) out, mm, system frame.
        covariance
            (n, 6, 6) out, mm^2, system frame, of X, Y, Z, U, V, W.
        """
        if stamp < 0:  # never; it makes the stamp part of the function
            return
        rays, per_px, scale, R, centre2, position, min_zncc, far_px = constant
        at = 4 * terms
        J = np.zeros((6, 4))
        half = np.empty((6, 4))
        d = np.empty(3)
        for i in range(first, last):
            if status[i] != _OK:
                continue
            numbers = out[i]
            if not min(numbers[at + 1], numbers[at + 2], numbers[at + 3]) >= min_zncc:
                status[i] = _LOW_CORRELATION
                continue
            if not abs(numbers[at]) <= MAX_EPIPOLAR_PX:
                status[i] = _EPIPOLAR_MISMATCH
                continue
            w0, g00, g10, g20 = numbers[0], numbers[terms], numbers[2 * terms], numbers[3 * terms]
            x, y = rays[i, 0], rays[i, 1]
            good = is_plausible(centre2, x, y, numbers[:terms], numbers[terms:at], True)
            # near its start
            across = g00 / g20 - start_g[i, 0, 0] / start_g[i, 2, 0]
            down = g10 / g20 - start_g[i, 1, 0] / start_g[i, 2, 0]
            px = max(abs(w0 - start_w[i, 0]) / per_px[i], math.sqrt(across * across + down * down) * scale[i])
            if not (good and px < far_px):
                status[i] = _NOT_CONVERGED
                continue
            d[0], d[1], d[2] = g00 - x, g10 - y, g20 - 1.0
            for r in range(3):
                along, motion = 0.0, 0.0
                for k in range(3):
                    along += (x if k == 0 else (y if k == 1 else 1.0)) * R[k, r]
                    motion += d[k] * R[k, r]
                    J[3 + r, 1 + k] = R[k, r] / w0
                uvw[i, r] = motion / w0
                J[r, 0] = -along / (w0 * w0)
                J[3 + r, 0] = -motion / (w0 * w0)
            own = numbers[at + 5 : at + 30]
            for r in range(6):
                for c in range(4):
                    half[r, c] = 0.0
                    for k in range(4):
                        half[r, c] += J[r, k] * own[5 * k + c]
            trace = 0.0
            for r in range(6):
                for c in range(6):
                    s = 0.0
                    for k in range(4):
                        s += half[r, k] * J[c, k]
                    covariance[i, r, c] = s
                if r < 3:
                    trace += covariance[i, r, r]
            # as in a step: the shape alone is the joint estimate plus an error independent of it
            if position[i, 0, 0] + position[i, 1, 1] + position[i, 2, 2] > trace:
                for r in range(3):
                    for c in range(3):
                        covariance[i, r, c] = position[i, r, c]
            for r in range(6):
                for c in range(6):
                    covariance[i, r, c] *= ratio[i, r] * ratio[i, c]

    return convert


convert = _converter(stamp_of([*SOURCES, Path(__file__)]))
