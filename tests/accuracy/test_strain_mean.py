"""The uncertainty of a strain's mean over an area, against the scatter of fields with pixel noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.field.smoothed import smoothed_displacement
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.core.strain.mean import mean_strain_sigma
from tests.support.gauge_field import SUBSET, make_field, pixel_noise, surface

TURN = Rotation.from_rotvec([0.1, -0.2, 0.4]).as_matrix()


@pytest.mark.normal_depth("infinitesimal-3-1-0", "hencky-7-2-0")
@pytest.mark.parametrize(
    ("tensor", "window", "order", "smooth"),
    [("green_lagrange", 5, 1, 0), ("hencky", 7, 2, 0), ("infinitesimal", 3, 1, 0), ("green_lagrange", 5, 1, 3)],
)
def test_reported_uncertainty_is_the_scatter(tensor, window, order, smooth):
    failed = np.zeros((14, 17), bool)
    failed[6:8, 4:6] = True
    # small strain assumes small rotations; how the others' frames turn under noise does not enter
    turn = np.eye(3) if tensor == "infinitesimal" else TURN
    field = make_field(lambda X: 1.01 * X @ turn.T, shape=surface, failed=failed)
    options = StrainOptions(window=window, order=order, tensor=tensor)
    areas = [np.ones(field.shape, bool), np.zeros(field.shape, bool), np.zeros(field.shape, bool)]
    areas[1][4:10, 8:13] = True  # inside
    areas[2][5, 9] = True  # one point: its own uncertainty
    found = []
    for errors in pixel_noise(np.random.default_rng(window), field, 400):
        copy = replace(field, xyz_mm=field.xyz_mm + errors[..., :3], uvw_mm=field.uvw_mm + errors[..., 3:])
        copy = smoothed_displacement(copy, smooth, subset_px=SUBSET) if smooth else copy
        strain = surface_strain(copy, options, subset_px=SUBSET)
        found.append([strain.strain[strain.valid & area].mean(axis=0) for area in areas])
    measured = smoothed_displacement(field, smooth, subset_px=SUBSET) if smooth else field
    sigma = np.array([mean_strain_sigma(measured, options, area, subset_px=SUBSET)[0] for area in areas])
    ratio = sigma / np.std(found, axis=0, ddof=1)  # each to 3.5 %
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    assert np.abs(ratio - 1.0).max() < 0.13, ratio
    own = surface_strain(measured, options, subset_px=SUBSET)
    np.testing.assert_allclose(sigma[2], own.sigma[5, 9], rtol=0.1)


def test_no_strain_no_uncertainty():
    field = make_field(lambda X: X)
    nowhere = np.zeros(field.shape, bool)
    assert np.isnan(mean_strain_sigma(field, StrainOptions(), nowhere, subset_px=SUBSET)).all()
