"""Reported uncertainty of strain against the scatter of many noisy fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import correlate, uniform_filter

from stereorig.core.field.points.patch import asked_for
from stereorig.core.field.points.shared_pixels import SharedPixels
from stereorig.core.strain import StrainOptions, surface_strain
from tests.support.strain_fields import make_field, plane, turned

SUBSET, STEP, SHAPE = 21, 8, (17, 19)
SIGMA = np.array([1e-4, 0.5e-4, 2e-4, 1.5e-4, 2e-4, 4e-4])
MOTIONS = {
    "small": np.diag([1.0005, 0.9998, 1.0]),
    "out of its plane by 0.1": turned((0.3, 1.0, 0.0), np.degrees(0.1)) @ np.diag([1.0005, 0.9998, 1.0]),
    "large": turned((1.0, 2.0, 3.0), 25.0) @ np.array([[1.15, 0.05, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]]),
}


def _subset_means(rng, components):
    """(r, c, n) means of white noise over each point's subset, one standard deviation each."""
    rows, cols = ((n - 1) * STEP + SUBSET for n in SHAPE)
    white = rng.standard_normal((rows, cols, components)) * SUBSET
    means = uniform_filter(white, size=(SUBSET, SUBSET, 1))
    half = SUBSET // 2
    return means[half : rows - half : STEP, half : cols - half : STEP]


@pytest.mark.normal_depth("green_lagrange-2-small", "hencky-1-large")
@pytest.mark.parametrize("motion", list(MOTIONS))
@pytest.mark.parametrize(
    ("tensor", "order"), [("green_lagrange", 1), ("green_lagrange", 2), ("infinitesimal", 1), ("hencky", 1)]
)
def test_reported_over_empirical(motion, tensor, order):
    """In the middle, at an edge, and beside a hole: white noise averaged over overlapping subsets."""
    rng = np.random.default_rng(5)
    clean = make_field(plane, lambda p: p @ MOTIONS[motion].T, shape=SHAPE, spacing_px=STEP)
    mix = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    root = np.diag(SIGMA) @ mix  # a covariance that is not diagonal after the rotation below
    root = np.linalg.qr(rng.standard_normal((6, 6)))[0] @ root
    covariance = np.broadcast_to(root @ root.T, (*SHAPE, 6, 6))
    status = clean.status.copy()
    status[12, 6:9] = 5
    options = StrainOptions(window=7, tensor=tensor, order=order)
    found, last = [], None
    for _ in range(200):
        e = _subset_means(rng, 6) @ root.T
        noisy = replace(
            clean,
            xyz_mm=clean.xyz_mm + e[..., :3],
            uvw_mm=clean.uvw_mm + e[..., 3:],
            status=status,
            covariance=covariance,
        )
        strain = surface_strain(noisy, options, subset_px=SUBSET)
        found.append(strain.strain)
        last = strain
    empirical = np.std(found, axis=0)
    both = last.sigma / empirical
    whole = np.zeros(SHAPE, bool)
    whole[3:8, 3:-3] = True
    cut = last.valid & ~whole
    for where in (whole, cut):
        for k in range(3):
            ratio = np.sqrt(np.mean(both[where][:, k] ** 2))
            assert 0.95 < ratio < 1.06, f"component {k}: {ratio}"


@pytest.mark.parametrize("tensor", ["green_lagrange", "infinitesimal"])
def test_noise_of_the_positions_alone_where_the_surface_leaves_its_plane(tensor):
    """Depth is ten times as noisy as motion, as with a narrow stereo angle; the part leaves its plane by 0.1."""
    sigma = np.array([1e-4, 1e-4, 1e-3, 1e-4, 1e-4, 1e-4])
    rng = np.random.default_rng(8)
    clean = make_field(plane, lambda p: p @ MOTIONS["out of its plane by 0.1"].T, shape=SHAPE, spacing_px=STEP)
    covariance = np.broadcast_to(np.diag(sigma**2), (*SHAPE, 6, 6))
    found = []
    for _ in range(200):
        e = _subset_means(rng, 6) * sigma
        noisy = replace(
            clean, xyz_mm=clean.xyz_mm + e[..., :3], uvw_mm=clean.uvw_mm + e[..., 3:], covariance=covariance
        )
        strain = surface_strain(noisy, StrainOptions(window=7, tensor=tensor), subset_px=SUBSET)
        found.append(strain.strain)
    inner = (slice(3, -3), slice(3, -3))
    ratio = strain.sigma[inner] / np.std(found, axis=0)[inner]
    for k in range(3):  # the scatter of 200 fields of some dozen independent windows: 2 %
        assert 0.94 < np.sqrt(np.mean(ratio[..., k] ** 2)) < 1.06, f"component {k}: {ratio[..., k].mean()}"


