"""The focus figure of a picture: highest where it is sharp, whatever the exposure, and missing where it is dark."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from stereorig.server.results.images.quality import image_quality

_OVER = 4  # samples a pixel
_BLURS_PX = (0.0, 0.7, 1.5, 2.5, 4.0)


def _speckles(rng: np.random.Generator, size_px: float, pixels: int = 256) -> NDArray[np.float64]:
    """Dots (white 0, black 1) of a diameter, drawn four times finer than the pixels."""
    side = pixels * _OVER
    out = np.zeros((side, side))
    y, x = np.mgrid[-8:9, -8:9] if size_px < 4 else np.mgrid[-20:21, -20:21]
    half = x.shape[0] // 2
    for cx, cy in rng.integers(half, side - half, size=(int(0.5 * pixels**2 / (np.pi * size_px**2 / 4)), 2)):
        dot = np.hypot(x, y) <= 0.5 * size_px * _OVER
        out[cy - half : cy + half + 1, cx - half : cx + half + 1][dot] = 1.0
    return out


def _frame(rng: np.random.Generator, dots: NDArray[np.float64], blur_px: float, exposure: float) -> NDArray[Any]:
    """Camera's picture: the lens blurs, pixels take the mean, photons and reading out add noise."""
    blurred = gaussian_filter(dots, blur_px * _OVER) if blur_px else dots
    side = blurred.shape[0] // _OVER
    light = (20.0 + 160.0 * (1.0 - blurred.reshape(side, _OVER, side, _OVER).mean(axis=(1, 3)))) * exposure
    noisy = light + rng.normal(size=light.shape) * np.sqrt(1.0 + 0.02 * light)
    frame: NDArray[Any] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return frame


@pytest.mark.parametrize("size_px", [3.5, 6.0])
def test_the_focus_figure_is_highest_in_focus_and_does_not_follow_the_exposure(size_px: float) -> None:
    rng = np.random.default_rng(5)
    dots = _speckles(rng, size_px)
    figures = np.array(
        [[image_quality(_frame(rng, dots, b, e), 8).focus for e in (1.0, 0.3, 0.1)] for b in _BLURS_PX], dtype=float
    )
    sharp = figures[:-1]  # at a tenth of the light the last is all but noise
    assert (np.diff(figures[:, 0]) < 0.0).all()
    # a thirtieth of the contrast's square beside the noise: what is left of it is known to a few parts in a hundred
    assert np.ptp(sharp[:3], axis=1).max() < 0.02
    assert (np.diff(figures[:3], axis=0) < 0.0).all()


@pytest.mark.parametrize("exposure", [0.01, 0.0])
def test_a_picture_of_nothing_but_noise_has_no_focus_figure(exposure: float) -> None:
    rng = np.random.default_rng(6)
    quality = image_quality(_frame(rng, _speckles(rng, 5.0), 0.5, exposure), 8)
    assert quality.focus is None
    assert quality.as_dict()["focus"] is None
    assert quality.code == "dark"


def test_strong_defocus_is_told_although_noise_has_a_gradient_of_its_own() -> None:
    rng = np.random.default_rng(7)
    assert image_quality(_frame(rng, _speckles(rng, 6.0), 4.0, 1.0), 8).code == "blurred"


@pytest.mark.parametrize(
    ("bit_depth", "grey"),
    [
        (16, lambda share: np.minimum(share, 1.0) * 4095 // 1 * 16),  # 12 bits to the left of 16
        (16, lambda share: np.minimum(share, 1.0) * 4095 // 1),
        (12, lambda share: np.minimum(share, 1.0) * 4095 // 1),
        (8, lambda share: 16 + np.minimum(share, 1.0) * 219 // 1),  # video: black is 16, white 235
        (8, lambda share: np.minimum(share, 1.0) * 255 // 1),
    ],
)
@pytest.mark.parametrize("gain", [0.7, 1.5])
def test_saturation_is_found_wherever_the_camera_puts_its_bits(bit_depth, grey, gain):
    share = gain * np.random.default_rng(1).uniform(0.1, 1.0, (200, 200))
    pixels = grey(share).astype(np.uint8 if bit_depth == 8 else np.uint16)
    found = image_quality(pixels, bit_depth).saturated_share
    assert abs(found - np.mean(share >= 1.0)) < 0.003
