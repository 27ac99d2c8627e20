"""A noise model in the matching: less scatter under shot noise, and the true standard uncertainty reported."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.matching import MatchOptions, fit_shape, prepare
from stereorig.core.noise import NoiseModel
from tests.support.matching_scene import Plane, Texture, paper_pair, render, true_w

SIZE = 260
MODEL = NoiseModel(coefficients=(0.5, 0.0, 0.0022), range_grey=(0.0, 255.0))  # sd 1.4 at 25, 10 at 215
XY = np.stack([v.ravel() for v in np.meshgrid(np.arange(26, SIZE - 26, 22.0), np.arange(26, SIZE - 26, 22.0))], -1)


@pytest.fixture(scope="module")
def scatter():
    """Empirical and reported sd of w0 over its truth, with and without the model."""
    pair = paper_pair(size=SIZE)
    clean = [render(camera, Plane(), Texture(), size=SIZE) for camera in (pair.cam1, pair.cam2)]
    w = true_w(pair.cam1, Plane(), XY)
    rng = np.random.default_rng(11)
    options = MatchOptions(subset_px=21)
    found = {True: ([], []), False: ([], [])}
    for _ in range(40):
        noisy = [c + np.sqrt(MODEL.variance(c)) * rng.normal(size=c.shape) for c in clean]
        for used, (errors, reported) in found.items():
            fit = fit_shape(pair, *(prepare(i, noise=MODEL if used else None) for i in noisy), XY, w, options)
            assert (fit.status == 0).all()
            errors.append(fit.w[:, 0] / w[:, 0] - 1.0)
            reported.append(fit.covariance[:, 0, 0] / w[:, 0] ** 2)
    return {
        used: (np.sqrt(np.var(errors, axis=0, ddof=1).mean()), np.sqrt(np.mean(reported)), np.mean(errors))
        for used, (errors, reported) in found.items()
    }


def test_weights_lower_the_scatter(scatter):
    assert scatter[True][0] < 0.95 * scatter[False][0]


@pytest.mark.parametrize("used", [True, False])
def test_the_reported_scatter_is_the_real_one(scatter, used):
    empirical, reported, mean = scatter[used]
    assert 0.93 < reported / empirical < 1.07  # its own chance is 1 %
    assert abs(mean) < 4 * empirical / np.sqrt(40 * len(XY))
