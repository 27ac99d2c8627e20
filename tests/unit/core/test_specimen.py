"""The specimen found in a pair of images, on pictures whose outline is drawn: a plate with a hole on backgrounds."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import ImageError, RegionError, SeedError
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.region.textured import texture_map
from stereorig.core.field.seeding.specimen import Specimen, find_specimen
from tests.support import field_bench

SUBSET = 21
SIZE = (512, 480)
Image = NDArray[np.uint8]
PLATE = np.array([(120, 90), (400, 110), (380, 380), (230, 400), (110, 330)], np.int32)
HOLE = ((250, 230), 34)


@lru_cache
def pair() -> StereoPair:
    return StereoPair(field_bench.rig().cam1.camera, field_bench.rig().cam2.camera)


def white(seed: int, blur_px: float, sd: float) -> NDArray[Any]:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SIZE[::-1]), (0, 0), blur_px)
    return np.asarray(sd * noise / noise.std())


@lru_cache
def drawn() -> NDArray[np.bool_]:
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillPoly(mask, [PLATE], 1)
    cv2.circle(mask, *HOLE, 0, -1)
    return np.asarray(mask > 0)


def in_camera2(xy_px: NDArray[Any]) -> NDArray[Any]:
    """Where camera 2 sees what camera 1 sees at positions (..., 2) of the plane Z = 0 of the system frame."""
    sys_from_cam = pair().cam1.cam_from_sys.inverse()
    ray = pair().cam1.rays_cam(xy_px).xyz_mm @ sys_from_cam.rotation.T
    centre = sys_from_cam.translation_mm
    return np.asarray(pair().cam2.project(centre - ray * (centre[2] / ray[..., 2])[..., None]).xy)


def seen_by_camera2(image: NDArray[Any], outside: float | NDArray[Any]) -> NDArray[Any]:
    """Warp what lies on that plane from camera 1's image to camera 2's."""
    corners = np.array([(60.0, 60.0), (450.0, 60.0), (450.0, 420.0), (60.0, 420.0)])
    # both lenses' distortion over the plate is some hundredths of a pixel: a homography serves
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), in_camera2(corners).astype(np.float32))
    warped = cv2.warpPerspective(image, H, SIZE, flags=cv2.INTER_CUBIC)
    inside = cv2.warpPerspective(drawn().astype(np.float32), H, SIZE, flags=cv2.INTER_LINEAR)
    return np.asarray(np.where(inside > 0.5, warped, outside))


BACKGROUNDS: dict[str, tuple[Any, Any]] = {
    "plain": (60.0, 60.0),
    "shaded": (np.linspace(20.0, 110.0, SIZE[0])[None, :], np.linspace(110.0, 20.0, SIZE[0])[None, :]),
    "dark": (4.0, 4.0),
    # a background out of focus: speckles seven times as wide, of the same contrast
    "blurred": (90.0 + white(11, 11.0, 30.0), 90.0 + white(12, 11.0, 30.0)),
    "another texture in each camera": (110.0 + white(13, 1.6, 35.0), 110.0 + white(14, 1.6, 35.0)),
}


def picture(background: str, *, noise: float = 2.0, light: float = 0.0, speckle_px: float = 1.6) -> tuple[Image, Image]:
    """Both cameras' images; ``light`` makes the left edge so much darker than the right one."""
    one, two = BACKGROUNDS[background]
    dim = 1.0 - light * np.linspace(1.0, 0.0, SIZE[0])[None, :]
    plate = (110.0 + white(1, speckle_px, 35.0)) * dim
    rng = np.random.default_rng(2)
    images = (np.where(drawn(), plate, one), seen_by_camera2(plate, two))
    first, second = (
        np.clip(np.rint(image + noise * rng.standard_normal(image.shape)), 0, 255).astype(np.uint8) for image in images
    )
    return first, second


def found(images: tuple[Image, Image], subset_px: int = SUBSET) -> Specimen:
    return find_specimen(pair(), MeasureImage(images[0]), MeasureImage(images[1]), subset_px=subset_px)


def disc(radius_px: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1,) * 2), np.uint8)


def is_the_plate(specimen: Specimen, within_px: int, plate: NDArray[np.bool_] | None = None) -> None:
    """The plate's inner part is all there, and nothing lies further out than ``within_px``."""
    plate = drawn() if plate is None else plate
    inner = cv2.erode(plate.astype(np.uint8), disc(within_px)) > 0
    outer = cv2.dilate(plate.astype(np.uint8), disc(within_px)) > 0
    assert specimen.mask[inner].mean() > 0.999
    # where a blurred blob's edge touches the plate's, some pixels more
    assert (specimen.mask & ~outer).sum() < 0.004 * plate.sum()


# a square of 21 px notices texture to within a tenth of its width, corners to a fifth
WITHIN_PX = 6


