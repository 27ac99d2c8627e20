"""The derivative under noise: compared with the gradients of the noise-free picture, which the filter never sees."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import correlate, correlate1d, gaussian_filter

from stereorig.core.matching.filters import derivative
from stereorig.core.matching.odd_filters import filter_both
from stereorig.core.matching.slopes import slope_filter
from stereorig.core.threads import available_threads, set_threads
from stereorig.core.threads import threads as numbers_of_threads

SHAPE = (400, 420)


def texture(kind, seed=2):
    """Grey levels and their exact derivatives, by Fourier."""
    rng = np.random.default_rng(seed)
    ky, kx = np.meshgrid(*(2 * np.pi * np.fft.fftfreq(n) for n in SHAPE), indexing="ij")
    sigma = {"fine": (1.0, 1.0), "coarse": (2.5, 2.5), "brushed": (1.0, 4.0)}[kind]
    spectrum = np.fft.fft2(rng.normal(size=SHAPE)) * np.exp(-0.5 * ((sigma[0] * ky) ** 2 + (sigma[1] * kx) ** 2))
    grey, gx, gy = (np.fft.ifft2(spectrum * f).real for f in (1.0, 1j * kx, 1j * ky))
    scale = 40.0 / grey.std()
    return 120.0 + grey * scale, gx * scale, gy * scale


def compared(filtered, true):
    """Information kept (1 at best) and sensitivity over sum of squares (1 where no noise is left to take out)."""
    kept = (filtered * true).sum() ** 2 / ((filtered**2).sum() * (true**2).sum())
    return kept, (filtered * true).sum() / (filtered**2).sum()


@pytest.mark.parametrize("kind", ["fine", "coarse", "brushed"])
@pytest.mark.parametrize("noise", [2.0, 6.0])
@pytest.mark.parametrize("known", [True, False])
def test_more_information_than_the_spline_and_nothing_to_take_out(kind, noise, known):
    grey, *true = texture(kind)
    image = grey + noise * np.random.default_rng(5).normal(size=SHAPE)
    found = slope_filter(image, 5, noise**2 if known else None)
    for axis, (filtered, exact) in enumerate(zip(found.apply(image), true, strict=True)):
        for order in (3, 5):
            plain = correlate1d(image, derivative(order), axis=1 - axis, mode="mirror")
            # a little is given away at the highest frequencies, which the spline between the pixels cannot carry
            gained = 0.005 if noise > 2.0 else -0.001
            assert compared(filtered, exact)[0] > compared(plain, exact)[0] + gained
        ratio = compared(filtered, exact)[1]
        assert abs(ratio - 1.0) < (0.02 if known else 0.04)
    if not known:
        assert 0.85 < np.sqrt(found.noise_variance) / noise < 1.1
    gained = found.apply(np.random.default_rng(6).normal(size=SHAPE))
    assert np.mean([g.var() for g in gained]) == pytest.approx(found.gain, rel=0.02)
    np.testing.assert_array_equal(found.along_x, -found.along_x[::-1, ::-1])


@pytest.mark.parametrize("threads", [1, 2])
def test_both_filters_are_scipys_correlation_on_a_mirrored_image(threads):
    rng = np.random.default_rng(3)
    taps = rng.normal(size=(2, 7, 7))
    before = numbers_of_threads()
    set_threads(min(threads, available_threads()))
    try:
        for shape, kind in (((261, 70), np.uint8), ((129, 40), np.uint16), ((16, 20), np.float64)):
            image = rng.uniform(0.0, 255.0, shape).astype(kind)
            for one, found in zip(taps, filter_both(image, *taps), strict=True):
                exact = correlate(image.astype(np.float64), one, mode="mirror")
                # float32: 49 products of 255 and taps of about 1
                np.testing.assert_allclose(found, exact, atol=2e-3)
    finally:
        set_threads(before)


@pytest.mark.parametrize("kind", ["fine", "coarse"])
def test_without_noise_it_is_the_derivative(kind):
    grey, *true = texture(kind)
    found = slope_filter(grey, 5)
    assert found.noise_variance < 1e-4
    for filtered, exact in zip(found.apply(grey), true, strict=True):
        kept, ratio = compared(filtered[8:-8, 8:-8], exact[8:-8, 8:-8])
        assert kept > 0.994
        assert abs(ratio - 1.0) < 0.008


def test_blank_parts_and_shading_do_not_spoil_it():
    grey, *true = texture("fine")
    rng = np.random.default_rng(1)
    grey[:, 200:] = 230.0
    grey += np.linspace(0, 60, SHAPE[0])[:, None]
    noisy = grey + 6.0 * rng.normal(size=SHAPE)
    found = slope_filter(noisy, 5)
    whole = slope_filter(texture("fine")[0] + 6.0 * rng.normal(size=SHAPE), 5)
    part = np.s_[8:-8, 8:190]
    for mine, best, exact in zip(found.apply(noisy), whole.apply(noisy), true, strict=True):
        kept, ratio = compared(mine[part] - mine[part].mean(), exact[part])
        assert kept > compared(best[part] - best[part].mean(), exact[part])[0] - 0.01
        assert abs(ratio - 1.0) < 0.05


def test_sixteen_bits_and_eight_agree():
    grey = np.clip(texture("fine")[0] + 3.0 * np.random.default_rng(1).normal(size=SHAPE), 0, 255)
    eight, sixteen = slope_filter(np.rint(grey).astype(np.uint8), 5), slope_filter((grey * 257).astype(np.uint16), 5)
    np.testing.assert_allclose(sixteen.along_x, eight.along_x, atol=0.01)
    assert sixteen.noise_variance == pytest.approx(257**2 * eight.noise_variance, rel=0.05)


@pytest.mark.parametrize("image", [np.full((64, 64), 7, np.uint8), np.full((16, 30), 0.5)])
def test_a_blank_image_has_no_filter(image):
    assert slope_filter(image, 5) is None


def test_a_small_picture_is_enough():
    rng = np.random.default_rng(0)
    image = gaussian_filter(rng.normal(size=(16, 24)), 1.0) * 100 + rng.normal(size=(16, 24))
    gx, gy = slope_filter(image, 5).apply(image)
    assert np.corrcoef(gx[:, 1:-1].ravel(), (image[:, 2:] - image[:, :-2]).ravel())[0, 1] > 0.8
    assert np.isfinite(gy).all()
