"""The page's noise estimate: drawn noise of overlapping subsets under a smooth deformation comes out as drawn."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import fftconvolve

from stereorig.core.field.points.shared_pixels import SharedPixels
from tests.bench.accuracy.rapid_noise import observed_over_reported, window_slope

SUBSET, STEP = 33, 11  # a subset of 3 x 3 steps, drawn as sums of white cells
SHARED = SharedPixels(SUBSET)


@pytest.mark.parametrize(("window", "axis"), [(1, 0), (5, 0), (9, 1)])
def test_noise_is_seen_as_drawn_under_a_deformation(window: int, axis: int) -> None:
    rng = np.random.default_rng(4)
    cells = rng.normal(0.0, 1.0 / 3.0, (203, 403))
    noise = fftconvolve(cells, np.ones((3, 3)), mode="valid")  # sd 1, shares pixels as the subsets do
    x, y = np.meshgrid(np.linspace(-1, 1, noise.shape[1]), np.linspace(-1, 1, noise.shape[0]))
    field = 2.0 * noise + 3e3 * (x + 0.4 * x**2 - 0.2 * x**3 + x * y**2)
    weights = np.ones((1, 1)) if window == 1 else window_slope(window, axis)
    values = fftconvolve(field, weights[::-1, ::-1], mode="valid")
    # an unbiased estimate: the scatter of many copies
    copies = fftconvolve(
        fftconvolve(rng.normal(0.0, 1.0 / 3.0, (603, 603)), np.ones((3, 3)), mode="valid"),
        weights[::-1, ::-1],
        mode="valid",
    )
    reported = np.full(values.shape, copies.std())
    for lag in (1, 2, 4):
        assert observed_over_reported(values, reported, weights, SHARED, STEP, lag) == pytest.approx(2.0, rel=0.06)
