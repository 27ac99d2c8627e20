"""Regions: which points are measured, and what is refused before anything is computed."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.errors import RegionError
from stereorig.core.field.region.region import PointGrid, check_region

IMAGE = (120, 200)  # rows, columns


def test_a_rectangle_ends_at_its_last_whole_step_and_includes_its_corner() -> None:
    grid = PointGrid.rectangle(20, 30, 80, 69, spacing_px=10)
    assert grid.x_px[0].tolist() == [20, 30, 40, 50, 60, 70, 80]
    assert grid.y_px[:, 0].tolist() == [30, 40, 50, 60]
    assert grid.allowed.all()


def test_positions_are_doubles_whatever_the_numbers_given_since_kernels_are_compiled_for_them() -> None:
    grid = PointGrid.rectangle(30, 40, 60, 80, spacing_px=10)
    assert grid.xy_px.dtype == np.float64
    assert grid.xy_px[1, 2].tolist() == [50.0, 50.0]


def test_a_fractional_step_does_not_lose_the_last_point_to_rounding() -> None:
    grid = PointGrid.rectangle(0.1, 0.0, 0.1 + 7 * 3.3, 33.0, spacing_px=3.3)
    assert grid.shape == (11, 8)


def test_a_polygon_keeps_what_lies_inside_even_where_it_is_concave() -> None:
    u_shape = [(0, 0), (30, 0), (30, 60), (50, 60), (50, 0), (80, 0), (80, 90), (0, 90)]
    grid = PointGrid.polygon(u_shape, spacing_px=10)
    inside = {(x, y) for x, y, a in zip(grid.x_px.flat, grid.y_px.flat, grid.allowed.flat, strict=True) if a}
    assert (40.0, 30.0) not in inside  # in the notch
    assert {(10.0, 30.0), (60.0, 30.0), (40.0, 80.0), (0.0, 0.0)} <= inside


def test_a_mask_is_white_where_points_may_lie() -> None:
    mask = np.zeros(IMAGE, np.uint8)
    mask[40:80, 50:150] = 255
    grid = PointGrid.rectangle(20, 20, 180, 100, spacing_px=10).within_mask(mask)
    x, y = grid.x_px[grid.allowed], grid.y_px[grid.allowed]
    assert (x.min(), x.max(), y.min(), y.max()) == (50, 140, 40, 70)
    own = PointGrid.mask(mask, spacing_px=10)
    assert own.extent_px == (50, 40, 149, 79)


def test_only_points_with_their_whole_subset_in_the_image_are_measured() -> None:
    grid = PointGrid.rectangle(0, 0, 199, 119, spacing_px=1)
    fits = check_region(grid, image_shape=IMAGE, subset_px=33)
    x, y = grid.x_px[fits], grid.y_px[fits]
    assert (x.min(), x.max(), y.min(), y.max()) == (16, 183, 16, 103)


@pytest.mark.fault(40)
@pytest.mark.parametrize(
    ("rectangle", "subset", "code"),
    [
        ((500, 500, 600, 600), 33, "region_outside_image"),
        ((-40, 20, 100, 100), 33, "region_outside_image"),
        ((20, 20, 260, 100), 33, "region_outside_image"),
        ((50, 20, 50, 100), 33, "region_too_small"),
        ((50, 20, 70, 100), 33, "region_too_small"),
        ((20, 20, 180, 100), 32, "subset_invalid"),
        ((20, 20, 180, 100), 3, "subset_invalid"),
        ((0, 0, 199, 119), 121, "region_too_small"),
    ],
)
def test_a_region_that_leaves_nothing_is_refused(rectangle: tuple[float, ...], subset: int, code: str) -> None:
    with pytest.raises(RegionError) as error:
        check_region(PointGrid.rectangle(*rectangle, spacing_px=10), image_shape=IMAGE, subset_px=subset)
    assert error.value.code == code


def test_a_mask_that_leaves_no_point_or_has_another_size_is_refused() -> None:
    grid = PointGrid.rectangle(20, 20, 180, 100, spacing_px=10)
    speck = np.zeros(IMAGE, bool)
    speck[55, 55] = True  # between the points
    with pytest.raises(RegionError) as error:
        check_region(grid.within_mask(speck), image_shape=IMAGE, subset_px=33)
    assert error.value.code == "region_empty"
    with pytest.raises(RegionError) as error:
        check_region(grid, image_shape=IMAGE, subset_px=33, mask_shape=(120, 199))
    assert error.value.code == "mask_size"
    with pytest.raises(RegionError, match="no white pixel"):
        PointGrid.mask(np.zeros(IMAGE), spacing_px=10)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(RegionError):
        PointGrid.rectangle(20, bad, 180, 100, spacing_px=10)
    with pytest.raises(RegionError):
        PointGrid.polygon([(0, 0), (bad, 0), (0, 40)], spacing_px=10)
    with pytest.raises(RegionError):
        PointGrid.rectangle(20, 20, 180, 100, spacing_px=bad)


def test_a_polygon_without_area_is_refused() -> None:
    with pytest.raises(RegionError, match="no area"):
        PointGrid.polygon([(0, 0), (10, 10), (20, 20)], spacing_px=5)
