"""Smoothed displacements: polynomials by hand, uncertainty by repeated noise, windows that end where they must."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.smoothed import smoothed_displacement
from stereorig.core.gauge.area import area_statistics
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.strain import StrainOptions, surface_strain
from tests.support.gauge_field import STEP, SUBSET, make_field, pixel_noise


def quadratic(X: Float) -> Float:
    """In the image's columns and rows, of which X and Y are multiples, and Z is not used."""
    x, y = X[..., 0], X[..., 1]
    u = 0.01 + 0.002 * x - 0.001 * y + 0.0004 * x * x - 0.0007 * x * y + 0.0003 * y * y
    return X + np.stack([u, -2.0 * u, 0.5 * u * 0 + 0.004 * x], axis=-1)


def flat(x_px: Float, y_px: Float) -> Float:
    x, y = 0.02 * (x_px - 200.0), 0.02 * (y_px - 150.0)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def by_hand(field: Field, r: int, c: int, seen: NDArray[np.bool_], terms: int = 6) -> Float:
    """numpy's own least squares over the points that are given."""
    rows, cols = np.nonzero(seen)
    y, x = rows - float(r), cols - float(c)
    A = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)[:, :terms]
    return np.linalg.lstsq(A, field.uvw_mm[rows, cols], rcond=None)[0][0]


def test_a_quadratic_stays_and_a_fit_is_numpys():
    failed = np.zeros((14, 17), bool)
    failed[4:6, 6] = failed[9, 12:15] = True
    field = make_field(quadratic, shape=flat, failed=failed)
    same = smoothed_displacement(field, 5, subset_px=SUBSET)
    # in the corners, nine points that share pixels: a quadratic would be noisier than the point itself
    corners = np.zeros(failed.shape, bool)
    corners[::13, ::16] = True
    np.testing.assert_allclose(same.uvw_mm[~corners], field.uvw_mm[~corners], atol=1e-12)
    np.testing.assert_array_equal(same.status, field.status)
    assert np.isnan(same.uvw_mm[failed]).all()
    noisy = replace(field, uvw_mm=field.uvw_mm + np.random.default_rng(1).normal(size=field.uvw_mm.shape))
    got = smoothed_displacement(noisy, 5, subset_px=SUBSET)
    window = np.zeros(failed.shape, bool)
    window[8:13, 4:9] = True
    np.testing.assert_allclose(got.uvw_mm[10, 6], by_hand(noisy, 10, 6, window), atol=1e-12)
    window = np.zeros(failed.shape, bool)
    window[0:3, 0:3] = True
    np.testing.assert_allclose(got.uvw_mm[0, 0], by_hand(noisy, 0, 0, window, terms=3), atol=1e-12)
    window = np.zeros(failed.shape, bool)
    window[0:3, 6:11] = True  # an edge
    np.testing.assert_allclose(got.uvw_mm[0, 8], by_hand(noisy, 0, 8, window), atol=1e-12)
    summary = got.smoothing
    assert summary is not None
    assert (summary.window, summary.resolution_px) == (5, 4 * STEP + SUBSET)
    assert summary.resolution_mm == pytest.approx(0.02 * summary.resolution_px, rel=1e-6)
    assert summary.whole + summary.reduced + summary.raw == field.valid.sum()
    assert summary.whole > 0
    assert summary.reduced > 0


def test_nothing_reaches_over_a_cut_or_a_lost_line():
    """Two halves that move apart: each keeps its own displacement, to the lip."""
    lost = np.zeros((14, 17), bool)
    lost[:, 8] = True
    step = lambda X: X + np.where(X[..., :1] < -1.5, 0.0, 1.0) * np.array([1.0, 0.0, 0.0])  # noqa: E731
    line = np.array([[40.0 + 8.5 * STEP, 0.0], [40.0 + 8.5 * STEP, 400.0]])
    for more in ({"failed": lost}, {"cuts": Cuts((line,))}):
        field = make_field(step, shape=flat, **more)
        right_half = (field.x_px > 40 + 8 * STEP).astype(float)
        uvw = field.uvw_mm.copy()
        uvw[..., 0] = np.where(field.valid, right_half, np.nan)
        got = smoothed_displacement(replace(field, uvw_mm=uvw), 7, subset_px=SUBSET)
        np.testing.assert_allclose(got.uvw_mm[..., 0], uvw[..., 0], atol=1e-9)


def test_a_lone_line_of_points_keeps_its_values():
    failed = np.ones((14, 17), bool)
    failed[7, :] = False
    field = make_field(quadratic, shape=flat, failed=failed)
    got = smoothed_displacement(field, 5, subset_px=SUBSET)
    assert got.smoothing is not None
    assert got.smoothing.raw == 17
    np.testing.assert_array_equal(got.uvw_mm, field.uvw_mm)
    np.testing.assert_allclose(got.covariance[7], field.covariance[7], rtol=1e-12)


