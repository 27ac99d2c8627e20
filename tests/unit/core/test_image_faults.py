"""Faults of pictures by formula: lattices, raw mosaics, two fields, rows of other moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, shift

from stereorig.core.field.checks.epipolar_offset import rows_not_together
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.seeding.diagnosis import diagnose
from stereorig.core.field.seeding.image_faults import blur_px, field_shift_px, mosaic_share, period_px
from stereorig.core.measure import MeasureOptions, ReferencePair
from tests.support import field_bench as bench

MOTION = (0.02, -0.013, 0.03, 0.0006, -0.0004, 0.001)
RNG = np.random.default_rng(5)


def digitised(image, noise=2.0):
    return np.clip(np.rint(image + RNG.normal(0.0, noise, image.shape)), 0, 255).astype(np.uint8)


def speckle(width=1.5, seed=0):
    raw = gaussian_filter(np.random.default_rng(seed).standard_normal((400, 480)), width)
    return 128.0 + 45.0 * raw / raw.std()


def lattice(pitch, jitter):
    rng, image = np.random.default_rng(2), np.zeros((400, 480))
    y, x = np.mgrid[:400, :480].astype(float)
    for i in range(-60, 61):
        for j in range(-60, 61):
            a, b = (pitch * (v + jitter * rng.standard_normal()) for v in (i, j))
            cx, cy = 240 + a - 0.1 * b, 200 + 0.1 * a + b
            if 0 < cx < 480 and 0 < cy < 400:
                part = np.s_[max(int(cy) - 6, 0) : int(cy) + 8, max(int(cx) - 6, 0) : int(cx) + 8]
                image[part] += 1.0 / (1.0 + np.exp((np.hypot(x[part] - cx, y[part] - cy) - pitch / 4) / 0.4))
    return 200.0 - 150.0 * np.clip(image, 0.0, 1.0)


@pytest.mark.fault(66)
@pytest.mark.parametrize("jitter", [0.0, 0.06])
@pytest.mark.parametrize("pitch", [8.0, 12.0])
def test_a_lattice_is_told_with_its_period_also_if_its_dots_are_off(pitch, jitter):
    assert period_px(digitised(lattice(pitch, jitter))) == pytest.approx(pitch * np.hypot(1.0, 0.1), rel=0.03)


@pytest.mark.fault(66)
@pytest.mark.parametrize("width", [0.8, 1.5, 3.0, 8.0])
def test_speckle_has_no_period_no_mosaic_and_no_fields(width):
    image = digitised(speckle(width))
    assert period_px(image) is None
    assert mosaic_share(image) is None
    assert abs(field_shift_px(image)) < 0.1


@pytest.mark.fault(66)
def test_dots_on_a_lattice_and_a_raw_mosaic_are_named_as_the_cause():
    grid = digitised(lattice(8.0, 0.06))
    one = MeasureImage(np.ascontiguousarray(grid[: bench.SIZE[1], : bench.SIZE[0]]))
    two = MeasureImage(np.ascontiguousarray(grid[13 : 13 + bench.SIZE[1], 9 : 9 + bench.SIZE[0]]))
    found = diagnose(bench.pair(), (one, two))
    assert found.finding == "repeating"
    assert "repeats itself every 8.0 px" in found.text
    raw = []
    for image in bench.take("block"):
        cells = image.astype(float)
        cells[0::2, 0::2] *= 0.7
        cells[1::2, 1::2] *= 0.55
        raw.append(MeasureImage(cells.astype(np.uint8)))
    found = diagnose(bench.pair(), (raw[0], raw[1]))
    assert found.finding == "mosaic"
    assert "raw Bayer mosaic" in found.text
    assert "demosaiced" in found.remedy


@pytest.mark.fault(66)
@pytest.mark.parametrize("apart", [0.0, 0.5, 2.0, -4.0])
def test_two_fields_are_found_with_their_distance(apart):
    image = speckle(2.0)
    image[1::2] = shift(image, (0.0, apart), mode="nearest")[1::2]
    assert field_shift_px(digitised(image)) == pytest.approx(apart, abs=0.05)


@pytest.mark.parametrize("px", [1.0, 2.0])
def test_a_gaussian_blur_is_told_by_its_width(px):
    image = speckle(1.8)
    assert blur_px(digitised(image), digitised(gaussian_filter(image, px))) == pytest.approx(px, rel=0.12)
    assert blur_px(digitised(image), digitised(image)) < 0.3


def warped(image, across, down):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]].astype(float)
    return map_coordinates(image.astype(float), [y - down, x - across], order=3, mode="nearest")


@pytest.mark.fault(66)
def test_rows_of_other_moments_are_named_and_a_refocused_or_turned_camera_is_not():
    reference, now = bench.take("block", 0.0, MOTION), bench.take("block", 1.0, MOTION, seed=1)
    grid, rows, cols = bench.grid(spacing_px=8.0), *now[0].shape
    y, x = np.mgrid[:rows, :cols].astype(float)
    per_row, per_col = y / rows - 0.5, x / rows - 0.5 * cols / rows
    options = MeasureOptions(subset_px=21, patch="affine")

    def told(one, two):
        images = [np.clip(np.rint(i), 0, 255).astype(np.uint8) for i in (one, two)]
        field = ReferencePair(bench.pair(), *reference).motion(*images, grid, options)
        assert field.valid.mean() > 0.95
        return rows_not_together(field, 0.02), field

    rolled, field = told(warped(now[0], 0.0, 1.5 * per_row), now[1])
    assert rolled is not None
    assert "camera 1 or of camera 2 were not exposed at one instant" in rolled
    assert rows_not_together(replace(field, uvw_mm=None), 0.02) is None
    for one, two in (
        (now[0], now[1]),
        (now[0], warped(now[1], 1.5 * per_col, 1.5 * per_row)),
        (now[0], warped(now[1], -1.5 * per_row, 1.5 * per_col)),
        (now[0], warped(now[1], 0.0, 0.6)),
    ):
        assert told(one, two)[0] is None