@pytest.mark.parametrize("background", BACKGROUNDS)
def test_the_specimen_is_found_on_its_background(background: str) -> None:
    if background == "another texture in each camera":
        # the same texture all over camera 1's image: matches alone tell, and reach some subsets beyond the edge
        specimen = found(picture(background))
        assert specimen.mask[drawn()].mean() > 0.99
        assert specimen.share < 0.75
        return
    specimen = found(picture(background))
    is_the_plate(specimen, WITHIN_PX)
    assert len(specimen.outlines_px) == 1
    assert len(specimen.holes_px) == 1
    moments = cv2.moments(specimen.holes_px[0].astype(np.float32))
    middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    assert np.linalg.norm(middle - np.array(HOLE[0])) < 3.0
    filled = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillPoly(filled, [np.rint(specimen.outlines_px[0]).astype(np.int32)], 1)
    cv2.fillPoly(filled, [np.rint(specimen.holes_px[0]).astype(np.int32)], 0)
    assert (filled > 0)[specimen.mask].mean() > 0.98  # the corners of the outline are what the mask is


@pytest.mark.parametrize(("noise", "light"), [(8.0, 0.0), (2.0, 0.8), (0.0, 0.0)])
def test_noise_and_uneven_light_do_not_hide_it(noise: float, light: float) -> None:
    is_the_plate(found(picture("dark", noise=noise, light=light)), WITHIN_PX)


@pytest.mark.parametrize(("speckle_px", "subset_px"), [(1.0, 21), (3.0, 31), (4.0, 41)])
def test_fine_and_coarse_speckles_leave_no_gaps_in_it(speckle_px: float, subset_px: int) -> None:
    is_the_plate(found(picture("dark", speckle_px=speckle_px), subset_px), subset_px // 3)


def test_a_larger_subset_finds_the_same_edge() -> None:
    is_the_plate(found(picture("plain"), 41), 9)  # a fifth of its width


def test_a_jpeg_of_low_quality_does_not_make_its_blocks_a_texture() -> None:
    images = []
    for image in picture("shaded"):
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 25])[1]
        images.append(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))
    is_the_plate(found((images[0], images[1])), WITHIN_PX)


@pytest.mark.parametrize("name", ["block", "sphere"])
def test_a_background_that_matches_too_may_be_measured(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = field_bench.take(name)
    specimen = find_specimen(field_bench.pair(), MeasureImage(one), MeasureImage(two), subset_px=SUBSET)
    # what camera 2 sees of the plane about which they lie, by the cameras alone
    monkeypatch.setattr("tests.unit.core.test_specimen.pair", field_bench.pair)
    x, y = np.meshgrid(np.arange(one.shape[1], dtype=float), np.arange(one.shape[0], dtype=float))
    there = in_camera2(np.stack([x, y], axis=-1))
    low, high = np.array([12.0, 12.0]), np.array(two.shape[::-1]) - 13.0
    inside = ((there > low) & (there < high)).all(axis=-1)
    assert specimen.mask[inside].mean() > 0.99


def test_edges_of_one_direction_and_noise_are_no_texture() -> None:
    rng = np.random.default_rng(4)
    bars = 60.0 + 60.0 * ((np.arange(200) // 7) % 2)
    for clean in (np.full((200, 200), 80.0), np.tile(bars, (200, 1)), np.tile(bars, (200, 1)).T):
        image = clean + 5.0 * rng.standard_normal((200, 200))
        texture = texture_map(image.astype(np.float32), 21)
        # of noise alone the share scatters by 0.05 over 21 x 21 px
        assert np.quantile(texture.structured, 0.99) < 0.2
    speckles = texture_map((100.0 + white(5, 1.2, 30.0) + 5.0 * rng.standard_normal(SIZE[::-1])).astype(np.float32), 21)
    assert np.quantile(speckles.structured, 0.01) > 0.3


def test_bands_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    image = picture("blurred")[0]
    whole = texture_map(image, 33)
    monkeypatch.setattr("stereorig.core.field.region.textured._BAND_PIXELS", 20_000)
    parts = texture_map(image, 33)
    for name in ("strength", "structured", "mean"):
        # sums of a band start from its own mean: float32
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=2e-4, atol=2e-3)


def test_nothing_to_find_is_said() -> None:
    rng = np.random.default_rng(6)
    noise = [rng.normal(90.0, 4.0, SIZE[::-1]).round().astype(np.uint8) for _ in range(2)]
    with pytest.raises(ImageError) as blank:
        found((noise[0], noise[1]))
    assert blank.value.code == "image_blank"
    one, other = (np.clip(np.rint(110.0 + white(seed, 1.6, 35.0)), 0, 255).astype(np.uint8) for seed in (13, 14))
    with pytest.raises(SeedError):
        found((one, other))
    with pytest.raises(RegionError) as caught:
        found(picture("plain"), 201)
    assert caught.value.code == "region_not_found"
