"""Plain centres beside gaps: the end of a surface, unless the texture itself is as plain amid the field."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.field.checks.blank_centres import reject_blank_centres
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.status import PointStatus

SUBSET_PX, SPACING_PX, COUNT, NOISE = 27, 6.0, 40, 2.0
SHAPE = (COUNT, COUNT)
X, Y = np.meshgrid(20.0 + SPACING_PX * np.arange(COUNT), 20.0 + SPACING_PX * np.arange(COUNT))
XY = np.stack([X.ravel(), Y.ravel()], axis=-1)
HOLE = np.hypot(X - 140.0, Y - 140.0).ravel()


def picture(cell_px: int) -> np.ndarray:
    """Squares of random grey, ``cell_px`` wide, with noise: plain within each."""
    rng = np.random.default_rng(1)
    size = 280
    cells = rng.uniform(40.0, 210.0, (size // cell_px + 1,) * 2)
    image = np.kron(cells, np.ones((cell_px, cell_px)))[:size, :size]
    return image + rng.normal(0.0, NOISE, image.shape)


def rejected(image: np.ndarray, unmatched: np.ndarray) -> np.ndarray:
    points = PointFits.empty(COUNT * COUNT, 1)
    points.status[:] = np.where(unmatched, PointStatus.LOW_CORRELATION, PointStatus.OK)
    points.noise[:] = NOISE
    measured = MeasureImage(np.clip(np.round(image), 0, 255).astype(np.uint8))
    reject_blank_centres(
        points,
        shape=SHAPE,
        texture=measured.subset_variance(XY, SUBSET_PX),
        taken=measured.pixels,
        image=measured.pixels,
        xy_px=XY,
        subset_px=SUBSET_PX,
        spacing_px=SPACING_PX,
    )
    return points.status == PointStatus.LOW_TEXTURE


def test_points_over_a_hole_are_rejected_beside_those_that_found_no_match_there() -> None:
    image = picture(3)
    y, x = np.mgrid[:280, :280]
    image[np.hypot(x - 140, y - 140) < 25] = 30.0
    out = rejected(image, HOLE < 8.0)
    over = (HOLE >= 8.0) & (HOLE < 15.0)
    assert out[over].all()
    assert not out[HOLE > 40.0].any()


def test_points_between_the_dots_of_a_coarse_texture_are_kept_beside_a_gap() -> None:
    out = rejected(picture(14), HOLE < 40.0)  # squares wider than a subset's centre
    assert not out.any()


@pytest.mark.parametrize("hole_px", [26, 34])
def test_points_over_a_hole_that_every_subset_reaches_across_are_rejected_though_all_matched(hole_px: int) -> None:
    image = picture(3)
    y, x = np.mgrid[:280, :280]
    image[np.hypot(x - 140, y - 140) < hole_px / 2] = 30.0
    out = rejected(image, np.zeros(COUNT * COUNT, bool))
    beyond_rim = HOLE - hole_px / 2
    assert out[beyond_rim < -3.0].all()
    assert not out[beyond_rim > SUBSET_PX / 3.0].any()


def test_a_plain_spot_that_is_narrower_than_half_a_subset_loses_no_point() -> None:
    image = picture(3)
    image[134:146, 134:146] = 30.0
    assert not rejected(image, np.zeros(COUNT * COUNT, bool)).any()


def test_a_coarse_texture_loses_no_point_where_all_matched() -> None:
    assert not rejected(picture(14), np.zeros(COUNT * COUNT, bool)).any()
