"""Where the axes of a field's numbers point in a figure."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.server.formats.figures.axes import directions_of
from stereorig.server.formats.figures.figure import FigureData, Frames
from stereorig.server.formats.figures.options import FigureStyle

X_PX, Y_PX = np.meshgrid(np.arange(50.0, 200.0, 10.0), np.arange(40.0, 160.0, 10.0))


def turned(degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Millimetres along axes that are turned clockwise in the image, one pixel 20 um."""
    a = np.radians(degrees)
    return 0.02 * (np.cos(a) * X_PX + np.sin(a) * Y_PX), 0.02 * (np.cos(a) * Y_PX - np.sin(a) * X_PX)


@pytest.mark.parametrize("degrees", [0.0, 45.0, -100.0])
def test_the_axes_point_where_their_coordinates_grow(degrees: float) -> None:
    x_mm, y_mm = turned(degrees)
    x_mm[3, 4] = np.nan
    a = np.radians(degrees)
    found = directions_of(X_PX, Y_PX, x_mm, y_mm)
    assert found is not None
    assert np.ravel(found) == pytest.approx([np.cos(a), np.sin(a), -np.sin(a), np.cos(a)], abs=1e-9)


def test_too_few_points_have_no_axes() -> None:
    x_mm, y_mm = turned(0.0)
    assert directions_of(X_PX[:1], Y_PX[:1], x_mm[:1], y_mm[:1]) is None
    assert directions_of(X_PX, Y_PX, np.full_like(X_PX, np.nan), y_mm) is None


def test_the_triad_is_drawn_in_the_lower_left_corner_of_the_map_alone() -> None:
    x_mm, y_mm = turned(45.0)
    plain = FigureData(np.zeros_like(X_PX), X_PX, Y_PX, "w", "mm", "a test")
    with_axes = FigureData(
        np.zeros_like(X_PX), X_PX, Y_PX, "w", "mm", "a test", axes=directions_of(X_PX, Y_PX, x_mm, y_mm)
    )
    style = FigureStyle(limits=(-1.0, 1.0))
    before, after = Frames(plain, style).first(), Frames(with_axes, style).first()
    rows, cols = np.nonzero((before != after).any(axis=2))
    assert len(rows) > 200
    assert cols.max() < before.shape[1] / 4
    assert rows.min() > before.shape[0] / 2
