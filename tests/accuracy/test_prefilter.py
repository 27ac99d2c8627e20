"""The Gaussian prefilter: noise and covariance against the scatter of repeated pictures, and refused inputs."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import correlate1d, gaussian_filter

from stereorig.core.errors import InputError, RegionError
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching import MatchOptions, fit_motion, fit_shape, prepare
from stereorig.core.matching.blur import Blur, spread_of
from stereorig.core.matching.filters import derivative
from stereorig.core.matching.slopes import slope_filter
from stereorig.core.measure import MeasureOptions, ReferencePair, measure_shape
from stereorig.core.noise import NoiseModel
from stereorig.core.status import PointStatus
from tests.support import field_bench
from tests.support.matching_scene import Plane, Texture, digitise, paper_pair, render, true_g, true_w

SIZE = 220
SUBSET = 33
MOVED = Plane(origin=np.array([0.0123, -0.0071, 0.011]))


@lru_cache(maxsize=1)
def scene():
    pair = paper_pair(size=SIZE)
    before, after, texture = Plane(), MOVED, Texture(blob_mm=0.045)
    clean = [render(c, p, texture, size=SIZE) for p in (before, after) for c in (pair.cam1, pair.cam2)]
    v = np.arange(30, SIZE - 30, SUBSET)
    xy = np.stack([a.ravel() for a in np.meshgrid(v, v)], -1).astype(float)
    return pair, clean, xy, true_w(pair.cam1, before, xy), true_g(pair.cam1, before, after, xy)


@pytest.mark.normal_depth("1.0-2.0-True")
@pytest.mark.parametrize(
    ("sd", "noise", "known"), [(0.5, 2.0, True), (1.0, 6.0, False), (1.0, 2.0, True), (2.0, 6.0, True)]
)
def test_reported_uncertainty_is_the_scatter(sd, noise, known):
    pair, clean, xy, w, G = scene()
    model = NoiseModel(coefficients=(noise**2 + 1.0 / 12.0, 0.0, 0.0)) if known else None
    rng = np.random.default_rng(11)
    errors, reported, levels = [], [], []
    for _ in range(60):
        images = [prepare(digitise(c, noise=noise, rng=rng), noise=model, blur=Blur(sd)) for c in clean]
        fit = fit_motion(pair, *images, xy, w, G, MatchOptions(subset_px=SUBSET))
        assert (fit.status == PointStatus.OK).all()
        errors.append(np.concatenate([fit.w[:, :1], fit.G[:, :, 0]], axis=1))
        reported.append(np.diagonal(fit.covariance, axis1=1, axis2=2)[:, :4])
        levels.append(fit.noise)
    ratio = np.sqrt(np.mean(reported, axis=(0, 1)) / np.mean(np.var(errors, axis=0, ddof=1), axis=0))
    # 36 points, 60 pictures: each ratio to 1.5 %
    assert (ratio > 0.94).all(), ratio
    assert (ratio < 1.06).all(), ratio
    expected = np.sqrt((noise**2 + 1.0 / 12.0) * Blur(sd).gain)
    assert np.sqrt(np.mean(np.square(levels))) == pytest.approx(expected, rel=0.05)


def test_the_gain_and_the_noise_model_are_those_of_filtered_noise():
    noise = np.random.default_rng(3).normal(scale=4.0, size=(600, 600))
    for sd in (0.5, 1.3):
        out = gaussian_filter(noise, sd, mode="mirror", truncate=8.0)
        np.testing.assert_allclose(Blur(sd).apply(noise), out, atol=0.01)
        assert Blur(sd).gain * 16.0 == pytest.approx(out.var(), rel=0.02)
        lag = (out[:, 1:] * out[:, :-1]).mean() / out.var()
        assert Blur(sd).correlation_at(np.array([0, 1, -1, 99])) == pytest.approx([1.0, lag, lag, 0.0], abs=0.01)
    model = NoiseModel(coefficients=(2.0, 0.05, 0.0), range_grey=(0.0, 255.0))
    image = prepare(np.full((64, 64), 100.0) + noise[:64, :64], noise=model, blur=Blur(1.0))
    assert image.noise_variance == pytest.approx(7.0 * Blur(1.0).gain, rel=0.01)


def test_spread_of_a_wave_is_that_of_its_frequency():
    """A sine's gradient meets the noise at one frequency alone: the spread there is its power spectrum."""
    x = np.arange(256)
    blur = Blur(1.0)
    for period in (8.0, 16.0):
        k = 2.0 * np.pi / period
        wave = (np.cos(k * x)[None, :] * np.ones((256, 1))).astype(np.float32)
        found = spread_of(blur, (wave, wave.T.copy()), 65)[128, 128]
        # one wave runs along x, one along y: each at frequency k one way and 0 the other, where the blur passes all
        expected = np.exp(-(k**2)) / blur.gain
        assert found == pytest.approx(expected, rel=0.06)


