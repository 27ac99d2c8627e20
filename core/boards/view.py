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


def neighbour_distances_px(xy_px: Float, target: BoardTarget) -> Float:
    """Return (columns, rows) mean distance to the neighbours one pitch away, NaN without any."""
    vertical = 1.0 if target.kind != "circles_asymmetric" else float(np.sqrt(2.0))
    horizontal = 1.0 if target.kind != "circles_asymmetric" else 2.0
    total, count = np.zeros(xy_px.shape[:2]), np.zeros(xy_px.shape[:2])
    for axis, pitches in ((0, horizontal), (1, vertical)):
        step = np.linalg.norm(np.diff(xy_px, axis=axis), axis=-1) / pitches
        for part in (slice(None, -1), slice(1, None)):
            at = (part, slice(None)) if axis == 0 else (slice(None), part)
            known = np.isfinite(step)
            total[at] += np.where(known, step, 0.0)
            count[at] += known
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)
