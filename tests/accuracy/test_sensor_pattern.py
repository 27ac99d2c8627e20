"""What sits on the sensor: dead and hot pixels, fixed columns and pixels, and noise of lines new in each frame.

Pictures of `tests.support.matching_scene`, which interpolates nothing; the plane's motion is the truth.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import ImageError
from stereorig.core.field.common import with_common_parts
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.region import PointGrid
from stereorig.core.gauge.area import area_statistics
from stereorig.core.gauge.reading import difference
from stereorig.core.matching.defects import find_defects, line_covariance, strips_along
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.names import CAMERAS
from stereorig.core.noise import NoiseModel, measure_noise, measure_pattern
from stereorig.core.systematic.sensor_pull import fixed_lines
from stereorig.server.formats.noise_json import load_noise, noise_content, write_noise
from tests.support.matching_scene import Plane, Texture, render

SIZE, SUBSET, PX_MM = 256, 21, 0.0333
OPTIONS = MeasureOptions(subset_px=SUBSET, patch="affine")
GRID = PointGrid.rectangle(22.0, 22.0, SIZE - 23.0, SIZE - 23.0, spacing_px=14.0)
MOVED = 0.3 * PX_MM, 0.1 * PX_MM, 0.0


@cache
def cameras() -> StereoPair:
    def camera(gamma_deg: float, x0: float) -> Camera:
        return Camera.from_paper(
            phd_px=12000.0,
            cx_px=0.5 * SIZE + 3.0,
            cy_px=0.5 * SIZE - 2.0,
            kappa_per_px2=0.0,
            aspect=1.0,
            alpha_rad=0.0,
            beta_rad=0.002,
            gamma_rad=np.deg2rad(gamma_deg),
            x0_mm=x0,
            y0_mm=0.03,
            z0_mm=400.0,
        )

    return StereoPair(camera(-12.5, 0.02), camera(12.5, -0.05))


@cache
def clean() -> tuple[np.ndarray, ...]:
    """Both cameras' pictures before and after, contrast about 0.5 of full scale."""
    texture = Texture(blob_mm=1.8 * PX_MM, extent_mm=0.95 * PX_MM * SIZE)
    planes = Plane(), Plane(origin=np.array(MOVED))
    pair = cameras()
    return tuple(
        128.0 + 0.65 * (render(camera, plane, texture, size=SIZE) - 120.0)
        for plane in planes
        for camera in (pair.cam1, pair.cam2)
    )


def taken(seed=0, *, noise=2.0, columns=0.0, pixels=0.0, new_columns=0.0, new_rows=0.0, wide_px=0.0, defects=0.0):
    """The four pictures as a sensor delivers them, and the mask of each camera's defective pixels."""
    rng, own = np.random.default_rng(seed), np.random.default_rng(1000 + seed)
    shape = clean()[0].shape
    fixed = [columns * own.standard_normal(SIZE)[None] + pixels * own.standard_normal(shape) for _ in range(2)]
    dead = [own.random(shape) < defects for _ in range(2)]
    stuck = [np.where(own.random(shape) < 0.5, 0.0, 255.0) for _ in range(2)]
    out = []
    for k, image in enumerate(clean()):
        white = rng.standard_normal(shape)
        if wide_px:
            white = gaussian_filter(white, wide_px, mode="wrap")
            white /= white.std()
        lines = new_columns * rng.standard_normal(SIZE)[None] + new_rows * rng.standard_normal(SIZE)[:, None]
        grey = np.where(dead[k % 2], stuck[k % 2], image + fixed[k % 2] + noise * white + lines)
        out.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    return out, dead


def measured(images):
    """Shape and motion, the latter with what is common in its uncertainty."""
    pair, reference = cameras(), ReferencePair(cameras(), *images[:2])
    shape = reference.shape(GRID, OPTIONS)
    motion = reference.motion(*images[2:], GRID, OPTIONS, shape=shape)
    before, now = (MeasureImage(image).prepared("quintic") for image in images[::2])
    lines = fixed_lines(motion, pair, before, now, subset_px=SUBSET)
    return shape, with_common_parts(motion, None, pair, None if lines is None else lines.pull_mm), lines


