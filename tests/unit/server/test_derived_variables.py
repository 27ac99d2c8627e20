"""The size of a displacement and its standard deviation, against many draws."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.server.formats.results.derived import derive, derived_names, magnitude
from stereorig.server.formats.results.layout import packed


def test_the_size_of_a_displacement_scatters_as_told() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(3, 3)) * 1e-3
    covariance, uvw = root @ root.T, np.array([0.03, -0.1, 0.07])
    size, sigma = magnitude(uvw, covariance)
    drawn = np.linalg.norm(rng.multivariate_normal(uvw, covariance, size=40_000), axis=-1)
    assert size == pytest.approx(np.sqrt(0.03**2 + 0.1**2 + 0.07**2))
    # the scatter of 40,000 draws is known to 1 / sqrt(2 * 40,000) = 0.4 %; here to four times that
    assert sigma == pytest.approx(drawn.std(), rel=0.014)


def test_a_point_that_did_not_move_has_no_direction_and_so_no_standard_deviation() -> None:
    size, sigma = magnitude(np.zeros(3), np.eye(3))
    assert size == 0.0
    assert np.isnan(sigma)


def test_it_is_derived_from_the_packed_covariance_and_only_where_there_is_a_displacement() -> None:
    c = np.diag([9.0, 9.0, 9.0, 1.0, 4.0, 16.0]) * 1e-6
    held = {name: np.full((1, 2), value) for name, value in (("u_mm", 0.0), ("v_mm", 0.0), ("w_mm", -0.2))}
    held["covariance"] = np.broadcast_to(packed(c), (1, 2, 21))
    assert derived_names(held) == ["d_mm", "sigma_d_mm"]
    assert derive(held, "d_mm") == pytest.approx(np.full((1, 2), 0.2))
    assert derive(held, "sigma_d_mm") == pytest.approx(np.full((1, 2), 4e-3))
    assert derived_names({"z_mm": held["w_mm"], "covariance": held["covariance"]}) == []
