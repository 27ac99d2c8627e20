"""Values along a line drawn in camera 1's reference image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.errors import RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import steps_px

MAX_POSITIONS = 100_000


def positions_along(field: Field, vertices_px: ArrayLike, count: int | None = None) -> tuple[Float, Float]:
    """Return evenly spaced positions along a polyline, both ends included.

    Parameters
    ----------
    field
        Gives the grid.
    vertices_px
        (n, 2), n >= 2.
    count
        Number of positions; None for as many as the grid's finer spacing gives.

    Returns
    -------
    xy_px, distance_px
        (m, 2) the positions, (m,) their distances along the line.

    Raises
    ------
    RegionError
        ``gauge_unusable`` for a line without length or a count under 2.
    """
    v = np.asarray(vertices_px, dtype=np.float64)
    if v.ndim != 2 or v.shape[1:] != (2,) or len(v) < 2 or not np.isfinite(v).all():
        raise RegionError("A line needs two or more finite (x, y) positions.", code="gauge_unusable")
    reach = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(v, axis=0), axis=1))])
    if reach[-1] == 0.0:
        raise RegionError("The line has no length.", code="gauge_unusable", remedy="Give two different positions.")
    if count is None:
        count = min(int(np.floor(reach[-1] / min(steps_px(field)))) + 1, MAX_POSITIONS)
        count = max(count, 2)
    if not 2 <= count <= MAX_POSITIONS:
        raise RegionError(
            f"A line of {count} positions cannot be read.",
            code="gauge_unusable",
            remedy=f"Give 2 to {MAX_POSITIONS} positions.",
        )
    at = np.linspace(0.0, reach[-1], count)
    return np.column_stack([np.interp(at, reach, v[:, 0]), np.interp(at, reach, v[:, 1])]), at
