"""Offsets of a step's own images: the same whatever else is being made of these images meanwhile."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.seeding.seeds import Seed
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.orientation.step import enough_points, step_points
from tests.support.disc_images import cameras_beside, discs

SIZE, DISPARITY_PX = 200, 6.0
BESIDE = cameras_beside(SIZE)


@pytest.mark.parametrize("given", [True, False])
def test_gradients_that_another_match_has_made_change_no_offset(given: bool) -> None:
    def pictures(moved_px: float) -> list[np.ndarray]:
        return [discs(SIZE, 4, shift_px=moved_px + shift) for shift in (0.0, -DISPARITY_PX)]

    options = MeasureOptions(subset_px=21, patch="affine")
    grid = PointGrid.rectangle(30, 30, SIZE - 30, SIZE - 30, spacing_px=10)
    reference = ReferencePair(BESIDE, *pictures(0.0))
    seeds = [Seed(xy_px=(100.0, 100.0), xy2_px=(100.0 - DISPARITY_PX, 100.0))]
    shape = reference.shape(grid, options, seeds=seeds)
    now = pictures(0.3)
    motion = reference.motion(*now, grid, options, shape=shape)
    slopes = reference.image1.prepared("quintic").slopes if given else None
    found = []
    for made in (False, True):
        one, two = (MeasureImage(picture) for picture in now)
        if made:
            assert one.prepared("quintic").gradients[0].shape == (SIZE, SIZE)
        points = step_points(BESIDE, motion, one, two, options, slopes)
        assert points is not None
        found.append(np.concatenate([points.xy1_px, points.xy2_px], axis=1))
    assert len(found[0]) > 50
    assert np.array_equal(found[0], found[1])


@pytest.mark.parametrize(("noise_px", "points"), [(0.001, 256), (0.008, 576), (0.05, 1000)])
def test_as_many_points_are_matched_as_make_noise_small_whatever_the_calibrations_own_offset(
    noise_px: float, points: int
) -> None:
    """The mean's standard deviation is 0.0005 px where a pair alone has one and a half times the motion's noise."""
    x = np.tile(np.arange(50.0, 1050.0, 10.0), (80, 1))
    own = 0.04 * (x / 1000.0) ** 2 - 0.05 * x / 800.0
    rng = np.random.default_rng(2)
    field: Any = SimpleNamespace(x_px=x, epipolar_px=own + rng.normal(0.0, noise_px, x.shape))
    assert enough_points(field, 33) == pytest.approx(points, rel=0.12)
    field.epipolar_px[::2] = np.nan
    assert enough_points(field, 33) == pytest.approx(points, rel=0.17)