@pytest.mark.parametrize("steepness", [0.0, 0.3, 1.0, 4.0])
def test_bias_of_one_sided_windows_stays_below_what_is_reported(steepness):
    """From no gradient over one about as large as the noise to steep: rms error and reported uncertainty agree."""
    rng = np.random.default_rng(9)
    sigma = np.full(6, 1e-4)
    k = steepness * 1.2e-3  # 1/mm

    def pull(p):
        x, y = p[..., 0], p[..., 1]
        return p + np.stack([0.5 * k * x**2 + 0.2 * k * x * y, -0.3 * k * x * y, 0 * x], axis=-1)

    clean = make_field(lambda a, b: np.stack([a, b, 0 * a], axis=-1), pull, shape=SHAPE, spacing_px=STEP)
    x, y = clean.xyz_mm[..., 0], clean.xyz_mm[..., 1]
    exact = np.stack([k * x + 0.2 * k * y, -0.3 * k * x, 0.5 * (0.2 * k * x - 0.3 * k * y)], axis=-1)
    covariance = np.broadcast_to(np.diag(sigma**2), (*SHAPE, 6, 6))
    errors, reported = [], []
    for _ in range(60):
        e = _subset_means(rng, 6) * sigma
        noisy = replace(clean, uvw_mm=clean.uvw_mm + e[..., 3:], covariance=covariance)
        strain = surface_strain(noisy, StrainOptions(window=7, tensor="infinitesimal"), subset_px=SUBSET)
        errors.append(strain.strain - exact)
        reported.append(strain.sigma)
    cut = strain.valid.copy()
    cut[3:-3, 3:-3] = False
    errors, reported = np.array(errors)[:, cut], np.sqrt(np.mean(np.square(reported), axis=0))[cut]
    bias = np.abs(errors.mean(axis=0))
    assert (bias < reported).mean() > 0.98  # the mean of 60 repeats keeps an eighth of the noise
    # the choice itself follows the noise where both orders are about as good: a fifth
    ratio = np.sqrt((errors**2).mean(axis=0).mean(axis=0) / (reported**2).mean(axis=0))
    assert (ratio > 0.8).all()
    assert (ratio < 1.25).all()


def test_principal_scatter():
    """Where strain is large against its noise the principal values' uncertainty is theirs."""
    rng = np.random.default_rng(6)
    clean = make_field(plane, lambda p: p @ MOTIONS["large"].T, shape=SHAPE, spacing_px=STEP)
    covariance = np.broadcast_to(np.diag(SIGMA**2), (*SHAPE, 6, 6))
    found, last = [], None
    for _ in range(200):
        e = _subset_means(rng, 6) * SIGMA
        noisy = replace(
            clean, xyz_mm=clean.xyz_mm + e[..., :3], uvw_mm=clean.uvw_mm + e[..., 3:], covariance=covariance
        )
        last = surface_strain(noisy, StrainOptions(window=7), subset_px=SUBSET)
        found.append(last.principal)
    ratio = (last.sigma_principal / np.std(found, axis=0))[3:-3, 3:-3]
    assert np.sqrt(np.mean(ratio**2, axis=(0, 1))) == pytest.approx([1.0, 1.0], abs=0.06)


def test_correlation_of_curved_patches():
    """Weights of the value in the middle of a second-order fit, found by least squares over the pixels."""
    side = np.arange(SUBSET) - SUBSET // 2
    y, x = np.meshgrid(side, side, indexing="ij")
    A = np.stack([0 * x + 1, x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6).astype(float)
    weight = np.linalg.pinv(A)[0].reshape(SUBSET, SUBSET)
    big = np.pad(weight, SUBSET)
    all_lags = correlate(big, weight, mode="constant")
    middle = np.array(all_lags.shape) // 2
    for dx, dy in ((0, 0), (5, 0), (7, 3), (12, 12), (20, 0), (21, 0), (40, 2)):
        expected = 0.0
        if max(dx, dy) < SUBSET:
            expected = all_lags[middle[0] + dy, middle[1] + dx] / all_lags[middle[0], middle[1]]
        correlation = SharedPixels(SUBSET, curved=True).correlation(np.array([float(dx)]), np.array([-float(dy)]))[0]
        assert correlation == pytest.approx(expected, abs=0.01)


def test_curved_patches_scatter_less_over_a_gauge():
    """Their neighbours go together less, so a gauge gains more by averaging them."""
    plain = make_field(plane, lambda p: p, shape=SHAPE, spacing_px=STEP)
    bent = replace(plain, patch=asked_for("quadratic", "quadratic"))
    one, two = (surface_strain(f, StrainOptions(window=7), subset_px=SUBSET) for f in (plain, bent))
    assert np.nanmedian(two.sigma) < 0.9 * np.nanmedian(one.sigma)
