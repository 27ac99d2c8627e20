"""What a point sees: by a plain count over all pixels, pieces and neighbours."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stereorig.core.errors import RegionError
from stereorig.core.field.growth.grow import Attempts
from stereorig.core.field.region.cuts import Cuts, crosses
from stereorig.core.field.region.find_visible import MARGIN_PX, with_visibility
from stereorig.core.field.region.region import PointGrid, check_region
from stereorig.core.field.region.visibility import MIN_SHARE
from stereorig.core.field.seeding.local_fit import robust_local_fits
from stereorig.core.field.seeding.seeds import as_seeds, nearest_points

SUBSET = 21
KINKED = [(12.3, 50.2), (60.1, 48.7), (75.4, 80.9)]


def distance(p: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    """Distance of a position from a straight piece, by trying the foot and both ends."""
    length = math.dist(a, b)
    along = ((p[0] - a[0]) * (b[0] - a[0]) + (p[1] - a[1]) * (b[1] - a[1])) / length
    if 0.0 <= along <= length:
        return abs((p[0] - a[0]) * (b[1] - a[1]) - (p[1] - a[1]) * (b[0] - a[0])) / length
    return min(math.dist(p, a), math.dist(p, b))


def test_a_point_sees_what_the_definition_says() -> None:
    grid = PointGrid.rectangle(20.0, 20.0, 100.0, 100.0, spacing_px=7.0).with_cracks([KINKED])
    visibility = with_visibility(grid, SUBSET).visibility
    assert visibility is not None
    half = SUBSET // 2
    cut = 0
    for k, (x, y) in enumerate(grid.xy_px.reshape(-1, 2)):
        left, top = math.floor(x - half + 0.5), math.floor(y - half + 0.5)
        columns, rows = np.meshgrid(left + np.arange(SUBSET), top + np.arange(SUBSET))
        pixels = np.stack([columns, rows], axis=-1).astype(float)
        free = ~crosses(np.array([x, y]), pixels, grid.cuts)
        for r, c in np.ndindex(SUBSET, SUBSET):
            near = min(distance(tuple(pixels[r, c]), KINKED[i], KINKED[i + 1]) for i in range(2))
            free[r, c] &= near >= MARGIN_PX
        which = visibility.visible.of_point[k]
        seen = np.ones((SUBSET, SUBSET), bool) if which < 0 else visibility.visible.patches[which].astype(bool)
        np.testing.assert_array_equal(seen, free)
        assert visibility.share[k] == pytest.approx(free.mean())
        assert (which >= 0) == (not free.all())
        cut += int(which >= 0)
    assert 20 < cut < 120


def test_neighbours_that_a_crack_parts_are_none() -> None:
    grid = PointGrid.rectangle(20.0, 20.0, 100.0, 100.0, spacing_px=7.0).with_cracks([KINKED])
    visibility = with_visibility(grid, SUBSET).visibility
    assert visibility is not None
    rows, cols = grid.shape
    xy = grid.xy_px
    neighbours = Attempts.on(grid.shape, visibility).neighbours.reshape(rows, cols, 8)
    separated_count = 0
    for dr in range(-2, 3):
        for dc in range(-2, 3):
            if (dr, dc) == (0, 0):
                continue
            separated = visibility.separated_at(dr, dc).reshape(rows, cols)
            for r, c in np.ndindex(rows, cols):
                i, j = r + dr, c + dc
                if not (0 <= i < rows and 0 <= j < cols):
                    continue
                over = bool(crosses(xy[r, c], xy[i, j], grid.cuts))
                assert separated[r, c] == over
                separated_count += over
                if max(abs(dr), abs(dc)) == 1:
                    assert (i * cols + j in neighbours[r, c]) == (not over)
    assert separated_count > 100


def test_a_mask_is_seen_along_its_white_alone() -> None:
    """A white U: its arms do not see each other, though both lie in one subset."""
    mask = np.zeros((120, 120), bool)
    mask[10:110, 10:110] = True
    mask[10:90, 55:63] = False
    grid = PointGrid.rectangle(20.0, 20.0, 100.0, 104.0, spacing_px=6.0).within_mask(mask)
    visibility = with_visibility(grid, SUBSET).visibility
    assert visibility is not None
    col = int(np.flatnonzero(grid.x_px[0] == 50.0)[0])
    row = int(np.flatnonzero(grid.y_px[:, 0] == 44.0)[0])
    patch = visibility.visible.patches[visibility.visible.of_point[row * grid.shape[1] + col]]
    columns = 40 + np.arange(SUBSET)
    np.testing.assert_array_equal(patch.astype(bool), np.broadcast_to(columns <= 53, patch.shape))
    a, b = np.array([[50.0, 44.0], [50.0, 100.0]]), np.array([[68.0, 44.0], [68.0, 100.0]])
    assert visibility.are_separated(a, b).tolist() == [True, False]


def test_a_hole_takes_its_points_and_what_lies_behind_it() -> None:
    hole = [(40.0, 40.0), (60.0, 40.0), (60.0, 60.0), (40.0, 60.0)]
    grid = PointGrid.rectangle(20.0, 20.0, 80.0, 80.0, spacing_px=5.0).without_holes([hole])
    inside = (np.abs(grid.x_px - 50.0) <= 10.0) & (np.abs(grid.y_px - 50.0) <= 10.0)
    np.testing.assert_array_equal(grid.allowed, ~inside)
    assert grid.cuts is not None
    assert grid.cuts.lines_px[0].tolist() == [*map(list, hole), list(hole[0])]
    visibility = with_visibility(grid, SUBSET).visibility
    assert visibility is not None
    beside = visibility.visible.patches[visibility.visible.of_point[6 * grid.shape[1] + 3]].astype(bool)  # (35, 50)
    assert beside[:, : 40 - 2 - 25 + 1].all()
    assert not beside[10, 40 - 2 - 25 + 1 :].any()


def test_a_point_on_the_line_sees_nothing() -> None:
    grid = PointGrid.rectangle(20.0, 20.0, 80.0, 80.0, spacing_px=5.0).with_cracks([[(20.0, 50.0), (80.0, 50.0)]])
    visibility = with_visibility(grid, SUBSET).visibility
    assert visibility is not None
    np.testing.assert_array_equal(visibility.enough, grid.y_px != 50.0)
    assert (visibility.share[visibility.enough.ravel()] > MIN_SHARE).all()


def test_local_fits_use_visible_pixels_only() -> None:
    """A step across a line: at its lips a fit of all neighbours would be wrong by up to the step."""
    rng = np.random.default_rng(8)
    points = rng.uniform(0.0, 100.0, (600, 2))
    cuts = Cuts([[(0.0, 50.0), (100.0, 50.0)]])

    def value(xy: np.ndarray) -> np.ndarray:
        return np.where(xy[:, 1] > 50.0, 5.0, 0.0) + 0.05 * xy[:, 0] + 0.02 * xy[:, 1]

    positions = np.stack([np.linspace(10.0, 90.0, 30), np.full(30, 50.5)], axis=-1)
    options = {"tolerance": 20.0, "neighbours": 14}
    heard = robust_local_fits(
        positions, points, value(points)[:, None], are_separated=lambda a, b: crosses(a, b, cuts), **options
    )
    np.testing.assert_allclose(heard.value[:, 0], value(positions), atol=1e-9)
    plain = robust_local_fits(positions, points, value(points)[:, None], **options)
    assert np.abs(plain.value[:, 0] - value(positions)).max() > 1.0


def test_a_click_starts_on_its_own_side() -> None:
    """The nearest point lies just over the line."""
    grid = PointGrid.rectangle(20.0, 20.0, 80.0, 80.0, spacing_px=10.0).with_cracks([[(15.0, 49.0), (85.0, 49.0)]])
    visibility = with_visibility(grid, SUBSET).visibility
    xy, usable = grid.xy_px.reshape(-1, 2), np.ones(49, bool)
    seeds = as_seeds([(50.0, 48.0), (50.0, 51.0)])
    found = nearest_points(seeds, xy, usable, reach_px=20.0, visibility=visibility)
    assert xy[found].tolist() == [[50.0, 40.0], [50.0, 50.0]]
    with pytest.raises(RegionError) as caught:
        nearest_points(seeds, xy, usable & (xy[:, 1] > 49.0), reach_px=20.0, visibility=visibility)
    assert caught.value.code == "seed_outside"


def test_a_crack_outside_the_image_is_refused() -> None:
    grid = PointGrid.rectangle(20.0, 20.0, 80.0, 80.0, spacing_px=5.0).with_cracks([[(20.0, 50.0), (120.0, 50.0)]])
    with pytest.raises(RegionError) as caught:
        check_region(grid, image_shape=(100, 100), subset_px=SUBSET)
    assert caught.value.code == "cut_outside_image"


def test_without_anything_in_the_way_there_is_nothing_to_see() -> None:
    assert with_visibility(PointGrid.rectangle(20.0, 20.0, 80.0, 80.0, spacing_px=5.0), SUBSET).visibility is None