def over_sigma(shape, motion):
    """Errors over sigma: rms of depth, rms of u, v, w, and of their means over the field."""
    xy = GRID.xy_px.reshape(-1, 2)
    plane = {"point_sys_mm": np.zeros(3), "normal_sys": np.array([0.0, 0.0, 1.0])}
    true = cameras().cam1.back_project_to_plane(xy, **plane).xyz_mm.reshape(*GRID.shape, 3)
    depth = ((shape.xyz_mm - true) / shape.sigma_mm)[shape.valid][:, 2]
    error = motion.uvw_mm - np.array(MOVED)
    each = (error / motion.sigma_mm[..., 3:])[motion.valid]
    own = np.sqrt(np.diagonal(motion.covariance, axis1=2, axis2=3)[..., 3:])
    means = []
    for k in range(3):
        common = None if motion.common is None else motion.common[..., 3 + k, :]
        found = area_statistics(
            motion, error[..., k], own[..., k], motion.valid, shared=SharedPixels.of(motion, SUBSET), common=common
        )
        means.append(found.mean / found.mean_sigma)
    return np.array([np.sqrt(np.mean(depth**2)), *np.sqrt(np.mean(each**2, axis=0)), *means])


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def test_one_per_cent_of_defective_pixels_costs_no_right_point():
    """15 % of right points were lost, half of them on this texture."""
    found = []
    for seed in range(2):
        images, dead = taken(seed, defects=0.01)
        for image, mask in zip(images, 2 * dead, strict=True):
            where = find_defects(image).where
            assert np.isin(where, np.flatnonzero(mask)).all()
            assert len(where) > 0.98 * mask.sum()
        shape, motion, _ = measured(images)
        assert min(shape.valid.mean(), motion.valid.mean()) >= 0.99
        found.append(over_sigma(shape, motion))
    assert np.all((rms(found)[:4] > 0.85) & (rms(found)[:4] < 1.15)), rms(found)


@pytest.mark.parametrize("radius_px", [0.75, 1.0, 1.5, 2.5, 4.0])
@pytest.mark.parametrize("count", [60, 600, 6000])
def test_specks_of_any_size_are_no_defects(radius_px, count):
    """Through a lens that is sharper than any (sd 0.3 px); a dot may look like a defect where it lies on a pixel."""
    rng, fine = np.random.default_rng(count), 8
    canvas = np.zeros((200 * fine, 200 * fine), np.float32)
    for x, y in rng.integers(0, 200 * fine, (count, 2)).tolist():
        cv2.circle(canvas, (x, y), round(radius_px * fine), 1.0, -1)
    sharp = gaussian_filter(canvas, 0.3 * fine).reshape(200, fine, 200, fine).mean(axis=(1, 3))
    grey = 40.0 + 170.0 * sharp + rng.normal(0.0, 2.0, sharp.shape)
    found = find_defects(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    assert found is None or len(found.where) <= 2


def test_images_without_defects_and_lines_are_measured_as_before():
    images, _ = taken()
    assert all(find_defects(image) is None for image in images)
    shape, motion, lines = measured(images)
    assert lines is None
    assert motion.common is None
    assert np.all(np.abs(rms([over_sigma(shape, motion)])[:4] - 1.0) < 0.15)


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_a_fixed_pattern_is_in_the_sigma_of_points_and_of_means(strength):
    """Columns of 1.5 and pixels of 1 grey level, as an ordinary camera has: means over the field were 4 sigma off."""
    found, without = [], []
    for seed in range(4):
        images, _ = taken(seed, columns=1.5 * strength, pixels=1.0 * strength)
        shape, motion, lines = measured(images)
        assert lines.columns_grey2 == pytest.approx((1.5 * strength) ** 2, rel=0.3)
        assert lines.rows_grey2 == 0.0
        found.append(over_sigma(shape, motion))
        without.append(over_sigma(shape, replace(motion, common=None)))
    assert np.all((rms(found)[:4] > 0.9) & (rms(found)[:4] < 1.12)), rms(found)
    # a mean's noise is drawn four times only: chance alone gives 0.5 to 1.6
    assert rms(found)[4:].max() < 1.7
    if strength == 1.0:
        assert rms(without)[4] > 2.5


def test_the_pull_of_a_pattern_goes_with_the_difference_of_steps():
    """It is a deterministic cause: two steps with the same motion have the same pull, and their difference has none."""
    images, _ = taken(columns=1.5)
    _, motion, lines = measured(images)
    causes = motion.causes
    assert causes.columns == ("sensor",) == causes.separate
    mean = [
        area_statistics(motion, motion.uvw_mm[..., 0], 0.0 * motion.x_px, motion.valid, shared=shared, common=c)
        for shared in [SharedPixels.of(motion, SUBSET)]
        for c in (motion.common[..., 3, :], motion.common[..., 3, :])
    ]
    one, two = (part.mean_reading for part in mean)
    assert one.budget.sensor == pytest.approx(abs(np.nanmean(lines.pull_mm[..., 0])), rel=1e-3)
    assert np.isnan(one.sigma_calibration)
    assert difference(one, two).sigma == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("kind", "before"),
    [({"new_columns": 3.0}, "1.4 to 1.55"), ({"new_rows": 3.0}, "0.65"), ({"wide_px": 0.9}, "1.15 to 1.3")],
)
def test_a_shapes_sigma_holds_noise_that_is_not_white(kind, before):
    found = []
    for seed in range(3):
        images, _ = taken(seed, **kind)
        shape, motion, lines = measured(images)
        assert lines is None, "new in each frame, it is no fixed pattern"
        found.append(over_sigma(shape, motion))
    assert 0.85 < rms(found)[0] < 1.15, f"{rms(found)[0]:.2f}, before {before}"


