"""Spline coefficients and gradients against scipy's recursive prefilter and B-spline tables."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import correlate1d, gaussian_filter, map_coordinates, spline_filter

from stereorig.core.matching import prepare
from stereorig.core.matching.filters import correlate, derivative
from stereorig.core.matching.image import PAD
from stereorig.core.noise import NoiseModel
from stereorig.core.threads import available_threads, set_threads, threads

ORDER = {"cubic": 3, "quintic": 5}


def textured(shape, scale, seed=1):
    rng = np.random.default_rng(seed)
    image = gaussian_filter(rng.normal(size=shape), 1.2)
    return (0.5 + 0.16 * image / image.std()) * scale


@pytest.mark.parametrize("interpolation", ["cubic", "quintic"])
@pytest.mark.parametrize(
    ("dtype", "scale"), [(np.uint8, 255), (np.uint16, 4095), (np.uint16, 65535), (np.float64, 1.0), (np.int32, 9e4)]
)
@pytest.mark.parametrize("shape", [(16, 16), (37, 18), (700, 90)])
def test_coefficients_are_the_recursive_ones_to_float32(interpolation, dtype, scale, shape):
    image = np.clip(textured(shape, scale), 0, scale).astype(dtype)
    expected = spline_filter(image.astype(float), ORDER[interpolation], mode="mirror")
    got = prepare(image, interpolation).coefficients
    assert got.dtype == np.float32
    assert np.abs(got[PAD:-PAD, PAD:-PAD] - expected).max() < 2e-6 * np.abs(expected).max()
    np.testing.assert_array_equal(got, np.pad(got[PAD:-PAD, PAD:-PAD], PAD, mode="reflect"))


@pytest.mark.parametrize("order", [3, 5])
def test_derivative_taps_give_the_splines_slopes(order):
    image, h = textured((90, 70), 255).astype(np.float32), 1e-4
    spline = spline_filter(image.astype(float), order, mode="mirror")
    y, x = np.mgrid[:90, :70].astype(float)

    def at(dx, dy):
        return map_coordinates(spline, [y + dy, x + dx], order=order, mode="mirror", prefilter=False)

    def along(axis, image):
        out = np.empty(image.shape, np.float32)
        taps = [np.ones(1), np.ones(1)]
        taps[axis] = derivative(order)
        correlate(image, *taps, out)
        return out

    np.testing.assert_allclose(along(1, image), (at(h, 0) - at(-h, 0)) / (2 * h), atol=3e-4)
    np.testing.assert_allclose(along(0, image), (at(0, h) - at(0, -h)) / (2 * h), atol=3e-4)
    # a parabola's slope is known
    parabola = np.add.outer(np.zeros(60), 0.01 * np.arange(60.0) ** 2)
    np.testing.assert_allclose(along(1, parabola)[30, 25:35], 0.02 * np.arange(25, 35), atol=1e-5)


def test_threads_do_not_change_the_result():
    image = textured((900, 130), 255).astype(np.float32)
    before = threads()
    try:
        set_threads(1)
        one = prepare(image)
        gradient = one.gradients[1]
        set_threads(available_threads())
        many = prepare(image)
        np.testing.assert_allclose(many.coefficients, one.coefficients, rtol=0, atol=1e-4)
        np.testing.assert_allclose(many.gradients[1], gradient, rtol=0, atol=1e-4)
    finally:
        set_threads(before)


def test_a_prepared_image_does_not_follow_a_reused_buffer():
    image = np.clip(textured((40, 40), 255), 0, 255).astype(np.uint8)
    kept = prepare(image)
    expected = image.astype(np.float32)
    slope = correlate1d(expected, [-0.5, 0.0, 0.5], axis=1, mode="mirror")
    image[:] = 0
    np.testing.assert_array_equal(kept.pixels, expected)
    assert np.corrcoef(kept.gradients[0].ravel(), slope.ravel())[0, 1] > 0.9


def test_a_noise_model_weighs_pixels_by_their_level():
    model = NoiseModel(coefficients=(1.0, 0.2, 0.0), range_grey=(0.0, 255.0))
    grey = 20.0 + 200.0 * (np.indices((60, 80))[1] > 39)
    noisy = grey + np.sqrt(model.variance(grey)) * np.random.default_rng(0).normal(size=grey.shape)
    image = prepare(noisy, noise=model)
    sides = [np.s_[4:-4, 4:34], np.s_[4:-4, 44:76]]
    variances = [image.noise_variance / image.weights[side].mean() for side in sides]
    np.testing.assert_allclose(variances, model.variance([20.0, 220.0]), rtol=0.03)
    assert image.weights.mean() == pytest.approx(1.0, rel=0.05)
    assert prepare(noisy).weights is None
    assert prepare(noisy).noise_variance is None
