"""Regions of several outlines: which points lie in them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from stereorig.core.errors import RegionError
from stereorig.core.field.region.lay_points import corners_px, lay_points
from stereorig.core.settings import Outline, Region
from stereorig.server.api.models import Region as RegionRequest

TRIANGLE = [(100, 20), (180, 20), (140, 90)]


def allowed(**region: object) -> set[tuple[float, float]]:
    grid = lay_points(Region.model_validate(region), 5, None)
    return set(zip(grid.x_px[grid.allowed].tolist(), grid.y_px[grid.allowed].tolist(), strict=True))


def test_points_lie_in_any_of_the_outlines_and_nowhere_else() -> None:
    found = allowed(outlines=[{"circle": [50, 60, 30]}, {"polygon": TRIANGLE}, {"rectangle": [60, 70, 90, 100]}])
    # by OpenCV's own rasteriser, on the grid that starts at the upper left corner of the box about all three
    drawn = np.zeros((130, 200), np.uint8)
    cv2.circle(drawn, (50, 60), 30, 255, -1)
    cv2.fillPoly(drawn, [np.array(TRIANGLE, np.int32)], 255)
    cv2.rectangle(drawn, (60, 70), (90, 100), 255, -1)
    grid = {(float(x), float(y)) for x in range(20, 181, 5) for y in range(20, 101, 5)}
    white = {(x, y) for x, y in grid if drawn[int(y), int(x)]}
    # a rasteriser widens slanted and round borders by up to a pixel: those points are left out of the comparison
    edge = cv2.morphologyEx(drawn, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    sure = {(x, y) for x, y in grid if not edge[int(y), int(x)]}
    assert found & sure == white & sure
    assert len(white & sure) > 100
    assert found <= grid
    assert {(50.0, 30.0), (60.0, 85.0), (90.0, 100.0)} <= found  # borders count as inside


def test_one_outline_gives_the_grid_that_the_same_rectangle_or_polygon_gives() -> None:
    for form, value in (("rectangle", [10.5, 20, 90, 61]), ("polygon", TRIANGLE)):
        assert allowed(outlines=[{form: value}]) == allowed(**{form: value})


def test_a_circles_corners_lie_on_it_and_its_chords_within_a_fiftieth_of_a_pixel() -> None:
    for radius in (3.0, 40.0, 900.0):
        v = corners_px(Outline(circle=(1000.0, 1000.0, radius))) - 1000.0
        assert np.allclose(np.hypot(*v.T), radius)
        sagitta = radius - np.hypot(*((v + np.roll(v, 1, axis=0)) / 2).T)
        assert sagitta.max() <= max(0.021, radius * (1 - np.cos(np.pi / 360)) + 1e-9)


def test_a_circle_that_leaves_the_outline_of_a_rectangle_turned_round_is_refused() -> None:
    with pytest.raises(RegionError, match="holds nothing"):
        allowed(outlines=[{"circle": [50, 60, 30]}, {"rectangle": [90, 100, 60, 70]}])


@pytest.mark.parametrize(
    "outline", [{}, {"circle": [5, 5, 0]}, {"circle": [5, 5, 3], "polygon": TRIANGLE}, {"rectangle": None}]
)
def test_an_outline_is_one_form_that_encloses_something(outline: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Outline.model_validate(outline)


def test_a_request_has_one_way_of_saying_its_region() -> None:
    circle = {"circle": [50, 60, 30]}
    assert RegionRequest.model_validate({"outlines": [circle]}).outlines[0].circle == (50, 60, 30)
    for region in ({"outlines": []}, {"outlines": [circle], "polygon": TRIANGLE}):
        with pytest.raises(ValidationError):
            RegionRequest.model_validate(region)