@pytest.mark.normal_depth("3-1")
@pytest.mark.parametrize(("window", "order"), [(3, 1), (5, 2), (9, 2)])
def test_reported_uncertainty_is_the_scatter(window, order):
    """Points, differences, mean, extensometer and strain of smoothed fields against 600 fields of pixel noise."""
    failed = np.zeros((14, 17), bool)
    failed[5:8, 9:11] = True
    field = make_field(lambda X: 1.001 * X, shape=flat, failed=failed, growing=False)
    noise = pixel_noise(np.random.default_rng(window), field, 600)
    ends = (40.0 + 2 * STEP, 60.0 + 3 * STEP), (40.0 + 13.5 * STEP, 60.0 + 10.5 * STEP)
    uvw, means, stretches, strains = [], [], [], []
    options = StrainOptions(window=5)
    inside = np.ones(field.shape, bool)
    for errors in noise:
        copy = replace(field, xyz_mm=field.xyz_mm + errors[..., :3], uvw_mm=field.uvw_mm + errors[..., 3:])
        got = smoothed_displacement(copy, window, subset_px=SUBSET, order=order)
        shared = SharedPixels.of(got, SUBSET)
        uvw.append(got.uvw_mm)
        means.append(area_statistics(got, got.uvw_mm[..., 2], None, inside, shared=shared).mean)
        stretches.append(extensometer(got, *ends, shared=shared).elongation_mm.value)
        strains.append(surface_strain(got, options, subset_px=SUBSET).strain)
    smoothed = smoothed_displacement(field, window, subset_px=SUBSET, order=order)
    shared = SharedPixels.of(smoothed, SUBSET)
    ok = field.valid
    scatter = np.var(np.array(uvw)[:, ok], axis=0, ddof=1)
    ratio = np.sqrt(np.diagonal(smoothed.covariance[ok], axis1=1, axis2=2)[:, 3:] / scatter)
    assert ratio.mean() == pytest.approx(1.0, abs=0.02)
    assert np.abs(ratio - 1.0).max() < 0.15  # sd of one: 3 %
    mean = area_statistics(smoothed, smoothed.uvw_mm[..., 2], smoothed.sigma_mm[..., 5], inside, shared=shared)
    # sd 3 %; points at edges are taken for ones with whole windows, and they are a good part of this small field
    assert mean.mean_sigma / np.std(means, ddof=1) == pytest.approx(1.03, abs=0.1)
    reading = extensometer(smoothed, *ends, shared=shared).elongation_mm
    assert reading.sigma / np.std(stretches, ddof=1) == pytest.approx(1.0, abs=0.09)
    strain = surface_strain(smoothed, options, subset_px=SUBSET)
    assert strain.gauge_px == 4 * STEP + SUBSET + (window - 1) * STEP
    whole = np.zeros(field.shape, bool)
    whole[4 : 14 - 4, 4:6] = True
    both = strain.valid & whole
    empirical = np.std(np.array(strains)[:, both], axis=0, ddof=1)
    assert (strain.sigma[both] / empirical).mean() == pytest.approx(1.0, abs=0.05)


def test_neighbours_go_together_as_their_weights_say():
    """The correlation of two smoothed values against a plain sum over both windows and all pixels."""
    field = make_field(lambda X: X, shape=flat)
    smoothed = smoothed_displacement(field, 5, subset_px=SUBSET)
    shared = SharedPixels.of(smoothed, SUBSET)
    noise = pixel_noise(np.random.default_rng(4), field, 1500)[..., 3:4]
    c = np.linalg.lstsq(np.vander(np.arange(-2, 3), 3), np.eye(5), rcond=None)[0]
    assert c.shape == (3, 5)
    smooth = []
    for errors in noise:
        copy = replace(field, uvw_mm=np.concatenate([errors] * 3, axis=-1))
        smooth.append(smoothed_displacement(copy, 5, subset_px=SUBSET).uvw_mm[..., 0])
    values = np.array(smooth)
    for dr, dc in ((0, 1), (0, 3), (2, 2), (0, 5), (5, 6)):
        pairs = [np.corrcoef(values[:, r, k], values[:, r + dr, k + dc])[0, 1] for r in (3, 5) for k in (3, 5, 7)]
        found = shared.correlation(dc * STEP, dr * STEP)
        assert np.mean(pairs) == pytest.approx(float(found), abs=0.03)


@pytest.mark.parametrize("window", [2, 4, 1, 53, True, 0])
def test_windows_that_cannot_be(window):
    with pytest.raises(InputError) as caught:
        smoothed_displacement(make_field(lambda X: X), window, subset_px=SUBSET)
    assert caught.value.code == "smoothing_window_invalid"


def test_only_measured_displacements_are_smoothed():
    with pytest.raises(InputError) as caught:
        smoothed_displacement(make_field(None), 5, subset_px=SUBSET)
    assert caught.value.code == "smoothing_needs_motion"
    once = smoothed_displacement(make_field(lambda X: X), 5, subset_px=SUBSET)
    with pytest.raises(InputError) as caught:
        smoothed_displacement(once, 5, subset_px=SUBSET)
    assert caught.value.code == "smoothed_already"
