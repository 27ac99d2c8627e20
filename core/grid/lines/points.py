"""Sub-pixel points on lines, the lines fitted to them, and the lines' intersections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.grid.view import LineOffsets


@dataclass(frozen=True)
class LinePoints:
    """Sub-pixel points on lines.

    Attributes
    ----------
    xy_px
        (n, 2).
    normal
        (n, 2) unit vector across the line.
    sigma_px
        (n,) standard deviation across the line, from the image's noise.
    family, line, along
        (n,) 0 or 1; number of the line; position along the line in units of the pitch.
    """

    xy_px: Float
    normal: Float
    sigma_px: Float
    family: NDArray[np.intp]
    line: NDArray[np.intp]
    along: Float


@dataclass(frozen=True)
class LineFit:
    """Lines of both families under one model.

    Attributes
    ----------
    nodes_px
        (n_a, n_b, 2) all intersections.
    covariance_px2
        (n_a, n_b, 2, 2) from the line points' own noise.
    residual_px
        (n,) of each line point across its line.
    variance_px2
        (n,) that the fit weighted it with.
    straight_px
        (n_a, n_b, 2) intersections in coordinates without distortion, up to a projective map; equal to ``nodes_px``
        under the parabola model.
    line_offsets
        Joint covariance along each line, see :class:`stereorig.core.grid.view.LineOffsets`; of the local model only.
    """

    nodes_px: Float
    covariance_px2: Float
    residual_px: Float
    variance_px2: Float
    straight_px: Float
    line_offsets: LineOffsets | None = None


def frames(points: LinePoints, v: Float, counts: tuple[int, int]) -> tuple[Float, Float, Float]:
    """Per line: a point, its direction and its normal, in the coordinates of ``v``; (n_line, 2) each."""
    n = sum(counts)
    index = line_index(points, counts)
    origin, direction = np.zeros((n, 2)), np.zeros((n, 2))
    for k in range(n):
        mine = v[index == k]
        if len(mine) < 4:
            raise np.linalg.LinAlgError(f"line {k} has {len(mine)} points")
        origin[k] = mine.mean(axis=0)
        d = mine - origin[k]
        direction[k] = np.linalg.eigh(d.T @ d)[1][:, 1]
    return origin, direction, np.stack([-direction[:, 1], direction[:, 0]], axis=-1)


def line_index(points: LinePoints, counts: tuple[int, int]) -> NDArray[np.intp]:
    """Number of each point's line over both families, (n,)."""
    return points.line + np.where(points.family == 0, 0, counts[0])


def meet_straight(point: Float, along: Float, counts: tuple[int, int]) -> Float:
    """Meet straight lines through points (n, 2) along directions (n, 2): (n_a, n_b, 2)."""
    na = counts[0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    c = np.sum(normal * point, axis=-1)
    (ax, ay), (bx, by) = normal[:na].T, normal[na:].T
    det = ax[:, None] * by[None, :] - ay[:, None] * bx[None, :]
    x = (c[:na, None] * by[None, :] - c[None, na:] * ay[:, None]) / det
    y = (ax[:, None] * c[None, na:] - bx[None, :] * c[:na, None]) / det
    return np.stack([x, y], axis=-1)
