"""Scatter of points that did not move, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field

_PLANE = 3  # unknowns of the plane that is taken off
LEAST = 12.0  # independent values, below which a scatter says nothing
_SHARED = 0.25  # correlation of two steps' squares: half of each variance is the reference pair's


@dataclass(frozen=True)
class Scatter:
    """Standard deviation over the points, its standard uncertainty, and the root mean square of what is reported."""

    sd: float
    u: float
    reported: float


def thinned(field: Field, every: int) -> Field:
    """Return the field with every so many of its rows and columns, with the points' own errors alone."""
    kept: dict[str, Any] = {}
    for one in fields(field):
        value = getattr(field, one.name)
        if isinstance(value, np.ndarray) and value.shape[:2] == field.shape:
            kept[one.name] = value[::every, ::every]
    return replace(field, **kept, common=None, causes=None, references=None, rejected=None, starts=None)


def scatter(
    values: Sequence[Float], sigma: Sequence[Float], width_px: float, spacing_px: float, *, about_zero: bool = False
) -> Scatter | None:
    """Return the scatter of static steps; None with too few independent values.

    Parameters
    ----------
    values, sigma
        By step (r, c); NaN where there is none.
    width_px
        Values nearer to each other than this have pixels in common.
    spacing_px
        Distance of neighbouring points.
    about_zero
        True for strains, which no rigid motion changes; displacements scatter about each step's plane.
    """
    taken = 0 if about_zero else _PLANE
    squares, independent, stated = [], [], []
    for of_step, known in zip(values, sigma, strict=True):
        row, col = np.nonzero(np.isfinite(of_step))
        count = len(row) * min(1.0, (spacing_px / width_px) ** 2)
        if count < LEAST:
            continue
        A = np.stack([np.ones(len(row)), row, col], axis=1)
        left = of_step[row, col]
        if not about_zero:
            left = left - A @ np.linalg.lstsq(A, left, rcond=None)[0]
        # the plane takes its share of the independent values, of which there are fewer than points
        squares.append(float(left @ left) / len(row) * count / (count - taken))
        independent.append(count - taken)
        stated.append(float(np.mean(known[row, col] ** 2)))
    if not squares:
        return None
    steps = len(squares) / (1.0 + _SHARED * (len(squares) - 1))
    sd = float(np.sqrt(np.mean(squares)))
    return Scatter(sd, sd / float(np.sqrt(2.0 * steps * np.mean(independent))), float(np.sqrt(np.mean(stated))))
