"""A smooth offset that no moved camera makes is stated as an error of lens or calibration, noise is not."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from stereorig.core.field.checks.epipolar_offset import check_epipolar
from stereorig.core.field.points.result import Field
from tests.support.strain_fields import MM_PER_PX, make_field

SHAPE = (41, 51)


def flat(offset_px: np.ndarray) -> Field:
    field = make_field(
        lambda a, b: np.stack([a, b, np.zeros_like(a)], axis=-1), lambda x: x, shape=SHAPE, spacing_px=10.0
    )
    field.epipolar_px[...] = offset_px
    return field


def noise(sd: float) -> np.ndarray:
    """As of overlapping subsets, three points wide."""
    white = uniform_filter(np.random.default_rng(4).normal(size=SHAPE), 3, mode="wrap")
    return np.asarray(sd * white / white.std())


def corners(height: float) -> np.ndarray:
    y, x = np.mgrid[-1.0 : 1.0 : SHAPE[0] * 1j, -1.0 : 1.0 : SHAPE[1] * 1j]
    return np.asarray(height * (np.hypot(x, y) / np.sqrt(2.0)) ** 5)


def test_what_a_lens_leaves_in_the_corners_is_stated_in_px_and_um() -> None:
    true = corners(0.15)
    y, x = np.mgrid[-1.0 : 1.0 : SHAPE[0] * 1j, -1.0 : 1.0 : SHAPE[1] * 1j]
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    beyond = true.ravel() - terms @ np.linalg.lstsq(terms, true.ravel(), rcond=None)[0]
    check = check_epipolar(flat(true + noise(0.004)), 0.01)
    assert check is not None
    rms = float(np.sqrt(np.mean(beyond**2)))
    # medians of blocks flatten a corner's peak by a part
    np.testing.assert_allclose(check.misfit_px, rms, rtol=0.35)
    assert 0.3 * np.abs(beyond).max() < check.misfit_max_px < 1.2 * np.abs(beyond).max()
    assert check.misfit_um is not None
    np.testing.assert_allclose(check.misfit_um, 1e3 * MM_PER_PX * check.misfit_px, rtol=1e-6)
    assert "lens model" in check.reason


def test_noise_and_a_moved_camera_are_no_misfit() -> None:
    y, x = np.mgrid[-1.0 : 1.0 : SHAPE[0] * 1j, -1.0 : 1.0 : SHAPE[1] * 1j]
    for sd in (0.002, 0.02):
        check = check_epipolar(flat(0.1 + 0.05 * x - 0.02 * x * y + noise(sd)), 0.01)
        assert check is not None
        assert check.misfit_px < max(0.4 * sd, 1e-3)
        assert "lens model" not in check.reason