def test_gradients_of_blurred_pictures_are_the_blurred_pictures_gradients():
    rng = np.random.default_rng(5)
    grey = gaussian_filter(rng.normal(size=(300, 300)), 1.5)
    grey *= 40.0 / grey.std()
    noisy = grey + 4.0 * rng.normal(size=grey.shape)
    blur = Blur(1.0)
    found = slope_filter(blur.apply(noisy), 5, blur=blur, unblurred=noisy)
    assert found is not None
    assert np.sqrt(found.noise_variance / blur.gain) == pytest.approx(4.0, rel=0.1)
    true = correlate1d(gaussian_filter(grey, 1.0), derivative(5), axis=1)[8:-8, 8:-8]
    got = found.apply(blur.apply(noisy))[0][8:-8, 8:-8]
    assert (got * true).sum() / (true**2).sum() == pytest.approx(1.0, abs=0.03)
    white = blur.apply(rng.normal(size=(600, 600)))
    gained = np.mean([g.var() for g in found.apply(white)]) / white.var()
    assert gained == pytest.approx(found.gain, rel=0.03)


@pytest.mark.parametrize("sd", [-0.5, float("nan"), float("inf"), 8.5, True])
def test_silly_values_are_refused(sd):
    with pytest.raises(InputError) as caught:
        MeasureOptions(subset_px=33, prefilter_px=sd)
    assert caught.value.code == "prefilter_invalid"
    assert caught.value.remedy


def test_images_blurred_unalike_are_refused():
    pair, clean, xy, w, _ = scene()
    with pytest.raises(InputError) as caught:
        fit_shape(pair, prepare(clean[0], blur=Blur(1.0)), prepare(clean[1]), xy, w)
    assert caught.value.code == "blur_mismatch"


def test_a_field_with_a_prefilter():
    """Truth by the renderer; points whose blur would lack pixels are left out, and what is reported is the scatter."""
    grid = PointGrid.rectangle(16, 16, field_bench.SIZE[0] - 17, field_bench.SIZE[1] - 17, spacing_px=8.0)
    options = MeasureOptions(subset_px=31, patch="affine", prefilter_px=1.0)
    reference = ReferencePair(field_bench.pair(), *field_bench.take("strip"))
    shape = reference.shape(grid, options)
    moved = reference.motion(*field_bench.take("strip", 1.0, seed=5), grid, options, shape=shape)
    near = (grid.x_px < 15 + 3) | (grid.y_px < 15 + 3)
    assert near.any()
    assert (shape.status[near] == PointStatus.OUTSIDE_IMAGE).all()
    truth = field_bench.truth(grid, field_bench.scene("strip"), field_bench.scene("strip", 1.0))
    inner = (grid.x_px > 34) & (grid.y_px > 34) & (grid.x_px < 228) & (grid.y_px < 188)
    assert moved.valid[inner].mean() > 0.97
    ok = moved.valid
    error = (moved.uvw_mm - truth.uvw_mm)[ok]
    reported = np.sqrt(np.mean(moved.sigma_mm[ok][:, 3:] ** 2, axis=0))
    ratio = reported / np.sqrt(np.mean(error**2, axis=0))
    assert (ratio > 0.8).all(), ratio
    assert (ratio < 1.25).all(), ratio


@pytest.mark.fault(36)
def test_noise_is_not_taken_for_texture():
    """FAULTS 36: blurred noise looks like a pattern; what shows noise alone before the blur is refused."""
    one, two = (image.copy() for image in field_bench.take("strip"))
    rng = np.random.default_rng(8)
    for image in (one, two):
        image[:, 130:] = np.clip(np.rint(128.0 + 3.0 * rng.normal(size=image[:, 130:].shape)), 0, 255)
    grid = field_bench.grid()
    options = MeasureOptions(subset_px=21, patch="affine", prefilter_px=2.0)
    field = measure_shape(field_bench.pair(), one, two, grid, options)
    assert field.valid[grid.x_px < 115].mean() > 0.9
    assert not field.valid[grid.x_px > 145].any()


def test_a_region_at_the_border_alone_is_refused():
    one, two = field_bench.take("strip")
    grid = PointGrid.rectangle(10, 1, 60, 9, spacing_px=1.0)
    with pytest.raises(RegionError) as caught:
        measure_shape(field_bench.pair(), one, two, grid, MeasureOptions(subset_px=9, prefilter_px=2.0, patch="affine"))
    assert caught.value.code == "region_too_small"
