"""Cuts: lines that no subset, neighbour or start value crosses.

A crack is an open line, a hole's border a closed one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import RegionError
from stereorig.core.threads import run_ranges

_AT_ONCE = 8192


@dataclass(frozen=True, eq=False)
class Cuts:
    """Lines in camera 1's reference image that separate parts of the surface.

    Attributes
    ----------
    lines_px
        Polylines (n, 2), n >= 2, x and y in px; one that ends at its beginning is the border of a hole.

    Raises
    ------
    RegionError
        ``cut_invalid`` for a line of one point, of no length, or with a number that is not finite.
    """

    lines_px: tuple[Float, ...]

    def __init__(self, lines_px: Iterable[ArrayLike]) -> None:
        object.__setattr__(self, "lines_px", tuple(_line(line) for line in lines_px))

    @property
    def pieces_px(self) -> Float:
        """(m, 4) the straight pieces x0, y0, x1, y1 of all lines."""
        parts = [np.concatenate([line[:-1], line[1:]], axis=1) for line in self.lines_px]
        return np.concatenate(parts) if parts else np.zeros((0, 4))

    def __bool__(self) -> bool:
        """False if there is no line."""
        return len(self.lines_px) > 0


def crosses(a_px: ArrayLike, b_px: ArrayLike, cuts: Cuts | None) -> Bool:
    """Return True if the straight lines from ``a_px`` to ``b_px`` meet a cut.

    Parameters
    ----------
    a_px, b_px
        (n, 2), or anything that broadcasts to (..., 2), px.
    cuts
        None: nothing is crossed.

    Returns
    -------
    NDArray
        (n,) or (...) bool. A line that only touches a cut meets it; NaN meets nothing.
    """
    from stereorig.core.field.region.line_crossings import cross  # slow to load, and not every start needs it

    a, b = np.broadcast_arrays(np.asarray(a_px, dtype=np.float64), np.asarray(b_px, dtype=np.float64))
    out = np.zeros(a.shape[:-1], bool)
    if not cuts or out.size == 0:
        return out
    pieces, flat = cuts.pieces_px, out.reshape(-1)
    begin, end = (np.ascontiguousarray(p.reshape(-1, 2)) for p in (a, b))
    run_ranges(lambda first, last: cross(first, last, begin, end, pieces, flat), len(flat), _AT_ONCE)
    return out


def _line(line: ArrayLike) -> Float:
    try:
        points = np.array(line, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < 2:
        raise RegionError(
            f"a crack needs two or more (x, y) points, got an array of shape {points.shape}.",
            code="cut_invalid",
            remedy="Give the points that the line goes through, one after the other.",
        )
    if not np.isfinite(points).all():
        raise RegionError(
            f"the crack {points.tolist()} holds a number that is not finite.",
            code="cut_invalid",
            remedy="Give x and y in px of camera 1's reference image.",
        )
    if not np.ptp(points, axis=0).any():
        raise RegionError(
            f"the crack's points all lie at ({points[0, 0]:g}, {points[0, 1]:g}).",
            code="cut_invalid",
            remedy="Give two different points or more.",
        )
    points.flags.writeable = False
    return points


def as_arrays(cuts: Cuts) -> tuple[Float, NDArray[np.int32]]:
    """Return all lines' points (n, 2) one after the other, and (n,) the index of each point's line."""
    points = np.concatenate(cuts.lines_px) if cuts else np.zeros((0, 2))
    of_line = np.repeat(np.arange(len(cuts.lines_px)), [len(line) for line in cuts.lines_px]).astype(np.int32)
    return points, of_line


def from_arrays(points_px: Float, of_line: NDArray[np.int32]) -> Cuts:
    """Return the cuts from the arrays of :func:`as_arrays`."""
    return Cuts([points_px[of_line == k] for k in np.unique(of_line)])
