"""Every face of a part in relief is reached, without a click and from any corner of the region."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereorig.core.field.points import features, fitter
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair, measure_shape
from stereorig.core.status import PointStatus
from stereorig.server.formats.results.summary import summarise
from tests.support.relief_rig import CYLINDER, HOLE, PLATEAU, RIDGE, WIRE, Body, Feature, Texture, trace, two_cameras
from tests.support.relief_truth import Part

SUBSET_PX = 21
OPTIONS = MeasureOptions(subset_px=SUBSET_PX, patch="affine")
SIZE = (320, 250)


HEIGHTS_MM = (9.0, 4.0, 12.0, 2.5, 7.0, 12.0, 3.0, 10.0, 5.5)


@pytest.fixture(scope="module")
def steps() -> Part:
    """A plate with nine pillars of 34 px, a subset and a half, up to 48 px of disparity high, and a low plateau."""
    pillars = [
        Feature(PLATEAU, (-8.5 + 7.5 * (k % 3), -7.0 + 7.0 * (k // 3)), (1.7, 1.7), height)
        for k, height in enumerate(HEIGHTS_MM)
    ]
    low = Feature(PLATEAU, (11.5, 0.0), (2.0, 6.0), 0.4)
    return Part(two_cameras(SIZE), (Body((*pillars, low), texture=Texture(wavelength_mm=0.7)),))


@pytest.fixture(scope="module")
def images(steps: Part) -> tuple[np.ndarray, np.ndarray]:
    return steps.images()


def placed(dx: int = 0, dy: int = 0) -> PointGrid:
    return PointGrid.rectangle(14.0 + dx, 14.0 + dy, 282.0 + dx, 214.0 + dy, spacing_px=5.0)


def shape_of(part: Part, images: tuple[np.ndarray, np.ndarray], grid: PointGrid, **more: object) -> Field:
    return measure_shape(part.pair, *images, grid, OPTIONS, **more)  # type: ignore[arg-type]


@pytest.mark.normal_depth("corner0")
@pytest.mark.parametrize("corner", [(0, 0), (6, 3), (10, 8)])
def test_all_pillars_are_reached_from_any_corner_of_the_region(
    steps: Part, images: tuple[np.ndarray, np.ndarray], corner: tuple[int, int]
) -> None:
    grid = placed(*corner)
    found = steps.beside_truth(shape_of(steps, images, grid), grid, SUBSET_PX)
    assert found.on_one_face.sum() > 500
    assert found.empty_faces == []
    assert found.unreached <= 0.01  # asked; what the validity checks refuse is theirs
    assert found.wrong == 0  # subsets on two faces included


def test_the_rim_of_a_hole_is_not_extended_into_it() -> None:
    hole = Feature(HOLE, (1.0, 0.5), (4.0, 4.0), 3.5)
    part = Part(two_cameras((200, 180)), (Body((hole,), texture=Texture(wavelength_mm=0.7)),))
    grid = PointGrid.rectangle(20.0, 20.0, 180.0, 160.0, spacing_px=3.0)
    field = measure_shape(part.pair, *part.images(), grid, MeasureOptions(subset_px=27))
    face = trace(part.cameras[0], part.bodies, grid.xy_px).face
    # by a sixth of a subset at most: so far the subset's centre holds some of the surface
    there = cv2.distanceTransform((face < 0).astype(np.uint8), cv2.DIST_L2, 5) * 3.0
    assert (there > 15.0).any()
    assert not (field.valid & (there > 27.0 / 6.0 + 3.0)).any()
    assert field.valid[there == 0.0].mean() > 0.6


def test_what_lies_behind_a_wire_is_not_delivered_before_it() -> None:
    wire = Feature(WIRE, (0.0, 0.0), (1.0, 40.0), 7.0, 0.3, 0.4)
    part = Part(two_cameras((200, 180)), (Body((wire,), texture=Texture(wavelength_mm=0.5)),))
    grid = PointGrid.rectangle(20.0, 20.0, 180.0, 160.0, spacing_px=2.0)
    found = part.beside_truth(measure_shape(part.pair, *part.images(), grid, OPTIONS), grid, SUBSET_PX)
    assert (found.face < -1).sum() > 100
    assert found.wrong == 0
    assert found.share > 0.99


def test_right_points_of_a_face_that_bends_and_beside_edges_are_kept_and_as_precise_as_reported() -> None:
    forms = (
        Feature(CYLINDER, (-6.0, 0.0), (4.0, 5.0), 6.0, np.radians(40.0)),
        Feature(RIDGE, (6.0, 0.0), (3.0, 5.0), 2.0, np.radians(35.0)),
    )
    part = Part(two_cameras((280, 200)), (Body(forms, texture=Texture(wavelength_mm=0.7)),))
    grid = PointGrid.rectangle(20.0, 20.0, 260.0, 176.0, spacing_px=6.0)
    field = measure_shape(part.pair, *part.images(), grid, OPTIONS)
    found = part.beside_truth(field, grid, SUBSET_PX)
    assert found.share > 0.99
    assert found.wrong == 0
    assert (field.status == PointStatus.NEIGHBOUR_MISMATCH).mean() < 0.05
    assert 0.9 < np.sqrt(np.mean(found.error_sigmas[field.valid] ** 2)) < 1.2  # the largest of three


def test_a_given_seed_adds_to_the_automatic_ones(steps: Part, images: tuple[np.ndarray, np.ndarray]) -> None:
    grid = placed()
    given = steps.beside_truth(shape_of(steps, images, grid, seeds=[(110.0, 130.0)]), grid, SUBSET_PX)
    assert given.empty_faces == []
    assert given.unreached <= 0.01
    assert given.wrong == 0


def test_a_given_seed_that_fails_is_named_and_the_field_measured_all_the_same(
    steps: Part, images: tuple[np.ndarray, np.ndarray]
) -> None:
    first, second = (image.copy() for image in images)
    bare = (slice(20, 70), slice(240, 310))
    first[bare] = 90  # no texture about the seed
    grid = placed()
    field = shape_of(steps, (first, second), grid, seeds=[(275.0, 45.0)])
    assert field.failed_seeds_px == ((275.0, 45.0),)
    assert summarise(field).document()["failed_seeds_px"] == ((275.0, 45.0),)
    far = (grid.x_px < 200) | (grid.y_px > 110)
    found = steps.beside_truth(field, grid, SUBSET_PX)
    # a twentieth is left to the validity checks
    assert (found.valid & found.on_one_face)[far].sum() >= 0.9 * found.on_one_face[far].sum()


def test_an_occluded_step_costs_no_search_of_features_and_few_more_fits(
    steps: Part, images: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = placed()
    reference = ReferencePair(steps.pair, *images)
    shape = reference.shape(grid, OPTIONS)
    before = reference.motion(*steps.images(seed=1), grid, OPTIONS, shape=shape)
    first, second = steps.images(seed=2)
    hidden = second.copy()
    hidden[:, : int(0.3 * SIZE[0])] = steps.images(seed=3)[0][::-1, ::-1][:, : int(0.3 * SIZE[0])]
    fitted: list[int] = []
    fit = fitter.fit_motion
    monkeypatch.setattr(fitter, "fit_motion", lambda *a: (fitted.append(len(a[5])), fit(*a))[1])
    good = reference.motion(first, second, grid, OPTIONS, shape=shape, previous=before)
    cost_of_a_good_one = sum(fitted)
    searched: list[int] = []
    monkeypatch.setattr(features, "_search", lambda *a: searched.append(1))
    fitted.clear()
    part = reference.motion(first, hidden, grid, OPTIONS, shape=shape, previous=before)
    assert good.valid.sum() > part.valid.sum() > 0.4 * good.valid.sum()
    assert not searched
    assert sum(fitted) <= 2 * cost_of_a_good_one  # asked of the time
