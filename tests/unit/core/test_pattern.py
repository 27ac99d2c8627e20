"""Pattern size: against the texture's own two-point statistics, counted on the formula, and against Gaussian fields."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.pattern import pattern_size
from stereorig.sim.texture import Texture, speckle
from tests.support.texture_width import two_point_width_mm

_PIXEL_WIDTH = 2.355 / np.sqrt(6.0)  # of the autocorrelation of a pixel's square, as a Gaussian's


def painted(texture: Texture, px_mm: float, size: tuple[int, int], fine: int = 4) -> NDArray[np.float64]:
    """The texture over square pixels, each the mean of what it sees."""
    rows, cols = size
    y, x = np.meshgrid(*((np.arange(n * fine) + 0.5) / fine * px_mm for n in size), indexing="ij")
    return texture.value(np.stack([x, y], axis=-1)).reshape(rows, fine, cols, fine).mean(axis=(1, 3))


@pytest.mark.parametrize("feature_px", [4.0, 7.0, 12.0])
def test_speckles_are_as_large_as_their_formula_says(feature_px: float) -> None:
    texture = speckle(diameter_mm=0.2, seed=3)
    true_mm = two_point_width_mm(texture)
    px_mm = true_mm / feature_px
    image = 200.0 * painted(texture, px_mm, (400, 420))
    found = pattern_size(image)
    assert found is not None
    # a pixel's own square widens what it sees, the more the smaller the feature
    assert found.feature_px == pytest.approx(np.hypot(feature_px, _PIXEL_WIDTH), rel=0.06)


def test_neither_noise_nor_light_changes_the_size() -> None:
    texture = speckle(diameter_mm=0.2, seed=4)
    clean = 150.0 * painted(texture, 0.04, (300, 300))
    y, x = np.mgrid[:300, :300] / 300.0
    noisy = clean + 60.0 * (x - 0.5) ** 2 + 40.0 * y + np.random.default_rng(1).normal(0.0, 8.0, clean.shape)
    alone, besides = pattern_size(clean), pattern_size(noisy)
    assert alone is not None
    assert besides is not None
    assert besides.feature_px == pytest.approx(alone.feature_px, rel=0.03)
    assert besides.contrast_grey == pytest.approx(clean.std(), rel=0.1)


def test_a_gaussian_fields_width_is_known() -> None:
    # blurred white noise of sd s has the autocorrelation exp(-r^2 / 4 s^2): full width 4 s sqrt(ln 2)
    field = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(600, 600)), (0, 0), sigmaX=3.0, sigmaY=2.0)
    found = pattern_size(field)
    assert found is not None
    assert found.width_x_px == pytest.approx(4 * 3.0 * np.sqrt(np.log(2)), rel=0.04)
    assert found.width_y_px == pytest.approx(4 * 2.0 * np.sqrt(np.log(2)), rel=0.04)


def test_only_the_region_counts() -> None:
    rng = np.random.default_rng(8)
    fine, coarse = (cv2.GaussianBlur(rng.normal(size=(300, 300)), (0, 0), s) for s in (1.5, 6.0))
    image = np.where(np.arange(300) < 150, fine / fine.std(), coarse / coarse.std())
    inside = np.zeros(image.shape, dtype=bool)
    inside[20:280, 5:145] = True
    inside[100:140, 60:90] = False  # a hole
    found = pattern_size(image, inside)
    assert found is not None
    assert found.feature_px == pytest.approx(4 * 1.5 * np.sqrt(np.log(2)), rel=0.06)


@pytest.mark.parametrize("image", [np.full((100, 100), 7), np.zeros((8, 300)), np.tile(np.arange(300.0), (300, 1))])
def test_what_has_no_pattern_has_no_size(image: NDArray[np.float64]) -> None:
    assert pattern_size(image) is None
    assert pattern_size(image, np.zeros(image.shape, dtype=bool)) is None