def test_lines_are_told_from_texture_and_from_those_of_another_frame():
    images, _ = taken(columns=1.0, new_rows=1.0)
    columns, later = (strips_along(image, 0) for image in images[::2])
    rows, rows_later = (strips_along(image, 1) for image in images[::2])
    for one, two, true in ((columns, columns, 1.0), (columns, later, 1.0), (rows, rows, 1.0), (rows, rows_later, 0.0)):
        found, sd = line_covariance(one, two)
        assert found == pytest.approx(true, abs=5.0 * sd + 0.1)
    assert np.isnan(line_covariance(columns[:3], columns[:3])).all()


def even_field(fixed, dead, rng, frames=12):
    """Frames of a diffuser under uneven light."""
    y, x = np.mgrid[:SIZE, :SIZE]
    light = 120.0 + 20.0 * np.cos((x - 150.0) / 200.0) - 0.05 * y
    greys = [np.where(dead, 255.0, light + fixed + rng.normal(0.0, 2.0, light.shape)) for _ in range(frames)]
    return [np.clip(np.rint(grey), 0, 255).astype(np.uint8) for grey in greys]


def test_a_map_from_an_even_field_takes_the_pattern_off_every_image(tmp_path):
    """Through the file: what is left of columns of 1.5 and pixels of 1 neither pulls nor is seen."""
    rng = np.random.default_rng(11)
    fixed = [1.5 * rng.standard_normal(SIZE)[None] + rng.standard_normal((SIZE, SIZE)) for _ in range(2)]
    dead = rng.random((SIZE, SIZE)) < 0.004
    frames = [even_field(one, dead, rng) for one in fixed]
    models = {cam: replace(measure_noise(f), sensor=measure_pattern(f)) for cam, f in zip(CAMERAS, frames, strict=True)}
    write_noise(tmp_path / "noise.json", noise_content(models))
    loaded = load_noise(tmp_path / "noise.json")
    for k, model in enumerate(loaded.models):
        np.testing.assert_array_equal(model.sensor.defects, np.flatnonzero(dead))
        left = (model.sensor.pattern - fixed[k])[~dead]
        assert left.std() < 0.65, "noise of 12 frames"
        assert loaded.record()[CAMERAS[k]]["sensor"]["defective_pixels"] == dead.sum()
        np.testing.assert_allclose(model.averaged(4, 16.0).sensor.pattern, 16.0 * model.sensor.pattern)
    found = []
    for seed in range(2):
        noise = np.random.default_rng(seed)
        grey = [image + fixed[k % 2] + noise.normal(0.0, 2.0, image.shape) for k, image in enumerate(clean())]
        images = [np.clip(np.rint(np.where(dead, 255.0, g)), 0, 255).astype(np.uint8) for g in grey]
        pair = [MeasureImage(image, noise=loaded.models[k % 2]) for k, image in enumerate(images)]
        assert all(np.isin(np.flatnonzero(dead), image.defects).all() for image in pair)
        shape, motion, lines = measured(pair)
        assert lines is None
        found.append(over_sigma(shape, motion))
    assert np.all((rms(found)[:4] > 0.85) & (rms(found)[:4] < 1.15)), rms(found)


@pytest.mark.parametrize("blur_px", [0.0, 3.0])
def test_a_specimen_is_no_even_field_in_focus_or_nearly(blur_px):
    images = [taken(seed)[0][0] for seed in range(3)]
    with pytest.raises(ImageError) as raised:
        measure_pattern([gaussian_filter(i.astype(np.float32), blur_px) if blur_px else i for i in images])
    assert raised.value.code == "frames_not_even"


def test_a_map_of_another_window_of_the_sensor_is_refused():
    rng = np.random.default_rng(2)
    sensor = measure_pattern(even_field(np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE), bool), rng, frames=2))
    model = NoiseModel(coefficients=(4.0, 0.0, 0.0), sensor=sensor)
    with pytest.raises(ImageError) as raised:
        MeasureImage(np.zeros((SIZE, SIZE - 2), np.uint8), "left.tif", noise=model)
    assert raised.value.code == "image_size_mismatch"
    assert "left.tif" in raised.value.cause
