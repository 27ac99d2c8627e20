"""Test for corners of a checkerboard outside those found: the board then has more corners than were declared."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float, Float32
from stereorig.core.boards.refine import sample

_OF_INNER = 0.75  # share of the inner corners' contrast; at a board's own rim, on a light margin, half of it is left
_MOST = 0.7  # share of a side's places that must show a corner
_LEAST_PLACES = 3
_REACH = (0.2, 0.28)  # parts of a square along both edges at which the light and dark are sampled


def extends_beyond(grey: Float32, corners_px: Float) -> bool:
    """Return True if the image shows corners of the same board one square outside the outermost ones on some side.

    Parameters
    ----------
    grey
        (rows, columns) image.
    corners_px
        (columns, rows, 2) corners found.
    """
    along, across = np.gradient(corners_px, axis=0), np.gradient(corners_px, axis=1)
    inner = float(np.median(np.abs(_saddle(grey, corners_px, along, across))))
    size = np.array([grey.shape[1], grey.shape[0]]) - 1.0
    for axis in (0, 1):
        for end in (0, -1):
            rim = np.take(corners_px, end, axis=axis)
            before = np.take(corners_px, 1 if end == 0 else -2, axis=axis)
            place = 2.0 * rim - before
            steps = [np.take(s, end, axis=axis) for s in (along, across)]
            reach = 0.3 * np.abs(np.stack(steps)).sum(axis=0)
            inside = ((place > reach) & (place < size - reach)).all(axis=-1)
            if inside.sum() < _LEAST_PLACES:
                continue
            strength = np.abs(_saddle(grey, place[inside], steps[0][inside], steps[1][inside]))
            if np.mean(strength > _OF_INNER * inner) > _MOST:
                return True
    return False


def _saddle(grey: Float32, places_px: Float, along: Float, across: Float) -> Float:
    """Difference of the squares on both diagonals of each place, (...)."""
    total = np.zeros(places_px.shape[:-1])
    for reach in _REACH:
        a, b = reach * (along + across), reach * (along - across)
        total += sample(grey, places_px + a) + sample(grey, places_px - a)
        total -= sample(grey, places_px + b) + sample(grey, places_px - b)
    return total
