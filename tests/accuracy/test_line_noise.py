"""What lines of a grid claim of their errors, against repeated pictures of a renderer apart."""

from __future__ import annotations

import pytest

from tests.support.line_noise import clean_pictures, scatter_over_claim

REPEATS = 24


@pytest.mark.normal_depth("2.0-True")
@pytest.mark.parametrize(("noise", "photons"), [(1.0, False), (2.0, True)])
def test_a_lines_offsets_scatter_as_claimed_whatever_the_blur_and_the_noise(noise: float, photons: bool) -> None:
    for name, grey in clean_pictures().items():
        ratios = scatter_over_claim(grey, noise, REPEATS, photons=photons)
        # 5 lines of 5 intersections in 24 pictures: sd of chi^2 over its 600 is 0.058
        assert ratios == pytest.approx((1.0, 1.0), abs=0.15), name
