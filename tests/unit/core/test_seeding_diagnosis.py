"""Why a field has no start: turned, mirrored and foreign images, and calibrations of another rig, are told apart."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.errors import SeedError
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.seeding.diagnosis import Diagnosis, diagnose, seed_error
from stereorig.core.field.seeding.epipolar_search import nominal_depth
from stereorig.core.measure import MeasureOptions, measure_motion, measure_shape
from tests.support.field_bench import SIZE, grid, pair, take

Image = NDArray[np.uint8]


def found(*images: NDArray[np.generic]) -> Diagnosis:
    one, two, *now = (MeasureImage(np.ascontiguousarray(image)) for image in images)
    return diagnose(pair(), (one, two), now, region_px=grid().extent_px)


@lru_cache
def texture(seed: int) -> Image:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(SIZE[1], SIZE[0])), (0, 0), 1.5)
    return np.clip(120 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


@lru_cache
def other_specimen() -> tuple[Image, Image]:
    """A plane with another texture at the rig's working distance: camera 2's image is camera 1's, seen from there."""
    one = texture(7)
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    corners = np.array([(20.0, 20.0), (240.0, 20.0), (240.0, 200.0), (20.0, 200.0)])
    seen = pair().image2_at_depth(corners, nominal_depth(pair()))
    back = cv2.getPerspectiveTransform(seen.astype(np.float32), corners.astype(np.float32))
    mapped = np.stack([x, y, np.ones_like(x)], axis=-1) @ back.T
    at = (mapped[..., :2] / mapped[..., 2:]).astype(np.float32)
    return one, cv2.remap(one, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


TURNS = {1: "turned by 90 degrees counter-clockwise", 2: "turned by 180 degrees", 3: "turned by 90 degrees clockwise"}


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_an_image_that_is_turned_is_named_with_its_angle(quarters: int) -> None:
    one, two = take("block")
    first, second = found(np.rot90(one, quarters), two), found(one, np.rot90(two, quarters))
    both = found(np.rot90(one, quarters), np.rot90(two, quarters))
    for diagnosis in (first, second, both):
        assert diagnosis.finding == "turned"
        assert TURNS[quarters] in diagnosis.text
    assert first.text.startswith("camera 1's image is turned")
    assert second.text.startswith("camera 2's image is turned")
    assert both.text.startswith("camera 1's image and camera 2's image are turned")


def test_a_mirrored_image_is_named() -> None:
    one, two = take("block")
    assert found(one[:, ::-1], two).text.startswith("camera 1's image is mirrored:")
    assert found(one, two[:, ::-1]).text.startswith("camera 2's image is mirrored:")
    assert found(one, two[::-1]).text.startswith("camera 2's image is mirrored and turned by 180 degrees:")
    assert found(one[:, ::-1], two[:, ::-1]).text.startswith("camera 1's image and camera 2's image are mirrored:")


@pytest.mark.parametrize("rows", [5, 23])
def test_a_calibration_of_another_rig_is_told_with_its_distance(rows: int) -> None:
    one, two = take("block")
    diagnosis = found(one, np.roll(two, rows, axis=0))
    assert diagnosis.finding == "off_epipolar_lines"
    assert diagnosis.epipolar_px == pytest.approx(rows, abs=0.3)  # the lines run nearly along the rows
    assert f"{diagnosis.epipolar_px:.3g} px (median)" in diagnosis.text


def test_different_surfaces_before_the_cameras_are_told() -> None:
    one, two = take("block")
    for diagnosis in (found(one, texture(1)), found(texture(1), texture(2))):
        assert diagnosis.finding == "different_surfaces"
        assert diagnosis.matches < 5
    blurred = found(one, cv2.GaussianBlur(two, (0, 0), 9.0))
    assert blurred.finding in ("different_surfaces", "few_features")
    assert "defocused" in blurred.text


def test_another_specimen_at_a_later_step_is_told() -> None:
    diagnosis = found(*take("block"), *other_specimen())
    assert diagnosis.finding == "other_specimen"
    assert diagnosis.matches >= 20
    assert diagnosis.matches_in_time is not None
    assert diagnosis.matches_in_time < 5


def test_turned_current_images_are_told_from_another_specimen() -> None:
    now1, now2 = take("block", 0.5)
    diagnosis = found(*take("block"), np.rot90(now1, 2), np.rot90(now2, 2))
    assert diagnosis.finding == "turned"
    assert "current image are turned by 180 degrees" in diagnosis.text


def test_right_images_are_not_accused() -> None:
    for images in (take("block"), (*take("block"), *take("block", 0.5))):
        diagnosis = found(*images)
        assert diagnosis.finding == "cameras_agree"
        assert diagnosis.epipolar_px is not None
        assert diagnosis.epipolar_px < 0.3


def test_no_texture_is_told() -> None:
    dull = np.full((SIZE[1], SIZE[0]), 90, np.uint8)
    dull[0, 0] = 91
    diagnosis = found(dull, take("block")[1])
    assert diagnosis.finding == "few_features"
    assert "camera 1's image shows 0 features" in diagnosis.text


def test_a_field_without_a_start_says_what_it_found() -> None:
    one, two = take("block")
    with pytest.raises(SeedError) as caught:
        measure_shape(pair(), one, np.roll(two, 23, axis=0), grid(), MeasureOptions(subset_px=21))
    assert caught.value.code == "not_seeded"
    assert caught.value.context["finding"] == "off_epipolar_lines"
    assert caught.value.context["epipolar_px"] == pytest.approx(23.0, abs=0.3)
    assert "calibration" in caught.value.remedy


def test_a_step_of_another_specimen_says_so() -> None:
    with pytest.raises(SeedError) as caught:
        measure_motion(pair(), *take("block"), *other_specimen(), grid(), MeasureOptions(subset_px=21))
    assert caught.value.context["finding"] == "other_specimen"
    assert caught.value.context["matches_in_time"] < 5


def test_a_noise_model_is_doubted_only_where_the_cameras_agree() -> None:
    agreeing = found(*take("block"))
    assert "noise model says 3.0 grey levels" in seed_error(agreeing, 9.0).remedy
    assert "noise model" not in seed_error(found(texture(1), texture(2)), 9.0).remedy
