"""A board found in one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.boards.board import BoardTarget


@dataclass(frozen=True, kw_only=True)
class BoardView:
    """The points of a board found in one image.

    Attributes
    ----------
    target
        The description it was found by.
    xy_px
        (columns, rows, 2) corners, or centres of the dots' ellipses as imaged, NaN for points that were not found. A
        circle's image is an ellipse whose centre is not the image of the circle's, see
        :func:`stereorig.core.boards.eccentricity.dot_centre_offset_px`.
    sigma_px
        (columns, rows) standard deviation per axis, from the image's own noise and edges; NaN where not found.
    radius_px
        (columns, rows) mean radius of each dot; None for corners.
    pitch_px
        Median distance of neighbouring points.
    image_size_px
        Columns, rows.
    covariance_px2
        (columns, rows, 2, 2) of each point; ``sigma_px`` is the root of half its trace. NaN where not found.
    ellipse_per_px
        (columns, rows, 2, 2) symmetric M of each dot, whose rim is at ``|M d| = 1`` for d from its centre; None for
        corners.
    blur_px
        Median standard deviation of the lens's blur at the edges, without the pixel's own area.
    contrast, noise
        Grey levels: median step at an edge, and standard deviation about the fitted picture.
    marks
        (column, row) of the three dots that mark the axes, the corner's first; empty without marks.
    """

    target: BoardTarget
    xy_px: Float
    sigma_px: Float
    radius_px: Float | None
    pitch_px: float
    image_size_px: tuple[int, int]
    covariance_px2: Float | None = None
    ellipse_per_px: Float | None = None
    blur_px: float = float("nan")
    contrast: float = float("nan")
    noise: float = float("nan")
    marks: tuple[tuple[int, int], ...] = ()

    @property
    def found(self) -> int:
        """Number of points found."""
        return int(np.isfinite(self.xy_px).all(axis=-1).sum())

    @property
    def object_points_mm(self) -> Float:
        """Nominal positions of the points, (columns, rows, 2) X and Y, mm."""
        return self.target.points_mm()

    @property
    def dot_radius_mm(self) -> float | None:
        """Radius of the dots: as described, else the median of those measured; None for corners."""
        if self.radius_px is None:
            return None
        if self.target.dot_diameter_mm is not None:
            return 0.5 * self.target.dot_diameter_mm
        return measured_dot_radius_mm(self.xy_px, self.radius_px, self.target)


def measured_dot_radius_mm(xy_px: Float, radius_px: Float, target: BoardTarget) -> float:
    """Return the median radius of dots, mm, each by the image's scale of areas about it.

    Parameters
    ----------
    xy_px, radius_px
        (columns, rows, 2) and (columns, rows); the radius is the root of the product of the half axes.
    target
        The board.
    """
    ex, ey = steps_px(xy_px, 0), steps_px(xy_px, 1)
    # dots in a row of an asymmetric grid are two pitches apart; the rows' shift changes no area
    cell_mm2 = target.pitch_mm**2 * (2.0 if target.kind == "circles_asymmetric" else 1.0)
    px_per_mm = np.sqrt(np.abs(ex[..., 0] * ey[..., 1] - ex[..., 1] * ey[..., 0]) / cell_mm2)
    return float(np.nanmedian(radius_px / px_per_mm))


def steps_px(xy_px: Float, axis: int) -> Float:
    """Return (columns, rows, 2) mean step to the neighbours along an axis, NaN without any."""
    return _mean(*_sum_of_neighbours(np.diff(xy_px, axis=axis), axis))


def neighbour_distances_px(xy_px: Float, target: BoardTarget) -> Float:
    """Return (columns, rows) mean distance to the neighbours one pitch away, NaN without any."""
    # distances in a row, and between two rows; dots in a row of an asymmetric grid are two pitches apart, across rows
    # the distance is diagonal
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
