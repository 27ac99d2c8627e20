"""The last pass over the vectors of a band of rows: checks, and the covariance at the ordinary field's level.

Values of the ordinary field's points are interpolated linearly along both axes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from stereorig.core.matching.kernels.naming import inner
from stereorig.core.status import PointStatus

OK = int(PointStatus.OK)
EXTRAPOLATED = int(PointStatus.EXTRAPOLATED)
LOW_TEXTURE = int(PointStatus.LOW_TEXTURE)
LOW_CORRELATION = int(PointStatus.LOW_CORRELATION)
EPIPOLAR_MISMATCH = int(PointStatus.EPIPOLAR_MISMATCH)
NEIGHBOUR_MISMATCH = int(PointStatus.NEIGHBOUR_MISMATCH)


class AtPoints(NamedTuple):
    """Values at the ordinary field's points (r, c) for the vectors between them, without gaps.

    Variance over the normal equations' (..., 1 or 2: positions, displacements), residual's squares per weight (...,
    images), epipolar offset, noise in grey levels; vectors' distance over the points'.
    """

    ratio: Any
    misfit: Any
    epipolar: Any
    noise: Any
    step: float


class Limits(NamedTuple):
    """Limits that a vector must meet.

    Least correlation; largest standard deviation, increment and change of the epipolar offset, px; largest residual
    over the points' (images,).
    """

    zncc: float
    sigma: float
    moved: float
    offset: float
    louder: Any


class Shape(NamedTuple):
    """The dense shape (r, c, ...) whose positions a displacement shows; empty arrays for a shape itself."""

    status: Any
    xyz: Any
    covariance: Any


@inner
def _between(values, r, c, k, v, u):
    low = values[r, c, k] + u * (values[r, c + 1, k] - values[r, c, k])
    high = values[r + 1, c, k] + u * (values[r + 1, c + 1, k] - values[r + 1, c, k])
    return low + v * (high - low)


@inner
def finish(first, last, found, points, limits, shape, covariance, noise):
    """Check rows ``first`` to ``last`` of the vectors ``found`` (a ``DenseOut``), in place; fill covariance, noise."""
    values, packed, epipolar, zncc, misfit, moved, sigma, status = found
    images, n = zncc.shape[2], values.shape[2]
    rows, cols = points.noise.shape[0], points.noise.shape[1]
    motion = shape.status.shape[0] > 0
    for r in range(first, last):
        along = r * points.step
        pr = min(int(along), rows - 2)
        v = along - pr
        for c in range(status.shape[1]):
            across = c * points.step
            pc = min(int(across), cols - 2)
            u = across - pc
            state = int(status[r, c])
            if motion and shape.status[r, c] != OK and shape.status[r, c] != EXTRAPOLATED:
                state = int(shape.status[r, c])  # only the shape's valid points are measured
            if state == OK:
                position = _between(points.ratio, pr, pc, 0, v, u)
                displacement = _between(points.ratio, pr, pc, 1, v, u) if n == 6 else position
                if not abs(epipolar[r, c] - _between(points.epipolar, pr, pc, 0, v, u)) <= limits.offset:
                    state = EPIPOLAR_MISMATCH
                for k in range(images):
                    if not moved[r, c, k] <= limits.moved:
                        state = NEIGHBOUR_MISMATCH
                for k in range(images):
                    expected = _between(points.misfit, pr, pc, k, v, u)
                    if not (zncc[r, c, k] >= limits.zncc and misfit[r, c, k] <= limits.louder[k] * expected):
                        state = LOW_CORRELATION
                if not sigma[r, c] * math.sqrt(max(position, displacement)) <= limits.sigma:
                    state = LOW_TEXTURE
            status[r, c] = state
            if state != OK:
                for k in range(n):
                    values[r, c, k] = math.nan
                    for m in range(n):
                        covariance[r, c, k, m] = math.nan
                for k in range(images):
                    zncc[r, c, k] = math.nan
                epipolar[r, c], noise[r, c] = math.nan, math.nan
                continue
            noise[r, c] = _between(points.noise, pr, pc, 0, v, u)
            by_position, by_displacement = math.sqrt(position), math.sqrt(displacement)
            slot = 0
            for k in range(n):
                one = by_position if k < 3 else by_displacement
                for m in range(k, n):
                    other = by_position if m < 3 else by_displacement
                    entry = packed[r, c, slot] * one * other
                    covariance[r, c, k, m], covariance[r, c, m, k] = entry, entry
                    slot += 1
            if motion:
                own, theirs = 0.0, 0.0
                for k in range(3):
                    values[r, c, k] = shape.xyz[r, c, k]
                    own += covariance[r, c, k, k]
                    theirs += shape.covariance[r, c, k, k]
                if theirs > own:  # as in the ordinary field, a position keeps the shape's
                    for k in range(3):
                        for m in range(3):
                            covariance[r, c, k, m] = shape.covariance[r, c, k, m]
