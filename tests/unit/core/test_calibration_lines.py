"""Intersections that share pieces of line: the adjustment against generalised least squares written out."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest

from stereorig.core.calibration import CalibrationOptions, CalibrationView, calibrate
from tests.support.calibration_truth import HELD, NOMINAL, Array, Grid, make_views

LAG_ONE = -0.2


@dataclass(frozen=True)
class Offsets:
    """Offsets across lines at 45 degrees, neighbours along a line anticorrelated."""

    normal_a: Array
    normal_b: Array
    covariance_a: Array
    covariance_b: Array


def offsets(sigma_px: float) -> Offsets:
    line = sigma_px**2 * (np.eye(9) + LAG_ONE * (np.eye(9, k=1) + np.eye(9, k=-1)))
    a, b = np.full((9, 9, 2), np.sqrt(0.5)), np.full((9, 9, 2), np.sqrt(0.5))
    b[..., 0] *= -1.0
    return Offsets(a, b, np.tile(line, (9, 1, 1)), np.tile(line, (9, 1, 1)))


def draw(rng: np.random.Generator, given: Offsets) -> Array:
    """Errors (9, 9, 2) of intersections with these offsets."""
    root = np.linalg.cholesky(given.covariance_a[0])
    a = rng.standard_normal((9, 9)) @ root.T  # along b
    b = (rng.standard_normal((9, 9)) @ root.T).T  # along a
    N = np.stack([given.normal_a, given.normal_b], axis=-2)
    return np.asarray(np.linalg.solve(N, np.stack([a, b], axis=-1)[..., None])[..., 0])


def views(seed: int, sigma_px: float = 0.003) -> list[CalibrationView]:
    rng = np.random.default_rng(seed)
    given = offsets(sigma_px)
    return [
        dataclasses.replace(v, xy_px=v.xy_px + draw(rng, given), sigma_px=sigma_px, offsets=given)
        for v in make_views(noise=0.0)
    ]


@pytest.mark.normal_depth("0.0")
@pytest.mark.parametrize("tolerance", [0.0, 0.004])
def test_the_parameters_scatter_as_their_covariance_says(tolerance: float) -> None:
    options = CalibrationOptions(lens="paper", axis_tilt_sigma_rad=0.0)
    squared, found = [], []
    truth = calibrate(make_views((0.0, 5.0), noise=0.0), Grid(), NOMINAL, options)
    for seed in range(24):
        rng = np.random.default_rng(900 + seed)
        grid = Grid(node_tolerance_mm=tolerance)
        given = offsets(0.003)
        error = rng.standard_normal((9, 9, 2)) * tolerance / np.sqrt(3.0)
        own = [
            dataclasses.replace(v, xy_px=v.xy_px + draw(rng, given), sigma_px=0.003, offsets=given)
            for v in make_views((0.0, 5.0), noise=0.0, grid=grid, error_mm=error)
        ]
        result = calibrate(own, grid, NOMINAL, options)
        off = np.array([result.pair.values()[n] - truth.pair.values()[n] for n in result.names])
        scale = np.sqrt(np.diagonal(result.covariance))
        whitened = np.linalg.solve(np.linalg.cholesky(result.covariance / scale / scale[:, None]), off / scale)
        squared.append(float(np.mean(whitened**2)))
        found.append(result.noise_px.mean())
    # 24 runs of 20 figures know their mean to 6 %; with the points taken as independent it is 0.6
    assert np.mean(squared) == pytest.approx(1.0, abs=0.2)
    assert np.mean(found) == pytest.approx(0.003, rel=0.05)


def test_the_covariance_is_that_of_generalised_least_squares() -> None:
    """Exact grid: the parameters' covariance shrinks as J' C^-1 J does with the full matrix of a view."""
    options = dataclasses.replace(HELD, lens="paper", axis_tilt_sigma_rad=0.0, aspect_sigma=0.0)
    correlated = calibrate(views(3), Grid(), NOMINAL, options)
    independent = calibrate([dataclasses.replace(v, offsets=None) for v in views(3)], Grid(), NOMINAL, options)
    # smooth changes of the image average anticorrelated errors better: the variance of a mean along a line falls by
    # 1 + 2 rho (1 - 1/n), along both families alike
    ratio = correlated.uncertainty.shape_rms_mm / independent.uncertainty.shape_rms_mm
    noise = correlated.noise_px.mean() / independent.noise_px.mean()
    assert (ratio / noise) ** 2 == pytest.approx(1.0 + 2.0 * LAG_ONE * (1.0 - 1.0 / 9.0), abs=0.06)


def test_missing_intersections_leave_the_others_covariance() -> None:
    rng = np.random.default_rng(4)
    holes = []
    for v in views(5):
        xy = v.xy_px.copy()
        xy[rng.random((9, 9)) < 0.15] = np.nan
        holes.append(dataclasses.replace(v, xy_px=xy))
    grid = Grid(node_tolerance_mm=0.001)
    result = calibrate(holes, grid, NOMINAL, dataclasses.replace(HELD, lens="paper"))
    assert result.held_out is not None
    assert result.held_out.mean.rbe_px < 0.006
    np.testing.assert_allclose(result.noise_px, 0.003, rtol=0.2)
