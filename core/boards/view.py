"""A board found in one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.arrays import Float
from core.boards.board import BoardTarget


@dataclass(frozen=True, kw_only=True)
class BoardView:
    """The points of a board found in one image.

    Attributes
    ----------
    target
        The description it was found by.
    xy_px
        (columns, rows, 2) corners or centroids of dots, NaN where one was not found.
    sigma_px
        (columns, rows) standard deviation per axis, from the image's own noise and edges; NaN where not found.
    radius_px
        (columns, rows) mean radius of each dot; None for corners.
    pitch_px
        Median distance of neighbouring points.
    image_size_px
        Columns, rows.
    """

    target: BoardTarget
    xy_px: Float
    sigma_px: Float
    radius_px: Float | None
    pitch_px: float
    image_size_px: tuple[int, int]

    @property
    def found(self) -> int:
        """Number of points found."""
        return int(np.isfinite(self.xy_px).all(axis=-1).sum())


def steps_px(xy_px: Float, axis: int) -> Float:
    """Return (columns, rows, 2) mean step to the neighbours along an axis, NaN without any."""
    return _mean(*_sum_of_neighbours(np.diff(xy_px, axis=axis), axis))


def neighbour_distances_px(xy_px: Float, target: BoardTarget) -> Float:
    """Return (columns, rows) mean distance to the neighbours one pitch away, NaN without any."""
    # of a row, and of two rows; dots of an asymmetric grid's row lie two pitches apart, those of two rows diagonally
    pitches = (2.0, float(np.sqrt(2.0))) if target.kind == "circles_asymmetric" else (1.0, 1.0)
    distances = []
    for axis, per_step in enumerate(pitches):
        distance = np.linalg.norm(np.diff(xy_px, axis=axis), axis=-1, keepdims=True) / per_step
        distances.append(_sum_of_neighbours(distance, axis))
    total, count = (sum(parts) for parts in zip(*distances, strict=True))
    return _mean(np.asarray(total), np.asarray(count))[..., 0]


def _sum_of_neighbours(step: Float, axis: int) -> tuple[Float, Float]:
    """Sum over the steps before and after each point, (columns, rows, n), and their number, (columns, rows, 1)."""
    shape = [*step.shape]
    shape[axis] += 1
    total, count = np.zeros(shape), np.zeros((*shape[:2], 1))
    known = np.isfinite(step).all(axis=-1, keepdims=True)
    for part in (slice(None, -1), slice(1, None)):
        at = (part, slice(None)) if axis == 0 else (slice(None), part)
        total[at] += np.where(known, step, 0.0)
        count[at] += known
    return total, count


def _mean(total: Float, count: Float) -> Float:
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1.0), np.nan))
